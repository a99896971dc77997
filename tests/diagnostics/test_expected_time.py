"""The expected time of a record: measured on its first observations, within bounds of its own."""

import gc
import threading
import time
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from numba import float64

import zakai
from zakai.diagnostics import expected_time
from zakai.diagnostics.expected_time import Expected, expected_seconds
from zakai.errors import ZakaiError
from zakai.numerics.compiled import compilation_time, kernel

PENDULUM = zakai.load_model("gallery:pendulum")


@pytest.mark.parametrize("count", [100, 1000])
def test_the_expected_time_is_that_of_the_observations_together(monkeypatch, count):
    """An observation takes .03 s on a clock of the test's own."""
    clock = [0.0]

    def advance(setting, prepared, rows, state, values, stepped):
        def after_one():
            clock[0] += 0.03
            stepped()

        return filtered(setting, prepared, rows, state, values, after_one)

    filtered = expected_time.advance
    monkeypatch.setattr(expected_time, "advance", advance)
    monkeypatch.setattr(expected_time, "working_time", lambda: clock[0])
    monkeypatch.setattr(expected_time, "_at_most", lambda _: nullcontext())
    _, record = zakai.simulate(PENDULUM, 0.02 * np.arange(1, count + 1), seed=0)
    expected = expected_seconds(PENDULUM, record, "yau-yau")
    assert not expected.at_least
    assert expected.seconds == pytest.approx(0.03 * count, rel=1e-9)


@pytest.mark.parametrize("interrupted", [True, False])
def test_a_slow_first_observation_gives_a_lower_bound(monkeypatch, interrupted):
    def slow(*_: object) -> None:
        for _ in range(40):
            time.sleep(0.01)
        raise AssertionError("the measurement was not interrupted")

    _, record = zakai.simulate(PENDULUM, 0.02 * np.arange(1, 101), seed=0)
    monkeypatch.setattr(expected_time, "advance", slow)
    found = []

    def measure() -> None:
        try:
            found.append(expected_seconds(PENDULUM, record, "yau-yau", most=0.2))
        except AssertionError as error:
            found.append(error)

    if interrupted:
        measure()
        assert found[0].at_least and found[0].seconds >= 20 - 1e-9 and str(found[0]) == "more than 20 s"
    else:  # only the main thread has a timer
        thread = threading.Thread(target=measure)
        thread.start()
        thread.join()
        assert isinstance(found[0], AssertionError)


def test_a_kernel_that_is_compiled_is_completed():
    loop = "    for k in range(9):\n        y += np.sin(y) / (k + y * y)\n"
    source = "def inner(x):\n    y = x\n" + 60 * loop + "    return y\n"
    names: dict[str, Any] = {"np": np}
    exec(source, names)  # without a file, so that it is not read from a cache
    compiled: Any = kernel(float64(float64))(names["inner"])
    with pytest.raises(ZakaiError, match="more than 0.01 s"), expected_time._at_most(0.01):
        compiled(1.0)
        time.sleep(2.0)
    assert len(compiled.signatures) == 1 and gc.isenabled()


def test_the_time_in_which_kernels_are_compiled_does_not_end_the_measurement():
    loop = "    for k in range(9):\n        y += np.sin(y) / (k + y * y)\n"
    names: dict[str, Any] = {"np": np}
    exec("def inner(x):\n    y = x\n" + 40 * loop + "    return y\n", names)  # without a file, so that it is compiled
    compiled: Any = kernel(float64(float64))(names["inner"])
    before = compilation_time()
    with expected_time._at_most(0.4):
        compiled(1.0)
    assert compilation_time() - before > 0.4


def test_the_time_is_not_over_in_a_callback_of_the_garbage_collection(monkeypatch):
    def slow(phase: str, info: object) -> None:
        ends = time.monotonic() + 0.2
        while time.monotonic() < ends:
            pass
        ended.append(phase)

    ended: list[str] = []
    monkeypatch.setattr(gc, "callbacks", [slow])
    with pytest.raises(ZakaiError, match="more than 0.05 s"), expected_time._at_most(0.05):
        gc.callbacks[0]("start", None)
        time.sleep(2.0)
    assert ended == ["start"]


def test_blocks_add_their_times_and_the_record_is_not_filtered_as_a_whole(monkeypatch):
    model = zakai.load_model("gallery:benes-2d")
    _, record = zakai.simulate(model, 0.01 * np.arange(1, 2001), seed=0)
    rows, own = [], expected_time.advance

    def counted(setting, prepared, part, state, values, stepped):
        rows.append(part.stop)
        return own(setting, prepared, part, state, values, stepped)

    monkeypatch.setattr(expected_time, "advance", counted)
    assert expected_seconds(model, record).seconds > 0
    assert max(rows) <= 128


def test_what_is_refused_by_the_filter_is_refused_here():
    _, record = zakai.simulate(PENDULUM, [0.1, 0.2], seed=0)
    with pytest.raises(zakai.ConditionError):
        expected_seconds(PENDULUM, record, "kalman-bucy")


@pytest.mark.parametrize(
    ("expected", "words"),
    [(Expected(0.0314), "about 0.03 s"), (Expected(4.4), "about 4 s"), (Expected(9.7), "about 10 s"),
     (Expected(161.2), "about 161 s"), (Expected(60.0, True), "more than 60 s")],
)  # fmt: skip
def test_the_words_have_the_digits_that_are_known(expected, words):
    assert str(expected) == words
