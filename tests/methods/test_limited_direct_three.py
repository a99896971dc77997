"""Three states: the direct method against Kalman and Bucy's equations, and against the law of a Benes system."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import norm

import zakai

STATE = ["x", "y", "z"]


def linear(matrix, row):
    return " + ".join(f"({c})*{name}" for c, name in zip(matrix[row], STATE, strict=True))


def test_a_linear_system_of_three_states_follows_the_equations_of_kalman_and_bucy():
    L = np.array([[-0.5, -1.0, 0.2], [1.0, -0.3, 0.1], [0.0, -0.2, -0.4]])
    H = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
    mean, cov, step = np.array([0.3, -0.2, 0.1]), np.full((3, 3), 0.3) + 0.7 * np.eye(3), 0.1
    model = zakai.Model(
        state=STATE,
        drift=[linear(L, i) for i in range(3)],
        observation=[linear(H, i) for i in range(2)],
        observation_kind="increments",
        prior={"kind": "gaussian", "mean": mean.tolist(), "cov": cov.tolist()},
    )
    increments = np.array([[0.3, -0.2], [-0.5, 0.4], [0.2, 0.1], [0.6, -0.3]])
    record = zakai.Record(step * np.arange(1, 5), increments, "increments")
    result = zakai.filter(model, record, "limited-direct")
    assert not result.warnings
    for k, increment in enumerate(increments, 1):

        def rate(t, values, dy=increment / step):
            m, P = values[:3], values[3:].reshape(3, 3)
            return np.r_[L @ m + P @ H.T @ (dy - H @ m), (L @ P + P @ L.T + np.eye(3) - P @ H.T @ H @ P).ravel()]

        end = solve_ivp(rate, (0, step), np.r_[mean, cov.ravel()], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
        mean, cov = end[:3], end[3:].reshape(3, 3)
        assert np.abs(result.mean[k] - mean).max() <= 1e-10
        assert np.abs(result.cov[k] - cov).max() <= 1e-9


class Tilted:
    """cosh(k.x) N(x; mean, cov), normalised: a sum of two Gaussians."""

    def __init__(self, k, mean, cov):
        signs = np.array([1.0, -1.0])
        self.cov, self.means = cov, mean + signs[:, None] * (cov @ k)
        self.log_mass = np.log(np.cosh(k @ mean)) + 0.5 * k @ cov @ k
        weights = np.exp(signs * (k @ mean))
        self.weights = weights / weights.sum()

    def density(self, x):
        d = x - self.means[:, None, :]
        exponent = -0.5 * np.einsum("spi,ij,spj->sp", d, np.linalg.inv(self.cov), d)
        return self.weights @ np.exp(exponent) / np.sqrt(np.linalg.det(2 * np.pi * self.cov))

    def mean(self):
        return self.weights @ self.means


def test_a_benes_system_of_three_states_with_rotation_gaps_and_samples_has_its_exact_law():
    # k'L = 0, so that e^phi = cosh(k.x) turns the system into a linear one with a constant potential -k'k/2.
    k = np.array([0.7, 0.7, 0.0])
    L = np.array([[-0.2, 0.2, 0.3], [0.2, -0.2, -0.3], [-0.3, 0.3, -0.4]])
    H = np.array([[1.0, 0.5, 0.0], [0.0, -1.0, 1.0]])
    S = np.array([[0.5, 0.1], [0.1, 0.4]])
    mean, cov, step = np.array([0.2, 0.1, -0.3]), np.diag([0.6, 0.5, 0.7]), 0.25
    quadratic = " - ".join(f"({name} - ({m}))**2/{2 * v}" for name, m, v in zip(STATE, mean, np.diag(cov), strict=True))
    model = zakai.Model(
        state=STATE,
        drift=[linear(L, i) + (" + 7/10*tanh(7/10*(x + y))" if i < 2 else "") for i in range(3)],
        observation=[linear(H, i) for i in range(2)],
        observation_noise=S.tolist(),
        observation_kind="samples",
        prior={"kind": "density", "log_density": f"log(cosh(7/10*(x + y))) - {quadratic}"},
    )
    values = np.array([[0.5, -0.4], [np.nan, 0.7], [np.nan, np.nan], [-0.6, 0.2]])
    result = zakai.filter(model, zakai.Record(step * np.arange(1, 5), values, "samples"), "limited-direct")
    assert not result.warnings
    blocks = expm(step * np.block([[-L, np.eye(3)], [np.zeros((3, 3)), L.T]]))
    A = blocks[3:, 3:].T
    Q, evidence, before = A @ blocks[:3, 3:], 0.0, Tilted(k, mean, cov).log_mass
    for index, value in enumerate(values, 1):
        mean, cov = A @ mean, A @ cov @ A.T + Q
        seen = ~np.isnan(value)
        if seen.any():
            C, R, residual = H[seen], S[np.ix_(seen, seen)], (value - H @ mean)[seen]
            innovation = C @ cov @ C.T + R
            gain = cov @ C.T @ np.linalg.inv(innovation)
            evidence -= 0.5 * residual @ np.linalg.solve(innovation, residual)
            evidence -= 0.5 * np.linalg.slogdet(2 * np.pi * innovation)[1]
            mean, cov = mean + gain @ residual, cov - gain @ C @ cov
        evidence -= 0.5 * k @ k * step
        law, density = Tilted(k, mean, cov), result.density(index)
        assert np.abs(result.mean[index] - law.mean()).max() <= 1e-9
        x = law.mean() + np.linalg.cholesky(cov).dot(np.random.default_rng(0).normal(size=(3, 300))).T
        expected = law.density(x)
        assert np.abs(np.exp(density.log_density(x)) - expected).max() <= 1e-8 * expected.max()
    assert result.log_likelihood == pytest.approx(evidence + law.log_mass - before, abs=1e-9)
    for i in range(3):
        line = density.marginal(i)
        at = np.linspace(-1.0, 1.0, 9)
        expected = law.weights @ norm.pdf(at, law.means[:, i : i + 1], np.sqrt(law.cov[i, i]))
        assert np.abs(np.exp(line.log_density(at)) - expected).max() <= 1e-8 * expected.max()
    pair = density.marginal([2, 0])
    assert pair.mean() == pytest.approx(law.mean()[[2, 0]], abs=1e-9)
