"""Grids of two states where a density has a kink, is stretched or falls into narrow peaks, against particles and quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai

FRICTION = {
    "state": ["x", "v"], "drift": ["v", "-x - v*abs(v)/2"], "diffusion": [["0"], ["1/2"]], "observation": ["x"],
    "observation_kind": "samples", "observation_noise": [["1/25"]],
    "prior": {"kind": "gaussian", "mean": [1.0, 0.0], "cov": [0.2, 0.2]},
}  # fmt: skip
PREDATOR = {
    "state": ["u", "v"], "drift": ["1 - exp(v)", "exp(u) - 1"], "process_noise": [["1/20", "0"], ["0", "1/20"]],
    "observation": ["exp(u)"], "observation_kind": "samples", "observation_noise": [["1/25"]],
    "prior": {"kind": "gaussian", "mean": [0.3, 0.0], "cov": [0.1, 0.1]},
}  # fmt: skip
# A kink in f, whose spectrum decreases slowly, and gaps in which a nonlinear drift stretches the density.
SYSTEMS = {
    "kink": (
        FRICTION, lambda x, v: (v, -x - v * np.abs(v) / 2), lambda x, v: x, (0.0, 0.5), np.full(90, 0.1), 0.0, 1, 6000, 20_000,
    ),
    "gaps": (
        PREDATOR, lambda u, v: (1 - np.exp(v), np.exp(u) - 1), lambda u, v: np.exp(u), (0.05**0.5, 0.05**0.5),
        np.random.default_rng(1).exponential(0.2, 45) + 0.01, 0.5, 3, 20000, 100_000,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_density_with_a_slow_spectrum_has_a_small_grid_and_the_moments_of_particles(name):
    keys, drift, observe, root, gaps, missing, seed, most, count = SYSTEMS[name]
    model, times, noise = zakai.Model(**keys), np.cumsum(gaps), 0.04
    _, record = zakai.simulate(model, times, seed=seed)
    values = np.where(np.random.default_rng(2).random(record.values.shape) < missing, np.nan, record.values)
    result = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau")
    assert not result.warnings
    assert max(result.density(k).log_values.size for k in range(len(times) + 1)) < most
    rng = np.random.default_rng(0)
    a, b = rng.multivariate_normal(keys["prior"]["mean"], np.diag(keys["prior"]["cov"]), count).T
    for k, (gap, z) in enumerate(zip(gaps, values[:, 0], strict=True)):
        steps = int(np.ceil(gap / 0.04))
        for _ in range(steps):
            # Heun's formula, of weak order two for noise that does not depend on the state.
            h, (v, w) = gap / steps, np.sqrt(gap / steps) * rng.standard_normal((2, count))
            f, g = drift(a, b)
            p, q = drift(a + h * f + root[0] * v, b + h * g + root[1] * w)
            a, b = a + h / 2 * (f + p) + root[0] * v, b + h / 2 * (g + q) + root[1] * w
        if not np.isnan(z):
            weights = np.exp(-0.5 * (z - observe(a, b)) ** 2 / noise)
            index = (np.arange(count) + rng.uniform()) / count
            chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), index).clip(0, count - 1)
            a, b = a[chosen], b[chosen]
        deviations = np.sqrt(result.variance[k + 1])
        assert np.abs((np.array([a.mean(), b.mean()]) - result.mean[k + 1]) / deviations).max() < 0.1
        assert np.abs(np.array([a.std(), b.std()]) / deviations - 1).max() < 0.1


def test_an_epidemic_near_extinction_agrees_with_particles():
    # Infections move a person from s to i: the noise of both is correlated, depends on them, and vanishes with a kink at i = 0.
    model = zakai.Model(
        state=["s", "i"], drift=["-2*s*i", "2*s*i - i"], observation=["i"], observation_kind="samples",
        diffusion=[["-sqrt(abs(s*i)/50)", "0"], ["sqrt(abs(s*i)/50)", "sqrt(abs(i)/100)"]], observation_noise=[["1/2500"]],
        prior={"kind": "gaussian", "mean": [0.9, 0.05], "cov": [4e-4, 1e-4]},
    )  # fmt: skip
    times, count, steps, rng = 0.2 * np.arange(1, 10), 100_000, 10, np.random.default_rng(0)
    _, record = zakai.simulate(model, times, seed=1)
    result = zakai.filter(model, record, "yau-yau")
    assert max(result.density(k).log_values.size for k in range(len(times) + 1)) < 20_000
    s, i = rng.normal(0.9, 0.02, count), rng.normal(0.05, 0.01, count)
    for k, z in enumerate(np.asarray(record.values)[:, 0]):
        h = 0.2 / steps
        for _ in range(steps):
            v, w = np.sqrt(h) * rng.standard_normal((2, count))
            infected, recovered = np.sqrt(np.abs(s * i) / 50) * v, np.sqrt(np.abs(i) / 100) * w
            s, i = s - 2 * s * i * h - infected, i + (2 * s * i - i) * h + infected + recovered
        weights = np.exp(-0.5 * (z - i) ** 2 * 2500)
        chosen = np.searchsorted(np.cumsum(weights) / weights.sum(), (np.arange(count) + rng.uniform()) / count)
        s, i = s[chosen.clip(0, count - 1)], i[chosen.clip(0, count - 1)]
        deviations = np.sqrt(result.variance[k + 1])
        assert np.abs((np.array([s.mean(), i.mean()]) - result.mean[k + 1]) / deviations).max() < 0.03
        assert np.abs(np.array([s.std(), i.std()]) / deviations - 1).max() < 0.015


def test_the_moments_are_those_of_the_density_at_a_small_tolerance():
    model = zakai.Model(
        state=["x", "y"], drift=["cos(x) + sin(y)/2", "cos(y)"], observation=["x**3", "y**3"], observation_kind="increments",
        observation_noise=[[1, 0], [0, 1]], prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.05, 0.05]},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.01 * np.arange(1, 26), seed=2)
    result = zakai.filter(model, record, "yau-yau", tolerance=1e-5)
    for k in range(1, 26):
        density = result.density(k)
        weights = np.exp(density.log_values - density.log_values.max())
        index = np.stack(np.meshgrid(*(np.arange(size) - size // 2 for size in weights.shape), indexing="ij"), axis=-1)
        x = density.centre + index @ density.basis.T
        mean = np.tensordot(weights, x, axes=2) / weights.sum()
        variance = np.tensordot(weights, (x - mean) ** 2, axes=2) / weights.sum()
        assert np.abs((result.mean[k] - mean) / np.sqrt(variance)).max() < 1e-6
        assert np.abs(result.variance[k] / variance - 1).max() < 1e-6


@pytest.mark.parametrize(("wave", "noise"), [(2.0, 0.02), (2.0, 0.002), (3.0, 0.01)])
def test_a_sample_that_leaves_several_narrow_peaks(wave, noise):
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x - 0.3*v"], diffusion=[["0"], ["0.5"]], observation=[f"sin({wave}*x)"],
        observation_kind="samples", observation_noise=[[str(noise)]],
        prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [[0.2, 0.0], [0.0, 0.1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.4], [[0.3]], kind="samples"), "yau-yau")
    A, prior = np.array([[0.0, 1.0], [-1.0, -0.3]]), np.diag([0.2, 0.1])
    both = expm(0.4 * np.block([[-A, np.diag([0.0, 0.25])], [np.zeros((2, 2)), A.T]]))  # Van Loan
    move = both[2:, 2:].T
    mean, cov = move @ [1.0, 0.0], move @ prior @ move.T + move @ both[:2, 2:]
    x = mean[0] + np.sqrt(cov[0, 0]) * np.linspace(-8.0, 8.0, 40_001)
    logs = -((x - mean[0]) ** 2) / (2 * cov[0, 0]) - (0.3 - np.sin(wave * x)) ** 2 / (2 * noise)
    weights = np.exp(logs) / np.exp(logs).sum()
    slope = cov[1, 0] / cov[0, 0]
    found = weights @ x, mean[1] + slope * (weights @ x - mean[0])
    spread = weights @ (x - found[0]) ** 2, cov[1, 1] - slope * cov[0, 1] + slope**2 * (weights @ (x - found[0]) ** 2)
    evidence = np.log(np.exp(logs).sum() * (x[1] - x[0])) - 0.5 * np.log(2 * np.pi * cov[0, 0]) - 0.5 * np.log(2 * np.pi * noise)
    assert not result.warnings
    assert np.allclose(result.mean[1], found, atol=1e-3 * np.sqrt(spread[0]))
    assert np.allclose(result.variance[1], spread, rtol=2e-3)
    assert abs(result.log_likelihood - evidence) < 1e-3


def test_two_precise_ranges_leave_two_peaks_by_the_method_of_auto():
    model = zakai.Model(
        state=["x", "y"], drift=["-x/10", "-y/10"], diffusion=[["1/2", "0"], ["0", "1/2"]], observation_kind="samples",
        observation=["sqrt(x**2 + y**2)", "sqrt((x - 3)**2 + y**2)"], observation_noise=[["1/400", "0"], ["0", "1/400"]],
        prior={"kind": "gaussian", "mean": [1, 0], "cov": [4, 4]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([2.0], [[1.99, 3.23]], "samples"))
    mean, variance = np.exp(-0.2), 4 * np.exp(-0.4) + 1.25 * (1 - np.exp(-0.4))
    axis = np.linspace(-8, 8, 3200)
    x, y = axis[:, None], axis
    prior = np.exp(-((x - mean) ** 2 + y**2) / (2 * variance)) / (2 * np.pi * variance)
    ranges = np.hypot(x, y), np.hypot(x - 3, y)
    product = prior * np.exp(-200 * ((1.99 - ranges[0]) ** 2 + (3.23 - ranges[1]) ** 2)) * 200 / np.pi
    mass = product.sum()
    assert abs(result.log_likelihood - np.log(mass * (axis[1] - axis[0]) ** 2)) < 1e-3
    along = product.sum(axis=1) / mass
    middle = along @ axis
    deviations = np.sqrt([along @ (axis - middle) ** 2, product.sum(axis=0) @ axis**2 / mass])
    assert abs(result.mean[1, 0] - middle) < 1e-3 * deviations[0]
    assert np.abs(np.sqrt(result.variance[1]) / deviations - 1).max() < 1e-3
    assert not result.warnings
