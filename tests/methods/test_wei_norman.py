"""The filter of Wei and Norman: against exact filters, and against the Duncan-Mortensen-Zakai equation on a box."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.convention import within_convention
from references.dmz import dmz
from references.kolmogorov import Box

MIXTURE = {"kind": "mixture", "weights": [0.4, 0.6], "means": [[-1.0], [0.8]], "covs": [[[0.3]], [[0.2]]]}
PLANE = {
    "kind": "mixture",
    "weights": [0.4, 0.6],
    "means": [[-0.8, 0.5], [0.6, -0.3]],
    "covs": [[[0.4, 0.1], [0.1, 0.3]], [0.3, 0.4]],
}
SPACE = {
    "kind": "mixture",
    "weights": [0.4, 0.6],
    "means": [[-0.6, 0.3, 0.2], [0.5, -0.3, 0.0]],
    "covs": [[0.3, 0.3, 0.4], [0.4, 0.3, 0.3]],
}
PASSIVE = [
    "x1 + x2 + x3",
    "x1 - (x2 + x3)/2 + 1.5*sin(x2 - x3) - 0.3*(x2 - x3) + 0.5*sin(x2)*cos(x3) + 0.1",
    "x1 - (x2 + x3)/2 - 1.5*sin(x2 - x3) + 0.3*(x2 - x3) - 0.5*sin(x2)*cos(x3)",
]


def line(drift="tanh(x)", prior=None, **others) -> zakai.Model:
    keys = {"observation_kind": "increments", "prior": prior or MIXTURE, **others}
    return zakai.Model(state=["x"], drift=[drift], observation=["x"], **keys)


def record_of(model, times, seed=1, missing=()):
    values = zakai.simulate(model, times, seed=seed)[1].values.copy()
    for row, column in missing:
        values[row, column] = np.nan
    return zakai.Record(times, values, model.observation_kind)


def same(a, b, tolerance):
    assert np.allclose(a.mean, b.mean, rtol=0, atol=tolerance)
    assert np.allclose(a.cov, b.cov, rtol=0, atol=tolerance)
    assert np.allclose(a.log_likelihood_increments, b.log_likelihood_increments, rtol=0, atol=tolerance)


def gaussians(prior, x):
    """The density of a mixture at points (..., n)."""
    total = 0.0
    for weight, mean, cov in zip(prior.weights, prior.means, prior.covs, strict=True):
        d = x - mean
        total = total + weight * np.exp(-0.5 * np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d)) / np.sqrt(
            np.linalg.det(2 * np.pi * cov)
        )
    return total


def as_the_equation_says(model, record, box, drift, divergence, h, S, tolerance):
    """The filter's densities, means and evidence are those of a plain solution."""
    result = zakai.filter(model, record, "wei-norman")
    assert result.warnings == []
    start = gaussians(model.prior, box.x)
    solution = dmz(
        box, start, record.times, record.values, drift, divergence, lambda t: np.eye(model.n), h, S, tolerance=tolerance
    )
    for k, sigma in enumerate(solution, 1):
        mass = sigma.sum() * box.cell
        expected = sigma / mass
        matters = expected > 1e-3 * expected.max()
        found = np.exp(result.density(k).log_density(box.x[matters]))
        assert np.max(np.abs(found / expected[matters] - 1)) < 1e-5
        mean = (expected[..., None] * box.x).reshape(-1, model.n).sum(axis=0) * box.cell
        assert np.allclose(result.mean[k], mean, rtol=0, atol=5e-6)
        assert np.isclose(np.log(mass / (start.sum() * box.cell)), result.log_likelihood_increments[: k + 1].sum(), atol=1e-5)
    return result


def test_benes_with_two_peaks_and_gaps_is_the_exact_filter():
    model = line()
    record = record_of(model, np.arange(1, 81) * 0.05, missing=[(10, 0), (11, 0)])
    wei_norman, exact = zakai.filter(model, record, "wei-norman"), zakai.filter(model, record, "benes")
    same(wei_norman, exact, 1e-10)
    x = np.linspace(*wei_norman.density(-1).quantile([1e-6, 1 - 1e-6])[:, 0], 101)[:, None]
    assert np.allclose(wei_norman.density(-1).log_density(x), exact.density(-1).log_density(x), rtol=0, atol=1e-8)
    assert wei_norman.warnings == []


