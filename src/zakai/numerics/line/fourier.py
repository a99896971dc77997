"""The Kolmogorov operator of one state on a large grid, by Fourier transforms in place of a matrix.

    L u = (G u)'' / 2 - (f u)' + V u

with the derivatives of the trigonometric interpolant.  Densities on the line vanish at the ends of their grid, so that it may as
well go around a circle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.line.operator import Exponential

Array = NDArray[Any]

PART = 6.0  # norm up to which one Taylor series is summed
TERMS = 80


@dataclass(frozen=True, eq=False)
class FourierOperator:
    """L for G, one number or (N,), f (N,) and V, one number or (N,), or integrals over time of these; or its adjoint.

    `length` is that of the grid.
    """

    covariance: Any
    drift: Array
    potential: Any
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
        parts = max(1, int(np.ceil(self.norm / PART)))
        for _ in range(parts):
            term, negligible = vector, 1e-17 * np.max(np.abs(vector.real))
            for k in range(1, TERMS):
                term = self.operator @ term / (parts * k)
                vector = vector + term
                if np.max(np.abs(term.real)) < negligible:
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
    found = np.fft.irfft(waves, size)
    return found if found.ndim == 1 else found[0] + 1j * found[1]
