"""Parts of an interval of time in which coefficients are resolved by few nodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

NODES = 6
_nodes, _weights = np.polynomial.legendre.leggauss(NODES)
GAUSS_NODES: Array = (_nodes + 1.0) / 2.0
GAUSS_WEIGHTS: Array = _weights / 2.0

PROBES = 129  # times of an interval at which coefficients are compared with their interpolants
_PROBES_OF_PART = 21
_MOST = 600


def interpolation(points: Array) -> Array:
    """Return the matrix from values at the Gauss nodes to values at points in [0, 1]."""
    return np.asarray((2.0 * points[:, None] - 1.0) ** _POWERS @ _COEFFICIENTS)


_POWERS = np.arange(NODES)
_COEFFICIENTS = np.linalg.inv((2.0 * GAUSS_NODES[:, None] - 1.0) ** _POWERS)


@lru_cache(maxsize=16)
def _probes(count: int) -> tuple[Array, Array]:
    points = np.linspace(0.0, 1.0, count)
    return points, interpolation(points)


class Panels(NamedTuple):
    """The `bounds` of the parts; `error` is the relative error of the integrals that remains where there are too many."""

    bounds: list[tuple[float, float]]
    error: float


def panels(coefficients: Callable[[Array], Array], start: float, stop: float, tolerance: float = 1e-8) -> Panels:
    """Return parts of [start, stop] in each of which the polynomial through six Gauss nodes agrees with the coefficients.

    Args:
        coefficients: function of times (T,) that returns (T, C).
        start, stop: the interval.
        tolerance: largest difference, relative to the largest modulus of each coefficient.
    """
    accepted: list[tuple[float, float]] = []
    stack, scale, error = [(start, stop)], np.zeros(1), 0.0
    while stack:
        first, last = stack.pop()
        length = last - first
        share = length / (stop - start)
        points, matrix = _probes(max(_PROBES_OF_PART, 1 + int((PROBES - 1) * 2.0 ** np.round(np.log2(share)))))
        values = coefficients(first + length * points)
        scale = np.maximum(np.maximum(scale, np.abs(values).max(axis=0)), 1e-300)
        rest = np.abs(matrix @ coefficients(first + length * GAUSS_NODES) - values).max(axis=0) / scale
        # What matters is the integral over a part.
        bad = float(rest.max()) * share
        if bad <= tolerance * max(share, 1e-3) or share < 1e-9 or len(accepted) + len(stack) > _MOST:
            if bad > tolerance:
                error += bad
            accepted.append((first, last))
        else:
            middle = first + 0.5 * length
            stack += [(middle, last), (first, middle)]
    return Panels(accepted, error)
