"""Gaussian sums with several modes: over whole paths of the spiral sensor."""

from __future__ import annotations

import numpy as np

import zakai


def spiral(variance, **changes):
    keys = {
        "state": ["x"], "drift": ["t/40 * x"], "observation": ["x*sin(x)", "x*cos(x)"], "observation_kind": "increments",
        "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[variance]]},
    }  # fmt: skip
    return zakai.Model(**(keys | changes))


def test_paths_that_begin_anywhere_in_the_prior_keep_the_weights_of_their_modes():
    model = spiral(3.0)
    # A longer path, and the beginnings of five.
    steps = [300] + [80] * 5
    truths, records = zip(*(zakai.simulate(model, np.arange(1, K + 1) * 0.01, seed=4000 + i) for i, K in enumerate(steps)))
    exact, filtered = (
        zakai.filter(model, list(records), method, keep="moments") for method in ("limited-direct", "general-direct")
    )

    def squared(results):
        pairs = zip(results, truths)
        return np.array([np.mean((one.mean[-1000:, 0] - truth.values[-1000:, 0]) ** 2) for one, truth in pairs])

    ratio = squared(filtered) / squared(exact)
    assert abs(squared(filtered).mean() / squared(exact).mean() - 1) <= 0.02 and np.abs(ratio - 1).max() <= 0.1
    away = [(one.mean - other.mean)[:, 0] / np.sqrt(other.variance[:, 0]) for one, other in zip(filtered, exact)]
    assert np.sqrt(np.mean(np.square(np.concatenate(away)))) <= 0.015
    assert all(result.warnings or np.abs(error).max() <= 0.1 for result, error in zip(filtered, away))
