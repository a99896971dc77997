"""Finite volumes: against the exponential of their own matrix, written here anew, and against the exact Gaussian."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from zakai.kolmogorov.comoving import Field
from zakai.kolmogorov.finite_volume import moved


def chang_cooper(size: int, cell: float, centre: float, drift, noise: float) -> np.ndarray:
    matrix = np.zeros((size, size))
    for i in range(size - 1):
        v = drift(centre + cell * (i + 0.5 - size // 2)) / cell
        d = 0.5 * noise / cell**2
        forwards, backwards = v / -np.expm1(-v / d), v / np.expm1(v / d)
        matrix[i + 1, i] += forwards
        matrix[i, i] -= forwards
        matrix[i, i + 1] += backwards
        matrix[i + 1, i + 1] -= backwards
    return matrix


def test_it_is_the_exponential_of_a_matrix_of_rates():
    size, cell, tau = 24, 0.3, 0.05
    x = cell * (np.arange(size) - size // 2)
    values = np.exp(-((x - 0.4) ** 2)) * (1 + 0.5 * np.sin(3 * x))
    values /= values.sum()
    mean_flow = values @ (1.0 - x**3)
    field = Field(jnp.asarray(values), jnp.zeros(1), jnp.array([[cell]]))
    after, _ = moved(field, lambda y, t: [1.0 - y[..., 0] ** 3], lambda t: jnp.array([[0.7]]), 0.0, tau, 40)
    # On the lattice as it stands in the middle of tau, in the frame of the mean.
    matrix = chang_cooper(size, cell, 0.5 * tau * mean_flow, lambda y: 1.0 - y**3 - mean_flow, 0.7)
    expected = scipy.linalg.expm(tau * matrix) @ values
    whole = round((float(after.centre[0]) - tau * mean_flow) / cell)
    assert np.allclose(np.roll(np.asarray(after.values), whole), expected, atol=1e-13)


@pytest.mark.slow
def test_mass_is_conserved_and_nothing_is_negative_however_long_the_step():
    rng = np.random.default_rng(0)
    values = rng.uniform(size=(12, 10)) * (rng.uniform(size=(12, 10)) > 0.7)
    field = Field(jnp.asarray(values / values.sum()), jnp.zeros(2), jnp.array([[0.4, 0.0], [0.1, 0.5]]))
    after, _ = moved(
        field, lambda x, t: [x[..., 1], -5 * x[..., 0] ** 3], lambda t: jnp.array([[0.0, 0.0], [0.0, 1.0]]), 0.0, 0.3, 40
    )
    assert np.all(np.asarray(after.values) >= 0) and abs(float(after.values.sum()) - 1) < 1e-12


@pytest.mark.slow
def test_the_error_is_of_second_order_in_the_cells_and_estimated():
    def error(size: int, cross: float) -> tuple[float, float]:
        cell, G, tau = 9.0 / size, np.array([[1.0, cross], [cross, 0.8]]), 0.2
        index = np.arange(size) - size // 2
        x = cell * np.stack(np.meshgrid(index, index, indexing="ij"), axis=-1)

        def gaussian(cov: np.ndarray) -> np.ndarray:
            density = np.exp(-0.5 * np.einsum("...i,ij,...j->...", x, np.linalg.inv(cov), x))
            return density / density.sum()

        field = Field(jnp.asarray(gaussian(np.eye(2))), jnp.zeros(2), cell * jnp.eye(2))
        for k in range(4):
            field, left = moved(field, lambda y, t: [-y[..., 0], 0.0 * y[..., 1]], lambda t: jnp.asarray(G), 0.05 * k, 0.05, 40)
        decay = np.diag([np.exp(-tau), 1.0])
        noise = G * np.array([[(1 - np.exp(-2 * tau)) / 2, 1 - np.exp(-tau)], [1 - np.exp(-tau), tau]])
        return float(np.abs(np.asarray(field.values) - gaussian(decay @ decay + noise)).sum()), 4 * float(left)

    for cross in (0.0, 0.5):
        (coarse, _), (fine, estimate) = error(24, cross), error(48, cross)
        assert 3.3 < coarse / fine < 4.7
        assert fine / 3 < estimate < 3 * fine
