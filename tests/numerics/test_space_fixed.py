"""Grids on which a density stays for many short substeps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from zakai.numerics.space.field import Field
from zakai.numerics.space.fixed import motion, refitted
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.transport import Dynamics
from zakai.numerics.space.window import Bounds


def two_peaks(points):
    return sum(np.exp(-0.5 * ((points - peak) ** 2).sum(axis=1)) for peak in (-2.0, 2.0))


def test_a_density_whose_peaks_skew_axes_would_blur_keeps_them():
    # The covariance of both peaks asks for skew axes, along which it is much wider than either peak.
    grid = Grid(np.zeros(2), 0.45 * np.eye(2), (40, 40), (False, False))
    bounds = Bounds(edge=1e-6, tail=1e-6, most=512, periodic=(False, False))
    found = refitted(Field(two_peaks(grid.points).reshape(grid.sizes), grid, 0.0), bounds)
    np.testing.assert_allclose(found.values.reshape(-1), two_peaks(found.grid.points), atol=1e-3)
    assert np.abs(np.fft.fftn(found.values))[:, found.grid.sizes[1] // 2].max() < 1e-4 * found.values.sum()
    assert np.abs(np.fft.fftn(found.values))[found.grid.sizes[0] // 2].max() < 1e-4 * found.values.sum()


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 1.0])
def test_points_of_a_fixed_grid_move_as_the_flow_does(share):
    matrix = np.array([[0.2, 1.1], [-0.9, -0.5]])
    grid = Grid(np.array([1.0, -2.0]), np.array([[0.3, 0.1], [0.0, 0.2]]), (20, 24), (False, False))

    def drift(x, t):
        return np.concatenate([x @ matrix.T, np.full((len(x), 1), np.trace(matrix))], axis=1)

    noise = (np.zeros((2, 2)), np.zeros((2, 2)))
    dynamics = Dynamics(drift, lambda x, t: np.broadcast_to(matrix, (len(x), 2, 2)), lambda a, b: noise, False)
    moved = motion(dynamics, grid, 0.26)
    assert moved.unit == 0.5
    found = (share ** np.arange(1, 6) @ moved.coefficients).reshape(3, -1)
    exact = grid.points @ (expm(-0.5 * share * matrix) - np.eye(2)).T
    np.testing.assert_allclose(grid.basis @ found[:2], exact.T, atol=2e-6)
    np.testing.assert_allclose(found[2], -0.5 * share * np.trace(matrix), rtol=1e-12)


def test_a_density_that_is_fitted_keeps_its_mass():
    bounds = Bounds(edge=1e-6, tail=1e-6, most=512, periodic=(False, False))
    grid = Grid(np.array([0.3, -1.0]), np.array([[0.5, 0.2], [0.0, 1.0]]), (40, 40), (False, False))
    apart = np.moveaxis(np.indices(grid.sizes), 0, -1) - np.array([20.4, 19.7])
    field = Field(3.0 * np.exp(-0.5 * (apart**2).sum(axis=-1) / 2.4**2), grid, 0.0)
    found = refitted(field, bounds)
    assert found.grid.sizes != grid.sizes
    np.testing.assert_allclose(found.values.sum() * found.grid.cell, field.values.sum() * grid.cell, rtol=1e-12)
