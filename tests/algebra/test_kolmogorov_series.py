"""The exact series of the Kolmogorov equation's kernel: put into the equation by SymPy, nothing is left below the order."""

from __future__ import annotations

import pytest
import sympy as sp
from mpmath import mp

import zakai
from zakai.algebra.kolmogorov_series import kolmogorov_series
from zakai.algebra.theorems import conditions_of
from zakai.errors import ConditionError

NAMES = ["cubic", "van der pol", "lorenz", "slanted"]
CUBIC = dict(state=["x"], drift=["x - x**3"], observation=["x**3"])
VAN_DER_POL = dict(state=["x", "v"], drift=["v", "(1 - x**2)*v - x"], observation=["x**2"])
LORENZ = dict(state=["x", "y", "z"], drift=["10*(y - x)", "x*(28 - z) - y", "x*y - 8*z/3"], observation=["x"])
SLANTED = dict(
    state=["x", "v"],
    drift=["v - a*x**2", "x*v - 1"],
    observation=["x + v", "v"],
    diffusion=[["2", "0"], ["1", "1"]],
    observation_noise=[["2", "1"], ["1", "3"]],
    parameters={"a": 0.5},
)


def residual(model: zakai.Model, series, exponent: list[sp.Poly], factor: list[sp.Poly]) -> list[int]:
    """The powers of t in (u_t - L u) / u_0, for u = u_0 factor and u_0 = t^(-n/2) exp(exponent / t), both series in t."""
    own = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    f, h, G, S = (m.xreplace(own) for m in (model.drift, model.observation, model.covariance, model.observation_noise))
    n, x = model.n, [str(symbol) for symbol in model.x]
    ring, t, *rest = sp.ring([sp.Dummy("t"), *series.x, *series.y], sp.QQ)
    place = dict(zip(x, rest))

    def in_time(coefficients):
        return ring.from_dict({(k, *m): c for k, p in enumerate(coefficients) for m, c in p.rep.to_dict().items()})

    u, q = in_time(factor), in_time(exponent)
    drift = [ring.from_expr(f_i) for f_i in f]
    killed = ring.from_expr((h.T * S.inv() * h)[0] / 2) + sum(f_i.diff(place[name]) for f_i, name in zip(drift, x))
    # t d_i u / u_0 and t^2 d_i d_j u / u_0
    first = [t * u.diff(place[name]) + q.diff(place[name]) * u for name in x]
    rate = t**2 * u.diff(t) + u * (t * q.diff(t) - q - t * sp.QQ(n, 2)) + t**2 * killed * u
    for i in range(n):
        rate = rate + t * drift[i] * first[i]
        for j in range(n):
            if G[i, j]:
                second = t * first[j].diff(place[x[i]]) + q.diff(place[x[i]]) * first[j]
                rate = rate - second * (sp.QQ(int(G[i, j].p), int(G[i, j].q)) / 2)
    return sorted({monomial[0] - 2 for monomial in rate.monoms()})


def gaussian(series) -> sp.Poly:
    return sp.Poly(series.log_gaussian, *series.x, *series.y, domain="QQ")


@pytest.mark.parametrize(("system", "order"), [(CUBIC, 3), (VAN_DER_POL, 2), (LORENZ, 1), (SLANTED, 2)], ids=NAMES)
def test_the_residual_of_the_sum_is_of_its_order_and_exactly_zero_below(system, order):
    model = zakai.Model(**system)
    series = kolmogorov_series(model, order)
    exponent = [gaussian(series), series.exponent]
    assert residual(model, series, exponent, series.coefficients) == [order]
    assert residual(model, series, exponent, series.coefficients[:-1]) == [order - 1]


@pytest.mark.parametrize(("system", "order"), [(CUBIC, 4), (VAN_DER_POL, 2), (LORENZ, 1), (SLANTED, 2)], ids=NAMES)
def test_the_residual_of_the_logarithmic_form_is_of_its_order_and_exactly_zero_below(system, order):
    model = zakai.Model(**system)
    series = kolmogorov_series(model, order)
    one = sp.Poly(1, *series.x, *series.y, domain="QQ")
    assert min(residual(model, series, [gaussian(series), series.exponent, *series.logarithms], [one])) == order


