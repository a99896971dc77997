"""The filter with the series of the Kolmogorov kernel, against a plain solver of the same splitting and exact filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import norm, poisson

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


def test_the_reported_error_is_near_the_error(observed):
    """One transition of an interval, of few kernels, between the means of two densities."""
    mean, _, _ = reference(observed.times, observed.values[:, 0])
    for substeps in (4, 8):
        coarse = zakai.filter(double_well(), observed, "kolmogorov-series", substeps=substeps)
        error = np.max(np.abs(coarse.mean[:, 0] - mean))
        reported = np.nansum(coarse.health["truncation"])
        assert error < 4 * reported and reported < 100 * error


def test_the_error_falls_with_the_power_of_the_order(observed):
    mean, _, _ = reference(observed.times, observed.values[:, 0])

    def error(order: int, substeps: int) -> float:
        reported = zakai.filter(double_well(), observed, "kolmogorov-series", order=order, substeps=substeps)
        return float(np.max(np.abs(reported.mean[:, 0] - mean)))

    # One more than that of the series: the columns of each kernel have the mass one.
    assert 1.7 < np.log2(error(1, 8) / error(1, 16)) < 2.3
    assert 2.6 < np.log2(error(2, 8) / error(2, 16)) < 3.4


def test_too_few_kernels_and_the_sum_are_warned_of():
    model = double_well("samples")
    record = zakai.simulate(model, [0.3, 0.6], seed=2)[1]
    few = zakai.filter(model, record, "kolmogorov-series", substeps=1)
    assert any("truncation" in words for words in few.warnings)
    added = zakai.filter(model, record, "kolmogorov-series", substeps=8, form="sum")
    assert any("truncation" in words or "lost" in words for words in added.warnings)


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


def test_an_observation_that_contradicts_the_prior_is_followed_or_warned_of():
    model = double_well("samples", observation=["x"], observation_noise=[["1/100"]], drift=["-x"])
    record = zakai.Record([0.1, 0.2], [[7.0], [7.0]], "samples")
    result = zakai.filter(model, record, "kolmogorov-series")
    exact = zakai.filter(model, record, "kalman-bucy")
    assert result.warnings or np.allclose(result.mean, exact.mean, atol=1e-4)


def kalman(a, G, mean, variance, times, samples, noise):
    """Means, variances and evidence increments of dx = a x dt + sqrt(G) dv, samples of x."""
    out, last = [], 0.0
    for t, z in zip(times, samples, strict=True):
        e, last = np.exp(a * (t - last)), t
        mean, variance = e * mean, e * e * variance + G * (e * e - 1) / (2 * a)
        S = variance + noise
        out.append((-0.5 * (z - mean) ** 2 / S - 0.5 * np.log(2 * np.pi * S),))
        mean, variance = mean + variance / S * (z - mean), variance * noise / S
        out[-1] = (mean, variance, *out[-1])
    return np.array(out)


def linear_result(times, samples, noise=0.1, scale=1.0, offset=0.0, unit=1.0, prior=1.0):
    """What the filter makes of dx = -x dt + dv in other units, in the units of `kalman`."""
    model = zakai.Model(
        state=["x"], drift=[f"-(x - {offset})/{unit}"], process_noise=[[repr(scale**2 / unit)]], observation=["x"],
        observation_noise=[[repr(noise * scale**2)]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [offset], "cov": [[prior * scale**2]]},
    )  # fmt: skip
    record = zakai.Record(np.asarray(times) * unit, np.asarray(samples)[:, None] * scale + offset, "samples")
    result = zakai.filter(model, record, "kolmogorov-series")
    mean, variance = (result.mean[1:, 0] - offset) / scale, result.variance[1:, 0] / scale**2
    return np.stack([mean, variance, result.log_likelihood_increments[1:] + np.log(scale)], axis=1), result


RNG = np.random.default_rng(5)
IRREGULAR = np.cumsum(10 ** RNG.uniform(-3.5, 1, 30))
SAMPLES = RNG.normal(0, 0.6, 30)


def test_intervals_over_five_decades_are_followed_and_reported_errors_hold():
    found, result = linear_result(IRREGULAR, SAMPLES)
    exact = kalman(-1.0, 1.0, 0.0, 1.0, IRREGULAR, SAMPLES, 0.1)
    assert np.max(np.abs(found - exact)) < 3e-6 and result.warnings == []
    assert np.max(np.abs(found[:, 0] - exact[:, 0])) < 10 * np.nansum(result.health["truncation"])


def test_a_sharp_sample_of_a_wide_prior_at_the_start_is_followed():
    times, samples = [0.0, 0.5, 3.0, 3.1], [-3.0, 0.2, 0.1, 0.0]
    found, result = linear_result(times, samples, 1e-4, prior=1e4)
    exact = kalman(-1.0, 1.0, 0.0, 1e4, times, samples, 1e-4)
    deviations = np.abs(found[:, 0] - exact[:, 0]) / np.sqrt(exact[:, 1])
    assert deviations.max() < 1e-4 and np.abs(found[:, 2] - exact[:, 2]).max() < 1e-3


@pytest.mark.parametrize("units", [dict(scale=1e6), dict(scale=1e-6), dict(offset=1e6), dict(unit=1e3), dict(unit=1e-3)])
def test_units_change_rounding_only(units):
    plain, _ = linear_result(IRREGULAR[:8], SAMPLES[:8])
    other, _ = linear_result(IRREGULAR[:8], SAMPLES[:8], **units)
    assert np.max(np.abs(other - plain)) < 2e-9


def test_noise_that_varies_within_an_interval_is_integrated():
    """Almost no process noise: the posterior is the prior times exp of an integral over the interval."""
    keys = dict(drift=["0"], diffusion=[["1/100"]], observation=["x*cos(9*t)"], observation_noise=[["1 + 0.9*sin(50*t)"]])
    result = zakai.filter(double_well(**keys), zakai.Record([0.2], [[0.3]], "increments"), "kolmogorov-series")
    t = (np.arange(20000) + 0.5) * 0.2 / 20000
    precision = 1 / (1 + 0.9 * np.sin(50 * t))
    linear, energy = (np.mean(precision * part) for part in (0.3 * np.cos(9 * t), 0.2 * np.cos(9 * t) ** 2))
    variance = 1 / (1 / 0.3 + energy)
    assert abs(result.mean[-1, 0] - variance * (0.4 / 0.3 + linear)) < 3e-5
    assert abs(result.variance[-1, 0] - variance) < 3e-5 and result.health["time_quadrature_error"][-1] == 0.0


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_the_gradient_is_that_of_differences(kind):
    from zakai.methods.series.kolmogorov_series import METHOD
    from zakai.records.schedule import Schedule, schedule_of

    model = zakai.Model(
        state=["x"], drift=["a*x - b*x**3"], observation=["a*x + x**3/5"], observation_noise=[["b/2"]], diffusion=[["1 + c"]],
        parameters={"a": 0.7, "b": 0.4, "c": 0.1}, observation_kind=kind,
        prior={"kind": "density", "log_density": "-(x - a)**2/(2*b)"},
    )  # fmt: skip
    rng = np.random.default_rng(1)
    record = zakai.Record(np.cumsum(rng.uniform(0.02, 0.5, 6)), rng.normal(0, 0.4, (6, 1)), kind)
    options = {"substeps": 4}  # a fixed number, so that differences are smooth
    schedule, values = schedule_of(model, record)

    def log_likelihood(theta):
        prepared = METHOD.prepare(model, schedule, theta, **options)
        state, total = METHOD.init(METHOD.prepare(model, Schedule.empty(1), theta, **options), model.prior), 0.0
        for k in range(len(schedule)):
            state, info = METHOD.step(prepared, k, state, values[k])
            total = total + info.log_likelihood_increment
        return total

    theta, d = model.theta(), 4e-3
    for axis in np.eye(3):
        gradient = log_likelihood(theta + 1e-150j * axis).imag / 1e-150
        values_at = [log_likelihood(theta + k * d * axis) for k in (-2, -1, 1, 2)]
        difference = (8 * (values_at[2] - values_at[1]) - (values_at[3] - values_at[0])) / (12 * d)
        assert abs(gradient - difference) < 1e-6 * max(1.0, abs(difference))


def test_an_interval_does_not_depend_on_its_neighbours_and_lengths_may_be_prepared_alone(observed):
    whole = zakai.filter(double_well(), observed, "kolmogorov-series")
    online = zakai.online(double_well(), "kolmogorov-series")
    for k, (time, value) in enumerate(zip(observed.times, observed.values, strict=True), 1):
        estimate = online.update(time, value)
        assert np.array_equal(estimate.mean, whole.mean[k]) and np.array_equal(estimate.cov, whole.cov[k])


def dense(z, h, log_likelihood):
    """The posterior mean, deviation and evidence of a double well by finite volumes and a matrix exponential."""
    edges = np.linspace(-3.5, 3.5, 801)
    x, spacing = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    peclet = 2 * spacing * (edges[1:-1] - edges[1:-1] ** 3)
    peclet = np.where(np.abs(peclet) < 1e-8, 1e-8, peclet)
    right, left = peclet / -np.expm1(-peclet) / (2 * spacing**2), peclet / np.expm1(peclet) / (2 * spacing**2)
    generator = np.diag(right, -1) + np.diag(left, 1)
    generator -= np.diag(generator.sum(axis=0))
    p = expm(0.4 * generator) @ (np.exp(-((x - 0.2) ** 2)) / np.exp(-((x - 0.2) ** 2)).sum()) * np.exp(log_likelihood(z, h(x)))
    mean = x @ p / p.sum()
    return mean, np.sqrt((x - mean) ** 2 @ p / p.sum()), np.log(p.sum())


@pytest.mark.parametrize(
    ("keys", "z", "h", "log_likelihood"),
    [
        ({"observation": ["3*exp(x)"], "observation_family": "poisson"}, 4.0, lambda x: 3 * np.exp(x), poisson.logpmf),
        ({"observation": ["0"], "observation_noise": [["exp(x)"]]}, 1.5, lambda x: np.exp(x / 2),
         lambda z, s: norm.logpdf(z, 0, s)),
        ({"observation": ["x + u"], "observation_noise": [["0.1"]], "inputs": ["u"]}, 0.9, lambda x: x + 0.7,
         lambda z, m: norm.logpdf(z, m, np.sqrt(0.1))),
        ({"observation_log_density": "-log(cosh(z - x)) - log(pi)", "observed": ["z"]}, 0.9, lambda x: x,
         lambda z, m: -np.log(np.cosh(z - m)) - np.log(np.pi)),
    ],
)  # fmt: skip
def test_samples_of_any_law_multiply_the_density(keys, z, h, log_likelihood):
    model = zakai.Model(state=["x"], drift=["x - x**3"], observation_kind="samples",
                        prior={"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}, **keys)  # fmt: skip
    inputs = zakai.Inputs([0.0], [[0.7]]) if "inputs" in keys else None
    result = zakai.filter(model, zakai.Record([0.4], [z], "samples", inputs=inputs), "kolmogorov-series", substeps=32)
    found = result.mean[1, 0], np.sqrt(result.variance[1, 0]), result.log_likelihood
    assert found == pytest.approx(dense(z, h, log_likelihood), abs=1e-4)


def test_a_law_with_a_kink_and_a_driven_state_are_refused():
    kinked = {"observation_log_density": "-abs(z - x)/0.2 - log(0.4)", "observed": ["z"]}
    model = zakai.Model(state=["x"], drift=["x - x**3"], observation_kind="samples", prior=GAUSSIAN, **kinked)
    with pytest.raises(zakai.ConditionError, match="smooth"):
        zakai.filter(model, zakai.Record([0.1], [[0.0]], "samples"), "kolmogorov-series")
    driven = zakai.Model(state=["x"], drift=["u - x**3"], observation=["x"], inputs=["u"], observation_kind="samples",
                         prior=GAUSSIAN)  # fmt: skip
    with pytest.raises(zakai.ConditionError, match="formulas of the class"):
        zakai.filter(driven, zakai.Record([0.1], [[0.0]], "samples", inputs=zakai.Inputs([0.0], [[1.0]])), "kolmogorov-series")
