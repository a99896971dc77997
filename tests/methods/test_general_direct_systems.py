"""The Gaussian sum against the exact methods, which share with it nothing but the flow, and what must hold of any filter."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.convention import within_convention
from references.systems import scalar
from zakai.errors import ConditionError, InputError


def encoder(**changes):
    keys = {
        "state": ["x", "v"],
        "drift": ["v", "-x/5 - v/5"],
        "diffusion": [["0.1", "0"], ["0", "1"]],
        "observation": ["sin(x)", "cos(x)"],
        "observation_noise": [["0.04", "0"], ["0", "0.04"]],
        "observation_kind": "samples",
        "prior": {"kind": "gaussian", "mean": [0.5, 0], "cov": [1.0, 1.0]},
    }
    return zakai.Model(**(keys | changes))


def errors(result, exact):
    """The largest error of a mean, in standard deviations of the exact posterior, and the error of the log-likelihood."""
    away = np.abs(result.mean - exact.mean) / np.sqrt(exact.variance)
    return away.max(), abs(result.log_likelihood - exact.log_likelihood)


def test_a_time_varying_system_with_a_log_cosh_gauge_agrees_with_the_exact_density():
    system = scalar()
    model = system.model("increments")
    # In parts, for the exact density undoes the first error of the splitting and a sum of Gaussians does not.
    times = system.times[-1] * np.arange(1, 4 * len(system.times) + 1) / (4 * len(system.times))
    record = zakai.Record(times, np.repeat(system.increments / 4, 4, axis=0), "increments")
    exact = zakai.filter(model, record, "limited-direct")
    mean, evidence = errors(zakai.filter(model, record, "general-direct"), exact)
    assert mean <= 5e-3 and evidence <= 5e-3
    finer, _ = errors(zakai.filter(model, record, "general-direct", components=60), exact)
    assert finer <= 5e-3


def test_sine_and_cosine_samples_of_two_states_agree_with_the_exact_density():
    model = encoder()
    _, record = zakai.simulate(model, np.arange(1, 31) * 0.1, seed=3)
    result = zakai.filter(model, record, "general-direct")
    mean, evidence = errors(result, zakai.filter(model, record, "limited-direct"))
    assert mean <= 0.05 and evidence <= 0.05 and not result.warnings


def test_a_mirrored_mode_is_kept_and_the_sum_stays_symmetric():
    model = zakai.Model(
        state=["x"],
        drift=["-x/5"],
        observation=["x**2"],
        observation_noise=[["0.05"]],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )
    _, record = zakai.simulate(model, np.arange(1, 41) * 0.1, seed=3)
    exact = zakai.filter(model, record, "limited-direct")
    result = zakai.filter(model, record, "general-direct")
    assert errors(result, exact)[0] <= 0.05
    assert np.abs(result.variance / exact.variance - 1)[1:].max() <= 0.05


def test_a_linear_system_gives_the_kalman_bucy_filter_exactly_and_singular_noise_is_allowed():
    model = zakai.load_model("gallery:falling-body")
    _, record = zakai.simulate(model, np.arange(1, 41) * 0.05, seed=1)
    exact = zakai.filter(model, record, "kalman-bucy")
    result = zakai.filter(model, record, "general-direct")
    assert np.abs(result.mean - exact.mean).max() <= 1e-9 and np.abs(result.cov - exact.cov).max() <= 1e-9
    assert abs(result.log_likelihood - exact.log_likelihood) <= 1e-9


def test_an_affine_observation_of_the_benes_system_is_exact_once_the_start_is_cut():
    model = zakai.load_model("gallery:benes")
    _, record = zakai.simulate(model, np.arange(1, 41) * 0.1, seed=3)
    exact = zakai.filter(model, record, "benes")
    result = zakai.filter(model, record, "general-direct", components=40)
    assert max(errors(result, exact)) <= 1e-3


@pytest.mark.parametrize(("variance", "step"), [(1e-8, 1e-6), (1e8, 0.1), (1.0, 10.0)])
def test_extreme_variances_and_steps_give_numbers_and_positive_variances(variance, step):
    model = zakai.Model(
        state=["x"],
        drift=["t/40 * x"],
        observation=["x*sin(x)", "x*cos(x)"],
        observation_kind="increments",
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[variance]]},
    )
    values = np.array([[0.3, -0.2], [0.1, 0.4], [-0.2, 0.1]]) * np.sqrt(min(step, 1.0))
    record = zakai.Record(step * np.arange(1, 4), values, "increments")
    result = zakai.filter(model, record, "general-direct")
    assert np.isfinite(result.mean).all() and np.isfinite(result.log_likelihood) and (result.variance > 0).all()


def test_a_row_without_readings_is_a_prediction_and_the_density_is_the_state_that_is_reported():
    model = encoder()
    times = np.arange(1, 11) * 0.1
    _, record = zakai.simulate(model, times, seed=5)
    values = record.values.copy()
    values[4], values[6, 0] = np.nan, np.nan
    record = zakai.Record(times, values, "samples")
    result = zakai.filter(model, record, "general-direct")
    mean, _ = errors(result, zakai.filter(model, record, "limited-direct"))
    assert mean <= 0.05 and result.log_likelihood_increments[5] == pytest.approx(0.0, abs=1e-12)
    density = result.density(-1)
    assert np.allclose(density.mean(), result.mean[-1]) and np.allclose(density.cov(), result.cov[-1])


def test_wrong_options_and_systems_outside_the_class_are_refused_in_one_line():
    model = encoder()
    record = zakai.Record(np.array([0.1]), np.zeros((1, 2)), "samples")
    for options, word in (({"reduction": "none"}, "reduction"), ({"components": 0}, "components"), ({"tolerance": 2}, "toler")):
        with pytest.raises(InputError, match=word):
            zakai.filter(model, record, "general-direct", **options)
    with pytest.raises(InputError, match="n <= 1"):
        zakai.filter(model, record, "general-direct", reduction="algorithm-1")
    cubic, spiral = zakai.load_model("gallery:cubic-sensor"), zakai.load_model("gallery:spiral-sensor")
    with pytest.raises(ConditionError, match="quadratic"):
        zakai.filter(cubic, zakai.Record(np.array([0.1]), np.zeros((1, 1)), "increments"), "general-direct")
    with pytest.raises(ConditionError, match="depends on t"):
        zakai.filter(spiral, zakai.Record(np.array([0.1]), np.zeros((1, 2)), "increments"), "gaussian-sum")


def benes(variance, **changes):
    keys = {
        "state": ["x"], "drift": ["tanh(x)"], "observation": ["x"], "observation_noise": [["0.5"]],
        "prior": {"kind": "gaussian", "mean": [0.3], "cov": [[variance]]},
    }  # fmt: skip
    return zakai.Model(**(keys | changes))


PRIORS = {
    "gaussian": {"kind": "gaussian", "mean": [0.3], "cov": [[1e4]]},
    "mixture": {"kind": "mixture", "weights": [0.4, 0.6], "means": [[0.1], [0.5]], "covs": [[[1e4]], [[2e4]]]},
    "density": {"kind": "density", "log_density": "-x**2/20000"},
}


@pytest.mark.parametrize(
    ("prior", "reduction"),
    [
        *[(prior, "split-merge") for prior in ("gaussian", "mixture", "density")],
        ("gaussian", "algorithm-1"),
    ],
)
def test_a_start_that_is_not_the_prior_is_said(prior, reduction):
    record = zakai.Record(np.array([0.01, 0.02]), np.array([[0.21], [0.14]]), "increments")
    wide = zakai.filter(benes(1.0, prior=PRIORS[prior]), record, "general-direct", reduction=reduction, components=6)
    assert any(line.startswith("start_error") for line in wide.warnings)
    if prior == "gaussian":
        narrow = zakai.filter(benes(0.01), record, "general-direct", reduction=reduction)
        assert np.all(narrow.health["start_error"][1:] <= 1e-4)


def test_an_angle_that_is_cut_is_the_prior_still():
    model = zakai.Model(
        state=["a"], drift=["0"], observation=["sin(a)", "cos(a)"], periodic=["a"],
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[1.0]]},
    )  # fmt: skip
    record = zakai.Record(np.array([0.1]), np.array([[0.1, 0.05]]), "increments")
    assert zakai.filter(model, record, "general-direct").health["start_error"][1] <= 1e-3


def record_of(step):
    """Eight increments: small ones over a step of 1e-6 say that x is far out in the tails."""
    return zakai.Record(step * np.arange(1, 9), np.random.default_rng(2).normal(size=(8, 1)) * 0.1 + 0.2, "increments")


VARIANCES = [1e-8, 1e-4, 1e-2, 1.0, 10.0, 1e2, 1e4, 1e6, 1e8]


@pytest.mark.parametrize(
    ("variance", "step"),
    [(v, 0.01) for v in VARIANCES] + [(v, h) for v in VARIANCES for h in (1e-6, 10.0)],
)
def test_a_prior_of_any_width_over_the_bend_of_the_gauge_is_right_or_warned_of(variance, step):
    model, record = benes(variance), record_of(step)
    exact, result = zakai.filter(model, record, "benes"), zakai.filter(model, record, "general-direct")
    assert np.isfinite(result.mean).all() and np.isfinite(result.log_likelihood) and (result.variance > 0).all()
    assert result.variance[0, 0] == pytest.approx(variance, rel=1e-3)
    warnings = within_convention(result.warnings)
    if not warnings:
        mean, evidence = errors(result, exact)
        assert mean <= 0.01 and evidence <= 0.01 and np.abs(result.variance / exact.variance - 1).max() <= 0.01
    # The increments of the short steps have values of long ones; what lies beyond 8.6 deviations of the prior is not there.
    known = ("edge_weight", "cannot be explained")
    assert (not warnings) if step > 1e-6 else all(any(word in line for word in known) for line in warnings)


def test_a_reduction_without_error_figures_says_that_it_has_none():
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]})
    record = zakai.Record(np.array([0.1]), np.array([[0.05]]), "increments")
    (line,) = zakai.filter(model, record, "general-direct", reduction="algorithm-1").warnings
    assert "algorithm-1" in line and "no error figures" in line


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_points_of_no_variance_are_put_together_without_a_division_by_zero():
    points = {"kind": "mixture", "weights": [0.3, 0.3, 0.4], "means": [[0.0], [0.1], [2.0]], "covs": [[[0.0]], [[0.0]], [[1.0]]]}
    record = zakai.Record(np.array([0.01]), np.array([[0.1]]), "increments")
    result = zakai.filter(benes(1.0, prior=points), record, "general-direct", components=10)
    assert np.isfinite(result.mean).all() and result.mean[0, 0] == pytest.approx(0.83, abs=0.01)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_long_gaps_of_an_unstable_state_keep_the_digits(kind):
    model = zakai.Model(
        state=["x"], drift=["x"], observation=["x"], observation_kind=kind, observation_noise=[["0.5"]],
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[1.3]]},
    )  # fmt: skip
    times, values = [1.0, 2.0, 15.0, 15.5], [2.0, 4.0, 7.0, 12.0]
    result = zakai.filter(model, zakai.Record(times, np.array(values)[:, None], kind), "general-direct")
    if kind == "increments":
        other = zakai.filter(model, zakai.Record(times, np.array(values)[:, None], kind), "kalman-bucy")
        assert np.allclose(result.mean, other.mean, rtol=1e-6) and np.allclose(result.variance, other.variance, rtol=1e-6)
        assert result.log_likelihood == pytest.approx(other.log_likelihood, rel=1e-6)
        return
    mean, variance, before, total = 1.0, 1.3, 0.0, 0.0
    for k, (time, value) in enumerate(zip(times, values, strict=True)):
        growth = np.exp(time - before)
        mean, variance, before = growth * mean, growth**2 * variance + (growth**2 - 1) / 2, time
        total -= 0.5 * ((value - mean) ** 2 / (variance + 0.5) + np.log(2 * np.pi * (variance + 0.5)))
        mean, variance = (0.5 * mean + variance * value) / (variance + 0.5), 0.5 * variance / (variance + 0.5)
        assert result.mean[k + 1, 0] == pytest.approx(mean, rel=1e-6)
        assert result.variance[k + 1, 0] == pytest.approx(variance, rel=1e-6)
    assert result.log_likelihood == pytest.approx(total, rel=1e-6)
