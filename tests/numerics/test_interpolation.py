"""Densities between the points of a grid, against formulas."""

import numpy as np
import pytest

from zakai.numerics.line.window import Window, density_at, interpolated


@pytest.mark.parametrize("slope", [0.0, 1e-20j])
def test_a_gaussian_between_points_is_accurate_far_into_its_tails(slope):
    window = Window(0.0, 0.5, 0.17, 128, False, 1.0)
    offsets = np.linspace(-10.0, 10.0, 401)

    def gaussian(x):
        return np.exp(-0.5 * (x + slope) ** 2)

    found = density_at(gaussian(window.offsets), window, offsets)
    np.testing.assert_allclose(found.real, gaussian(offsets).real, rtol=3e-8, atol=0.0)
    np.testing.assert_allclose(found.imag, gaussian(offsets).imag, rtol=3e-7, atol=1e-34)


def test_beyond_the_grid_there_is_nothing_and_at_a_point_its_own_value():
    window = Window(0.0, 0.0, 0.25, 32, False, 1.0)
    values = np.exp(-0.5 * window.offsets**2)
    np.testing.assert_array_equal(density_at(values, window, np.array([-6.0, 5.0])), 0.0)
    np.testing.assert_array_equal(density_at(values, window, window.offsets), values)


def test_on_the_circle_waves_are_interpolated_exactly():
    window = Window(0.0, 0.0, 2.0 * np.pi / 48, 48, True, 1.0)
    offsets = np.append(np.linspace(-4.0, 7.0, 201), window.offsets[:3] + 1e-7)

    def function(x):
        return 2.0 + np.cos(3.0 * x) - 0.5 * np.sin(11.0 * x)

    found = interpolated(function(window.offsets), window, offsets)
    np.testing.assert_allclose(found, function(offsets), rtol=0.0, atol=1e-13)
    assert np.all(density_at(function(window.offsets) - 3.6, window, offsets) >= 0.0)
