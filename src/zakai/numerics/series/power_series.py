"""Truncated power series: an array `a` whose first axis is the power, a(s) = sum_v a[v] s^v.

Axes between the first and a matrix's own are a batch, for instance one entry for each expansion point.  Every rule is exact up to
the truncation, and gives the same bits for a batch of any size.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics import complex_step
from zakai.numerics.transition import transposed

Array = NDArray[Any]
Product = Callable[[Array, Array], Array]


def apply(matrix: Array, vector: Array) -> Array:
    """Return the matrix times the vector (..., n)."""
    return np.asarray((matrix @ vector[..., None])[..., 0])


def dot(a: Array, b: Array) -> Array:
    """Return the scalar product of two vectors (..., n)."""
    return np.asarray(np.sum(a * b, axis=-1))


def cauchy(a: Array, b: Array, product: Product = np.multiply) -> Array:
    """Return the series of a(s) b(s), as long as the shorter; `product` may be `np.matmul`, `apply` or `dot`."""
    terms = min(len(a), len(b))
    result = np.array(product(a[0], b[:terms]))
    for i in range(1, terms):
        result[i:] += product(a[i], b[: terms - i])
    return result


def product(*factors: Array) -> Array:
    """Return the series of a product of matrices."""
    result = factors[0]
    for factor in factors[1:]:
        result = cauchy(result, factor, np.matmul)
    return result


def derivative(a: Array) -> Array:
    """Return the series of a'(s), one term shorter than that of a."""
    return np.asarray(a[1:] * np.arange(1.0, len(a)).reshape(-1, *[1] * (a.ndim - 1)))


def integral(a: Array, first: Any = 0.0) -> Array:
    """Return the series of the integral of a that is `first` at s = 0, one term longer than that of a."""
    powers = np.arange(1.0, len(a) + 1.0).reshape(-1, *[1] * (a.ndim - 1))
    start = np.broadcast_to(first, (1, *a.shape[1:]))
    return np.concatenate([start, a / powers])


def value(a: Array, s: Any) -> Array:
    """Return a(s) by Horner's rule; the shape of s begins with that of the batch, or broadcasts with it."""
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
        rest = g[v] - sum(factors[i] @ transposed(factors[v - i]) for i in range(1, v))
        factors.append(first @ (half * (inverted @ rest @ transposed(inverted))))
    return np.stack(factors)


def inverse(f: Array) -> Array:
    """Return the series of the inverse of the matrix f(s)."""
    result = [np.linalg.inv(f[0])]
    for v in range(1, len(f)):
        result.append(-result[0] @ sum(f[i] @ result[v - i] for i in range(1, v + 1)))
    return np.stack(result)
