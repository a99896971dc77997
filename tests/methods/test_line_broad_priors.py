"""A steep drift maps a broad or distant prior on a narrow density within one interval: against an independent solution."""

from __future__ import annotations

import time

import numpy as np
import pytest

import zakai
from references.graded import posterior, sinh_faces

TIMES, VALUES, NOISE = np.array([0.5, 1.0, 1.5]), np.array([0.8, 1.1, 0.9]), 0.2


def filtered(drift: str, mean: float, variance: float, kind: str = "samples", **keys):
    model = zakai.Model(
        state=["x"], drift=[drift], observation=["x"], observation_noise=[[NOISE]], observation_kind=kind,
        prior={"kind": "gaussian", "mean": [mean], "cov": [variance]}, **keys,
    )
    return zakai.filter(model, zakai.Record(TIMES, VALUES[:, None], kind), "yau-yau")


def reference(drift, mean: float, variance: float, count: int = 4000, stages: int = 80):
    reach = 9 * np.sqrt(variance)
    faces = sinh_faces(min(mean - reach, -6.0), max(mean + reach, 6.0), 0.5, count)
    likelihoods = [lambda x, y=y: -0.5 * (y - x) ** 2 / NOISE - 0.5 * np.log(2 * np.pi * NOISE) for y in VALUES]
    first = 0.05 * float(np.min(np.abs(faces[[0, -1]] / drift(faces[[0, -1]]))))
    return posterior(drift, lambda x: -0.5 * (x - mean) ** 2 / variance, TIMES, likelihoods, faces, first, stages)


def holds(result: zakai.FilterResult, expected, allowed: float) -> bool:
    means, variances, total = expected
    wrong = np.abs(result.mean[1:, 0] - means) / np.sqrt(variances)
    return max(wrong.max(), np.abs(result.variance[1:, 0] / variances - 1).max(), abs(result.log_likelihood - total)) < allowed


@pytest.mark.parametrize(
    ("formula", "drift", "mean", "variance"),
    [
        ("x - x**3", lambda x: x - x**3, 0.0, 10.0),
        ("x - x**3", lambda x: x - x**3, 0.0, 100.0),
        ("x - x**3", lambda x: x - x**3, 0.0, 1e4),
        ("x - x**3", lambda x: x - x**3, 100.0, 1e4),
        ("-x**5", lambda x: -(x**5), 0.0, 100.0),
        ("-x*abs(x)", lambda x: -x * np.abs(x), 0.0, 100.0),
    ],
)
def test_a_broad_prior_contracts_to_the_right_density_in_about_a_second(formula, drift, mean, variance):
    begin = time.process_time()
    result = filtered(formula, mean, variance)
    assert time.process_time() - begin < 6.0
    assert not result.warnings
    assert holds(result, reference(drift, mean, variance), 2e-4)


def test_increments_contract_a_broad_prior_too():
    result = filtered("x - x**3", 0.0, 100.0, "increments")
    assert not result.warnings
    faces = sinh_faces(-90.0, 90.0, 0.5, 3000)
    potentials = [lambda x, y=y: (2.0 * y * x - 0.5 * x * x) / NOISE for y in VALUES]
    nothing = [np.zeros_like] * 3
    expected = posterior(lambda x: x - x**3, lambda x: -x * x / 200, TIMES, nothing, faces, 1e-5, 240, potentials)
    assert holds(result, expected, 2e-4)


def test_a_distant_prior_moves_to_the_right_density():
    result = filtered("x - x**3", 30.0, 1.0)
    assert not result.warnings
    assert holds(result, reference(lambda x: x - x**3, 30.0, 1.0, 6000, 120), 2e-4)


def test_coefficients_of_time_contract_a_broad_prior_too():
    result, still = filtered("x - x**3 + 0*sin(t)", 0.0, 1e4), filtered("x - x**3 + 1e-9*sin(t)", 0.0, 1e4)
    assert not result.warnings and not still.warnings
    assert np.abs(result.mean - still.mean)[1:].max() < 1e-5


def test_a_drift_that_grows_exponentially_is_followed():
    result = filtered("-sinh(x)", 0.0, 100.0)
    expected = reference(lambda x: -np.clip(np.sinh(x), -1e8, 1e8), 0.0, 100.0, 4000, 120)
    assert not result.warnings
    assert holds(result, expected, 4e-4)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_density_that_no_grid_holds_is_lost_and_stays_lost(smooth):
    """The logarithm of a state grows as exp(2 t): modes near zero stay narrow while tails pass every bound."""
    model = zakai.Model(
        state=["x"], drift=["x*log(x**2 + 1)"], observation=["x"], observation_kind="samples", observation_noise=[["0.2"]],
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.5]]},
    )  # fmt: skip
    record = zakai.Record([1.0, 2.0, 3.0], [[1.9], [0.2], [-1.1]], "samples")
    result = (zakai.smooth if smooth else zakai.filter)(model, record)
    assert any("the density was lost at t = 1" in warning for warning in result.warnings)
    assert smooth or np.isnan(result.mean[1:]).all()


def test_a_drift_with_nearly_no_noise_folds_a_prior_into_sharp_fronts():
    step, observed, q = 0.2, 0.8, 1e-4
    model = zakai.Model(
        state=["x"], drift=["-5*x**3"], process_noise=[[q]], observation=["x"], observation_noise=[[0.01]],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.5]]},
    )
    result = zakai.filter(model, zakai.Record([step], [[observed]], "samples"), "yau-yau")
    assert not result.warnings and result.health["tolerance_ratio"][-1] < 1.0
    # Each state moves to x / s with s^2 = 1 + 10 t x^2, and its noise has the variance v of v' = -30 v x(t)^2 + q.
    x = np.linspace(-6.0, 8.0, 40001)
    s2 = 1 + 10 * step * x**2
    mean, variance = x / np.sqrt(s2), q * (s2**4 - 1) / (40 * np.where(x == 0, 1, x) ** 2 * s2**3)
    variance[x == 0] = q * step
    logs = -((x - 1) ** 2) - 0.5 * (observed - mean) ** 2 / (variance + 0.01) - 0.5 * np.log(variance + 0.01)
    p = np.exp(logs) / np.exp(logs).sum()
    centre, left = mean + variance / (variance + 0.01) * (observed - mean), 0.01 * variance / (variance + 0.01)
    total = p @ centre
    deviation = np.sqrt(p @ (left + (centre - total) ** 2))
    assert abs(result.mean[-1, 0] - total) < 1e-3 * deviation
    assert abs(np.sqrt(result.variance[-1, 0]) / deviation - 1) < 1e-3
