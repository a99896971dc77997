"""Models of the gallery, filtered by their defaults, against Bayes' rule with their exact transition densities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import eval_jacobi, ive
from scipy.stats import norm, poisson

import zakai

TIMES = np.array([0.1, 0.2, 0.9, 1.0, 3.0, 3.4])


def line(low, high, count):
    """Return points and weights of the trapezoidal rule."""
    x = np.linspace(low, high, count)
    return x, np.full(count, x[1] - x[0])


def logarithmic(low, high, count):
    z, weights = line(low, high, count)
    return np.exp(z), weights * np.exp(z)


def between(count):
    nodes, weights = np.polynomial.legendre.leggauss(count)
    angle = 0.5 * np.pi * (nodes + 1)
    return 0.5 * (1 - np.cos(angle)), 0.25 * np.pi * weights * np.sin(angle)


def square_root(y, x, tau, a=1.0, b=2.0, s=1.0):
    """The noncentral chi-squared transition density of Cox, Ingersoll and Ross."""
    c, q = 2 * a / (s * s * (1 - np.exp(-a * tau))), 2 * a * b / s**2 - 1
    u, v = c * x * np.exp(-a * tau), c * y
    return c * np.exp(-((np.sqrt(u) - np.sqrt(v)) ** 2)) * (v / u) ** (q / 2) * ive(q, 2 * np.sqrt(u * v))


def lognormal(y, x, tau, mu=0.05, sigma=0.3):
    return norm.pdf(np.log(y), np.log(x) + (mu - sigma**2 / 2) * tau, sigma * np.sqrt(tau)) / y


def jacobi(y, x, tau, a=1.0, b=1.5, s=0.8):
    """The transition density of Wright and Fisher in polynomials of Jacobi (Karlin and Taylor 1981)."""
    alpha, beta = 2 * b / s**2 - 1, 2 * a / s**2 - 1
    nodes, weights = between(400)
    result = np.zeros(np.broadcast(x, y).shape)
    for n in range(60):
        at = [eval_jacobi(n, alpha, beta, 2 * points - 1) for points in (nodes, x, y)]
        norm_n = np.sum(weights * at[0] ** 2 * nodes**beta * (1 - nodes) ** alpha)
        result = result + at[1] * at[2] * np.exp(-((a + b) * n + s * s / 2 * n * (n - 1)) * tau) / norm_n
    return result * y**beta * (1 - y) ** alpha


def mean_reverting(k, s):
    return lambda y, x, tau: norm.pdf(y, x * np.exp(-k * tau), s * np.sqrt(-np.expm1(-2 * k * tau) / (2 * k)))


# name: points and weights, prior, transition density, likelihood
GALLERY = {
    "cox-ingersoll-ross": (
        logarithmic(-14, 3.2, 1200), lambda x: x**3 * np.exp(-2 * x), square_root, lambda z, x: norm.pdf(z, x, 0.2),
    ),
    "geometric-brownian-motion": (
        logarithmic(-5, 5, 1200), lambda x: lognormal(x, 1.0, 1.0, 0.005, 0.1), lognormal, lambda z, x: norm.pdf(z, x, 0.1),
    ),
    "wright-fisher": (
        between(400), lambda x: x**2.125 * (1 - x) ** 3.6875, jacobi, lambda z, x: norm.pdf(z, x, 0.1),
    ),
    "stochastic-volatility": (
        line(-7, 7, 1200), lambda x: norm.pdf(x, 0, 0.4**0.5), mean_reverting(0.05, 0.2),
        lambda z, x: norm.pdf(z, 0, np.exp(x / 2)),
    ),
    "counted-events": (
        line(-7, 7, 1200), lambda x: norm.pdf(x, 0, 0.4**0.5), mean_reverting(0.2, 0.4),
        lambda z, x: poisson.pmf(z, 3 * np.exp(x)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GALLERY)
def test_defaults_agree_with_the_exact_transition(name):
    (x, weights), prior, transition, likelihood = GALLERY[name]
    model = zakai.load_model(f"gallery:{name}")
    truth, record = zakai.simulate(model, TIMES, seed=5)
    result = zakai.filter(model, record)
    assert not result.warnings
    mass, time, kernels, log_likelihood = prior(x) * weights, 0.0, {}, 0.0
    mass /= mass.sum()
    for k, (stop, z) in enumerate(zip(TIMES, record.values[:, 0], strict=True)):
        tau = round(stop - time, 9)
        if tau not in kernels:
            kernels[tau] = transition(x[:, None], x[None], tau) * weights[:, None]
        mass, time = (kernels[tau] @ mass) * likelihood(z, x), stop
        log_likelihood += np.log(mass.sum())
        mass /= mass.sum()
        mean = mass @ x
        deviation = np.sqrt(mass @ (x - mean) ** 2)
        assert abs(result.mean[k + 1, 0] - mean) < 1e-6 * deviation
        assert abs(np.sqrt(result.variance[k + 1, 0]) / deviation - 1) < 1e-6
    assert abs(result.log_likelihood - log_likelihood) < 1e-5
