"""The filters of other libraries against exact filters, and against FilterPy, a third library."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.stats import multivariate_normal

import zakai
from peers.reference import filtered
from peers.systems import linear, record_of, spiral

TIMES = np.cumsum([0.1, 0.05, 0.2, 0.1, 0.1, 0.15, 0.05, 0.1, 0.3, 0.1])


def apart(result: zakai.FilterResult, exact: tuple[np.ndarray, ...]) -> np.ndarray:
    """Root mean square distances of the means, covariances and log-likelihood increments."""
    ours = result.mean[1:], result.cov[1:], result.log_likelihood_increments[1:]
    return np.array([np.sqrt(np.mean((one - other) ** 2)) for one, other in zip(ours, exact, strict=True)])


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_sampled_linear_system_is_filtered_exactly_but_for_the_substeps(name):
    record = record_of(linear("samples"), TIMES, gaps=True)
    assert (apart(zakai.filter(linear("samples"), record, name, substeps=8), filtered(record)) < 2e-5).all()


@pytest.mark.parametrize(("scheme", "order"), [("midpoint", 2), ("euler", 1)])
def test_the_order_of_the_substeps_is_as_it_is_said(scheme, order):
    record = record_of(linear("samples"), TIMES, gaps=True)
    results = [zakai.filter(linear("samples"), record, "ekf", scheme=scheme, substeps=k) for k in (4, 8)]
    coarse, fine = (apart(result, filtered(record)) for result in results)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_increments_of_a_linear_system_are_exact_to_first_order_in_the_interval(name):
    model = linear("increments")
    path = np.cumsum(record_of(model, np.arange(1, 129) / 64).values, axis=0)
    errors = []
    for every in (2, 1):
        times, values = np.arange(every, 129, every) / 64, np.diff(path[every - 1 :: every], axis=0, prepend=0.0)
        record = zakai.Record(times, values, "increments")
        errors.append(apart(zakai.filter(model, record, name), filtered(record))[:2])
    assert (errors[1] < 0.01).all()
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("kind", ["increments", "samples"])
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_nonlinear_system_with_gaps_is_filtered_as_by_filterpy(name, kind):
    model = spiral(kind)
    record = record_of(model, TIMES, gaps=True)
    result = zakai.filter(model, record, name, scheme="euler")
    ukf = UnscentedKalmanFilter(1, 2, None, None, None, MerweScaledSigmaPoints(1, alpha=1.0, beta=0.0, kappa=2.0))
    ekf = ExtendedKalmanFilter(1, 2)
    for other in (ukf, ekf):
        other.x, other.P = np.array([0.3]), np.array([[0.5]])
    S = np.array([[1 / 2, 1 / 8], [1 / 8, 1 / 3]])
    before = 0.0
    for k, (time, value) in enumerate(zip(TIMES, record.values, strict=True)):
        step, seen = time - before, ~np.isnan(value)
        scale = step if kind == "increments" else 1.0
        noise, reading = S[np.ix_(seen, seen)] / (scale if kind == "increments" else 1.0), value[seen] / scale
        ukf.Q = step * np.eye(1)
        ukf.predict(dt=step, fx=lambda x, dt, t=before: x + dt * t * x / 40)
        ekf.x, ekf.P = ekf.x * (1 + step * before / 40), ekf.P * (1 + step * before / 40) ** 2 + step
        before, evidence = time, 0.0
        if seen.any():

            def h(x, seen=seen):
                return np.array([x[0] * np.sin(x[0]), x[0] * np.cos(x[0])])[seen]

            def slope(x, seen=seen):
                sine, cosine = np.sin(x[0]), np.cos(x[0])
                return np.array([[sine + x[0] * cosine], [cosine - x[0] * sine]])[seen]

            ukf.update(reading, R=noise, hx=h)
            ekf.update(reading, slope, h, R=noise)
            evidence = (ukf if name == "ukf" else ekf).log_likelihood
            if kind == "increments":
                evidence -= multivariate_normal.logpdf(reading, np.zeros(seen.sum()), noise)
        other = ukf if name == "ukf" else ekf
        assert np.allclose(result.mean[k + 1], other.x, rtol=0, atol=1e-6)
        assert np.allclose(result.cov[k + 1], other.P, rtol=0, atol=1e-6)
        assert result.log_likelihood_increments[k + 1] == pytest.approx(evidence, abs=1e-6)


SIZES = {"particle": "particles", "enkf": "members"}


def over_seeds(record: zakai.Record, name: str, size: int, seeds: int) -> list[zakai.FilterResult]:
    model, sized = linear(record.kind), {SIZES[name]: size}
    return [zakai.filter(model, record, name, seed=seed, substeps=4, keep="moments", **sized) for seed in range(seeds)]


@pytest.mark.parametrize("name", SIZES)
def test_sampling_peers_come_to_the_exact_posterior_as_one_over_the_root_of_their_size(name):
    record = record_of(linear("samples"), TIMES, gaps=True)
    mean, cov, _ = filtered(record)
    errors = {}
    for size in (100, 1600):
        runs = over_seeds(record, name, size, 12)
        errors[size] = np.array([run.mean[1:] - mean for run in runs])
    # Nothing is left in the mean over seeds but chance.
    bias, spread = errors[1600].mean(axis=0), errors[1600].std(axis=0, ddof=1) / np.sqrt(12)
    assert np.abs(bias / spread).max() < 6
    assert np.sqrt(np.mean(errors[1600] ** 2)) < 0.03
    assert np.log2(np.sqrt(np.mean(errors[100] ** 2) / np.mean(errors[1600] ** 2))) == pytest.approx(2, abs=0.5)
    assert np.mean([run.cov[1:] for run in runs], axis=0) == pytest.approx(cov, abs=0.03)


def test_the_likelihood_of_the_particle_filter_is_unbiased():
    record = record_of(linear("increments"), TIMES / 8, gaps=True)
    exact = filtered(record)[2].sum()
    ratios = np.exp([run.log_likelihood - exact for run in over_seeds(record, "particle", 1600, 30)])
    # Increments leave one error: the filter holds the state constant over the interval.
    assert abs(ratios.mean() - 1) < 0.02 + 4 * ratios.std(ddof=1) / np.sqrt(30)
    assert ratios.std() < 0.15
