"""One state that nearly reaches a natural end, near the limit of Feller: exact transition densities, by quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ive
from scipy.stats import ncx2

import zakai

NOISE = 0.3


def bessel(c):
    """Return the transition density of dx = c / x dt + dB, a Bessel process of index c - 1/2."""
    index = c - 0.5
    return lambda t, x, y: y / t * (y / x) ** index * np.exp(-((x - y) ** 2) / (2 * t)) * ive(index, x * y / t)


def cox_ingersoll_ross(a):
    """Return the transition density of dx = a (1 - x) dt + sqrt(x) dB."""

    def transition(t, x, y):
        c = 2 * a / (1 - np.exp(-a * t))
        return 2 * c * ncx2.pdf(2 * c * y, 4 * a, 2 * c * x * np.exp(-a * t))

    return transition


CASES = {
    "bessel at the limit": ("0.5/x", "1", bessel(0.5)),
    "bessel near it": ("0.75/x", "1", bessel(0.75)),
    "bessel in three dimensions": ("1/x", "1", bessel(1.0)),
    "square root at the limit": ("0.5*(1 - x)", "sqrt(x)", cox_ingersoll_ross(0.5)),
    "square root near it": ("0.6*(1 - x)", "sqrt(x)", cox_ingersoll_ross(0.6)),
}


@pytest.mark.parametrize("name", CASES)
def test_a_process_near_the_limit_of_feller_has_the_exact_law(name):
    drift, diffusion, transition = CASES[name]
    model = zakai.Model(
        state=["x"], drift=[drift], diffusion=[[diffusion]], observation=["x"], observation_kind="samples",
        observation_noise=[[str(NOISE)]], domain={"x": {"lower": 0}},
        prior={"kind": "density", "log_density": "-5*(x - 1.5)**2 - 0.02/x"},
    )  # fmt: skip
    times, values = np.array([0.8, 1.0]), np.array([0.6, 0.2])
    result = zakai.filter(model, zakai.Record(times, values[:, None], "samples"), "yau-yau")
    nodes, weights = np.polynomial.legendre.leggauss(260)
    root = 1.6 * (nodes + 1)  # powers of x at zero are smooth in the root
    x, weights = root**2, 3.2 * root * weights
    p, log_likelihood = np.exp(-5 * (x - 1.5) ** 2 - 0.02 / x), 0.0
    p /= weights @ p
    for k, length in enumerate([0.8, 0.2]):
        p = (weights * p) @ transition(length, x[:, None], x)
        p *= np.exp(-((values[k] - x) ** 2) / (2 * NOISE)) / np.sqrt(2 * np.pi * NOISE)
        log_likelihood += np.log(weights @ p)
        p /= weights @ p
        mean = weights @ (x * p)
        assert result.mean[k - 2, 0] == pytest.approx(mean, abs=4e-6)
        assert result.variance[k - 2, 0] == pytest.approx(weights @ ((x - mean) ** 2 * p), abs=4e-6)
    assert result.log_likelihood == pytest.approx(log_likelihood, abs=4e-6)
    assert not result.warnings


@pytest.mark.parametrize("name", ["bessel at the limit", "square root at the limit", "square root near it"])
def test_smoothing_near_the_limit_of_feller_has_the_exact_law(name):
    drift, diffusion, transition = CASES[name]
    model = zakai.Model(
        state=["x"], drift=[drift], diffusion=[[diffusion]], observation=["x"], observation_kind="samples",
        observation_noise=[[str(NOISE)]], domain={"x": {"lower": 0}},
        prior={"kind": "density", "log_density": "-5*(x - 1.5)**2 - 0.02/x"},
    )  # fmt: skip
    times, values = np.array([0.8, 1.0]), np.array([0.6, 0.2])
    result = zakai.smooth(model, zakai.Record(times, values[:, None], "samples"), "yau-yau")
    nodes, weights = np.polynomial.legendre.leggauss(260)
    root = 1.6 * (nodes + 1)
    x, weights = root**2, 3.2 * root * weights
    moves = [transition(length, x[:, None], x) for length in (0.8, 0.2)]
    likelihoods = [np.exp(-((value - x) ** 2) / (2 * NOISE)) for value in values]
    forward, backward = [np.exp(-5 * (x - 1.5) ** 2 - 0.02 / x)], [np.ones_like(x)]
    for move, likelihood in zip(moves, likelihoods, strict=True):
        forward.append(((weights * forward[-1]) @ move) * likelihood)
    for move, likelihood in zip(moves[::-1], likelihoods[::-1], strict=True):
        backward.insert(0, move @ (weights * likelihood * backward[0]))
    for k, (p, b) in enumerate(zip(forward, backward, strict=True)):
        law = weights * p * b / (weights @ (p * b))
        mean = law @ x
        assert result.mean[k, 0] == pytest.approx(mean, abs=4e-6)
        assert result.variance[k, 0] == pytest.approx(law @ (x - mean) ** 2, abs=4e-6)
    assert not result.warnings


def positive(log_density):
    """Return two populations with a prior by its density, and a record of their counts."""
    model = zakai.Model(
        state=["n", "p"], drift=["n*(1 - 0.5*p)", "p*(0.5*n - 1)"], diffusion=[["0.15*n", 0], [0, "0.15*p"]],
        observation=["20*n", "10*p"], observation_kind="samples", observation_family="poisson",
        domain={"n": {"lower": 0.0}, "p": {"lower": 0.0}}, prior={"kind": "density", "log_density": log_density},
    )  # fmt: skip
    return model, zakai.Record([0.5, 1.0], [[22, 6], [35, 12]], "samples")


def test_particles_take_a_density_of_several_positive_states_that_has_no_value_beyond_its_ends():
    """Of two Gamma(4, 1/2): mean 2, variance 1."""
    result = zakai.filter(*positive("3*log(n) - 2*n + 3*log(p) - 2*p"))
    assert result.method == "guided-particles" and "yau-yau holds too, but refuses the prior" in result.why
    np.testing.assert_allclose(result.mean[0], 2.0, atol=0.05)
    np.testing.assert_allclose(result.variance[0], 1.0, atol=0.1)


def test_a_density_that_ends_abruptly_is_refused_on_a_grid_and_taken_by_particles():
    model, record = positive("-n - p")
    with pytest.raises(zakai.InputError, match="must vanish before the ends of the domain") as caught:
        zakai.filter(model, record, "tensor-train")
    assert "guided-particles" in str(caught.value)
    np.testing.assert_allclose(zakai.filter(model, record).variance[0], 1.0, atol=0.1)
