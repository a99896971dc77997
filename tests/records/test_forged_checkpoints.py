"""Whatever somebody writes into a checkpoint, and however right its hash is: it is refused, or a filter goes on from it."""

from __future__ import annotations

import copy
import json
import time
from collections import Counter

import numpy as np
import pytest

import zakai
from zakai.records.checkpoint import read_checkpoint, write_checkpoint

WORDS = [None, True, False, -1, 0, 1, 2.0, 1e300, 1e-300, np.nan, np.inf, "x", [], {}, 10**30, [[0.0]]]
BLOCKS = dict(
    state=["x", "y"],
    drift=["-x/2", "cos(y) - y"],
    observation=["2*x", "y"],
    prior={"kind": "gaussian", "mean": [0.3, 0.0], "cov": [[2.0, 0.0], [0.0, 1.0]]},
)

def model_of(name):
    return zakai.Model(**BLOCKS, observation_kind="increments") if name == "two blocks" else zakai.load_model(f"gallery:{name}")


def places(said, path=()):
    """The path of every part of what JSON says."""
    if path:
        yield path
    parts = said.items() if isinstance(said, dict) else enumerate(said) if isinstance(said, list) else ()
    for key, part in parts:
        yield from places(part, (*path, key))


def put(said, path, what):
    changed = part = copy.deepcopy(said)
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = what
    return changed


def forged(array):
    for number in (np.nan, -1.0, 0.0, 1e300, 1e-300, np.inf, -np.inf):
        yield np.full_like(array, number)
    yield from (-array, 1e6 * array, array.astype("<f4"), np.zeros(array.shape, "<i8"), np.ones(array.shape, bool))
    yield from (np.append(array, 1.0), array[None], np.zeros(0))
    if array.size > 1:
        yield np.where(np.arange(array.size).reshape(array.shape) == 0, np.nan, array)


def saved_after_a_few(path, model, method="auto"):
    """A filter that goes on, and what the checkpoint of one like it says."""
    online = zakai.online(model, method)
    for k in range(1, 6):
        online.update(0.01 * k, [0.01 * k] * model.m)
    online.save(path)
    online.update(0.06, [0.05] * model.m)
    return online, *read_checkpoint(path)


def numbers_of(estimate):
    values = [estimate.mean.tolist(), estimate.cov.tolist(), estimate.interval().tolist(), estimate.log_likelihood_increment]
    json.dumps([estimate.time, *values], allow_nan=False)
    assert (np.diag(estimate.cov) >= -1e-9 * np.abs(estimate.cov).max()).all() or estimate.warnings


def outcome(path, online, about, arrays):
    """What becomes of a forged checkpoint; any other exception, or a number that is none, fails the test."""
    write_checkpoint(path, about, arrays)
    since = time.process_time()
    found = "refused"
    try:
        online.restore(path)
        numbers_of(online.last)
        found = "unread"
        for _ in range(2):
            numbers_of(online.update(online.time + 0.01, [0.05] * online.model.m))
        found = "read"
    except zakai.InputError as error:
        assert "\n" not in str(error)
    # The promise is 2 seconds; a machine may be busy.
    assert time.process_time() - since < 10
    return found


@pytest.mark.parametrize(
    "name",
    ["kalman-bucy-1d", "spiral-sensor"],
)
def test_a_forged_checkpoint_is_refused_or_gone_on_from(tmp_path, name):
    path = tmp_path / "state"
    online, about, arrays = saved_after_a_few(path, model_of(name))
    assert outcome(path, online, about, arrays) == "read"
    found = Counter()
    rng = np.random.default_rng(1)
    for place in places({key: about[key] for key in ("method", "options", "filters", "more")}):
        words = [WORDS[i] for i in rng.permutation(len(WORDS))[: 3 if name == "kalman-bucy-1d" else 1]]
        found.update(outcome(path, online, put(about, place, word), arrays) for word in words)
    for key, array in arrays.items():
        found.update(outcome(path, online, about, {**arrays, key: other}) for other in forged(array))
    assert found["refused"] > found["read"] > 0


@pytest.mark.parametrize("number", [np.nan, -1.0])
def test_a_state_of_numbers_that_are_no_density_is_refused(tmp_path, number):
    path = tmp_path / "state"
    online, about, arrays = saved_after_a_few(path, model_of("kalman-bucy-1d"))
    assert outcome(path, online, about, {key: np.full_like(array, number) for key, array in arrays.items()}) == "refused"


def test_what_is_no_moment_of_the_filter_is_refused_word_by_word(tmp_path):
    path = tmp_path / "state"
    online, about, arrays = saved_after_a_few(path, model_of("kalman-bucy-1d"))
    before = online.time, online.last.mean.tolist()
    wrong = {
        ("time",): [np.nan, np.inf, -1.0, 0, "x", 1e300],
        ("values",): [[], [np.nan], [1.0], ["0"]],
        ("times",): [[], [np.nan], [1.0], ["0"]],
        ("info",): [None, [], [{"array": 0}], 0.0],
        ("health",): [None, [], {"x": "y"}, {"x": [1.0]}],
        ("notes",): [["\x1b[2J"], "x"],
    }
    for place, words in wrong.items():
        for word in words:
            write_checkpoint(path, put(about, ("filters", 0, *place), word), arrays)
            with pytest.raises(zakai.InputError, match="does not fit"):
                online.restore(path)
    for changed in ({**arrays, "more": np.zeros(1)}, {**arrays, "0/19": np.zeros(1)}, dict(list(arrays.items())[:-1])):
        write_checkpoint(path, about, changed)
        with pytest.raises(zakai.InputError, match="does not fit"):
            online.restore(path)
    assert (online.time, online.last.mean.tolist()) == before


def test_blocks_that_are_not_at_one_time_are_refused(tmp_path):
    path = tmp_path / "state"
    online, about, arrays = saved_after_a_few(path, model_of("two blocks"))
    online.save(path)
    later, later_arrays = read_checkpoint(path)
    mixed = {key: (arrays if key.startswith("0/") else later_arrays)[key] for key in arrays}
    write_checkpoint(path, {**about, "filters": [about["filters"][0], later["filters"][1]]}, mixed)
    with pytest.raises(zakai.InputError, match="does not fit"):
        online.restore(path)


@pytest.mark.parametrize("count", [0, 1])
def test_before_the_first_interval_a_checkpoint_says_what_the_filter_knows_or_is_refused(tmp_path, count):
    path = tmp_path / "state"
    online = zakai.online(zakai.Model(**BLOCKS, observation_kind="samples"), "extended-kalman-bucy")
    if count:
        online.update(0.0, [0.5, np.nan])
    expected = online.last.mean.tolist()
    online.save(path)
    about, arrays = read_checkpoint(path)
    fresh = zakai.online(online.model, "extended-kalman-bucy")
    fresh.restore(path)
    assert fresh.last.mean.tolist() == expected and fresh.time == 0
    for place in places(about["filters"], ("filters",)):
        for word in (None, -1, "x"):
            changed = put(about, place, word)
            if json.dumps(changed) != json.dumps(about):
                assert outcome(path, fresh, changed, arrays) == "refused"