def states_of(model, record, theta=None):
    """The states after each step, and the log-likelihood."""
    from zakai.methods.series.wei_norman import METHOD
    from zakai.records.schedule import Schedule, schedule_of

    theta = model.theta() if theta is None else theta
    schedule, values = schedule_of(model, record)
    prepared = METHOD.prepare(model, schedule, theta)
    states, total = [METHOD.init(METHOD.prepare(model, Schedule.empty(model.m), theta), model.prior)], 0.0
    for k in range(len(schedule)):
        state, info = METHOD.step(prepared, k, states[-1], values[k])
        states.append(state)
        total = total + info.log_likelihood_increment
    return states, total


def test_statistics_grow_over_many_observations_and_restart_before_they_are_large():
    model = line()
    states, _ = states_of(model, record_of(model, np.arange(1, 121) * 0.01))
    statistics = np.array([state.statistics for state in states[1:]])
    restarts = np.flatnonzero(np.all(statistics == 0, axis=1))
    assert 1 <= len(restarts) < 30
    # They grow from one restart to the next, over several observations.
    assert np.diff(restarts).max() > 5 and np.abs(statistics).max() > 0.2


@pytest.mark.parametrize(
    "keys",
    [
        dict(state=["x"], drift=["a*tanh(a*x)"], prior={"kind": "density", "log_density": "-(x - a)**2/(2*b)"}),
        dict(
            state=["x", "v"], drift=["v", "-a*x - v/3"], process_noise=[["1/2", "1/10"], ["1/10", "1"]],
            prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.3, 0.4]},
        ),
    ],
)  # fmt: skip
def test_the_gradient_is_that_of_differences(keys):
    parameters = {"a": 0.7, "b": 1.4, "c": 0.1}
    model = zakai.Model(observation=["b*x"], observation_noise=[["1 + c"]], parameters=parameters, **keys)
    record = zakai.Record(np.array([0.05, 0.12]), np.array([[0.2], [-0.3]]), "increments")
    theta, d = model.theta(), 1e-3
    for axis in np.eye(3):
        gradient = states_of(model, record, theta + 1e-150j * axis)[1].imag / 1e-150
        two, one, three, four = (states_of(model, record, theta + k * d * axis)[1] for k in (-2, -1, 1, 2))
        assert np.isclose(gradient, (8 * (three - one) - (four - two)) / (12 * d), rtol=1e-8, atol=1e-10)


def test_irregular_intervals_and_long_gaps_are_kalman_and_bucys():
    model = line("-x")
    times = np.cumsum(10 ** np.random.default_rng(0).uniform(-4, 0.5, 20))
    record = record_of(model, np.append(times, times[-1] + 200.0), missing=[(3, 0), (10, 0), (20, 0)])
    result, exact = zakai.filter(model, record, "wei-norman"), zakai.filter(model, record, "kalman-bucy")
    same(result, exact, 1e-9)
    assert within_convention(result.warnings) == []


def test_an_online_filter_gives_the_same_to_the_last_bit():
    model = line()
    record = record_of(model, np.cumsum([0.05, 0.1, 0.07, 0.3, 0.05]), missing=[(2, 0)])
    result, online = zakai.filter(model, record, "wei-norman"), zakai.online(model, "wei-norman")
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), 1):
        estimate = online.update(time, value)
        assert np.array_equal(estimate.mean, result.mean[k]) and np.array_equal(estimate.cov, result.cov[k])


