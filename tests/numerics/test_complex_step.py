"""Products and moments that keep a derivative in the imaginary part."""

import numpy as np
from scipy.integrate import trapezoid

from zakai.numerics.complex_step import STEP, real_product
from zakai.numerics.line import window as lw
from zakai.numerics.line.operator import Exponential


def test_a_real_matrix_keeps_the_derivative_of_what_it_multiplies():
    draw = np.random.default_rng(0)
    matrix, values, slopes = draw.normal(size=(5, 7)), draw.normal(size=(7, 3)), draw.normal(size=(7, 3))
    found = real_product(matrix, values + 1j * STEP * slopes)
    np.testing.assert_allclose(found.real, matrix @ values, rtol=1e-13)
    np.testing.assert_allclose(found.imag / STEP, matrix @ slopes, rtol=1e-12)
    assert not np.iscomplexobj(real_product(matrix, values)) and real_product(matrix, values[:, 0] * 1j).shape == (5,)


def test_the_exponential_of_a_real_matrix_keeps_the_derivative_of_a_vector():
    draw = np.random.default_rng(1)
    vector, slope = draw.normal(size=40), draw.normal(size=40)
    for size in (0.05, 60.0):  # by products with the vector, and by squaring
        matrix = size * (np.eye(40, k=1) + np.eye(40, k=-1) - 2 * np.eye(40))
        rates, modes = np.linalg.eigh(matrix)
        transition = Exponential(matrix)
        found, _ = transition(vector + 1j * STEP * slope)
        for own, given in ((found.real, vector), (found.imag / STEP, slope)):
            np.testing.assert_allclose(own, modes @ (np.exp(rates) * (modes.T @ given)), rtol=1e-8, atol=1e-10)


def test_the_moments_of_an_angle_are_integrals_of_its_wrapped_deviation():
    window = lw.Window(0.4, 0.3, 2 * np.pi / 64, 64, True, 1.0)
    x, tilt = window.points, np.sin(window.points)
    weights = np.exp(np.cos(x - 2.0))
    weights /= weights.sum()

    def expected(shift):
        """The mean and the variance of a density tilted by a factor."""
        d = np.linspace(-np.pi, np.pi, 20001)
        u = np.exp(np.cos(d + 2.0 - 2.0) + shift * np.sin(d + 2.0))
        mean = 2.0 + np.angle(trapezoid(u * np.exp(1j * d), d))
        apart = np.angle(np.exp(1j * (d + 2.0 - mean)))
        return mean - window.origin, trapezoid(u * apart**2, d) / trapezoid(u, d)

    slope = weights * (tilt - np.sum(weights * tilt))
    for own, high, low, middle in zip(
        lw.moments(weights + 1j * STEP * slope, window), expected(1e-4), expected(-1e-4), expected(0.0), strict=True
    ):
        assert np.isclose(own.real, middle, atol=1e-6)
        assert np.isclose(own.imag / STEP, (high - low) / 2e-4, atol=1e-5)
