"""The smoother of one-state density grids against dense forward-backward sums in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, solve_banded
from scipy.stats import norm

import zakai
from references import graded

TIMES, VALUES = np.array([0.05, 0.1, 0.9, 1.0, 2.5]), np.array([0.6, np.nan, -0.3, 0.8, 0.2])


def derivatives(x, closed):
    """The matrices of d/dx and d^2/dx^2: of waves on the circle, else differences of order eight."""
    size, spacing = len(x), x[1] - x[0]
    if closed:
        k, waves = np.fft.fftfreq(size, 1 / size)[:, None], np.fft.fft(np.eye(size), axis=0)
        return np.fft.ifft(1j * k * waves, axis=0).real, np.fft.ifft(-(k**2) * waves, axis=0).real
    first, second = np.zeros((size, size)), np.diag(np.full(size, -205 / 72))
    for j, (a, b) in enumerate(zip((4 / 5, -1 / 5, 4 / 105, -1 / 280), (8 / 5, -1 / 5, 8 / 315, -1 / 560), strict=True), 1):
        first += a * (np.eye(size, k=j) - np.eye(size, k=-j))
        second += b * (np.eye(size, k=j) + np.eye(size, k=-j))
    return first / spacing, second / spacing**2


def forward_backward(x, drift, covariance, h, noise, prior, kind, closed, times=TIMES, values=VALUES):
    """The smoothed densities at the start and at each time, by sums over a fine grid."""
    first, second = derivatives(x, closed)
    operator, spacing = 0.5 * covariance * second - first * drift, x[1] - x[0]
    states, matrices = [prior / prior.sum() / spacing], []
    for length, value in zip(np.diff(np.concatenate([[0.0], times])), values, strict=True):
        inside, factor = np.zeros_like(x), np.ones_like(x)
        if not np.isnan(value) and kind == "samples":
            factor = np.exp(-0.5 * (value - h) ** 2 / noise)
        elif not np.isnan(value):
            inside = (h * value / length - 0.5 * h**2) / noise
        matrices.append(factor[:, None] * expm(length * (operator + np.diag(inside))))
        state = matrices[-1] @ states[-1]
        states.append(state / state.sum() / spacing)
    message, found = np.ones_like(x), []
    for k in reversed(range(len(states))):
        product = states[k] * message
        found.append(product / product.sum() / spacing)
        if k:
            message = matrices[k - 1].T @ message
            message /= message.max()
    return found[::-1]


def test_sharp_samples_hold_the_paths_between_them():
    # The deviation of the sensor is a tenth of that of the noise between two samples.
    x, noise = np.linspace(-2.4, 2.6, 501), 0.0009
    model = zakai.Model(
        state=["x"], drift=["sin(x)"], observation=["x"], observation_kind="samples", observation_noise=[[noise]],
        process_noise=[[0.4]], prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.04]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record(TIMES, VALUES[:, None], "samples"), "yau-yau")
    expected = forward_backward(x, np.sin(x), 0.4, x, noise, np.exp(-((x - 0.4) ** 2) / 0.08), "samples", False)
    for k, density in enumerate(expected):
        with np.errstate(divide="ignore"):
            own = np.exp(result.density(k).log_density(x[:, None]))
        np.testing.assert_allclose(own, density, atol=1e-6 * density.max())
    assert result.warnings == []


def test_increments_that_are_sharper_than_the_noise_of_their_intervals():
    # The observation holds the state within a third of the noise of an interval.
    x, noise, times = np.linspace(-0.7, 1.1, 301), 1e-4, np.array([0.1, 0.16, 0.22])
    values = np.array([0.2, 0.3, 0.15]) * np.diff(np.append(0.0, times))
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="increments", observation_noise=[[noise]],
        process_noise=[[0.4]], prior={"kind": "gaussian", "mean": [0.2], "cov": [[0.02]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record(times, values[:, None], "increments"), "yau-yau")
    prior = np.exp(-((x - 0.2) ** 2) / 0.04)
    expected = forward_backward(x, x - x**3, 0.4, x, noise, prior, "increments", False, times, values)
    for k, density in enumerate(expected):
        with np.errstate(divide="ignore"):
            own = np.exp(result.density(k).log_density(x[:, None]))
        np.testing.assert_allclose(own, density, atol=1e-6 * density.max())
    assert result.warnings == []


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
def test_samples_that_are_far_sharper_than_the_noise(noise):
    model = zakai.Model(
        state=["x"], drift=["-x"], diffusion=[["0.6"]], observation=["x"], observation_noise=[[str(noise)]],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0.0], "cov": [4.0]},
    )  # fmt: skip
    times = np.cumsum([0.3, 0.02, 0.4, 0.9, 0.1])
    values = np.array([0.4, 0.45, np.nan, 0.1, 0.2])
    smoothed = zakai.smooth(model, zakai.Record(times, values[:, None], "samples"), method="yau-yau")
    # The joint normal law of the states at the start and at the times, given the samples.
    t = np.append(0.0, times)
    joint = np.exp(-(t[:, None] + t)) * (4.0 + 0.18 * np.expm1(2.0 * np.minimum(t[:, None], t)))
    seen = np.flatnonzero(np.isfinite(values)) + 1
    gain = joint[:, seen] @ np.linalg.inv(joint[np.ix_(seen, seen)] + noise * np.eye(len(seen)))
    deviation = np.sqrt(np.diag(joint - gain @ joint[seen]))
    assert not smoothed.warnings
    assert np.all(np.abs(smoothed.mean[:, 0] - gain @ values[seen - 1]) < 1e-6 * deviation)
    assert np.all(np.abs(np.sqrt(smoothed.variance[:, 0]) - deviation) < 1e-6 * deviation)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_broad_prior_is_smoothed_as_its_evidence_says(kind):
    # The derivative of the evidence for the mean of a prior N(mean, 1) is the smoothed mean less the prior's.
    times, values, noise = np.array([0.33, 0.5, 0.9]), np.array([0.6, -0.3, 0.8]), 0.2

    def evidence(mean):
        lengths = np.diff(np.concatenate([[0.0], times]))
        samples = [lambda x, z=z: -0.5 * (z - x) ** 2 / noise for z in values]
        nothing = [lambda x: 0.0 * x] * 3
        inside = [lambda x, r=z / tau: (r - 0.5 * x) * x / noise for z, tau in zip(values, lengths, strict=True)]
        likelihoods, potentials = (samples, None) if kind == "samples" else (nothing, inside)
        faces = graded.sinh_faces(-9.0, 9.0, 0.6, 1600)
        return graded.posterior(
            lambda x: x - x**3, lambda x: -0.5 * (x - mean) ** 2, times, likelihoods, faces, 1e-4, potentials=potentials
        )[2]

    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind=kind, observation_noise=[[noise]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record(times, values[:, None], kind), "yau-yau")
    low, middle, high = (evidence(mean) for mean in (-0.02, 0.0, 0.02))
    assert result.mean[0, 0] == pytest.approx((high - low) / 0.04, abs=2e-4)
    assert result.variance[0, 0] == pytest.approx(1 + (high - 2 * middle + low) / 0.0004, abs=2e-3)
    assert result.warnings == []


LINE, CIRCLE = np.linspace(-3.4, 3.4, 321), np.linspace(-np.pi, np.pi, 128, endpoint=False)
CASES = {
    "double well": (LINE, "x - x**3", LINE - LINE**3, 0.5, "x", LINE, False),
    "circle": (CIRCLE, "0.3 + sin(x)", 0.3 + np.sin(CIRCLE), 0.4, "cos(x)", np.cos(CIRCLE), True),
}


@pytest.mark.parametrize("kind", ["samples", "increments"])
@pytest.mark.parametrize("case", CASES)
def test_a_smoothed_density_agrees_with_sums_over_a_fine_grid(case, kind):
    x, drift, f, covariance, observation, h, closed = CASES[case]
    model = zakai.Model(
        state=["x"], drift=[drift], observation=[observation], observation_kind=kind, observation_noise=[[0.3]],
        process_noise=[[covariance]], periodic=["x"] if closed else [],
        prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.04]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record(TIMES, VALUES[:, None], kind), "yau-yau")
    expected = forward_backward(x, f, covariance, h, 0.3, np.exp(-((x - 0.4) ** 2) / 0.08), kind, closed)
    for k, density in enumerate(expected):
        with np.errstate(divide="ignore"):
            own = np.exp(result.density(k).log_density(x[:, None]))
        np.testing.assert_allclose(own, density, atol=1e-6 * density.max())
    assert result.warnings == [] and result.log_likelihood == result.filtered.log_likelihood
    np.testing.assert_allclose(result.mean[-1], result.filtered.mean[-1], atol=1e-9)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_drift_in_time_on_the_circle_agrees_with_sums_over_a_fine_grid(kind):
    x, times, values, noise = CIRCLE[::2], np.array([0.3, 0.9, 1.1]), np.array([0.5, -0.4, 0.3]), 0.1
    first, second = derivatives(x, True)
    lengths = np.diff(np.append(0.0, times))

    def advanced(state, k, backward):  # classical Runge-Kutta steps of the equation, or of its adjoint
        start, tau, h = times[k] - lengths[k], lengths[k], np.cos(x)
        inside = (h * values[k] / tau - 0.5 * h**2) / noise if kind == "increments" else np.zeros_like(x)
        count = 600

        def slope(s, u):
            drift = 0.8 * np.sin(x) + np.cos(3 * (start + (tau - s if backward else s)))
            moved = drift * (first @ u) if backward else -first @ (drift * u)
            return moved + 0.2 * (second @ u) + inside * u

        for s in tau / count * np.arange(count):
            step = tau / count
            a = slope(s, state)
            b = slope(s + step / 2, state + step / 2 * a)
            c = slope(s + step / 2, state + step / 2 * b)
            state = state + step / 6 * (a + 2 * b + 2 * c + slope(s + step, state + step * c))
        return state

    factors = [np.exp(-0.5 * (z - np.cos(x)) ** 2 / noise) if kind == "samples" else np.ones_like(x) for z in values]
    states, message = [np.exp(-((x - 0.4) ** 2) / 0.08)], np.ones_like(x)
    for k, factor in enumerate(factors):
        states.append(factor * advanced(states[-1], k, False))
    model = zakai.Model(
        state=["x"], drift=["0.8*sin(x) + cos(3*t)"], observation=["cos(x)"], observation_kind=kind, periodic=["x"],
        observation_noise=[[noise]], process_noise=[[0.4]], prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.04]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record(times, values[:, None], kind), "yau-yau")
    for k in (3, 2, 1, 0):
        expected = states[k] * message / np.sum(states[k] * message) / (x[1] - x[0])
        with np.errstate(divide="ignore"):
            own = np.exp(result.density(k).log_density(x[:, None]))
        np.testing.assert_allclose(own, expected, atol=1e-6 * expected.max())
        message = advanced(factors[k - 1] * message, k - 1, True) if k else message
    assert result.warnings == []


def test_a_drift_in_time_is_smoothed_as_by_the_gaussian_smoother():
    model = zakai.Model(
        state=["x"], drift=["-x + cos(t)*x/2 + sin(t)"], observation=["x"], observation_kind="samples",
        observation_noise=[[0.3]], prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.2]]},
    )  # fmt: skip
    record = zakai.Record(TIMES, VALUES[:, None], "samples")
    exact = zakai.smooth(model, record, "kalman-bucy")
    for method in ("yau-yau", "limited-direct"):
        grid = zakai.smooth(model, record, method)
        np.testing.assert_allclose(grid.mean, exact.mean, atol=1e-6)
        np.testing.assert_allclose(grid.variance, exact.variance, atol=1e-6)
        assert grid.warnings == []


def test_a_grid_and_a_gaussian_smoother_agree():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.2]]}
    )
    record = zakai.Record(TIMES, 0.3 * VALUES[:, None], "increments")
    grid, exact = (zakai.smooth(model, record, method) for method in ("yau-yau", "kalman-bucy"))
    np.testing.assert_allclose(grid.mean, exact.mean, atol=1e-6)
    np.testing.assert_allclose(grid.variance, exact.variance, atol=1e-6)


@pytest.fixture(scope="module")
def ignited():
    # A reactor that ignites: the drift grows from .1 to 100 within a few observations.
    model = zakai.Model(
        state=["T"], drift=["2*exp(5 - 15/(T + 2)) - 1.5*(T - 1)"], observation=["T"], observation_kind="samples",
        diffusion=[["0.2"]], observation_noise=[[0.01]], prior={"kind": "gaussian", "mean": [1], "cov": [[0.05]]},
    )  # fmt: skip
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.exponential(0.1, 120) + 0.005)
    _, record = zakai.simulate(model, times, seed=5)
    values = np.where(rng.random((120, 1)) < 0.15, np.nan, record.values)
    return model, times, values


@pytest.mark.parametrize("count", [10, 11])
def test_a_message_that_is_lost_is_said_and_stops_nothing(ignited, count):
    model, times, values = ignited
    result = zakai.smooth(model, zakai.Record(times[:count], values[:count], "samples"))
    assert np.isfinite(result.mean).all() or any("no moments were found" in line for line in result.warnings)


def test_a_sensor_with_a_kink_is_smoothed_by_both_methods():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["abs(x)"], prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.2]]}
    )
    record = zakai.Record([0.1, 0.25], [[0.05], [0.1]], "increments")
    one, other = (zakai.smooth(model, record, method, tolerance=1e-5) for method in ("yau-yau", "limited-direct"))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-5)
    assert one.warnings == other.warnings == []


def test_increments_under_noise_that_grows_with_the_state():
    """The density is skew; the reference has the state v = log x, of constant noise."""
    v, times = np.linspace(-1.3, 1.0, 400), 0.05 * np.arange(1.0, 21.0)
    x, values = np.exp(v), 0.05 * (1.0 - 0.2 * times) + 0.02 * np.sin(9.0 * times)
    model = zakai.Model(
        state=["x"], drift=["0.5*x*(1 - x)"], diffusion=[["0.2*x"]], observation=["x"], observation_noise=[[0.01]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.01]]},
    )  # fmt: skip
    smoothed = zakai.smooth(model, zakai.Record(times, values[:, None], "increments"))
    prior = x * np.exp(-50.0 * (x - 1.0) ** 2)
    densities = forward_backward(v, 0.5 * (1.0 - x) - 0.02, 0.04, x, 0.01, prior, "increments", False, times, values)
    mean = np.array([np.sum(x * one) / np.sum(one) for one in densities])
    variance = np.array([np.sum((x - m) ** 2 * one) / np.sum(one) for m, one in zip(mean, densities, strict=True)])
    assert not smoothed.warnings
    assert np.abs(smoothed.mean[:, 0] - mean).max() < 1e-5 * np.sqrt(variance.min())
    assert np.abs(smoothed.variance[:, 0] / variance - 1.0).max() < 2e-5


def test_increments_of_a_double_well_under_noise_that_depends_on_the_state():
    """The prior covers both wells."""
    x, times = np.linspace(-4.6, 4.6, 320), 0.05 * np.arange(1.0, 25.0)
    values = 0.05 * (1.0 + 0.8 * np.sin(31.0 * times))
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], diffusion=[["0.5 + 0.1*cos(x)"]], observation=["x"], observation_noise=[[0.1]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.5]]},
    )  # fmt: skip
    smoothed = zakai.smooth(model, zakai.Record(times, values[:, None], "increments"), "yau-yau")
    prior, covariance = np.exp(-(x**2)), (0.5 + 0.1 * np.cos(x)) ** 2
    densities = forward_backward(x, x - x**3, covariance, x, 0.1, prior, "increments", False, times, values)
    mean = np.array([np.sum(x * one) / np.sum(one) for one in densities])
    variance = np.array([np.sum((x - m) ** 2 * one) / np.sum(one) for m, one in zip(mean, densities, strict=True)])
    assert np.abs(smoothed.mean[:, 0] - mean).max() < 1e-6
    assert np.abs(smoothed.variance[:, 0] / variance - 1.0).max() < 1e-5


def evidence_of_double_well(record, noise, nodes, steps):
    """Return p(record | x at 0) at nodes (N,) for dx = (x - x^3) dt + dw, by implicit steps of the backward equation."""
    below, above = nodes[1:-1] - nodes[:-2], nodes[2:] - nodes[1:-1]
    drift = nodes[1:-1] - nodes[1:-1] ** 3
    lower, upper = (1 - drift * above) / (below * (below + above)), (1 + drift * below) / (above * (below + above))
    bands, b = np.zeros((3, len(nodes))), np.ones(len(nodes))
    times, values = np.append(0.0, record.times), record.values[:, 0]
    for k in range(len(values) - 1, -1, -1):
        b, length = b * norm.pdf(values[k], nodes, np.sqrt(noise)), (times[k + 1] - times[k]) / steps
        bands[0, 2:], bands[1], bands[2, :-2] = -length * upper, 1.0, -length * lower
        bands[1, 1:-1] += length * (lower + upper)
        bands[0, 1], bands[2, -2] = -1.0, -1.0  # b' is zero at the ends
        for _ in range(steps):
            b[[0, -1]] = 0.0
            b = solve_banded((1, 1), bands, b)
    return b


@pytest.mark.parametrize("variance", [25.0, 100.0])
def test_a_double_well_is_smoothed_from_a_broad_prior(variance):
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples", observation_noise=[["0.2"]],
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[variance]]},
    )  # fmt: skip
    record = zakai.Record([0.2, 0.4, 0.7], [[0.9], [1.3], [0.4]], "samples")
    result = zakai.smooth(model, record)
    scale = np.sqrt(variance)
    nodes = 0.05 * np.sinh(np.linspace(-np.arcsinh(180 * scale), np.arcsinh(180 * scale), 4001))
    coarse, fine = (evidence_of_double_well(record, 0.2, nodes, steps) for steps in (200, 400))
    weights = (2 * fine - coarse) * norm.pdf(nodes, 0.5, scale) * np.gradient(nodes)
    mean = weights @ nodes / weights.sum()
    deviation = np.sqrt(weights @ (nodes - mean) ** 2 / weights.sum())
    assert not result.warnings
    np.testing.assert_allclose(result.mean[0, 0], mean, atol=5e-4 * scale)
    np.testing.assert_allclose(np.sqrt(result.cov[0, 0, 0]), deviation, rtol=5e-4)


def test_a_law_whose_density_underflows_is_smoothed_by_both_methods():
    # A quantised sensor: beyond a few deviations of the noise erf - erf is zero, and its logarithm minus infinity.
    law = "log(erf((z + 0.25 - x)/0.0707) - erf((z - 0.25 - x)/0.0707)) - log(2)"
    model = zakai.Model(
        state=["x"], drift=["-(x - 1)/4"], diffusion=[["0.3"]], observed=["z"], observation_kind="samples",
        observation_log_density=law, prior={"kind": "gaussian", "mean": [0], "cov": [[1.0]]},
    )  # fmt: skip
    record = zakai.Record(0.5 * np.arange(1, 9), [0.0, 0.5, 0.5, 0.5, 1.0, 1.0, 0.5, 1.0], "samples")
    one, other = (zakai.smooth(model, record, method) for method in ("limited-direct", "yau-yau"))
    assert one.warnings == other.warnings == []
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-7)
