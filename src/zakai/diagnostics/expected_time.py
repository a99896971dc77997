"""How long a method takes for a record, measured on its first observations."""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

from zakai.engine.driver import check_records
from zakai.engine.first_intervals import first_intervals
from zakai.engine.loop import CHUNK, advance
from zakai.engine.plan import plan_of
from zakai.engine.setting import Setting
from zakai.errors import ZakaiError
from zakai.models.model import Model
from zakai.numerics.compiled import compiling, working_time
from zakai.records import Record
from zakai.records.schedule import Schedule

ENOUGH, LOADED = 0.8, 0.2  # seconds of observations from which the others are extrapolated, and of those before
AGAIN = 0.02  # seconds after which it is seen again whether a kernel has been compiled
FEW, MORE, MOST = 2, 16, 128  # intervals that are prepared to see what each of them costs; and filtered, at most


class Expected(NamedTuple):
    """Seconds for a whole record; with `at_least` they are a lower bound."""

    seconds: float
    at_least: bool = False

    def __str__(self) -> str:
        """As in "about 0.4 s"."""
        bound = "more than" if self.at_least else "about"
        return f"{bound} {self.seconds:.1g} s" if self.seconds < 9.5 else f"{bound} {self.seconds:.0f} s"


class _LateError(ZakaiError):
    """The time for a measurement is over."""


def expected_seconds(model: Model, record: Record, method: str = "auto", *, most: float = 2.5, **options: Any) -> Expected:
    """Return how long `zakai.filter` takes for a record, measured on its first observations and extrapolated.

    The time to compile kernels does not count, nor that to decide which methods hold. The estimate depends on the load of the
    machine; nothing that is computed may depend on it.

    Args:
        model: the system, with a prior.
        record: K observations of the model's kind.
        method: a method's name, or "auto".
        most: seconds after which the measurement ends, without those of compilation. In the main thread it ends within a step,
            elsewhere after one.
        **options: options of the method.

    Returns:
        The seconds; a lower bound where less than two observations could be filtered in time.

    Raises:
        InputError: a wrong record or option.
        ConditionError: the method does not hold.

    Example:
        model = zakai.load_model("gallery:benes")
        _, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        print(expected_seconds(model, record, "yau-yau"))
    """
    check_records(model, record)
    found = []
    unfit = first_intervals(model, record).fault
    runs = plan_of(model, model.prior, method, options, unfit=unfit).runs(record, "moments")
    for run in runs:
        found.append(_of_block(run.setting, run.schedule, run.values, most / len(runs)))
    return Expected(sum(one.seconds for one in found), any(one.at_least for one in found))


def _of_block(setting: Setting, schedule: Schedule, values: np.ndarray, most: float) -> Expected:
    """Return the time of one method for all intervals."""
    count = len(schedule)
    found, before = _Measured(ENOUGH), _Measured(LOADED)
    try:
        with _at_most(most):
            found.preparing, each = _preparation(setting, schedule)
            rows = int(np.clip(ENOUGH / max(each, 1e-9), min(MORE, count), min(MOST, count)))
            prepared = _prepare(setting, schedule.part(slice(0, rows)))
            _measure(setting, prepared, values[: min(MORE, rows)], before)  # loads kernels
            _measure(setting, prepared, values[:rows], found)
    except _LateError:
        pass
    times = found.times or before.times[1:]  # the first of those before waits for what is made once
    if not times:
        return Expected(max(most * count, found.preparing), True)
    # A filter adapts to the first observations.
    rate = float(np.mean(times[max(len(times) // 3, min(1, len(times) - 1)) :]))
    return Expected(found.preparing + times[0] + rate * (count - 1), len(times) == 1 and count > 1)


@dataclass
class _Measured:
    """What was measured until now: seconds for the preparation, and for each of the first observations."""

    enough: float
    preparing: float = 0.0
    times: list[float] = field(default_factory=list)


def _measure(setting: Setting, prepared: Any, values: np.ndarray, found: _Measured) -> None:
    """Filter observations, in segments that double, until it has taken long enough."""
    times, began = found.times, working_time()
    state, done, last = setting.method.init(prepared, setting.prior), 0, began

    def stepped() -> None:
        nonlocal last
        now = working_time()
        times.append(now - last)
        last = now

    while done < len(values) and (done < 2 or working_time() - began < found.enough):
        rows = slice(done, min(max(2 * done, done + 1), len(values)))
        last = working_time()
        with np.errstate(all="ignore"):
            states, _ = advance(setting, prepared, rows, state, values[rows], stepped)
        state, done = states[-1], rows.stop
        if len(times) < done:  # in one kernel
            times.extend([(working_time() - last) / (done - rows.start)] * (done - rows.start))


def _prepare(setting: Setting, schedule: Schedule) -> Any:
    """Return what is prepared for a schedule, which is not kept."""
    schedule = schedule.from_zero() if setting.autonomous else schedule
    return setting.method.prepare(setting.model, schedule, setting.theta, **setting.options)


def _preparation(setting: Setting, schedule: Schedule) -> tuple[float, float]:
    """Return the time to prepare a schedule, of what its chunks have in common and all intervals add; and of one interval."""
    count = len(schedule)
    spent = []
    for size in (min(FEW, count), min(MORE, count)):
        part = schedule.part(slice(0, size))
        _prepare(setting, part)  # compiles, and makes what is kept for the model
        before = working_time()
        _prepare(setting, part)
        spent.append((size, working_time() - before))
        if size == count:
            return spent[-1][1], spent[-1][1] / count
    (few, first), (more, second) = spent
    each = max(second - first, 0.0) / (more - few)
    chunks = -(-count // CHUNK)
    return chunks * max(first - few * each, 0.0) + each * count, each


@contextmanager
def _at_most(seconds: float) -> Iterator[None]:
    """Raise _LateError after some seconds, in the main thread of a system with interval timers; never elsewhere.

    The compilation of kernels does not count, and a kernel that is being compiled at that time is completed first.
    """
    timers = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not timers or signal.getitimer(signal.ITIMER_REAL)[0] > 0.0:
        yield
        return

    ends = working_time() + seconds

    def late(_: int, frame: FrameType | None) -> None:
        left = ends - working_time()
        if compiling() or left > 0.0 or _collecting(frame):
            signal.setitimer(signal.ITIMER_REAL, max(left, AGAIN))
            return
        raise _LateError(f"more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _collecting(frame: FrameType | None) -> bool:
    """Return whether a frame belongs to a callback of the garbage collection, in which an error would be ignored."""
    callbacks = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None:
        if frame.f_code in callbacks:
            return True
        frame = frame.f_back
    return False
