"""Truncated Taylor series in time: of SymPy expressions, and the arithmetic of matrices of series.

A series about t_0 is an array `a` whose *first* axis is the power, a(t_0 + s) = sum_v a[v] s^v.  Axes between
the first and a matrix's own are a batch, for instance one entry for each expansion point.  Every rule is
exact up to the truncation: no difference quotient, no symbolic derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import sympy
from scipy.special import erf

from zakai.errors import ConditionError

Product = Callable[[np.ndarray, np.ndarray], np.ndarray]
Values = Mapping[sympy.Symbol, float]


def transpose(matrix: np.ndarray) -> np.ndarray:
    """The transpose of the last two axes."""
    return np.swapaxes(matrix, -1, -2)


def symmetric(matrix: np.ndarray) -> np.ndarray:
    """The symmetric part, which removes rounding from a matrix that is symmetric."""
    return 0.5 * (matrix + transpose(matrix))


def apply(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """The matrix times the vector (..., n)."""
    return (matrix @ vector[..., None])[..., 0]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The scalar product of two vectors (..., n)."""
    return np.sum(a * b, axis=-1)


def cauchy(a: np.ndarray, b: np.ndarray, product: Product = np.multiply) -> np.ndarray:
    """The series of a(t) b(t), as long as the shorter; `product` may be `np.matmul`, `apply` or `dot`."""
    terms = min(len(a), len(b))
    return np.stack([np.sum([product(a[i], b[v - i]) for i in range(v + 1)], axis=0) for v in range(terms)])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The series of a product of matrices."""
    return cauchy(a, b, np.matmul)


def derivative(a: np.ndarray) -> np.ndarray:
    """The series of a'(t), one term shorter than that of a."""
    return a[1:] * np.arange(1.0, len(a)).reshape(-1, *[1] * (a.ndim - 1))


def integral(a: np.ndarray, constant: np.ndarray | float = 0.0) -> np.ndarray:
    """The series of the integral of a that is `constant` at t_0, one term longer than that of a."""
    powers = np.arange(1.0, len(a) + 1.0).reshape(-1, *[1] * (a.ndim - 1))
    return np.concatenate([np.broadcast_to(constant, (1, *a.shape[1:])), a / powers])