@pytest.mark.parametrize("kind", ["increments", "path", "rates"])
def test_two_linear_states_with_readings_missing_are_kalman_and_bucys(kind):
    model = zakai.Model(
        state=["x", "v"],
        drift=["v", "-x - v/3"],
        observation=["x", "x + v + 1"],
        observation_kind=kind,
        observation_noise=[["1", "0.2"], ["0.2", "0.5"]],
        process_noise=[["0.5", "0.1"], ["0.1", "1"]],
        prior=PLANE,
    )
    record = record_of(model, np.arange(1, 17) * 0.05, missing=[(3, 0), (4, 0), (7, 1), (9, 0), (9, 1)])
    result, exact = zakai.filter(model, record, "wei-norman"), zakai.filter(model, record, "kalman-bucy")
    same(result, exact, 1e-8)
    assert result.warnings == exact.warnings


def test_a_passive_state_that_is_not_linear_is_as_the_equation_says():
    model = zakai.Model(
        state=["x1", "x2"],
        drift=["x2 - x1 + sin(x1 + x2)", "x1 - x2 + sin(x1 + x2) + 1/2"],
        observation=["x1 - x2"],
        observation_noise=[["0.5"]],
        prior=PLANE,
    )
    assert zakai.analyze(model).recommended == "yau-yau"  # no other method of `auto` is exact here
    record = record_of(model, np.arange(1, 11) * 0.05)

    def drift(x, t):
        curved = np.sin(x[..., 0] + x[..., 1])
        return np.stack([x[..., 1] - x[..., 0] + curved, x[..., 0] - x[..., 1] + curved + 0.5], axis=-1)

    as_the_equation_says(
        model,
        record,
        Box(6.5, 96, (0.0, 0.0)),
        drift,
        lambda x, t: -2.0 + 2 * np.cos(x[..., 0] + x[..., 1]),
        lambda x, t: x[..., :1] - x[..., 1:],
        np.array([[0.5]]),
        1e-11,
    )



def test_three_states_with_a_passive_drift_are_as_the_equation_says():
    model = zakai.Model(state=["x1", "x2", "x3"], drift=PASSIVE, observation=["2*x1"], prior=SPACE)
    record = record_of(model, [0.05])

    def drift(x, t):
        a, b, c = np.moveaxis(x, -1, 0)
        q = 1.5 * np.sin(b - c) - 0.3 * (b - c) + 0.5 * np.sin(b) * np.cos(c)
        return np.stack([a + b + c, a - (b + c) / 2 + q + 0.1, a - (b + c) / 2 - q], axis=-1)

    def divergence(x, t):
        _, b, c = np.moveaxis(x, -1, 0)
        return 3 * np.cos(b - c) - 0.6 + 0.5 * np.cos(b) * np.cos(c) + 0.5 * np.sin(b) * np.sin(c)

    box = Box((4.8, 4.8, 4.8), 48, (0.0, 0.0, 0.0))
    as_the_equation_says(model, record, box, drift, divergence, lambda x, t: 2 * x[..., :1], np.eye(1), 1e-8)



def test_the_observed_block_of_three_states_is_kalman_and_bucys():
    model = zakai.load_model("gallery:passive-drift")
    record = record_of(model, np.arange(1, 5) * 0.05, seed=2)
    result = zakai.filter(model, record, "wei-norman")
    # x1 and x2 + x3 are a linear system by themselves.
    block = zakai.Model(
        state=["a", "s"],
        drift=["a + s", "2*a - s + 0.1"],
        diffusion=[["1", "0"], ["0", "sqrt(2)"]],
        observation=["2*a"],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.1, 0.2]},
    )
    exact = zakai.filter(block, record, "kalman-bucy")
    seen = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    assert np.allclose(result.mean @ seen.T, exact.mean, rtol=0, atol=1e-6)
    assert np.allclose(seen @ result.cov @ seen.T, exact.cov, rtol=0, atol=5e-6)
    assert np.allclose(result.log_likelihood_increments, exact.log_likelihood_increments, rtol=0, atol=1e-6)
    assert result.warnings == []


def test_what_it_cannot_resolve_is_said():
    slanted = zakai.Model(
        state=["a", "b"],
        drift=["-a", "b - a"],
        observation=["a", "b"],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [[1, 0.99], [0.99, 1]]},
    )
    result = zakai.filter(slanted, zakai.Record([0.05], [[0.1, 0.1]], "increments"), "wei-norman")
    assert any("aliasing" in said for said in result.warnings)


