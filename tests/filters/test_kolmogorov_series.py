"""The filter with the series of the Kolmogorov kernel, against a plain solver of the same splitting and exact filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai

GAUSSIAN = {"kind": "gaussian", "mean": [0.4], "cov": [[0.3]]}


def double_well(kind: str = "increments", **changed) -> zakai.Model:
    keys = dict(
        state=["x"], drift=["x - x**3"], observation=["x**3"], diffusion=[["6/5"]], observation_noise=[["1/2"]], prior=GAUSSIAN
    )
    return zakai.Model(observation_kind=kind, **(keys | changed))


def reference(times: np.ndarray, increments: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means, variances and evidence for the double well: sinc collocation and exp of a matrix, Strang's halves on either side."""
    x = np.linspace(-4, 4, 241)
    cell, count = x[1] - x[0], len(x)
    apart = np.arange(count)[:, None] - np.arange(count)
    off = np.where(apart == 0, 1, apart)
    first = np.where(apart == 0, 0.0, (-1.0) ** apart / off) / cell
    second = np.where(apart == 0, -(np.pi**2) / 3, -2 * (-1.0) ** apart / off**2) / cell**2
    generator = 0.5 * 1.44 * second - first @ np.diag(x - x**3)
    p = np.exp(-((x - 0.4) ** 2) / 0.6)
    p, h, start, evidence, means, variances = p / p.sum(), x**3, 0.0, 0.0, [0.4], [0.3]
    for time, dy in zip(times, increments):
        span = time - start
        half = np.exp(0.5 * (h * dy - 0.5 * h**2 * span) / 0.5)
        p = half * (expm(span * generator) @ (half * p))
        evidence, start, p = evidence + np.log(p.sum()), time, p / p.sum()
        means.append(p @ x)
        variances.append(p @ (x - means[-1]) ** 2)
    return np.array(means), np.array(variances), evidence


TIMES = np.cumsum([0.05, 0.05, 0.02, 0.1, 0.05, 0.08, 0.05, 0.05, 0.05, 0.1])


@pytest.fixture(scope="module")
def observed():
    return zakai.simulate(double_well(), TIMES, seed=4)[1]


@pytest.fixture(scope="module")
def result(observed):
    return zakai.filter(double_well(), observed, "kolmogorov-series")


def test_the_posterior_is_that_of_a_plain_solver(observed, result):
    mean, variance, evidence = reference(observed.times, observed.values[:, 0])
    assert np.allclose(result.mean[:, 0], mean, rtol=0, atol=5e-6)
    assert np.allclose(result.variance[:, 0], variance, rtol=0, atol=5e-6)
    assert abs(result.log_likelihood - evidence) < 2e-5
    assert result.warnings == []


@pytest.mark.slow
def test_the_error_that_is_told_is_near_the_error(observed):
    """One transition of an interval, of few kernels, between the means of two densities."""
    mean, _, _ = reference(observed.times, observed.values[:, 0])
    for substeps in (4, 8):
        coarse = zakai.filter(double_well(), observed, "kolmogorov-series", substeps=substeps)
        error = np.max(np.abs(coarse.mean[:, 0] - mean))
        told = np.nansum(coarse.health["truncation"])
        assert error < 4 * told and told < 100 * error


@pytest.mark.slow
def test_the_error_falls_with_the_power_of_the_order(observed):
    mean, _, _ = reference(observed.times, observed.values[:, 0])

    def error(order: int, substeps: int) -> float:
        told = zakai.filter(double_well(), observed, "kolmogorov-series", order=order, substeps=substeps)
        return float(np.max(np.abs(told.mean[:, 0] - mean)))

    assert 0.8 < np.log2(error(1, 8) / error(1, 16)) < 1.3
    assert 1.7 < np.log2(error(2, 8) / error(2, 16)) < 2.7


@pytest.mark.slow
def test_too_few_kernels_and_the_sum_are_warned_of():
    model = double_well("samples")
    record = zakai.simulate(model, [0.3, 0.6], seed=2)[1]
    few = zakai.filter(model, record, "kolmogorov-series", substeps=1)
    assert any("truncation" in words for words in few.warnings)
    added = zakai.filter(model, record, "kolmogorov-series", substeps=8, form="sum")
    assert any("truncation" in words or "lost" in words for words in added.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_where_an_exact_filter_exists_the_posterior_is_its(kind):
    keys = dict(
        state=["x"], drift=["0.8*tanh(0.8*x)"], observation=["1.2*x"], observation_noise=[["1/5"]], observation_kind=kind
    )
    model = zakai.Model(prior=GAUSSIAN, **keys)
    times = np.arange(0 if kind == "samples" else 1, 41) / 40
    record = zakai.simulate(model, times, seed=1)[1]
    exact = zakai.filter(model, record, "limited-direct" if kind == "samples" else "benes")
    series = zakai.filter(model, record, "kolmogorov-series")
    # Samples leave only the transition; increments are split, which is of second order in the interval.
    atol = 1e-5 if kind == "samples" else 2e-3
    assert np.allclose(series.mean, exact.mean, rtol=0, atol=atol) and np.allclose(series.cov, exact.cov, rtol=0, atol=atol)
    assert abs(series.log_likelihood - exact.log_likelihood) < 20 * atol


def test_a_sensor_may_depend_on_time_and_a_drift_may_not():
    model = double_well(observation=["x*cos(t)"], observation_noise=[["1 + t"]])
    assert np.isfinite(zakai.filter(model, zakai.simulate(model, [0.1, 0.2], seed=0)[1], "kolmogorov-series").mean).all()
    for changed, said in (
        (dict(drift=["t*x"]), "constant in time"),
        (dict(diffusion=[["1 + t"]]), "constant in time"),
        (dict(drift=["abs(x)"]), "smooth"),
        (dict(diffusion=[["0"]]), "positive definite"),
        (dict(periodic=["x"], drift=["sin(x)"], observation=["cos(x)"]), "no angle"),
    ):
        other = double_well(**changed)
        with pytest.raises(zakai.ConditionError, match=said):
            zakai.filter(other, zakai.Record([0.1], [[0.0]], "increments"), "kolmogorov-series")


@pytest.mark.parametrize(
    "options", [dict(order=0), dict(order=True), dict(substeps=0), dict(substeps=1.5), dict(form="x"), dict(splitting="x")]
)
def test_an_option_that_cannot_be_is_refused_in_one_line(options):
    record = zakai.Record([0.1], [[0.0]], "increments")
    with pytest.raises(zakai.InputError, match=f"option {next(iter(options))}"):
        zakai.filter(double_well(), record, "kolmogorov-series", **options)


def test_intervals_that_are_too_short_for_a_lattice_are_refused():
    with pytest.raises(zakai.InputError, match="too short"):
        zakai.filter(double_well(), zakai.Record([1e-7, 2e-7], [[0.0], [0.0]], "increments"), "kolmogorov-series")


@pytest.mark.slow
def test_an_observation_that_contradicts_the_prior_is_followed_or_warned_of():
    model = double_well("samples", observation=["x"], observation_noise=[["1/100"]], drift=["-x"])
    record = zakai.Record([0.1, 0.2], [[7.0], [7.0]], "samples")
    result = zakai.filter(model, record, "kolmogorov-series")
    exact = zakai.filter(model, record, "kalman-bucy")
    assert result.warnings or np.allclose(result.mean, exact.mean, atol=1e-4)