def test_the_two_forms_are_one_series():
    series = kolmogorov_series(zakai.Model(**CUBIC), 3)
    one, two, three = series.logarithms
    assert series.coefficients[1] == one
    assert series.coefficients[2] == two + one**2 / 2
    assert series.coefficients[3] == three + one * two + one**3 / 6


def test_a_constant_covariance_is_that_of_other_coordinates():
    # x = g z with g = [[2, 0], [1, 1]] makes the slanted system one with the identity.
    whitened = zakai.Model(
        state=["x", "v"],
        drift=["(x + v - 2*x**2)/2", "2*x*(x + v) - 1 - (x + v - 2*x**2)/2"],
        observation=["3*x + v", "x + v"],
        observation_noise=[["2", "1"], ["1", "3"]],
    )
    slanted, white = kolmogorov_series(zakai.Model(**SLANTED), 2), kolmogorov_series(whitened, 2)
    (x, v), (y, w) = slanted.x, slanted.y
    there = {x: 2 * x, v: x + v, y: 2 * y, w: y + w}
    for ours, theirs in zip((slanted.exponent, *slanted.logarithms), (white.exponent, *white.logarithms), strict=True):
        assert sp.expand(ours.as_expr().subs(there, simultaneous=True) - theirs.as_expr()) == 0


def test_the_kernel_of_ornstein_and_uhlenbeck_is_the_series_of_the_exact_one():
    theta, x, y = (mp.mpf(k) / 8 for k in (12, 5, -3))
    series = kolmogorov_series(zakai.Model(state=["x"], drift=["-3*x/2"], observation=["0"]), 4)

    def exact(t):
        variance = (1 - mp.exp(-2 * theta * t)) / (2 * theta)
        return -((x - y * mp.exp(-theta * t)) ** 2) / (2 * variance) - mp.log(variance / t) / 2 + (x - y) ** 2 / (2 * t)

    with mp.workdps(60):
        # The power series by interpolation at small times, which takes differences of large numbers.
        times = [mp.mpf(k) / 10**5 for k in range(1, 13)]
        vandermonde = mp.matrix([[t**k for k in range(12)] for t in times])
        expected = mp.lu_solve(vandermonde, mp.matrix([exact(t) for t in times]))
    for k, p in enumerate((series.exponent, *series.logarithms)):
        assert abs(float(expected[k]) - float(p.eval((sp.Rational(5, 8), sp.Rational(-3, 8))))) < 1e-12


def test_the_numbers_of_terms_grow_as_they_must():
    # For x - x^3, W has degree 6 in x and y together.
    assert kolmogorov_series(zakai.Model(**CUBIC), 6).terms() == tuple((3 * k + 1) ** 2 for k in range(7))
    assert [len(p.terms()) for p in kolmogorov_series(zakai.Model(**CUBIC), 6).logarithms] == [16, 9, 36, 25, 64, 49]
    assert kolmogorov_series(zakai.Model(**VAN_DER_POL), 3).terms()[-1] == 2417
    assert kolmogorov_series(zakai.Model(**LORENZ), 2).terms()[-1] == 495


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (dict(drift=["sin(x)"]), "no polynomial"),
        (dict(drift=["sqrt(2)*x"]), "no polynomial with rational coefficients"),
        (dict(drift=["t*x"]), "f without time"),
        (dict(observation=["t*x"]), "h without time"),
        (dict(diffusion=[["1 + t"]]), "G without time"),
        (dict(diffusion=[["0"]]), "positive definite"),
    ],
)
def test_what_is_no_polynomial_or_depends_on_time_is_refused(changed, said):
    with pytest.raises(ConditionError, match=said):
        kolmogorov_series(zakai.Model(**(CUBIC | changed)), 2)


def test_a_kink_of_h_is_refused_whose_sums_over_the_grid_have_no_error_figure():
    model = zakai.Model(state=["x"], drift=["-sin(x)"], observation=["abs(x)"], observation_kind="samples")
    failed = [condition.statement for condition in conditions_of("kolmogorov-series", model) if condition.holds is False]
    assert failed == ["f and the law of observations are smooth"]
