"""Spreading of a density by noise that depends on the state, on a grid that resolves it.

    u_t = 1/2 sum_ij d_i d_j (G_ij(x) u)

The derivatives are exact in frequency, so that mass is kept; the exponential of the operator is a series of Chebyshev
polynomials, for noise of any size.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, rfftn
from scipy.special import ive

from zakai.numerics.space.grid import Grid

Array = NDArray[Any]
_REST = 1e-12  # terms of the series that are left out, relative to the density
NEGLIGIBLE = 1e-8  # of the maximum, below which the noise need not be exact
SPARE = 2.0  # times the largest noise elsewhere
MOST_TERMS = 4000


@lru_cache(maxsize=64)
def _multipliers(sizes: tuple[int, ...]) -> dict[tuple[int, int], Array]:
    """Return the Fourier multipliers of d_i d_j (i >= j) in index units, those with i > j counted twice."""
    n, waves = len(sizes), []
    for d, size in enumerate(sizes):
        k = 2 * np.pi * (np.fft.rfftfreq(size) if d == n - 1 else np.fft.fftfreq(size))
        waves.append(k.reshape([-1 if a == d else 1 for a in range(n)]))
    # The sign of the highest frequency is unknown: a first derivative has none of it.
    first = [np.where(np.abs(k) > np.pi - 1e-9, 0.0, k) for k in waves]
    return {(i, j): -(waves[i] ** 2) if i == j else -2.0 * first[i] * first[j] for i in range(n) for j in range(i + 1)}


def diffused(values: Array, grid: Grid, noise: Array, tau: float, adjoint: bool = False) -> Array:
    """Return a density after spreading over a time by noise that depends on the state.

    With `adjoint` the values are a function of the state after the time, whose mean given the state before it is returned.

    Args:
        values: the density (*sizes); an imaginary part is a derivative.
        grid: its grid.
        noise: G at the points of the grid (J, n, n).
        tau: the time.
    """
    inverse = grid.inverse
    noise = inverse @ noise @ inverse.T
    # Where the density is negligible the noise may be so too, which bounds the spectrum of the operator.
    size, real = np.abs(noise.real).sum(axis=(1, 2)), values.real.reshape(-1)
    largest = SPARE * float(np.max(size, where=real > NEGLIGIBLE * real.max(), initial=0.0))
    noise = noise * np.minimum(1.0, largest / np.maximum(size, 1e-300))[:, None, None]
    axes, parts = tuple(range(grid.n)), []
    for (i, j), multiplier in _multipliers(grid.sizes).items():
        entry = (0.5 * tau) * noise[:, i, j].reshape(grid.sizes)
        if np.any(entry):
            parts.append((entry, multiplier))
    if not parts:
        return values
    # A bound on the spectrum, whose eigenvalues are in [-radius, 0]: k'Gk for waves of at most pi a spacing along each axis.
    radius = 0.5 * tau * np.pi**2 * min(largest, float(size.max()))

    def transformed(fields: list[Array]) -> Array:
        spectrum = sum((rfftn(field) * multiplier for field, (_, multiplier) in zip(fields, parts, strict=True)))
        return np.asarray(irfftn(spectrum, grid.sizes, axes=axes))

    def moved(u: Array) -> Array:
        """Return (1 + 2 L / radius) u."""
        if adjoint:
            waves = rfftn(u)
            for entry, multiplier in parts:
                u = u + (2.0 / radius) * entry * irfftn(waves * multiplier, grid.sizes, axes=axes)
            return u
        fields = [entry * u for entry, _ in parts]
        change = transformed([field.real for field in fields])
        if np.iscomplexobj(fields[0]):
            change = change + 1j * transformed([field.imag for field in fields])
        return u + (2.0 / radius) * change

    weights = ive(np.arange(min(MOST_TERMS, int(20 + 2 * radius))), 0.5 * radius)
    weights = weights[: 1 + int(np.flatnonzero(weights > _REST * weights[0])[-1])]
    before, last = values, moved(values)
    result = weights[0] * values + 2.0 * weights[1] * last if len(weights) > 1 else weights[0] * values
    for weight in weights[2:]:
        before, last = last, 2.0 * moved(last) - before
        result = result + 2.0 * weight * last
    return np.asarray(result)
