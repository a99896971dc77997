"""Cross interpolation of a function of points as a tensor train.

A sweep evaluates the fibres A = F(left[k] x axis k x right[k + 1]) for one axis after the other, and takes as the next index
set rows of A that interpolate it (`kernels.skeleton`).  The sets on the other side have some points more than the rank, so that
it can grow; after a sweep with too large an error at control points they get those that were worst.

References:
    Oseledets and Tyrtyshnikov 2010, TT-cross approximation for multidimensional arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.trains.grid import Grid
from zakai.numerics.trains.kernels import fibre_points, skeleton
from zakai.numerics.trains.train import Train

Array = Any
# Points of the mass whose parts, in all pairs, show which parts the first sweep needs: this many times the rank that is expected,
# and more; and the share of a skeleton's tolerance to which they are chosen.  Parts of random points need a second sweep in most
# builds of a track of four or five states, and half as many evaluations more.
TIMES, MORE, CHOSEN = 2, 8, 0.2
KEPT_GAIN = 0.7  # ratio of the errors of two sweeps above which another one gains too little
MOST_SWEEPS, CAPPED_SWEEPS = 6, 2  # and where a rank meets its limit: more sweeps gain little there
FLOOR = 1e-4  # of the largest value, below which errors do not count relative to the value
# Rows below this share of the largest count less, or ranks grow with what is noise; the second number where a rank meets its
# limit, which then is for what has mass.  Three observations in a row, each one deviation to the same side, lead to where a
# density was a thousandth: with 1e-2 the mean of a body that falls was off by 5 tolerances there, that of a ship seen by
# bearings by 3, with an estimate of a third; with 1e-3 for both a turning track needs twice the time.
SCALING = (0.5, 1e-3), (0.4, 1e-2)
WORST = 8  # control points with the largest errors that join the sets: the rank can grow by so many in a sweep


Function = Callable[[Array], Array]  # the values (P,) at points x (n, P)


class Options(NamedTuple):
    """The relative error of a core, the largest rank, and the error at control points, relative to it, that is small enough."""

    tolerance: float
    most_rank: int
    enough: float = 3.2


class Built(NamedTuple):
    """A train; the evaluations and the sweeps, the error at control points, and whether a rank met its limit."""

    train: Train
    evaluations: int
    sweeps: int
    error: float
    capped: bool


@dataclass
class _Cross:
    """The index sets to the left (r, k) and to the right (r, n - k) of every bond k; `mild` is the scaling that is taken."""

    grid: Grid
    function: Function
    options: Options
    left: list[Array]
    right: list[Array]
    evaluations: int = 0
    mild: bool = False
    capped: bool = False

    def fibres(self, k: int) -> Array:
        """Return F at left[k] x axis k x right[k + 1]: (a, N, b)."""
        grid, B = self.grid, self.grid.basis
        left, right = self.left[k].T, self.right[k + 1].T
        L = grid.centre[:, None] + B[:, :k] @ (grid.low[:k, None] + grid.step[:k, None] * left)
        R = B[:, k + 1 :] @ (grid.low[k + 1 :, None] + grid.step[k + 1 :, None] * right)
        axis = B[:, k, None] * grid.axis(k)
        a, N, b = L.shape[1], axis.shape[1], R.shape[1]
        x = np.empty((grid.n, a * N * b))
        fibre_points(L, axis, R, x)
        self.evaluations += a * N * b
        return self.function(x).reshape(a, N, b)

    def _skeleton(self, A: Array, share: float = 1.0) -> tuple[Array, Array, Array]:
        """Return rows, C with A ~ C A[rows] to a share of the tolerance, and the pivot columns.

        Raises:
            LinAlgError: A has no finite norm.
        """
        if not math.isfinite(np.vdot(A, A)):
            raise np.linalg.LinAlgError("a function has no finite values on a grid")
        most = min(self.options.most_rank, *A.shape)
        rows, columns, out = np.empty(most, np.int64), np.empty(most, np.int64), np.empty((len(A), most))
        tolerance = share * self.options.tolerance / math.sqrt(max(self.grid.n - 1, 1))
        r = skeleton(np.ascontiguousarray(A), tolerance, SCALING[self.mild], most, rows, columns, out)
        return rows[:r], out[:, :r], columns[:r]

    def _interpolated(self, A: Array) -> tuple[Array, Array, Array]:
        """Return the skeleton of fibres; where the rank meets its limit, that of a milder scaling."""
        found = self._skeleton(A)
        if len(found[0]) == self.options.most_rank and not self.mild:
            self.mild = True
            found = self._skeleton(A)
        self.capped = self.capped or len(found[0]) == self.options.most_rank
        return found

    def begin(self, index: Array, expected: Sequence[int]) -> None:
        """Choose the sets to the right from grid indices (P, n): columns that span those of all pairs of their parts."""
        grid, B, parts = self.grid, self.grid.basis, list[tuple[Array, Array]]()
        for k in range(1, grid.n):
            count = min(TIMES * expected[k] + MORE, len(index))
            some = index[np.linspace(0, len(index) - 1, count).astype(int)]
            parts.append((distinct(some[:, :k], grid.sizes[:k]), distinct(some[:, k:], grid.sizes[k:])))
        points = []
        for k, (left, right) in enumerate(parts, 1):
            L = grid.centre[:, None] + B[:, :k] @ (grid.low[:k, None] + grid.step[:k, None] * left.T)
            R = B[:, k:] @ (grid.low[k:, None] + grid.step[k:, None] * right.T)
            points.append((L[:, :, None] + R[:, None]).reshape(grid.n, -1))
        values = self.function(np.concatenate(points, axis=1))
        self.evaluations += len(values)
        ends = np.cumsum([x.shape[1] for x in points])[:-1]
        for k, ((left, right), part) in enumerate(zip(parts, np.split(values, ends), strict=True), 1):
            self.right[k] = right[self._skeleton(part.reshape(len(left), len(right)), CHOSEN)[2]]

    def sweep_right(self) -> list[Array]:
        cores = []
        for k in range(self.grid.n - 1):
            A = self.fibres(k)
            a, N, b = A.shape
            rows, C, columns = self._interpolated(A.reshape(a * N, b))
            i, j = np.divmod(rows, N)
            self.right[k + 1] = self.right[k + 1][columns]
            self.left[k + 1] = np.concatenate([self.left[k][i], j[:, None]], axis=1)
            cores.append(C.reshape(a, N, -1))
        return [*cores, self.fibres(self.grid.n - 1)]

    def sweep_left(self) -> list[Array]:
        cores = []
        for k in range(self.grid.n - 1, 0, -1):
            A = self.fibres(k)
            a, N, b = A.shape
            rows, C, columns = self._interpolated(A.reshape(a, N * b).T)
            j, i = np.divmod(rows, b)
            self.left[k] = self.left[k][columns]
            self.right[k] = np.concatenate([j[:, None], self.right[k + 1][i]], axis=1)
            cores.append(C.T.reshape(-1, N, b))
        return [self.fibres(0), *cores[::-1]]


def distinct(index: Array, sizes: Array) -> Array:
    """Return the distinct rows of indices (P, k) below sizes (k,), in ascending order."""
    code = np.zeros(len(index), np.int64)
    for column, size in zip(index.T, sizes, strict=True):
        code = code * size + column
    order = np.argsort(code, kind="stable")
    code = code[order]
    first = np.append(True, code[1:] != code[:-1])
    return np.asarray(index[order[first]])


def cross(
    grid: Grid, function: Function, control: tuple[Array, Array], options: Options, periods: Array,
    expected: Sequence[int] | None = None,
) -> Built:  # fmt: skip
    """Return a function on a grid as a train.

    Args:
        grid: the grid.
        function: the function.
        control: points (n, P) of its mass, and how much each counts (P,); the errors at the nearest points of the grid, relative
            to the values there, decide how many sweeps are made.
        options: the accuracy.
        periods: (n,), 2 pi for angles and 0 for other states.
        expected: the ranks (n + 1,) that are expected.
    """
    points, counts = control
    n, index = grid.n, grid.index_of(points)
    values = function(grid.x_of(grid.low[:, None] + grid.step[:, None] * index.T))
    nothing = np.zeros((1, 0), np.int64)
    work = _Cross(grid, function, options, [nothing] * (n + 1), [nothing] * (n + 1), len(index))
    work.begin(index[np.argsort(-np.abs(values), kind="stable")], [1] * (n + 1) if expected is None else expected)
    counts = counts / np.maximum(np.abs(values), FLOOR * np.abs(values).max())
    last, sweep = math.inf, 0
    while True:
        cores = work.sweep_left() if sweep % 2 else work.sweep_right()
        train = Train(grid, tuple(map(np.ascontiguousarray, cores)), periods)
        errors = np.abs(train.on_grid(index) - values) * counts
        error = float(errors.sum())
        sweep += 1
        most = CAPPED_SWEEPS if work.capped else MOST_SWEEPS
        if error < options.enough * options.tolerance or error > KEPT_GAIN * last or sweep >= most:
            return Built(train, work.evaluations, sweep, error, work.capped)
        last = error
        worst = index[np.argsort(-errors, kind="stable")[:WORST]]
        for k in range(1, n):
            if sweep % 2:  # a sweep to the right comes next to the left, and takes the sets of the left
                work.left[k] = distinct(np.concatenate([work.left[k], worst[:, :k]]), grid.sizes[:k])
            else:
                work.right[k] = distinct(np.concatenate([work.right[k], worst[:, k:]]), grid.sizes[k:])
