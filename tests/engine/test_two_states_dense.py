"""Smoothing, paths and residuals of coupled systems of two states, against finite volumes and Bayes' rule on a fixed grid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import expm_multiply
from scipy.stats import norm, poisson

import zakai

TIMES = np.array([0.2, 0.3, 0.55, 0.9])
LAWS = {
    "samples": (
        {"observation": ["x + y/5"], "observation_noise": [["0.09"]]},
        [0.6, np.nan, 0.1, 0.2],
        lambda z, x, y: norm.pdf(z, x + y / 5, 0.3),
        lambda z, x, y: np.array([norm.cdf(z, x + y / 5, 0.3)] * 2),
    ),
    "counts": (
        {"observation": ["exp(4*x/5)"], "observation_family": "poisson"},
        [2, np.nan, 0, 1],
        lambda z, x, y: poisson.pmf(z, np.exp(0.8 * x)),
        lambda z, x, y: np.array([poisson.cdf(z - 1, np.exp(0.8 * x)), poisson.cdf(z, np.exp(0.8 * x))]),
    ),
}


def generator(size, ends, drift, noise):
    """Points (N, 2) of a grid between two ends, and the matrix of a drift and the variances of independent noise."""
    low, high = np.array(ends)
    space = (high - low) / size
    index = np.arange(size * size).reshape(size, size)
    points = low + space * (np.stack(np.unravel_index(index.ravel(), (size, size)), axis=1) + 0.5)
    entries = []
    for axis, spread in enumerate(noise):
        i, j = (np.delete(index, end, axis=axis).ravel() for end in (-1, 0))
        x, y = 0.5 * (points[i] + points[j]).T
        f = drift(x, y)[axis]
        forth, back = (0.5 * (sign * f + spread / space[axis]) / space[axis] for sign in (1, -1))
        entries += [(j, i, forth), (i, i, -forth), (i, j, back), (j, j, -back)]
    rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    return points, csr_matrix((values, (rows, columns)))


def dense(size, system, prior, times, values, likelihood, cdf=None):
    """Smoothed means and covariances, P(Z < z), P(Z <= z) for each row that is observed, and E[x_k x_(k+1)']."""
    points, matrix = generator(size, *system)
    x, y = points.T
    forward, laws, starts = [np.exp(-0.5 * ((points - prior["mean"]) ** 2 / prior["cov"]).sum(axis=1))], [], [0.0, *times]
    factors = [np.ones(len(x)) if np.isnan(z) else likelihood(z, x, y) for z in values]
    for k, z in enumerate(values):
        predicted = expm_multiply(matrix * (times[k] - starts[k]), forward[-1])
        if cdf and not np.isnan(z):
            laws.append(cdf(z, x, y) @ predicted / predicted.sum())
        forward.append(predicted * factors[k] / (predicted * factors[k]).sum())
    message, rows, lagged = np.ones(len(x)), [], []
    for k in range(len(values), -1, -1):
        weights = forward[k] * message / (forward[k] @ message)
        mean = weights @ points
        rows.append(np.column_stack([mean, (points - mean).T @ (weights[:, None] * (points - mean))]))
        if k:
            ahead = expm_multiply(matrix * (times[k - 1] - starts[k - 1]), forward[k - 1][:, None] * points)
            joint = (factors[k - 1] * message)[:, None] * ahead
            total = factors[k - 1] * message @ expm_multiply(matrix * (times[k - 1] - starts[k - 1]), forward[k - 1])
            lagged.append(joint.T @ points / total)
            message = expm_multiply(matrix.T.tocsr() * (times[k - 1] - starts[k - 1]), factors[k - 1] * message)
    return np.array(rows[::-1]), np.array(laws), np.array(lagged[::-1])


def extrapolated(*arguments):
    """What finite volumes of second order converge to."""
    coarse, fine = (dense(size, *arguments) for size in (60, 90))
    return [b + 0.8 * (b - a) for a, b in zip(coarse, fine, strict=True)]


def assert_smoothed(smoothed, moments):
    deviation = np.sqrt(moments[:, [0, 1], [1, 2]])
    assert not smoothed.warnings
    assert np.all(np.abs(smoothed.mean - moments[:, :, 0]) < 2e-3 * deviation)
    assert np.all(np.abs(smoothed.cov - moments[:, :, 1:]) < 4e-3 * deviation[:, :, None] * deviation[:, None])


@pytest.mark.parametrize("law", LAWS)
def test_smoothing_paths_and_residuals_are_those_of_a_dense_grid(law):
    keys, values, likelihood, cdf = LAWS[law]
    prior = {"kind": "gaussian", "mean": [0.5, 0.0], "cov": [0.3, 0.3]}
    model = zakai.Model(
        state=["x", "y"], drift=["y", "(1 - x**2)*y - x"], diffusion=[["1/2", "0"], ["0", "7/10"]], observation_kind="samples",
        prior=prior, **keys,
    )  # fmt: skip
    smoothed = zakai.smooth(model, zakai.Record(TIMES, np.array(values)[:, None], "samples"), "yau-yau")
    system = ((-4.5, -5.5), (4.5, 5.5)), lambda x, y: (y, (1 - x**2) * y - x), (0.25, 0.49)
    moments, laws, lagged = extrapolated(system, prior, TIMES, values, likelihood, cdf)
    assert_smoothed(smoothed, moments)
    paths = smoothed.sample_paths(4000, seed=1)
    products = paths[:, :-1, :, None] * paths[:, 1:, None, :]
    assert np.all(np.abs(products.mean(axis=0) - lagged) < 4 * products.std(axis=0) / np.sqrt(len(paths)))
    found = smoothed.filtered.residuals(seed=5)
    draws = np.random.default_rng(5).uniform(size=found.shape)
    seen = ~np.isnan(values)
    assert np.isnan(found[~seen]).all()
    expected = laws[:, 0] + draws[seen, 0] * (laws[:, 1] - laws[:, 0])
    assert found[seen, 0] == pytest.approx(expected, abs=5e-4)


def test_an_excitable_neuron_is_smoothed_while_it_fires():
    # The fast coordinate contracts by e^-8 in the last interval; backward in time it leaves every grid.
    times, counts, prior = np.array([0.15, 0.4, 0.7]), [0, 3, 5], {"kind": "gaussian", "mean": [-1.0, 0.0], "cov": [0.1, 0.05]}
    model = zakai.Model(
        state=["v", "w"], drift=["10*(v - v**3/3 - w + 1/2)", "(v + 7/10 - 4*w/5)/10"], process_noise=[["9/10", 0], [0, "1/25"]],
        observation=["exp(v)"], observation_kind="samples", observation_family="poisson", prior=prior,
    )  # fmt: skip
    smoothed = zakai.smooth(model, zakai.Record(times, np.array(counts, float)[:, None], "samples"), "yau-yau")
    system = ((-3.0, -1.2), (3.2, 1.6)), lambda v, w: (10 * (v - v**3 / 3 - w + 0.5), (v + 0.7 - 0.8 * w) / 10), (0.9, 0.04)
    moments, *_ = extrapolated(system, prior, times, counts, lambda z, v, w: poisson.pmf(z, np.exp(v)))
    assert_smoothed(smoothed, moments)
