"""Transitions over any time as compositions of short kernels of the heat series, on one grid.

    p(t + d) = K(r) K(c)^m p(t),      d = r + m c

The powers K(c)^(2^i) are kept as matrices where m is large, so that every interval costs the remainder and a few products.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import dia_array

from zakai.numerics.series.dyadic_grid import Grid

SHORTEST = 1.34  # grid spacings in the standard deviation of the shortest kernel
KEPT = 12  # short kernels of other lengths
Array = NDArray[Any]


class Kernels:
    """The kernels on one grid, made when they are needed; `base` is the length whose powers are kept.

    Args:
        banded: takes a time and returns the kernel of this time, times the spacing, for the differences -b, ..., b of grid points
            (2 b + 1, N).
        G: the variance of a short kernel for a unit of time.
        grid: the grid.
        positive: whether all values of a kernel are positive, so that its columns are scaled to mass one.
    """

    def __init__(self, banded: Callable[[float], Array], G: float, grid: Grid, positive: bool):
        self.banded, self.grid, self.positive = banded, grid, positive
        self.base = 2 * (SHORTEST * grid.spacing) ** 2 / G
        self._short: dict[float, tuple[Any, Array]] = {}
        self._powers: dict[tuple[float, int], Array] = {}

    def short(self, t: float) -> tuple[Any, Array]:
        """Return the kernel of a time t as a banded matrix (N, N), and the defects (N,) of the masses of its columns."""
        found = self._short.get(t)
        if found is not None:
            return found
        columns = self.banded(t)
        with np.errstate(invalid="ignore", over="ignore"):
            mass = columns.sum(axis=0)
            # A series that is of no use at a point, as where the drift is too fast for it, carries nothing from there.
            good = (np.abs(mass) < 1e100) & ((mass.real > 1e-100) | (not self.positive))
        known = np.where(good, mass, 1.0)
        columns = np.where(good, columns, 0.0) / (known if self.positive else 1.0)
        reach, size = len(columns) // 2, columns.shape[1]
        matrix = dia_array((columns, np.arange(reach, -reach - 1, -1)), shape=(size, size))
        if len(self._short) >= KEPT:
            self._short.clear()
        found = self._short[t] = matrix, np.where(good, np.abs(known.real - 1.0), 1.0)
        return found

    def power(self, t: float, i: int) -> Array:
        """Return the matrix of 2^i kernels of a time t."""
        found = self._powers.get((t, i))
        if found is None:
            half = self.power(t, i - 1) if i else None
            found = self._powers[t, i] = self.short(t)[0].toarray() if half is None else half @ half
        return found

    def repeated(self, values: Array, t: float, count: int) -> Array:
        """Apply `count` kernels of a time t."""
        if 100 * count < self.grid.size**2 * count.bit_length():  # fewer operations than powers of a matrix take
            matrix, _ = self.short(t)
            for _ in range(count):
                values = matrix @ values
            return values
        for i in range(count.bit_length()):
            if count >> i & 1:
                values = self.power(t, i) @ values
        return values

    def moved(self, values: Array, t: float, substeps: int | None) -> tuple[Array, Array, float]:
        """Return the values after a time t, the same with kernels twice as long, and the defect of the kernels' mass."""
        if substeps is None:
            count = max(int(t / self.base) - 1, 0)
            rest = t - count * self.base
            fine, coarse = self.repeated(values, 0.5 * rest, 2), self.repeated(values, rest, 1)
            if count:
                fine, coarse = self.repeated(fine, 0.5 * self.base, 2 * count), self.repeated(coarse, self.base, count)
            (_, defects), total = self.short(rest), count + 1
        else:
            (_, defects), total = self.short(t / substeps), substeps
            coarse = self.repeated(values, t / substeps, substeps)
            fine = self.repeated(values, 0.5 * t / substeps, 2 * substeps)
        return fine, coarse, float(total * (defects @ values.real) / values.real.sum())