@pytest.mark.parametrize("variance", [1e-6, 1e-2, 1e4])
def test_a_narrow_or_wide_prior_is_kalman_and_bucys(variance):
    model = line("1 - x/2", {"kind": "gaussian", "mean": [2.0], "cov": [[variance]]})
    record = record_of(line("1 - x/2"), np.arange(1, 9) * 0.1)
    result, exact = zakai.filter(model, record, "wei-norman"), zakai.filter(model, record, "kalman-bucy")
    assert np.allclose(result.mean, exact.mean, rtol=1e-8, atol=0) and np.allclose(result.cov, exact.cov, rtol=1e-8, atol=0)
    assert result.warnings == []


def test_a_reading_that_contradicts_the_density_is_followed_or_said_to_be_too_far():
    model = line("1 - x/2", MIXTURE)
    for size in (4.0, 12.0):
        record = zakai.Record([0.1, 0.2, 0.3], [[0.05], [size], [0.1]], "increments")
        result, exact = zakai.filter(model, record, "wei-norman"), zakai.filter(model, record, "kalman-bucy")
        if size == 4.0:
            same(result, exact, 1e-7)
        assert any("tail_depth" in said for said in result.warnings) == (size == 12.0)


def test_a_grid_that_is_too_coarse_is_said_to_be():
    model = line(prior={"kind": "density", "log_density": "-3*abs(x)"})
    record = record_of(line(), [0.1, 0.2])
    assert any("aliasing" in said for said in zakai.filter(model, record, "wei-norman").warnings)
    coarse = zakai.filter(line(), record, "wei-norman", points=20)
    assert any("aliasing" in said for said in coarse.warnings)


def test_a_drift_that_explodes_is_not_silent():
    model = zakai.Model(state=["x"], drift=["x**3"], observation=["1"], prior=MIXTURE)
    record = record_of(zakai.Model(state=["x"], drift=["-x"], observation=["1"], prior=MIXTURE), np.arange(1, 3) * 0.25)
    assert zakai.filter(model, record, "wei-norman").warnings


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drift": ["x - x**3"]}, "the estimation algebra is finite dimensional .infinite"),
        ({"drift": ["sin(t) - x"]}, "undecided whether the estimation algebra is finite dimensional"),
        ({"observation_kind": "samples"}, "a sample|samples: the likelihood of one is the exponential of no element"),
        ({"periodic": ["x"], "drift": ["1"], "observation": ["sin(x)"]}, "no state is an angle"),
    ],
)
def test_a_system_for_which_it_does_not_hold_is_refused(changes, words):
    model = zakai.Model(**{"state": ["x"], "drift": ["-x"], "observation": ["x"], "prior": MIXTURE, **changes})
    record = zakai.Record([0.1], [[0.1]], model.observation_kind)
    with pytest.raises(zakai.ConditionError, match=words):
        zakai.filter(model, record, "wei-norman")


def test_more_than_three_states_and_a_prior_without_width_are_refused():
    names = ["a", "b", "c", "d"]
    model = zakai.Model(
        state=names,
        drift=["b - a", "c - b", "d - c", "-d"],
        observation=["a"],
        prior={"kind": "gaussian", "mean": [0] * 4, "cov": [1] * 4},
    )
    with pytest.raises(zakai.ConditionError, match="at most 3 coordinates"):
        zakai.filter(model, zakai.Record([0.1], [[0.1]], "increments"), "wei-norman")
    sharp = line(prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.0]]})
    with pytest.raises(zakai.InputError, match="a variance is zero"):
        zakai.filter(sharp, zakai.Record([0.1], [[0.1]], "increments"), "wei-norman")
    with pytest.raises(zakai.InputError, match="option points"):
        zakai.filter(line(), zakai.Record([0.1], [[0.1]], "increments"), "wei-norman", points=7)
