"""A sensor of the phase of one state leaves many narrow peaks under a broad prior, which only a large grid resolves.

References: the exact convolution with the Gaussian kernels of Brownian motion, and quadrature with them, on 16,384 points.
"""

import numpy as np
import pytest

import zakai

NOISE, INTENSITY = 0.09, 0.05
TIMES = np.cumsum([0.18, 0.06, 0.09, 0.08, 0.33, 0.12, 0.04, 0.05, 0.11, 0.4])
VALUES = np.cos(3 * 0.7) + 0.3 * np.random.default_rng(5).normal(size=(len(TIMES), 1))
POINTS = np.linspace(-24.0, 24.0, 2**14, endpoint=False)
RECORD = zakai.Record(TIMES, VALUES, "samples")


def model_of(drift, **keys):
    prior = {"kind": "gaussian", "mean": [0.0], "cov": [[4.0]]}
    fixed = {"observation": ["cos(3*x)"], "observation_kind": "samples", "observation_noise": [[NOISE]], "prior": prior}
    return zakai.Model(state=["x"], drift=[drift], **{"diffusion": [[INTENSITY]], **fixed, **keys})


def moments(values):
    mean = POINTS @ values / values.sum()
    return mean, (POINTS - mean) ** 2 @ values / values.sum()


def exact(times, values):
    """Return the filter's means and variances, the smoother's, and the evidence, for Brownian motion."""
    waves = 2 * np.pi * np.fft.rfftfreq(len(POINTS), POINTS[1] - POINTS[0])

    def diffused(values, length):
        return np.maximum(np.fft.irfft(np.fft.rfft(values) * np.exp(-0.5 * INTENSITY**2 * length * waves**2), len(POINTS)), 0.0)

    likelihoods = np.exp(-0.5 * (values - np.cos(3 * POINTS)) ** 2 / NOISE) / np.sqrt(2 * np.pi * NOISE)
    lengths, density, evidence, densities = np.diff(times, prepend=0.0), np.exp(-(POINTS**2) / 8.0), 0.0, []
    for length, likelihood in zip(lengths, likelihoods, strict=True):
        density = diffused(density / density.sum(), length) * likelihood
        evidence += np.log(density.sum())
        densities.append(density / density.sum())
    message, smoothed = np.ones(len(POINTS)), []
    for density, length, likelihood in zip(densities[::-1], lengths[::-1], likelihoods[::-1], strict=True):
        smoothed.append(moments(density * message))
        message = diffused(message * likelihood, length)
    return np.array([moments(density) for density in densities]), np.array(smoothed[::-1]), evidence


def test_the_filter_resolves_all_peaks():
    expected, _, evidence = exact(TIMES, VALUES)
    result = zakai.filter(model_of("0"), RECORD)
    np.testing.assert_allclose(result.mean[-len(TIMES) :, 0], expected[:, 0], atol=1e-8)
    np.testing.assert_allclose(result.cov[-len(TIMES) :, 0, 0], expected[:, 1], rtol=1e-8)
    assert float(result.log_likelihood) == pytest.approx(evidence, abs=1e-8)
    assert not result.warnings


def test_the_smoother_resolves_all_peaks():
    number = 6
    _, expected, _ = exact(TIMES[:number], VALUES[:number])
    result = zakai.smooth(model_of("0"), zakai.Record(TIMES[:number], VALUES[:number], "samples"))
    np.testing.assert_allclose(result.mean[-number:, 0], expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(result.cov[-number:, 0, 0], expected[:, 1], rtol=1e-6)


@pytest.mark.parametrize("drift", ["a*sin(x)", "-a*x"])
def test_the_gradient_is_the_slope_of_the_evidence(drift):
    model = model_of(drift, diffusion=[["g"]], parameters={"a": 1.0, "g": 0.1})
    likelihood, at = zakai.log_likelihood(model, zakai.Record(TIMES[:5], VALUES[:5], "samples")), np.array([1.0, 0.1])
    value, gradient = likelihood.value_and_gradient(at)
    assert value == pytest.approx(float(likelihood(at)), abs=1e-10)
    for slope, step in zip(gradient, np.diag([1e-4, 1e-5]), strict=True):
        difference = float(likelihood(at + step)) - float(likelihood(at - step))
        assert slope == pytest.approx(difference / (2 * step.sum()), rel=1e-5, abs=1e-6)


def test_the_evidence_does_not_depend_on_the_tolerance():
    coarse, fine = (zakai.filter(model_of("sin(x)"), RECORD, tolerance=tolerance) for tolerance in (1e-4, 1e-8))
    assert float(coarse.log_likelihood) == pytest.approx(float(fine.log_likelihood), abs=1e-5)
    assert not coarse.warnings and not fine.warnings


def test_peaks_too_many_for_any_grid_are_said():
    values = np.random.default_rng(6).uniform(-1.0, 1.0, size=(8, 1))
    result = zakai.filter(model_of("-x", observation_noise=[[1e-3]]), zakai.Record(TIMES[:8], values, "samples"))
    assert result.warnings
