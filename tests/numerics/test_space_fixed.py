"""Grids on which a density stays for many short substeps."""

from __future__ import annotations

import numpy as np

from zakai.numerics.space_field import Field
from zakai.numerics.space_fixed import refitted
from zakai.numerics.space_grid import Grid
from zakai.numerics.space_window import Bounds


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
