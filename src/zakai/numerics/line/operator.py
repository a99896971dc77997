"""The Kolmogorov operator of one state on a uniform grid, and its exponential.

    L u = (G u)'' / 2 - (f u)' + V u

with the derivatives of the sinc interpolant on the line and of the trigonometric interpolant on the circle: spectrally
accurate, exact in time for every interval.  Up to `window.LARGEST` points L is a matrix; on larger grids its products with
vectors are computed by Fourier transforms, because a density on the line vanishes at the ends of its grid, which may as well go
around a circle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import real_product
from zakai.numerics.line.resolution import ROUNDING


@lru_cache(maxsize=64)
def derivatives(size: int, closed: bool) -> tuple[Array, Array]:
    """Return the matrices (size, size) of d/dx and d^2/dx^2 for the spacing one (line) or 2 pi / size (circle)."""
    offset = np.subtract.outer(np.arange(size), np.arange(size))
    sign = np.where(offset % 2 == 0, 1.0, -1.0)
    safe = np.where(offset == 0, 1, offset)
    if closed:
        half = np.pi * safe / size
        first = 0.5 * sign / np.tan(half)
        second = -0.5 * sign / np.sin(half) ** 2
        diagonal = -(size**2) / 12.0 - 1.0 / 6.0
    else:
        first, second, diagonal = sign / safe, -2.0 * sign / safe**2, -(np.pi**2) / 3.0
    first = np.where(offset == 0, 0.0, first)
    second = np.where(offset == 0, diagonal, second)
    first.setflags(write=False)
    second.setflags(write=False)
    return first, second


@lru_cache(maxsize=64)
def derivative_between(size: int, closed: bool) -> Array:
    """Return the matrix of d/dx of the interpolant half a spacing below each point, on the line also above the last one."""
    offset = np.subtract.outer(np.arange(size if closed else size + 1) - 0.5, np.arange(size))
    sign = np.sin(np.pi * offset)
    return np.asarray(-0.5 * sign / (size * np.sin(np.pi * offset / size) ** 2) if closed else -sign / (np.pi * offset**2))


class Generator(NamedTuple):
    """G, () or (N,), f (N,) and V (N,) at the points of a grid, or integrals over time of these."""

    covariance: Array
    drift: Array
    potential: Array


def generator(closed: bool, spacing: float, covariance: Array, drift: Array, potential: Array) -> Array:
    """Return L (N, N) for G, one number or (N,), f (N,) and V (N,), or integrals over time of these."""
    size = len(drift)
    first, second = derivatives(size, closed)
    scale = np.float64(1.0 if closed else spacing)  # whose powers may overflow
    matrix = (0.5 * covariance / scale**2) * second - first * (drift / scale)
    matrix[np.arange(size), np.arange(size)] += potential
    return np.asarray(matrix)


class Exponential:
    """exp(A) for A (N, N), real, or complex with an infinitesimal imaginary part, by scaling and squaring.

    It multiplies any number of vectors.
    """

    def __init__(self, matrix: Array):
        size = len(matrix)
        shift = float(np.trace(matrix.real)) / size
        matrix = matrix - shift * np.eye(size)
        norm = float(np.abs(matrix.real).sum(axis=0).max())  # as an operator on probabilities
        self.finite = bool(np.isfinite(norm))
        if self.finite:
            squarings = int(np.ceil(np.log2(max(norm, 0.5)))) + 1
            self.powers = min(squarings, 4)
            self.error = 1e-16 * 2.0**squarings
            self.matrix = exponential(matrix * 0.5**squarings) * np.exp(shift * 0.5**squarings)
            for _ in range(squarings - self.powers):
                self.matrix = self.matrix @ self.matrix

    def __call__(self, vector: Array) -> tuple[Array, float]:
        """Return exp(A) vector, and an estimate of its relative rounding error."""
        if not self.finite:
            return np.full_like(vector, np.nan), np.inf
        for _ in range(2**self.powers):
            vector = real_product(self.matrix, vector)
        return vector, self.error


def exponential(matrix: Array) -> Array:
    """Return exp(matrix) for a norm of at most one half, by a Taylor polynomial of degree 15 (Paterson and Stockmeyer)."""
    one = np.eye(len(matrix))
    second = matrix @ matrix
    third = second @ matrix
    fourth = second @ second
    c = _INVERSE_FACTORIALS
    total: Any = 0.0
    for k in (12, 8, 4, 0):
        block = c[k] * one + c[k + 1] * matrix + c[k + 2] * second + c[k + 3] * third
        total = block if k == 12 else fourth @ total + block
    return np.asarray(total)


_INVERSE_FACTORIALS = 1.0 / np.cumprod(np.concatenate([[1.0], np.arange(1.0, 16.0)]))


def symmetric(closed: bool, spacing: float, covariance: Array, potential: Array) -> Array:
    """Return H (N, N) of v_t = (G v')' / 2 - V v = -H v, symmetric.

    Of a G that depends on the state, -(G v')' is D' G D v with the derivative D of the interpolant between the points: no
    eigenvalue lies below the least value of the potential, however much G varies.

    Args:
        closed: whether the grid goes around the circle.
        covariance: G, one number, or its values between the points: (N + 1,) half a spacing below and above each, (N,) below
            each on the circle.
        potential: V at the points (N,).
    """
    size = len(potential)
    unit = np.float64(1.0 if closed else spacing)  # whose powers may overflow
    if np.ndim(covariance) == 0:
        return np.asarray(-0.5 * covariance * derivatives(size, closed)[1] / unit**2 + np.diag(potential))
    slope = derivative_between(size, closed) / unit
    return np.asarray(0.5 * (slope.T * covariance) @ slope + np.diag(potential))


def quotients(rates: Array, decay: Array, length: float) -> Array:
    """Return the divided differences (N, N) of exp(-length rates), which is `decay`."""
    apart = rates[:, None] - rates
    same = np.abs(apart) * length < 1e-6
    equal = -length * np.sqrt(np.outer(decay, decay))
    return np.asarray(np.where(same, equal, (decay[:, None] - decay) / np.where(same, 1.0, apart)))


class Spectral:
    """The operators exp(tau L), for every tau, where L is similar to a symmetric operator.

    With u = s v and s'/s = (f - G'/2) / G,

        v_t = (G v')' / 2 - ((f - G'/2)^2 / G + f' - G''/2) / 2 v = -H v,      exp(tau L) = s U exp(-tau lambda) U' / s.

    `rates` are lambda, `modes` U, `scale` s over the exponential of `top`, and `logs` its logarithms.
    """

    def __init__(self, operator: Array, gauge: Array, scale: Array | float = 1.0, known: Spectral | None = None):
        """Decompose H.

        Args:
            operator: H (N, N), symmetric.
            gauge: int f / G (N,).
            scale: s is the exponential of the gauge times this; G^(-1/2) where G depends on the state.
            known: the decomposition of the real part of a complex H.
        """
        self.rates: Array
        self.modes: Array
        self.rates, self.modes = np.linalg.eigh(operator.real) if known is None else (known.rates, known.modes)
        self.change = self.modes.T @ operator.imag @ self.modes if np.iscomplexobj(operator) else None
        self.top = float(gauge.real.max())
        self.logs = gauge - self.top + np.log(scale)
        self.scale = np.exp(gauge - self.top) * scale

    def __call__(self, values: Array, length: float) -> tuple[Array, float]:
        """Return exp(length L) values, and an estimate of its rounding error relative to its maximum."""
        with np.errstate(all="ignore"):
            return self.carried(values / self.scale, length)

    def carried(self, inner: Array, length: float) -> tuple[Array, float]:
        """Return s U exp(-length lambda) U' inner, and an estimate of its rounding error relative to its maximum."""
        reach = float(np.sqrt(np.sum(inner.real**2)))
        if not np.isfinite(reach):
            return inner, np.inf
        result = self.scale * self.decayed(inner, length)
        top, growth = float(np.max(result.real)), max(1.0, float(np.exp(-length * self.rates[0])))
        return result, ROUNDING * reach * growth / top if top > 0 else np.inf

    def decayed(self, inner: Array, length: float) -> Array:
        """Return U exp(-length lambda) U' inner, for one vector (N,) or, where H is real, several (N, J)."""
        decay = np.exp(-length * self.rates)
        coefficients = real_product(self.modes.T, inner)
        propagated = (decay * coefficients.T).T
        if self.change is not None:
            propagated = propagated + 1j * ((quotients(self.rates, decay, length) * self.change) @ coefficients.real)
        return real_product(self.modes, propagated)


FOURIER_PART = 6.0  # norm up to which one Taylor series is summed


@dataclass(frozen=True, eq=False)
class FourierOperator:
    """L for G, one number or (N,), f (N,) and V (N,), or integrals over time of these; or its adjoint.

    `length` is that of the grid.
    """

    covariance: Array
    drift: Array
    potential: Array
    length: float
    adjoint: bool = False

    @property
    def T(self) -> FourierOperator:  # noqa: N802
        """The adjoint."""
        return replace(self, adjoint=not self.adjoint)

    @property
    def highest(self) -> float:
        """The wave number of the shortest wave."""
        return float(np.pi * len(self.drift) / self.length)

    @property
    def decay(self) -> float:
        """The most by which diffusion lets the logarithm of the shortest wave decrease."""
        return 0.5 * self.highest**2 * float(np.max(np.real(self.covariance)))

    def __matmul__(self, values: Array) -> Array:
        """Return L u for u (N,)."""
        first, second = _factors(len(values), self.length)
        if self.adjoint:
            waves = _waves(values)
            slope, curvature = (_values(factor * waves, len(values)) for factor in (first, second))
            return np.asarray(0.5 * self.covariance * curvature + self.drift * slope + self.potential * values)
        waves = second * _waves(0.5 * self.covariance * values) - first * _waves(self.drift * values)
        return np.asarray(_values(waves, len(values)) + self.potential * values)


class FourierExponential:
    """exp(L), by Taylor series: it multiplies any number of vectors."""

    def __init__(self, operator: FourierOperator):
        potential, fastest = np.real(operator.potential), float(np.max(np.abs(operator.drift.real)))
        self.shift = 0.5 * float(np.max(potential) + np.min(potential) - operator.decay)
        self.norm = 0.5 * float(operator.decay + np.ptp(potential)) + operator.highest * fastest
        self.operator = replace(operator, potential=operator.potential - self.shift)

    def __call__(self, vector: Array) -> tuple[Array, float]:
        """Return exp(L) vector, and an estimate of its relative rounding error."""
        if not np.isfinite(self.norm):
            return np.full_like(vector, np.nan), np.inf
        parts = max(1, int(np.ceil(self.norm / FOURIER_PART)))
        for _ in range(parts):
            term, negligible = vector, 1e-17 * np.max(np.abs(vector.real))
            for k in count(1):
                term = self.operator @ term / (parts * k)
                vector = vector + term
                if not np.max(np.abs(term.real)) > negligible:
                    break
            vector = vector * np.exp(self.shift / parts)
        return vector, 1e-15 * (1.0 + self.norm)


def exponential_of(operator: Array | FourierOperator) -> Exponential | FourierExponential:
    """Return exp(L) for L as a matrix (N, N) or by Fourier transforms."""
    return FourierExponential(operator) if isinstance(operator, FourierOperator) else Exponential(operator)


@lru_cache(maxsize=16)
def _factors(size: int, length: float) -> tuple[Array, Array]:
    """Return what the first and the second derivative multiply waves by."""
    k = 2.0 * np.pi / length * np.arange(size // 2 + 1)
    return 1j * np.where(2 * np.arange(len(k)) < size, k, 0.0), -(k**2)


def _waves(values: Array) -> Array:
    """Return the transforms of the real part and, where there is one, of the imaginary part, which may be infinitesimal."""
    return np.fft.rfft(np.stack([values.real, values.imag]) if np.iscomplexobj(values) else values)


def _values(waves: Array, size: int) -> Array:
    result = np.fft.irfft(waves, size)
    return result if result.ndim == 1 else result[0] + 1j * result[1]
