"""Yau (1993), Theorems 11 and 12: the printed formulas that do not hold, beside those that do."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

x, y, t, s = sp.symbols("x y t s", real=True)


@pytest.mark.parametrize(("limit", "holds"), [(1, True), (2, False)])
def test_the_exponent_of_theorem_11_is_an_integral_to_one_and_not_to_two(limit, holds):
    """(14) prints int_0^2; then terms in 1 / t are left, whatever the coefficients are."""
    f = x - x**3
    a = sp.integrate(sp.expand((x - y) * f.subs(x, y + s * (x - y))), (s, 0, limit))
    exponent = -((x - y) ** 2) / (2 * t) + a
    slope = sp.diff(exponent, x)
    rate = sp.diff(exponent, t) - 1 / (2 * t)
    residual = rate - (sp.diff(slope, x) + slope**2) / 2 + f * slope + sp.diff(f, x)
    singular = sp.Poly(sp.expand(t**2 * residual), t).all_coeffs()[::-1][:2]
    assert (singular[0] == 0) and ((singular[1] == 0) is holds)


@pytest.mark.parametrize(("integrals", "holds"), [(lambda K: K - 1, True), (lambda K: K, False)])
def test_the_kernel_of_a_long_time_is_made_of_as_many_kernels_as_there_are_intervals(integrals, holds):
    """Theorem 12 prints K integrals, which join K + 1 kernels of the time T / K."""
    T, K, cell = 1.5, 3, 0.05
    points = np.arange(-8, 8 + cell / 2, cell)
    kernel = np.exp(-((points[:, None] - points) ** 2) / (2 * T / K)) / np.sqrt(2 * np.pi * T / K)
    joined = kernel
    for _ in range(integrals(K)):
        joined = joined @ kernel * cell
    middle = len(points) // 2
    variance = joined[:, middle] @ points**2 / joined[:, middle].sum()
    assert np.isclose(variance, T, rtol=1e-6) == holds
    assert np.isclose(variance, T * (integrals(K) + 1) / K, rtol=1e-6)
