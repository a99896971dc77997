"""A run of steps ends where its lattice no longer holds, and the next begins there."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import zakai
from zakai.filters import _run
from zakai.filters._protocol import Info
from zakai.filters.yau_yau import METHOD

CUBIC = dict(state=["x"], drift=["cos(x)"], observation=["x**3"], prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.05]]})


def adding(state, slices):
    """The sum so far; a step is well while it is below 10."""
    new = state + slices[0]
    return new, (Info(new, new, new, {}), None)


def well(info):
    return info.log_likelihood_increment < 10


@pytest.mark.parametrize(
    ("healthy", "most", "strict", "count", "end"),
    [
        (well, 6, True, 4, 10.0 - 4.0),  # 0 + 1 + 2 + 3, and 4 more would be 10
        (well, 3, True, 3, 3.0),
        (well, 6, False, 6, 15.0),
        (None, 6, True, 6, 15.0),
    ],
)
def test_a_run_gives_the_state_before_the_first_step_that_is_not_well(healthy, most, strict, count, end):
    state, (info, _), taken = _run.taken(adding, healthy, jnp.zeros(()), (jnp.arange(6.0),), most, strict)
    assert int(taken) == count and float(state) == end
    sums = np.cumsum(np.arange(6.0))
    assert np.array_equal(np.asarray(info.mean)[:count], sums[:count])
    if count < most:
        assert float(info.mean[count]) == sums[count]  # what went wrong can be looked at


def adding_some(state, slices):
    """The same for several steps, with a leading axis."""
    sums = state + jnp.cumsum(slices[0])
    return sums, (Info(sums, sums, sums, {}), None)


@pytest.mark.parametrize("count", [1, 2, 4, 6, 16])
@pytest.mark.parametrize(("most", "strict"), [(6, True), (3, True), (5, True), (6, False), (5, False)])
def test_several_steps_at_once_end_where_single_ones_end(count, most, strict):
    given = well, jnp.zeros(()), (jnp.arange(6.0),), most, strict
    end, (info, _), taken = _run.taken(adding, *given)
    again, (info_again, _), taken_again = _run.taken_some(adding_some, *given, count)
    assert int(taken_again) == int(taken) and float(again) == float(end)
    told = min(int(taken) + 1, most)
    assert np.array_equal(info_again.mean[:told], info.mean[:told])


def test_densities_that_would_not_fit_are_given_up_after_the_first_run(monkeypatch):
    model = zakai.Model(**CUBIC)
    _, record = zakai.simulate(model, 0.005 * np.arange(1, 1101), seed=3)
    kept = []
    monkeypatch.setattr(_run, "scan", lambda *given, scan=_run.scan: kept.append(given[5]) or scan(*given))
    run = _run.Run(_run.Setting(model, model.prior, METHOD, dict(METHOD.options)), record, None, most=2**16)
    run.all(None)
    assert not run.keep and kept[0] and not kept[-1] and sum(kept) <= 4


@pytest.fixture
def lengths(monkeypatch):
    """How many steps were taken by each run, and how many in vain."""
    found, run_steps, scan = {"taken": [], "scanned": []}, _run.run_steps, _run.scan

    def noted(*arguments):
        result = run_steps(*arguments)
        found["taken"].append(result[0].stop - result[0].start)
        return result

    def counted(*arguments):
        result = scan(*arguments)
        found["scanned"].append(int(result[2]))
        return result

    monkeypatch.setattr(_run, "run_steps", noted)
    monkeypatch.setattr(_run, "scan", counted)
    return found


@pytest.mark.longest
@pytest.mark.slow
def test_runs_that_end_early_take_few_steps_twice_and_change_no_estimate(lengths):
    model = zakai.Model(**CUBIC)
    _, record = zakai.simulate(model, 0.005 * np.arange(1, 601), seed=3)
    result = zakai.filter(model, record, "yau-yau", keep="moments")
    assert sum(lengths["taken"]) == 600 and min(lengths["taken"][:-1]) < 256
    assert sum(lengths["scanned"]) < 900
    finer = zakai.filter(model, record, "yau-yau", keep="moments", tolerance=1e-6)
    assert not result.warnings and not finer.warnings
    assert np.abs((result.mean - finer.mean) / np.sqrt(finer.variance)).max() < 1e-4
    assert np.abs(result.log_likelihood - finer.log_likelihood) < 1e-4


@pytest.mark.longest
@pytest.mark.slow
def test_equal_sensors_side_by_side_give_what_each_gives_alone():
    names = [f"x{k}" for k in range(20)]
    model = zakai.Model(
        state=names, drift=[f"cos({name})" for name in names], observation=[f"{name}**3" for name in names],
        prior={"kind": "gaussian", "mean": [0.0] * 20, "cov": (0.05 * np.eye(20)).tolist()},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.005 * np.arange(1, 401), seed=0)
    together = zakai.filter(model, record, keep="moments")
    assert not together.warnings
    for k in range(0, 20, 4):
        own = zakai.Record(record.times, np.asarray(record.values)[:, [k]], record.kind)
        alone = zakai.filter(zakai.Model(**CUBIC), own, "yau-yau", keep="moments")
        assert np.abs((together.mean[:, k] - alone.mean[:, 0]) / np.sqrt(alone.variance[:, 0])).max() < 1e-4
        assert np.allclose(together.variance[:, k], alone.variance[:, 0], rtol=1e-4, atol=0)
