"""Samples that are much sharper than the noise of an interval, against Bayes' rule by dense sums with a kernel in closed form.

For dx = tanh(x) dt + dv the transition density is cosh(x) / cosh(y) exp(-tau / 2) N(x; y, tau) (Benes 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.special import gammaln

import zakai

POINTS = 801


def model_of(h: str, **law: Any) -> zakai.Model:
    return zakai.Model(
        state=["x"],
        drift=["tanh(x)"],
        observation=[h],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
        **law,
    )


def dense(times: np.ndarray, log_likelihood: Callable[[int, np.ndarray], Any]) -> tuple[np.ndarray, np.ndarray, float]:
    """Means, standard deviations and the log-likelihood by sums over points that zoom in on each posterior."""

    def log_cosh(x: np.ndarray) -> np.ndarray:
        return np.logaddexp(x, -x)

    y, before, found, total = np.linspace(-9.0, 9.0, POINTS), 0.0, [], 0.0
    p = np.exp(-0.5 * y**2) / np.sum(np.exp(-0.5 * y**2))
    for k, t in enumerate(times):
        tau, before = t - before, t
        y, p = y[p > 1e-30 * p.max()], p[p > 1e-30 * p.max()]
        reach = 12.0 * np.sqrt(tau) + tau
        low, high = y[0] - reach, y[-1] + reach
        for _ in range(60):
            x = np.linspace(low, high, POINTS)
            logs = log_cosh(x)[:, None] - log_cosh(y) - 0.5 * (x[:, None] - y) ** 2 / tau + np.log(p)
            top = logs.max(axis=1)
            logs = top + np.log(np.exp(logs - top[:, None]).sum(axis=1)) - 0.5 * tau - 0.5 * np.log(2 * np.pi * tau)
            logs = logs + log_likelihood(k, x)
            used = np.flatnonzero(logs > logs.max() - 45.0)
            inner = x[max(used[0] - 1, 0)], x[min(used[-1] + 1, POINTS - 1)]
            if inner[1] - inner[0] > 0.7 * (high - low):
                break
            low, high = inner
        mass = np.exp(logs - logs.max())
        total += np.log(mass.sum() * (x[1] - x[0])) + logs.max()
        y, p = x, mass / mass.sum()
        found.append((p @ x, np.sqrt(p @ (x - p @ x) ** 2)))
    means, deviations = np.array(found).T
    return means, deviations, float(total)


def agrees(model: zakai.Model, times: np.ndarray, values: np.ndarray, log_likelihood: Callable[[int, np.ndarray], Any]) -> None:
    result = zakai.filter(model, zakai.Record(times, values[:, None], "samples"), "yau-yau")
    means, deviations, total = dense(times, log_likelihood)
    errors = np.abs(result.mean[-len(times) :, 0] - means) / deviations
    errors = np.maximum(errors, np.abs(np.sqrt(result.cov[-len(times) :, 0, 0]) / deviations - 1.0))
    estimates = result.health["error_estimate"][-len(times) :]
    assert not result.warnings
    assert np.all(estimates < 1e-6)
    assert np.all(errors < 10.0 * estimates)
    assert np.isclose(result.log_likelihood, total, rtol=0, atol=1e-6)


TIMES = np.cumsum([0.3, 0.05, 0.41, 0.2, 1.6, 0.1, 0.1, 0.33, 0.06, 0.25])


def observed(model: zakai.Model, outlier: float) -> np.ndarray:
    """A record with a gap of two rows and an outlier."""
    _, record = zakai.simulate(model, TIMES, seed=4)
    values = record.values[:, 0].copy()
    values[[5, 6]], values[3] = np.nan, values[3] + outlier
    return values


@pytest.mark.parametrize("noise", ["1e-8", "1e-5", "1e-3"])
def test_sharp_samples_agree_with_dense_sums(noise: str) -> None:
    model, S = model_of("x + x**3/4", observation_noise=[[noise]]), float(noise)
    values = observed(model, 50.0 * np.sqrt(S))

    def log_likelihood(k: int, x: np.ndarray) -> Any:
        return 0.0 if np.isnan(values[k]) else -0.5 * (values[k] - x - x**3 / 4) ** 2 / S - 0.5 * np.log(2 * np.pi * S)

    agrees(model, TIMES, values, log_likelihood)


def test_two_sharp_modes_agree_with_dense_sums() -> None:
    model = model_of("x**2", observation_noise=[["1e-2"]])
    values = np.array([1.1, 0.9, 0.4, np.nan, 1.6, 2.2])

    def log_likelihood(k: int, x: np.ndarray) -> Any:
        return 0.0 if np.isnan(values[k]) else -50.0 * (values[k] - x**2) ** 2 - 0.5 * np.log(2 * np.pi * 0.01)

    agrees(model, TIMES[:6], values, log_likelihood)


def test_sharp_samples_of_a_moving_sensor_agree_with_dense_sums() -> None:
    model = model_of("x*(2 + cos(t)) + sin(x)", observation_noise=[["1e-4"]])
    values = observed(model, 0.0)

    def log_likelihood(k: int, x: np.ndarray) -> Any:
        h = x * (2.0 + np.cos(TIMES[k])) + np.sin(x)
        return 0.0 if np.isnan(values[k]) else -0.5 * (values[k] - h) ** 2 / 1e-4 - 0.5 * np.log(2e-4 * np.pi)

    agrees(model, TIMES, values, log_likelihood)


@pytest.mark.parametrize("rate", [2.0, 5000.0])
def test_few_and_many_counts_agree_with_dense_sums(rate: float) -> None:
    model = model_of(f"{rate}*exp(x)", observation_family="poisson")
    values = observed(model, 0.0)

    def log_likelihood(k: int, x: np.ndarray) -> Any:
        mean = rate * np.exp(x)
        return 0.0 if np.isnan(values[k]) else values[k] * np.log(mean) - mean - gammaln(values[k] + 1.0)

    agrees(model, TIMES, values, log_likelihood)


LAWS: dict[str, dict[str, Any]] = {
    "x + x**3/4": {"observation_noise": [["1e-5"]]},
    "400*exp(x)": {"observation_family": "poisson"},
}


@pytest.mark.parametrize("h", LAWS)
def test_an_online_filter_takes_the_same_sharp_steps(h: str) -> None:
    model = model_of(h, **LAWS[h])
    times = np.cumsum(np.random.default_rng(1).uniform(0.02, 0.4, 12))
    _, record = zakai.simulate(model, times, seed=3)
    values = record.values.copy()
    values[[7, 8]] = np.nan
    record = zakai.Record(times, values, "samples")
    whole = zakai.filter(model, record, "yau-yau")
    online = zakai.online(model, "yau-yau")
    rows = [online.update(t, row) for t, row in zip(times, values)]
    assert np.array_equal(whole.mean[-12:], [row.mean for row in rows])
    assert np.array_equal(whole.cov[-12:], [row.cov for row in rows])
