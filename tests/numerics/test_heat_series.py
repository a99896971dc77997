"""The kernel's series near its diagonal, its composition and the convergent series, against exact and spectral kernels."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import sympy as sp

import zakai
from zakai.algebra.kolmogorov_series import kolmogorov_series
from zakai.methods.series.heat import heat_series
from zakai.methods.system.jets import jets
from zakai.numerics.series.power_series import value
from zakai.studies._yau_kernels import parametrix, transition

DRIFTS = {
    # f, f' and its primitive as NumPy functions
    "x - x**3": (lambda x: x - x**3, lambda x: 1 - 3 * x**2, lambda x: x**2 / 2 - x**4 / 4),
    "tanh(x)": (np.tanh, lambda x: 1 - np.tanh(x) ** 2, lambda x: np.log(np.cosh(x))),
}


def system(drift: str, **more) -> zakai.Model:
    return zakai.Model(state=["x"], drift=[drift], observation=["0"], **more)


@cache
def spectrum(drift: str, half_width: float, count: int):
    """The grid, and the eigenvalues and vectors of -1/2 d^2 + (f^2 + f') / 2 by sinc collocation."""
    f, slope, _ = DRIFTS[drift]
    x = np.linspace(-half_width, half_width, count)
    apart = np.arange(count)[:, None] - np.arange(count)
    second = np.where(apart == 0, np.pi**2 / 3, 2 * (-1.0) ** apart / np.where(apart == 0, 1, apart) ** 2)
    return x, *np.linalg.eigh(second / (2 * (x[1] - x[0]) ** 2) + np.diag((f(x) ** 2 + slope(x)) / 2))


def spectral_kernel(drift: str, t: float, half_width: float, count: int, gauged: bool = False):
    """The grid and the kernel on it, of u or, `gauged`, of exp(-F) u."""
    x, values, vectors = spectrum(drift, half_width, count)
    kernel = (vectors * np.exp(-values * t)) @ vectors.T / (x[1] - x[0])
    if gauged:
        return x, kernel
    potential = DRIFTS[drift][2](x)
    return x, kernel * np.exp(np.minimum(potential[:, None] - potential, 700.0))


@cache
def series_of(drift: str, orders: int):
    y = np.linspace(-1, 1, 9)
    return y, heat_series(system(drift), y, orders - 1, degree=16 if orders < 5 else 22)


def errors(drift: str, t: float, reference, orders: int) -> dict:
    """The largest relative error for |x - y| <= 2 sqrt(t) and y in [-1, 1]."""
    y, series = series_of(drift, orders)
    z = 2 * np.sqrt(t) * np.linspace(-1, 1, 17)
    exact, points = reference(y + z[:, None], y, t), np.broadcast_to(z[:, None], (17, 9))
    return {
        (form, order): np.max(np.abs(np.asarray(series.offset(points, t, form, order)) / exact - 1))
        for form in ("sum", "log")
        for order in range(orders)
    }


def ornstein_uhlenbeck(x, y, t):
    variance = (1 - np.exp(-2 * t)) / 2
    return np.exp(-((x - y * np.exp(-t)) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)


def cosh_drift(x, y, t):
    """For f = tanh(x): Girsanov's theorem makes the kernel cosh(x) / cosh(y) exp(-t / 2) times the Gaussian's."""
    return np.cosh(x) / np.cosh(y) * np.exp(-t / 2 - (x - y) ** 2 / (2 * t)) / np.sqrt(2 * np.pi * t)


def cubic(x, y, t):
    """From the eigenfunctions, interpolated by their own sinc series."""
    grid, values, vectors = spectrum("x - x**3", 4.5, 361)
    spacing = grid[1] - grid[0]
    F = DRIFTS["x - x**3"][2]
    at_x = np.sinc((x[..., None] - grid) / spacing) @ vectors
    at_y = np.sinc((y[:, None] - grid) / spacing) @ vectors
    return np.einsum("pyk,yk,k->py", at_x, at_y, np.exp(-values * t)) / spacing * np.exp(F(x) - F(y))


def slopes(drift: str, reference, orders: int = 4) -> dict:
    coarse, fine = (errors(drift, t, reference, orders) for t in (0.05, 0.025))
    return {key: np.log2(coarse[key] / fine[key]) for key in coarse}


def test_the_orders_for_ornstein_and_uhlenbeck_are_one_more_than_that_of_the_series():
    found = slopes("-x", ornstein_uhlenbeck)
    for (form, order), slope in found.items():
        assert slope > order + 0.9, (form, order, slope)


def test_the_orders_for_the_tangent_are_one_more_and_its_logarithmic_form_is_exact():
    found = slopes("tanh(x)", cosh_drift)
    assert all(abs(found["sum", order] - order - 1) < 0.1 for order in range(4))
    # The remainder comes from a, which is a Taylor polynomial of degree 17 in z, |z| <= 0.45.
    assert max(errors("tanh(x)", 0.05, cosh_drift, 4)["log", order] for order in (1, 2, 3)) < 1e-9


def test_the_orders_for_the_double_well_are_one_more_than_that_of_the_series():
    found, at_tenth = slopes("x - x**3", cubic), errors("x - x**3", 0.1, cubic, 4)
    for (form, order), slope in found.items():
        assert slope > order + 0.85, (form, order, slope)
    assert [at_tenth["sum", order] for order in (1, 2, 3)] == pytest.approx([1.4e-2, 2.6e-3, 3.6e-4], rel=0.3)


def test_the_order_is_one_more_for_four_terms_too():
    for drift, reference in (("-x", ornstein_uhlenbeck), ("tanh(x)", cosh_drift), ("x - x**3", cubic)):
        found = slopes(drift, reference, 5)
        assert found["sum", 4] > 4.7, (drift, found["sum", 4])


@pytest.fixture(scope="module")
def moved_density():
    """A density, the same after a time of one by the spectral kernel, the grid, and the series on it."""
    x, kernel = spectral_kernel("x - x**3", 1.0, 4.0, 321)
    density = np.exp(-((x - 0.5) ** 2) / 0.2)
    density = density / (density.sum() * (x[1] - x[0]))
    return density, kernel @ density * (x[1] - x[0]), x, heat_series(system("x - x**3"), x, 2)


def composed_error(moved, form: str, order: int, substeps: int) -> float:
    density, exact, x, series = moved
    matrix = transition(series, x[1] - x[0], 1.0, substeps=substeps, form=form, order=order)
    return float(np.sum(np.abs(np.asarray(matrix) @ density - exact)) * (x[1] - x[0]))


def test_the_logarithmic_form_is_composed_with_an_error_of_the_order_of_the_series(moved_density):
    first = [composed_error(moved_density, "log", 1, K) for K in (80, 160)]
    second = [composed_error(moved_density, "log", 2, K) for K in (80, 160)]
    assert second[1] <= 2e-5
    assert 0.9 < np.log2(first[0] / first[1]) < 1.1
    assert 1.8 < np.log2(second[0] / second[1]) < 2.2


def test_the_sum_diverges_when_it_is_composed_and_what_lacks_a_first_term_does_not_converge(moved_density):
    assert composed_error(moved_density, "sum", 2, 5) > 1e3
    assert composed_error(moved_density, "sum", 2, 20) > 1e6 * composed_error(moved_density, "sum", 2, 5)
    assert composed_error(moved_density, "log", 0, 160) > 0.2


def test_the_jets_give_the_exact_polynomials():
    """G that is not one, and h that is not constant: at points off the diagonal, to rounding."""
    model = zakai.Model(state=["x"], drift=["1 - x**2/2"], observation=["x**2 - x"], diffusion=[["3/2"]])
    exact = kolmogorov_series(model, 3)
    y, x = np.array([0.3, -0.4]), 0.5
    series = heat_series(model, y, 3, degree=20)
    for ours, theirs in zip(
        (series.exponent, *series.coefficients, *series.logarithms),
        (exact.exponent, *exact.coefficients[1:], *exact.logarithms),
        strict=True,
    ):
        expected = [float(theirs.eval((sp.Rational(str(x)), sp.Rational(str(point))))) for point in y]
        assert np.allclose(value(ours, x - y), expected, rtol=1e-11, atol=1e-12)


FORMULAS = [
    "exp(x)*sin(2*x)", "log(2 + x**2)/(1 + cosh(x))", "tan(x/3) + asin(x/4) + acos(x/5) + atan(x)", "sqrt(2 + x)*erf(x)",
    "(2 + x)**(7/3) + log(cosh(x)) - 1/x**2 + abs(x)", "cos(x)*a + sinh(x)*tanh(x)**3 + (3 + x)**(-1/2)",
]  # fmt: skip


@pytest.mark.parametrize("formula", FORMULAS)
def test_the_taylor_polynomial_of_a_formula_is_that_of_its_derivatives(formula):
    model = zakai.Model(state=["x"], drift=[formula], observation=["x"], parameters={"a": 0.7})
    ours = jets(model.drift, model, np.array([0.4, 1.1]), 6, model.theta())[0]
    expression = model.drift[0].subs(model.parameter_symbols[0], sp.Rational(7, 10))
    for point, column in zip(("2/5", "11/10"), np.asarray(ours).T, strict=True):
        for k in range(7):
            expected = sp.diff(expression, model.x[0], k).subs(model.x[0], sp.Rational(point)).evalf(25) / sp.factorial(k)
            assert np.isclose(column[k], float(expected), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("order", "t", "figures"),
    [(0, 0.1, [1.4e-1, 9.8e-3]), (1, 0.1, [3.0e-2, 2.0e-4]), (1, 0.05, [8.0e-3, 1.3e-5])],
)
def test_each_term_of_the_convergent_series_brings_it_nearer_to_the_kernel(order, t, figures):
    x, exact = spectral_kernel("x - x**3", t, 4.5, 361, gauged=True)
    inside = np.ix_(np.abs(x) < 1.5 + 1e-9, np.abs(x) < 1.5 + 1e-9)
    found = parametrix(system("x - x**3"), x, t, order, 1)
    assert [np.max(np.abs(p - exact)[inside]) / np.max(exact[inside]) for p in found] == pytest.approx(figures, rel=0.1)


def test_the_second_term_of_the_convergent_series_brings_it_nearer_still():
    for order, t, figure in ((0, 0.1, 4.8e-4), (1, 0.2, 3.8e-4), (1, 0.1, 5.4e-7), (1, 0.05, 1.2e-8)):
        x, exact = spectral_kernel("x - x**3", t, 4.5, 361 if t < 0.1 else 241, gauged=True)
        inside = np.ix_(np.abs(x) < 1.5 + 1e-9, np.abs(x) < 1.5 + 1e-9)
        found = parametrix(system("x - x**3"), x, t, order, 2)[-1]
        assert np.max(np.abs(found - exact)[inside]) / np.max(exact[inside]) == pytest.approx(figure, rel=0.5)


def test_the_convergent_series_is_for_one_state():
    with pytest.raises(zakai.ConditionError, match="one state"):
        parametrix(zakai.Model(state=["x", "v"], drift=["v", "-x"], observation=["x"]), np.zeros(3), 0.1, 1, 1)
