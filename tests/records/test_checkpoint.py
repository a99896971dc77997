"""Checkpoints are whole or refused, and a filter goes on from one as if it had never stopped."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import zakai
from zakai.records import checkpoint
from zakai.records.checkpoint import read_checkpoint, write_checkpoint

ABOUT = {"time": 0.1 + 0.2, "names": ["x", "y"], "none": None, "infinite": float("inf")}
ARRAYS = {"mean": np.array([1.0, -0.0, np.nan, np.inf, 5e-324]), "count": np.arange(6).reshape(2, 3), "one": np.array(7.5)}
ARRAYS |= {"empty": np.zeros((0, 3)), "flags": np.array([True, False])}


def test_what_is_written_is_read_bit_for_bit(tmp_path):
    write_checkpoint(tmp_path / "state", ABOUT, ARRAYS)
    about, arrays = read_checkpoint(tmp_path / "state")
    assert about == ABOUT and list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and arrays[name].shape == array.shape
        assert arrays[name].tobytes() == array.tobytes()
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def refused(path, words):
    with pytest.raises(zakai.InputError, match=words) as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


@pytest.fixture
def content(tmp_path):
    write_checkpoint(tmp_path / "state", ABOUT, ARRAYS)
    return (tmp_path / "state").read_bytes()


def test_a_checkpoint_that_was_cut_or_changed_anywhere_is_refused(tmp_path, content):
    path, rng = tmp_path / "state", np.random.default_rng(0)
    for length in [0, 1, 17, 40, len(content) // 2, len(content) - 33, len(content) - 1]:
        path.write_bytes(content[:length])
        refused(path, "checkpoint")
    for place in rng.integers(0, len(content), 60):
        changed = bytearray(content)
        changed[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(changed))
        refused(path, "checkpoint")
    path.write_bytes(content + b"\0")
    refused(path, "damaged")


def test_another_file_a_folder_and_nothing_are_refused(tmp_path, content):
    (tmp_path / "state").write_text("time,y\n1,2\n")
    refused(tmp_path / "state", "is not a checkpoint file")
    refused(tmp_path, "not a regular file")
    refused(tmp_path / "none", "cannot be read")
    later = content[:-32].replace(b"zakai checkpoint 1\n", b"zakai checkpoint 2\n")
    (tmp_path / "state").write_bytes(later + hashlib.sha256(later).digest())
    refused(tmp_path / "state", "format 2, and this version of zakai reads format 1")


@pytest.mark.parametrize(
    "header",
    [
        {},
        [],
        {"about": 1, "arrays": []},
        {"about": {}, "arrays": [["a", "<f8", [10**12]]]},
        {"about": {}, "arrays": [["a", "<f8", [-1]]]},
        {"about": {}, "arrays": [["a", "O", [1]]]},
        {"about": {}, "arrays": [[1, "<f8", [1]]]},
        {"about": {}, "arrays": [["a", "<f8"]]},
        {"about": {}, "arrays": [["a", ["<f8"], [1]]]},
    ],
)
def test_a_header_that_somebody_made_up_is_refused(tmp_path, header):
    made = b"zakai checkpoint 1\n" + json.dumps(header).encode() + b"\n" + bytes(8)
    (tmp_path / "state").write_bytes(made + hashlib.sha256(made).digest())
    refused(tmp_path / "state", "damaged")


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300))
def test_no_bytes_are_read_as_a_checkpoint_by_chance(junk):
    for made in (junk, b"zakai checkpoint 1\n" + junk + hashlib.sha256(b"zakai checkpoint 1\n" + junk).digest()):
        with pytest.raises(zakai.InputError):
            checkpoint._unpacked(made, "state")


WALK = dict(state=["x"], drift=["-x/2"], observation=["2*x"], prior={"kind": "gaussian", "mean": [0.3], "cov": [[2.0]]})
MIXTURE = {"kind": "mixture", "weights": [0.25, 0.75], "means": [[-1.0], [1.0]], "covs": [[[0.5]], [[0.5]]]}
TIMED = dict(WALK, drift=["cos(t) - x/2"])
CUBIC = dict(WALK, drift=["cos(x)"], observation=["x**3"])
SINE = dict(WALK, observation=["x*sin(x)", "x*cos(x)"])
TIMES = np.concatenate([np.arange(1, 30) / 20, [1.5, 1.53, 1.6], 1.6 + np.arange(1, 9) / 20])


def values_of(estimate):
    """Everything that an estimate says, to the bit."""
    numbers = [estimate.time, *estimate.mean, *estimate.cov.ravel(), estimate.log_likelihood_increment]
    return np.array([*numbers, *estimate.health.values(), *estimate.interval().ravel()]).tobytes(), estimate.warnings


def check_continuation(tmp_path, model, method, times, every):
    rng = np.random.default_rng(2)
    values = 0.1 * rng.standard_normal((len(times), model.m))
    values[5, 0] = np.nan
    straight = zakai.online(model, method)
    expected = [values_of(straight.update(time, value)) for time, value in zip(times, values, strict=True)]
    path = tmp_path / "state"
    online = zakai.online(model, method)
    for k, (time, value) in enumerate(zip(times, values, strict=True)):
        if k % every == 0:
            online.save(path, {"k": k})
            online = zakai.online(model, method)
            assert online.restore(path) == {"k": k}
            assert k == 0 or values_of(online.last) == expected[k - 1]
        assert values_of(online.update(time, value)) == expected[k]


@pytest.mark.parametrize(
    ("keys", "method", "kind"),
    [
        (WALK, "kalman-bucy", "path"),
        (TIMED, "extended-kalman-bucy", "increments"),
        (WALK, "extended-kalman-bucy", "samples"),
    ],
)
def test_a_filter_goes_on_from_a_checkpoint_with_the_same_bits(tmp_path, keys, method, kind):
    model = zakai.Model(**keys, observation_kind=kind)
    times = np.concatenate([[0.0], TIMES]) if kind == "samples" else TIMES
    check_continuation(tmp_path, model, method, times, 5)


@pytest.mark.parametrize("kind", ["increments", "path", "rates", "samples"])
@pytest.mark.parametrize("keys", [WALK, TIMED])
def test_a_filter_that_begins_before_zero_goes_on_with_the_same_bits(tmp_path, keys, kind):
    model = zakai.Model(**keys, observation_kind=kind, start=-10.0)
    check_continuation(tmp_path, model, "extended-kalman-bucy", TIMES[:12] - 10.0, 4)


def test_a_filter_of_lengths_that_never_repeat_goes_on_with_the_same_bits(tmp_path):
    times = np.cumsum(np.random.default_rng(6).permutation(np.geomspace(0.1, 6.0, 12)))
    check_continuation(tmp_path, zakai.Model(**WALK, observation_kind="samples"), "kalman-bucy", times, 3)


@pytest.mark.parametrize(
    ("keys", "method", "kind"),
    [
        (CUBIC, "yau-yau", "increments"),
        (dict(SINE, drift=["cos(t) - x/2"]), "limited-direct", "increments"),
        (CUBIC, "kolmogorov-series", "increments"),
    ],
)
def test_adaptive_filters_go_on_from_a_checkpoint_with_the_same_bits(tmp_path, keys, method, kind):
    check_continuation(tmp_path, zakai.Model(**keys, observation_kind=kind), method, TIMES[:20], 6)


def test_a_window_that_moves_goes_on_with_the_same_bits(tmp_path):
    model = zakai.load_model("gallery:spiral-sensor")
    check_continuation(tmp_path, model, "limited-direct", 0.01 * np.arange(1, 61), 7)


def test_the_checkpoint_of_another_filter_is_refused_and_changes_nothing(tmp_path):
    path = tmp_path / "state"
    online = zakai.online(zakai.Model(**WALK, observation_kind="increments"), "kalman-bucy")
    online.update(0.1, 0.2)
    online.save(path)
    for keys, method, words in [(WALK, "extended-kalman-bucy", "another method"), (TIMED, "kalman-bucy", "another model")]:
        other = zakai.online(zakai.Model(**keys, observation_kind="increments"), method)
        with pytest.raises(zakai.InputError, match=words):
            other.restore(path)
        assert other.time == 0
    about, arrays = read_checkpoint(path)
    about["versions"]["version_numba"] = "0.0.1"
    write_checkpoint(path, about, arrays)
    with pytest.raises(zakai.InputError, match="another version of"):
        online.restore(path)


def test_a_state_that_somebody_made_up_is_refused_and_nothing_of_it_is_run(tmp_path):
    path = tmp_path / "state"
    online = zakai.online(zakai.Model(**WALK, observation_kind="increments"), "kalman-bucy")
    online.update(0.1, 0.2)
    before = values_of(online.last)
    online.save(path)
    good, arrays = read_checkpoint(path)
    wrong = [
        {"record": "os:system", "fields": {"command": "false"}},
        {"array": 99},
        {"array": "x"},
        [{"array": 0}],
        [1],
        3,
        None,
    ]
    for state in wrong:
        about = json.loads(json.dumps(good))
        about["filters"][0]["state"] = state
        write_checkpoint(path, about, arrays)
        with pytest.raises(zakai.InputError, match="does not fit"):
            online.restore(path)
        assert values_of(online.last) == before
    (one,) = good["filters"]
    for filters in ([], None, [{}], [{**one, "info": None}], [{**one, "time": "x"}], [one, one]):
        write_checkpoint(path, {**good, "filters": filters}, arrays)
        with pytest.raises(zakai.InputError, match="does not fit"):
            online.restore(path)
    write_checkpoint(path, good, {})
    with pytest.raises(zakai.InputError, match="does not fit"):
        online.restore(path)
