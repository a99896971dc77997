"""Characteristics: against Kalman-Bucy's moments, and against densities that a flow carries by a formula."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import zakai
from zakai.kolmogorov import comoving
from zakai.kolmogorov.characteristics import moved
from zakai.kolmogorov.comoving import Field


def nothing(x):
    return jnp.zeros(x.shape[:-1])


def gaussian_field(size: int, mean, cov, reach: float = 6.5) -> Field:
    n = len(mean)
    index = np.stack(np.meshgrid(*[np.arange(size) - size // 2] * n, indexing="ij"), axis=-1)
    basis = np.linalg.cholesky(np.asarray(cov)) * reach / (size / 2 - 1)
    values = np.exp(-0.5 * np.sum((index * reach / (size / 2 - 1)) ** 2, axis=-1))
    return Field(jnp.asarray(values / values.sum()), jnp.asarray(mean, float), jnp.asarray(basis))


def mean_and_cov(field: Field):
    _, mean, cov = comoving.moments(field.values)
    return np.asarray(field.centre + field.basis @ mean), np.asarray(field.basis @ cov @ field.basis.T)


@pytest.mark.slow
def test_a_linear_system_has_the_moments_of_kalman_and_bucy():
    A, b = np.array([[-1.0, 2.0], [-0.5, -6.0]]), np.array([0.3, -1.0])
    G, tau = np.array([[0.2, 0.05], [0.05, 0.1]]), 0.3
    mean, cov = np.array([1.0, -2.0]), np.array([[0.5, 0.2], [0.2, 0.4]])
    field, mass = gaussian_field(30, mean, cov), 1.0
    drift = lambda x, t: [A[i, 0] * x[..., 0] + A[i, 1] * x[..., 1] + b[i] for i in range(2)]  # noqa: E731
    step = jax.jit(lambda field: moved(field, drift, lambda t: jnp.asarray(G), 0.0, tau / 3, 6.5, nothing, 0))
    for _ in range(3):
        field, error, cells = step(field)
        mass *= float(field.values.sum())
        field = field._replace(values=field.values / field.values.sum())
        assert float(error) < 1e-3 and float(cells) < 1e-6
    # Van Loan's exponential, which has no steps.
    block = scipy.linalg.expm(tau * np.block([[-A, G], [np.zeros((2, 2)), A.T]]))
    turned = block[2:, 2:].T
    expected = turned @ cov @ turned.T + turned @ block[:2, 2:]
    moved_mean = turned @ mean + np.linalg.solve(A, (turned - np.eye(2)) @ b)
    got_mean, got_cov = mean_and_cov(field)
    # What is left is the error of the paths, two steps of Runge and Kutta in each.
    assert np.allclose(got_mean, moved_mean, atol=2e-4)
    assert np.allclose(got_cov, expected, rtol=1e-3, atol=1e-5)
    assert abs(mass - 1) < 1e-4


def logistic(size: int) -> tuple[float, float]:
    """The largest error of the density relative to its maximum after x' = x (1 - x), from a Gaussian, and that of the mass."""
    mean, deviation, tau, parts = 0.4, 0.06, 0.8, 4
    field = gaussian_field(size, [mean], [[deviation**2]], 6.0)
    drift, still = lambda x, t: [x[..., 0] * (1 - x[..., 0])], lambda t: jnp.zeros((1, 1))
    step = jax.jit(lambda field: moved(field, drift, still, 0.0, tau / parts, 6.0, nothing, 0))
    for _ in range(parts):
        field, _, _ = step(field)
    x = np.asarray(field.points())[:, 0]
    # x(t) = x e^t / (1 + x (e^t - 1)), solved for the start; its derivative is the factor of the density.
    growth = np.exp(-tau)
    below = 1 + x * (growth - 1)
    start, slope = x * growth / below, growth / below**2
    exact = np.exp(-0.5 * ((start - mean) / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi)) * slope
    density = np.asarray(field.values) / float(field.basis[0, 0])
    return np.abs(density - exact).max() / exact.max(), abs(float(field.values.sum()) - 1)


@pytest.mark.slow
def test_a_logistic_flow_is_followed_to_the_third_order_of_the_cells_or_better():
    (coarse, _), (fine, mass) = logistic(24), logistic(48)
    assert fine < 1e-4 and mass < 1e-4
    assert coarse / fine > 8


@pytest.mark.slow
def test_a_rotation_with_shear_carries_the_density_along():
    # The speed of the rotation is the square of the radius: the density bends, the exact one is read at the point turned back.
    def drift(x, t):
        r = x[..., 0] ** 2 + x[..., 1] ** 2
        return [-r * x[..., 1], r * x[..., 0]]

    mean, deviation, tau, parts = np.array([1.0, 0.0]), 0.15, 0.5, 5
    field = gaussian_field(48, mean, deviation**2 * np.eye(2), 6.0)
    step = jax.jit(lambda field: moved(field, drift, lambda t: jnp.zeros((2, 2)), 0.0, tau / parts, 6.0, nothing, 0))
    for _ in range(parts):
        field, _, _ = step(field)
    x = np.asarray(field.points())
    angle = -tau * np.sum(x**2, axis=-1)
    back = np.stack(
        [np.cos(angle) * x[..., 0] - np.sin(angle) * x[..., 1], np.sin(angle) * x[..., 0] + np.cos(angle) * x[..., 1]], axis=-1
    )
    exact = np.exp(-0.5 * np.sum((back - mean) ** 2, axis=-1) / deviation**2) / (2 * np.pi * deviation**2)
    density = np.asarray(field.values) / abs(np.linalg.det(np.asarray(field.basis)))
    assert np.abs(density - exact).max() < 5e-3 * exact.max()
    assert abs(float(field.values.sum()) - 1) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_the_filter_of_a_linear_system_is_that_of_kalman_and_bucy(kind):
    model = zakai.Model(
        state=["x", "v"],
        drift=["v", "-x - v/2"],
        observation=["x"],
        observation_kind=kind,
        process_noise=[["1/20", "0"], ["0", "1/10"]],
        observation_noise=[["1/4"]],
        prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [[0.5, 0.0], [0.0, 0.5]]},
    )
    every = 0.25 if kind == "samples" else 0.05
    _, record = zakai.simulate(model, every * np.arange(1, 13), seed=2)
    exact = zakai.filter(model, record, "kalman-bucy")
    result = zakai.filter(model, record, "yau-yau", operator="characteristics", tolerance=1e-2)
    assert not result.warnings
    deviation = np.sqrt(exact.variance)
    assert np.abs((result.mean - exact.mean) / deviation).max() < 5e-3
    assert np.abs(result.variance / exact.variance - 1).max() < 1e-2
    assert abs(result.log_likelihood - exact.log_likelihood) < 1e-2
