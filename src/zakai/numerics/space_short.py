"""Short substeps on a grid that stays where it is: the splitting of `space_transport` without its linearised noise.

What depends on the grid alone is prepared once, for intervals of any length: along the characteristics that end in a point the
displacement and the change of volume are polynomials of degree four in the length.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space_grid import Grid, gather, gaussian_response, indices
from zakai.numerics.space_transport import Dynamics, runge_kutta

Array = NDArray[Any]
PLAIN = 0.1  # largest tau |L| for which the noise is not that of the linearised system
DEGREE = 4


class Motion(NamedTuple):
    """Coefficients (4, J (n + 1)) of tau / `unit`, ... of the displacement in spacings and of the log of the change of volume."""

    coefficients: Array
    unit: float


def rate_of(dynamics: Dynamics, grid: Grid) -> float:
    """Return |L| in spacings at the centre of a grid with aligned axes; infinite for other grids and noise."""
    step = np.diagonal(grid.basis)
    G = dynamics.noise(0.0, 1.0)[0]
    if np.count_nonzero(grid.basis) > grid.n or np.count_nonzero(G - np.diag(np.diagonal(G))):
        return math.inf
    jacobian = dynamics.jacobian(grid.centre, 0.0).real
    return float(np.abs(jacobian * step / step[:, None]).sum(axis=1).max()) if np.isfinite(jacobian).all() else math.inf


def motion(dynamics: Dynamics, grid: Grid, tau: float) -> Motion:
    """Return the motion of a grid for lengths up to the power of two that is not below tau."""
    unit = math.ldexp(1.0, math.ceil(math.log2(tau)))
    shares = (np.arange(DEGREE) + 1.0) / DEGREE
    points = grid.points
    with np.errstate(all="ignore"):
        moved = np.stack([runge_kutta(dynamics.drift, points, unit * share, 0.0, 1) for share in shares])
    moved[..., :-1] /= np.diagonal(grid.basis)
    powers = np.linalg.inv(shares[:, None] ** np.arange(1, DEGREE + 1))
    return Motion(powers @ moved.reshape(DEGREE, -1), unit)


@lru_cache(maxsize=64)
def _fourier(size: int) -> tuple[Array, Array]:
    """Return the orthonormal real Fourier basis (size, size) in its columns, and the numbers of their frequencies."""
    number = (np.arange(size) + 1) // 2
    angle = 2 * np.pi / size * np.arange(size)[:, None] * number
    basis = np.where(np.arange(size) % 2 == 1, np.cos(angle), np.sin(angle))
    basis[:, 0] = 1.0
    return basis / np.sqrt((basis**2).sum(axis=0)), number


@lru_cache(maxsize=256)
def circulant(variance: complex, size: int, spline: bool = False) -> Array:
    """Return the matrix of spreading by a variance in index units, or of the coefficients of a spline."""
    basis, number = _fourier(size)
    return np.asarray((basis * gaussian_response(np.array([[variance]]), (size,), spline)[number]) @ basis.T)


def along_axes(matrices: list[Array], values: Array) -> Array:
    """Return values (*sizes) times a symmetric matrix along each axis."""
    shape = values.shape
    for d, matrix in enumerate(matrices):
        if d == values.ndim - 1:
            values = values.reshape(-1, shape[d]) @ matrix
        else:
            values = matrix @ values.reshape(-1, shape[d], math.prod(shape[d + 1 :]))
    return values.reshape(shape)


def short_step(values: Array, grid: Grid, moved: Motion, tau: float, G: Array, factors: tuple[Array, Array] | None) -> Array:
    """Return the density after a substep; `factors` are exp(b / 6) and exp(b / 3 - tau g / 144)."""
    variances = 0.5 * tau * np.diagonal(G) / np.diagonal(grid.basis) ** 2
    spreads = [circulant(v.item(), size) for v, size in zip(variances, grid.sizes, strict=True)]
    s = tau / moved.unit
    change = (np.array([s, s * s, s**3, s**4]) @ moved.coefficients).reshape(-1, grid.n + 1)
    at = indices(grid.sizes) + np.array(grid.sizes) // 2 + change[:, :-1]
    volume = np.exp(np.where(np.abs(change[:, -1].real) < 300.0, change[:, -1], 0.0)).reshape(grid.sizes)
    if factors is not None:
        volume = volume * factors[1]
    splines = [circulant(0.0, size, True) for size in grid.sizes]
    values = along_axes(spreads, values if factors is None else values * factors[0])
    coefficients = along_axes(splines, values if factors is None else values * factors[1])
    values = along_axes(spreads, gather(coefficients, at, grid).reshape(grid.sizes) * volume)
    return values if factors is None else values * factors[0]


def splitting_error(grid: Grid, tau: float, rate: float, G: Array) -> float:
    """Return an estimate of the error of the plain splitting of a density that fills its grid."""
    variances = tau * np.diagonal(G).real / np.diagonal(grid.basis) ** 2
    return float((tau * rate) ** 2 / 6 * np.max(variances / (np.array(grid.sizes) / 11.0) ** 2))
