"""Spreading by noise that depends on the state, where that noise is a constant."""

from __future__ import annotations

import numpy as np

from zakai.numerics.space.diffusion import diffused
from zakai.numerics.space.grid import Grid


def test_noise_of_correlated_states_spreads_a_gaussian():
    # The same G at all points, of waves across the diagonal of the grid's spacings: the result is a Gaussian.
    grid = Grid(np.zeros(2), 0.1 * np.eye(2), (128, 128), (False, False))
    start, noise = np.diag([0.25, 0.25]), np.array([[1.0, -0.95], [-0.95, 1.0]])

    def gaussian(cov):
        inner = ((grid.points @ np.linalg.inv(cov)) * grid.points).sum(axis=1)
        return np.exp(-0.5 * inner).reshape(grid.sizes) / np.sqrt(np.linalg.det(cov))

    result = diffused(gaussian(start), grid, np.broadcast_to(0.5 * noise, (128 * 128, 2, 2)))
    np.testing.assert_allclose(result, gaussian(start + 0.5 * noise), atol=1e-9)


def test_noise_that_vanishes_where_the_density_is_spreads_nothing():
    values = np.zeros((32, 32))
    values[4:8, 4:8] = 1.0
    noise = np.zeros((32, 32, 2, 2))
    noise[20:, 20:] = np.nan  # where a formula has no value
    grid = Grid(np.zeros(2), 0.1 * np.eye(2), (32, 32), (False, False))
    np.testing.assert_array_equal(diffused(values, grid, noise.reshape(-1, 2, 2)), values)