def value(a: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The number a(t_0 + s) by Horner's rule; s has the shape of the batch."""
    s = np.reshape(s, np.shape(s) + (1,) * (a.ndim - 1 - np.ndim(s)))
    result = np.zeros_like(a[0])
    for coefficient in a[::-1]:
        result = result * s + coefficient
    return result


def cholesky(g: np.ndarray) -> np.ndarray:
    """The series of the lower triangular F with F F' = g, for g (terms, ..., n, n)."""
    first = np.linalg.cholesky(g[0])
    inverted = np.linalg.inv(first)
    half = np.tril(np.ones(g.shape[-2:])) - 0.5 * np.eye(g.shape[-1])
    factors = [first]
    for v in range(1, len(g)):
        rest = g[v] - sum(factors[i] @ transpose(factors[v - i]) for i in range(1, v))
        factors.append(first @ (half * (inverted @ rest @ transpose(inverted))))
    return np.stack(factors)


def inverse(f: np.ndarray) -> np.ndarray:
    """The series of the inverse of the matrix f(t)."""
    result = [np.linalg.inv(f[0])]
    for v in range(1, len(f)):
        result.append(-result[0] @ sum(f[i] @ result[v - i] for i in range(1, v + 1)))
    return np.stack(result)


def expand(
    expression: sympy.Expr,
    t: sympy.Symbol,
    points: np.ndarray | float,
    terms: int,
    values: Values | None = None,
) -> np.ndarray:
    """The first `terms` Taylor coefficients of an expression about each of `points`: (terms, *points.shape).

    `values` are the numbers of the other symbols.  Raises `ConditionError` where the expression is not
    analytic, or if it holds a function whose series is not known here.

        >>> import sympy
        >>> t = sympy.Symbol("t")
        >>> expand(1 / (1 - t), t, 0.0, 4)
        array([1., 1., 1., 1.])
    """
    return _Expansion(t, points, terms, values).of(expression)


def expand_matrix(
    matrix: sympy.MatrixBase,
    t: sympy.Symbol,
    points: np.ndarray | float,
    terms: int,
    values: Values | None = None,
) -> np.ndarray:
    """`expand` of every entry of a matrix: (terms, *points.shape, rows, columns)."""
    expansion = _Expansion(t, points, terms, values)
    entries = np.stack([expansion.of(entry) for entry in matrix], axis=-1)
    return entries.reshape(*entries.shape[:-1], *matrix.shape)


class _Expansion:
    """One walk over expression trees; the series of a sub-expression that occurs twice is computed once."""

    def __init__(
        self, t: sympy.Symbol, points: np.ndarray | float, terms: int, values: Values | None
    ) -> None:
        self.t, self.points, self.terms, self.values = t, np.asarray(points, float), terms, values or {}
        self.known: dict[sympy.Expr, np.ndarray] = {}

    def of(self, expression: sympy.Expr) -> np.ndarray:
        if expression not in self.known:
            with np.errstate(all="ignore"):
                series = self._series(expression)
            finite = np.all(np.isfinite(series), axis=0)
            if not np.all(finite):
                bad = self.points[~finite].flat[0]
                raise ConditionError(
                    f"{expression} has no power series about {self.t} = {bad:g}, and "
                    'kernel="power-series" needs one; use kernel="flow"'
                )
            self.known[expression] = series
        return self.known[expression]

    def _constant(self, number: np.ndarray | float) -> np.ndarray:
        series = np.zeros((self.terms, *self.points.shape))
        series[0] = number
        return series

    def _series(self, e: sympy.Expr) -> np.ndarray:
        if e == self.t:
            series = self._constant(self.points)
            series[1:2] = 1.0
            return series
        if e in self.values:
            return self._constant(self.values[e])
        if e.is_number and e.is_real:
            return self._constant(float(e))
        if e.is_Add:
            return np.sum([self.of(a) for a in e.args], axis=0)
        if e.is_Mul:
            series = self.of(e.args[0])
            for factor in e.args[1:]:
                series = cauchy(series, self.of(factor))
            return series
        if e.is_Pow:
            return self._power(e.base, e.exp)
        if e.func in _RULES:
            return _RULES[e.func](self.of(e.args[0]))
        raise ConditionError(
            f"the power series of {e} in {self.t} is not known, and "
            'kernel="power-series" needs it; use kernel="flow"'
        )

    def _power(self, base: sympy.Expr, exponent: sympy.Expr) -> np.ndarray:
        u = self.of(base)
        if exponent.is_Integer and exponent >= 0:
            series, count = self._constant(1.0), int(exponent)
            while count:
                if count % 2:
                    series = cauchy(series, u)
                u, count = cauchy(u, u), count // 2
            return series
        if exponent.has(self.t):
            return _exp(cauchy(self.of(exponent), _log(u)))
        return _real_power(u, self.of(exponent)[0])


def _chain(u: np.ndarray, w: list[np.ndarray], k: int) -> np.ndarray:
    """The power k - 1 of u' w over k: the power k of the integral of u' w."""
    return np.sum([i * u[i] * w[k - i] for i in range(1, k + 1)], axis=0) / k


def _real_power(u: np.ndarray, a: np.ndarray | float) -> np.ndarray:
    # w = u^a obeys u w' = a u' w.
    w = [u[0] ** a]
    for k in range(1, len(u)):
        w.append(np.sum([(a * i - (k - i)) * u[i] * w[k - i] for i in range(1, k + 1)], axis=0) / (k * u[0]))
    return np.stack(w)


def _exp(u: np.ndarray) -> np.ndarray:
    w = [np.exp(u[0])]
    for k in range(1, len(u)):
        w.append(_chain(u, w, k))
    return np.stack(w)


def _from_rate(function: Callable[[np.ndarray], np.ndarray], rate: Callable[[np.ndarray], np.ndarray]):
    """The rule of a function from its value and its derivative, a function of series: w' = rate(u) u'."""
    return lambda u: integral(cauchy(rate(u), derivative(u)), function(u[0])) if len(u) > 1 else function(u)


def _pair(first: np.ndarray, second: np.ndarray, sign: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sine and cosine of u (sign -1) or their hyperbolic kin (sign 1): s' = u' c, c' = sign u' s."""
    s, c = [first], [second]
    for k in range(1, len(u)):
        following = _chain(u, c, k)
        c.append(sign * _chain(u, s, k))
        s.append(following)
    return np.stack(s), np.stack(c)


def _circular(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return _pair(np.sin(u[0]), np.cos(u[0]), -1.0, u)


def _hyperbolic(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return _pair(np.sinh(u[0]), np.cosh(u[0]), 1.0, u)


def _feedback(first: np.ndarray, sign: float, u: np.ndarray) -> np.ndarray:
    """The tangent of u (sign 1) or the hyperbolic one (sign -1): w' = u' (1 + sign w^2)."""
    w, rate = [first], [1.0 + sign * first**2]
    for k in range(1, len(u)):
        w.append(_chain(u, rate, k))
        rate.append(sign * np.sum([w[i] * w[k - i] for i in range(k + 1)], axis=0))
    return np.stack(w)


def _tan(u: np.ndarray) -> np.ndarray:
    return _feedback(np.tan(u[0]), 1.0, u)


def _tanh(u: np.ndarray) -> np.ndarray:
    return _feedback(np.tanh(u[0]), -1.0, u)


def _reciprocal(u: np.ndarray) -> np.ndarray:
    return _real_power(u, -1.0)


def _plus(number: float, u: np.ndarray) -> np.ndarray:
    return np.concatenate([u[:1] + number, u[1:]])


def _sign(u: np.ndarray) -> np.ndarray:
    signs = np.zeros_like(u)
    signs[0] = np.where(u[0] == 0.0, np.nan, np.sign(u[0]))
    return signs


_log = _from_rate(np.log, _reciprocal)
_asin = _from_rate(np.arcsin, lambda u: _real_power(_plus(1.0, -cauchy(u, u)), -0.5))

_RULES: dict[type, Callable[[np.ndarray], np.ndarray]] = {
    sympy.exp: _exp,
    sympy.log: _log,
    sympy.sin: lambda u: _circular(u)[0],
    sympy.cos: lambda u: _circular(u)[1],
    sympy.tan: _tan,
    sympy.sec: lambda u: _reciprocal(_circular(u)[1]),
    sympy.csc: lambda u: _reciprocal(_circular(u)[0]),
    sympy.cot: lambda u: _reciprocal(_tan(u)),
    sympy.sinh: lambda u: _hyperbolic(u)[0],
    sympy.cosh: lambda u: _hyperbolic(u)[1],
    sympy.tanh: _tanh,
    sympy.sech: lambda u: _reciprocal(_hyperbolic(u)[1]),
    sympy.csch: lambda u: _reciprocal(_hyperbolic(u)[0]),
    sympy.coth: lambda u: _reciprocal(_tanh(u)),
    sympy.asin: _asin,
    sympy.acos: lambda u: _plus(np.pi / 2.0, -_asin(u)),
    sympy.atan: _from_rate(np.arctan, lambda u: _reciprocal(_plus(1.0, cauchy(u, u)))),
    sympy.erf: _from_rate(erf, lambda u: 2.0 / np.sqrt(np.pi) * _exp(-cauchy(u, u))),
    sympy.Abs: lambda u: u * _sign(u)[0],
    sympy.sign: _sign,
}
