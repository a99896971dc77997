"""One state that the drift carries far between observations, against Fourier collocation on a box that stands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import zakai
from references.kolmogorov import Box, propagate

SYSTEMS = {
    # f and f' for NumPy; noise, mean and variance of the prior, times, half width and centre of the box, its points
    "1 + 0.5*sin(x)": (
        lambda x: 1.0 + 0.5 * np.sin(x), lambda x: 0.5 * np.cos(x), 0.02, 0.5, 1e-3, [0.7, 1.0, 2.1], 2.5, 2.2, 640,
    ),
    "0.5*x + sin(x)": (
        lambda x: 0.5 * x + np.sin(x), lambda x: 0.5 + np.cos(x), 0.7, 300.0, 0.05, [0.1, 0.13, 0.2], 21.0, 316.0, 1000,
    ),
}  # fmt: skip


def reference(system, kind, values, S, shift=0.0):
    """Means, deviations and the evidence, with the mean of the prior displaced."""
    drift, slope, noise, mean, variance, times, half, centre, points = system
    box, start, rows, total = Box(half, points, [centre]), 0.0, [], 0.0
    x = box.x[:, 0]
    u = np.exp(-0.5 * (x - mean - shift) ** 2 / variance)
    u /= u.sum()
    for stop, y in zip(times, values, strict=True):
        rate = y / (stop - start)

        def potential(x, t, rate=rate):
            return (x[..., 0] - rate) ** 2 / S if kind == "increments" else 0.0 * x[..., 0]

        u = propagate(
            box, u, start, stop, lambda x, t: drift(x), lambda x, t: slope(x[..., 0]), lambda t: np.array([[noise**2]]),
            potential, 1e-11,
        )  # fmt: skip
        if kind == "samples":
            u = u * np.exp(-0.5 * (y - x) ** 2 / S) / np.sqrt(2.0 * np.pi * S)
        else:
            total += 0.5 * (stop - start) * rate**2 / S
        total, u, start = total + np.log(u.sum()), u / u.sum(), stop
        rows.append([u @ x, np.sqrt(u @ (x - u @ x) ** 2)])
    return *np.array(rows).T, total


@pytest.mark.parametrize("kind", ["samples", "increments"])
@pytest.mark.parametrize("formula", SYSTEMS)
def test_a_density_that_moves_far_is_the_right_one(formula, kind):
    drift, _, noise, mean, variance, times, *_ = SYSTEMS[formula]
    lengths, S = np.diff([0.0, *times]), 2.0 * variance
    path = solve_ivp(lambda t, x: drift(x), (0.0, times[-1]), [mean], rtol=1e-9, dense_output=True).sol
    values = path(np.array(times))[0]
    if kind == "increments":
        S = 20.0 * variance
        values = np.array([path(np.linspace(t - tau, t, 101))[0].mean() for t, tau in zip(times, lengths, strict=True)])
    values = (values + np.array([0.8, -0.5, 0.3]) * variance**0.5) * (lengths if kind == "increments" else 1.0)
    model = zakai.Model(
        state=["x"], drift=[formula], diffusion=[[noise]], observation=["x"], observation_noise=[[S]], observation_kind=kind,
        prior={"kind": "gaussian", "mean": [mean], "cov": [[variance]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(np.array(times), values[:, None], kind), "yau-yau")
    means, deviations, total = reference(SYSTEMS[formula], kind, values, S)
    assert not [warning for warning in result.warnings if "linear between" not in warning]  # which this reference assumes too
    assert np.abs(result.mean[1:, 0] - means).max() < 1e-5 * deviations.min()
    assert np.abs(result.variance[1:, 0] ** 0.5 / deviations - 1.0).max() < 1e-5
    assert abs(result.log_likelihood - total) < 1e-5 * max(1.0, abs(total))
    if kind == "samples":  # d log Z / d mean = (E (x_0 | all) - mean) / variance
        step = 1e-2 * variance**0.5
        one, other = (reference(SYSTEMS[formula], kind, values, S, shift)[2] for shift in (step, -step))
        smoothed = zakai.smooth(model, zakai.Record(np.array(times), values[:, None], kind), "yau-yau")
        assert not smoothed.warnings
        assert abs(smoothed.mean[0, 0] - mean - variance * (one - other) / (2.0 * step)) < 1e-4 * variance**0.5


def test_increments_over_short_intervals_of_motion_are_split_accurately():
    """The drift carries the state by six deviations of the noise in an interval, so that a kernel ends far from its centre."""
    drift, slope, noise, *_ = SYSTEMS["1 + 0.5*sin(x)"]
    times, values, S = np.array([0.1, 0.2, 0.3]), 0.1 * np.array([6.04, 6.1, 6.17]), 0.0004
    model = zakai.Model(
        state=["x"], drift=["1 + 0.5*sin(x)"], diffusion=[[noise]], observation=["x"], observation_noise=[[S]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [6.0], "cov": [[2.6e-4]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(times, values[:, None], "increments"), "yau-yau")
    system = drift, slope, noise, 6.0, 2.6e-4, times, 0.4, 6.1, 256
    means, deviations, total = reference(system, "increments", values, S)
    assert not result.warnings
    assert np.abs(result.mean[1:, 0] - means).max() < 1e-6 * deviations.min()
    assert np.abs(result.variance[1:, 0] ** 0.5 / deviations - 1.0).max() < 1e-6
    assert abs(result.log_likelihood - total) < 1e-5


def test_an_increment_far_from_the_density_is_accurate_or_warned_of():
    """The extended Kalman-Bucy filter is near the truth here; grids need densities of the size of rounding errors."""
    drift, slope, noise, *_ = SYSTEMS["1 + 0.5*sin(x)"]
    tau, rate, S = 1.22, 3.474, 0.0004

    def rhs(t, z):
        return [drift(z[0]) + z[1] * (rate - z[0]) / S, 2.0 * slope(z[0]) * z[1] + noise**2 - z[1] ** 2 / S]

    mean, variance = solve_ivp(rhs, (0.0, tau), [2.873, 3.2e-4], rtol=1e-9, atol=1e-12).y[:, -1]
    model = zakai.Model(
        state=["x"], drift=["1 + 0.5*sin(x)"], diffusion=[[noise]], observation=["x"], observation_noise=[[S]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [2.873], "cov": [[3.2e-4]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(np.array([tau]), np.array([[rate * tau]]), "increments"), "yau-yau")
    assert abs(result.mean[1, 0] - mean) < 0.1 * variance**0.5 or any("tolerance" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    "drift, noise, kind, S, length, count",
    [
        ("1.5", 0.02, "samples", 0.04, 0.2, 30),
        ("0.5*x", 0.3, "samples", 4.0, 0.5, 14),
        ("0.5*x", 0.05, "increments", 0.02, 0.1, 20),
    ],
)
def test_messages_of_motion_and_growth_agree_with_the_kalman_smoother(drift, noise, kind, S, length, count):
    model = zakai.Model(
        state=["x"], drift=[drift], diffusion=[[noise]], observation=["x"], observation_noise=[[S]], observation_kind=kind,
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[1.0]]},
    )  # fmt: skip
    times = np.cumsum(0.01 + np.random.default_rng(0).exponential(length, count))
    _, record = zakai.simulate(model, times, seed=1)
    exact, result = zakai.smooth(model, record, "kalman-bucy"), zakai.smooth(model, record, "yau-yau")
    deviations = exact.variance[:, 0] ** 0.5
    assert not result.warnings
    assert (np.abs(result.mean[:, 0] - exact.mean[:, 0]) / deviations).max() < 1e-5
    assert np.abs(result.variance[:, 0] ** 0.5 / deviations - 1.0).max() < 1e-5


def test_a_message_that_is_much_narrower_than_the_prior_is_found_in_bent_motion():
    """The score is E (x_0 | all) for a Gaussian prior of variance one: d log Z / d mean = (E (x_0 | all) - mean) / variance."""
    times = np.cumsum(0.01 + np.random.default_rng(0).exponential(0.2, 40))

    def model(mean):
        return zakai.Model(
            state=["x"], drift=["2 + sin(x)"], diffusion=[[0.01]], observation=["x"], observation_noise=[[0.04]],
            observation_kind="samples", prior={"kind": "gaussian", "mean": [mean], "cov": [[1.0]]},
        )  # fmt: skip

    _, record = zakai.simulate(model(0.5), times, seed=1)
    result = zakai.smooth(model(0.5), record, "yau-yau")
    one, other = (zakai.filter(model(mean), record, "yau-yau").log_likelihood for mean in (0.51, 0.49))
    assert not result.warnings
    assert abs(result.mean[0, 0] - 0.5 - (one - other) / 0.02) < 1e-3


def test_linear_motion_on_the_grid_of_limited_direct_is_that_of_the_kalman_filter():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.2, 1.0, 30))
    values = times + 0.14 * rng.standard_normal(30)
    model = zakai.Model(
        state=["x"], drift=["1"], diffusion=[[0.03]], observation=["x"], observation_noise=[[0.02]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.04]]},
    )  # fmt: skip
    record = zakai.Record(times, values[:, None], "samples")
    result, exact = (zakai.filter(model, record, method) for method in ("limited-direct", "kalman-bucy"))
    assert not result.warnings
    assert np.abs(result.mean - exact.mean).max() < 1e-8
    assert abs(result.log_likelihood - exact.log_likelihood) < 1e-8


def test_the_gradient_of_motion_is_that_of_the_kalman_filter():
    times = np.cumsum([0.6, 1.0, 0.4, 0.9, 0.7, 0.8])
    values = times + np.array([0.1, -0.2, 0.15, 0.0, -0.1, 0.2])
    record = zakai.Record(times, values[:, None], "samples")
    gradients = []
    for drift, method in (("a - 0.1*x", "kalman-bucy"), ("a - 0.1*x + 1e-10*sin(x)", "yau-yau")):
        model = zakai.Model(
            state=["x"], drift=[drift], diffusion=[["c"]], observation=["x"], observation_noise=[["S"]],
            observation_kind="samples", parameters={"a": 1.5, "c": 0.03, "S": 0.02},
            prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.04]]},
        )  # fmt: skip
        gradients.append(zakai.log_likelihood(model, record, method).value_and_gradient([1.4, 0.03, 0.02])[1])
    assert np.abs(gradients[1] / gradients[0] - 1.0).max() < 1e-6


def test_the_gradient_of_growth_is_that_of_differences():
    times = np.array([0.1, 0.25, 0.5, 0.6])
    record = zakai.Record(times, 3.0 * np.exp(0.5 * times)[:, None] + 0.2, "samples")
    model = zakai.Model(
        state=["x"], drift=["r*x + sin(x)"], diffusion=[["c"]], observation=["x"], observation_noise=[[0.05]],
        observation_kind="samples", parameters={"r": 0.5, "c": 0.1},
        prior={"kind": "gaussian", "mean": [3.0], "cov": [[0.04]]},
    )  # fmt: skip
    function, at = zakai.log_likelihood(model, record, "yau-yau"), np.array([0.5, 0.1])
    _, gradient = function.value_and_gradient(at)
    for i, step in enumerate(np.diag([1e-3, 1e-3])):
        first, second = (function(at + n * step) - function(at - n * step) for n in (1, 2))
        assert abs(gradient[i] - (8.0 * first - second) / (12.0 * step[i])) < 1e-6 * np.abs(gradient).max()
