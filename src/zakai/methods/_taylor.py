"""Truncated Taylor series in time: of SymPy expressions, and the arithmetic of matrices of series.

A series about t_0 is an array `a` whose *first* axis is the power, a(t_0 + s) = sum_v a[v] s^v.  Axes between the first and a
matrix's own are a batch, for instance one entry for each expansion point.  Every rule is exact up to the truncation: no
difference quotient, no symbolic derivative.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.errors import ConditionError, InputError
from zakai.methods._jets import jets_of
from zakai.models._program import Program
from zakai.models.numeric import COMPLEX, REAL
from zakai.numerics import complex_step

Array = NDArray[Any]
Product = Callable[[Array, Array], Array]
Values = Mapping[sympy.Symbol, float]


def transpose(matrix: Array) -> Array:
    """Return the transpose of the last two axes."""
    return np.swapaxes(matrix, -1, -2)


def symmetric(matrix: Array) -> Array:
    """Return the symmetric part, which removes rounding from a matrix that is symmetric."""
    return 0.5 * (matrix + transpose(matrix))


def apply(matrix: Array, vector: Array) -> Array:
    """Return the matrix times the vector (..., n)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def dot(a: Array, b: Array) -> Array:
    """Return the scalar product of two vectors (..., n)."""
    return np.asarray(np.sum(a * b, axis=-1))


def total(terms: Iterable[Array]) -> Array:
    """Return the sum of the terms, added in their order: the same to the last bit for a batch of any size."""
    return np.asarray(reduce(operator.add, terms))


def cauchy(a: Array, b: Array, product: Product = np.multiply) -> Array:
    """Return the series of a(t) b(t), as long as the shorter; `product` may be `np.matmul`, `apply` or `dot`."""
    terms = min(len(a), len(b))
    return np.stack([total(product(a[i], b[v - i]) for i in range(v + 1)) for v in range(terms)])


def product(a: Array, b: Array) -> Array:
    """Return the series of a product of matrices."""
    return cauchy(a, b, np.matmul)


def derivative(a: Array) -> Array:
    """Return the series of a'(t), one term shorter than that of a."""
    return np.asarray(a[1:] * np.arange(1.0, len(a)).reshape(-1, *[1] * (a.ndim - 1)))


def integral(a: Array) -> Array:
    """Return the series of the integral of a that is 0 at t_0, one term longer than that of a."""
    powers = np.arange(1.0, len(a) + 1.0).reshape(-1, *[1] * (a.ndim - 1))
    return np.concatenate([np.zeros((1, *a.shape[1:])), a / powers])


def value(a: Array, s: Any) -> Array:
    """Return a(t_0 + s) by Horner's rule; s has the shape of the batch."""
    s = np.reshape(s, np.shape(s) + (1,) * (a.ndim - 1 - np.ndim(s)))
    result: Array = np.zeros_like(a[0])
    for coefficient in a[::-1]:
        result = result * s + coefficient
    return result


def cholesky(g: Array) -> Array:
    """Return the series of the lower triangular F with F F' = g, for g (terms, ..., n, n)."""
    first = complex_step.cholesky(g[0])
    inverted = np.linalg.inv(first)
    half = np.tril(np.ones(g.shape[-2:])) - 0.5 * np.eye(g.shape[-1])
    factors = [first]
    for v in range(1, len(g)):
        rest = g[v] - sum(factors[i] @ transpose(factors[v - i]) for i in range(1, v))
        factors.append(first @ (half * (inverted @ rest @ transpose(inverted))))
    return np.stack(factors)


def inverse(f: Array) -> Array:
    """Return the series of the inverse of the matrix f(t)."""
    result = [np.linalg.inv(f[0])]
    for v in range(1, len(f)):
        result.append(-result[0] @ sum(f[i] @ result[v - i] for i in range(1, v + 1)))
    return np.stack(result)


def expand(expression: sympy.Expr, t: sympy.Symbol, points: Any, terms: int, values: Values | None = None) -> Array:
    """Return the first `terms` Taylor coefficients of an expression about each of `points`: (terms, *points.shape).

    `values` are the numbers of the other symbols.  Raises ConditionError where the expression is not analytic, or if it holds a
    function whose series is not known here.

        >>> import sympy
        >>> t = sympy.Symbol("t")
        >>> expand(1 / (1 - t), t, 0.0, 4)
        array([1., 1., 1., 1.])
    """
    return np.asarray(expand_matrix(sympy.Matrix([[expression]]), t, points, terms, values)[..., 0, 0])


def expand_matrix(matrix: sympy.MatrixBase, t: sympy.Symbol, points: Any, terms: int, values: Values | None = None) -> Array:
    """Return `expand` of every entry of a matrix: (terms, *points.shape, rows, columns)."""
    given = dict(values or {})
    found = Expansion(list(matrix), t, list(given)).taylor(points, terms, np.array(list(given.values()), float))
    return found.reshape(*found.shape[:-1], *matrix.shape)


class Expansion:
    """Expressions in t and other symbols, for many expansion points and values of the symbols.

    Args:
        entries: the expressions.
        t: time.
        symbols: the other symbols.

    Raises:
        ConditionError: a function whose series is not known here.
    """

    def __init__(self, entries: Sequence[sympy.Expr], t: sympy.Symbol, symbols: Sequence[sympy.Symbol]):
        self.entries, self.t = list(entries), t
        try:
            self._program = Program(self.entries, ((t,), sympy.Dummy(), tuple(symbols)))
        except InputError as error:
            raise ConditionError(
                f"the power series of {sympy.Matrix(self.entries)} in {t} is not known ({error}), and "
                'kernel="power-series" needs it; use kernel="flow"'
            ) from None

    def values(self, times: Any, theta: Array) -> Array:
        """Return the values (*times.shape, entries)."""
        times = np.asarray(times, float)
        with np.errstate(all="ignore"):
            found = self._program.run(times[..., None], 0.0, theta, COMPLEX if np.iscomplexobj(theta) else REAL)
        return np.stack([found[slot] + np.zeros(times.shape) for slot in self._program.outputs], axis=-1)

    def taylor(self, points: Any, terms: int, theta: Array) -> Array:
        """Return the first `terms` coefficients (terms, *points.shape, entries); theta may be complex.

        Raises:
            ConditionError: an expression is not analytic at one of the points.
        """
        points = np.asarray(points, float)
        found = jets_of(self._program, points.reshape(-1, 1), max(terms - 1, 1), theta)
        for expression, jet in zip(self.entries, found, strict=True):
            finite = np.isfinite(jet.coefficients[:terms]).all(axis=0)
            if not finite.all():
                raise ConditionError(
                    f"{expression} has no power series about {self.t} = {points.reshape(-1)[~finite][0]:g}, and "
                    'kernel="power-series" needs one; use kernel="flow"'
                )
        return np.stack([jet.coefficients[:terms].reshape(terms, *points.shape) for jet in found], axis=-1)
