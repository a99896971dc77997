"""The arguments and results of the compiled loop of one-state filters (`line/loop.py`)."""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

Array = NDArray[Any]

COLUMNS = (
    "gained", "mean", "variance", "aliasing", "edge", "negative", "time", "depth", "growth", "made", "error", "log_floor",
    "start", "pairs", "substeps", "needed",
)  # fmt: skip
# The transition: whole with a sample after it, split with increments inside, whole with increments inside, split with a sample.
FACTOR, SPLIT, KERNEL, SPLIT_FACTOR = 0, 1, 2, 3
OK, FAILED, RANGE, AFTER, TABLE, UNRESOLVED = range(6)  # why a loop ends; the last where a product needs a finer grid
RELIABLE = 1e-3  # of the promised error: smaller estimates are not reported
MARGIN = 96  # points of a table of coefficients in time beyond the grid, of which a third may be used before it is made again


class Mechanisms(NamedTuple):
    """What the steps of a record may need; only that is compiled.

    `kernels` or `splits` or both; `samples`: samples after the transition; `weak`: their likelihoods have kinks and act in the
    weak sense; `closed`: grids around the circle.
    """

    kernels: bool
    splits: bool
    samples: bool
    weak: bool
    closed: bool


class Grid(NamedTuple):
    """The data of a grid: terms `table` (K, R, 4 + m, T) as in `line/terms.py`, K = 1 where they do not depend on the interval.

    The table is longer than the grid, which begins at `start`; its first point is `offset` away from the origin of the kernels.
    `fine` (m, F) are the values of an h with kinks at the nodes of `line/weak.py`, else empty.
    """

    table: Array
    start: int
    offset: float
    spacing: float
    fine: Array


class Steps(NamedTuple):
    """K intervals.

    `kinds` (K,) are FACTOR, SPLIT, KERNEL or SPLIT_FACTOR.  `shares` (K,) are the parts of `Limits.splitting` that an interval
    may leave.  `precisions` (K, P, m, m) are the inverses of S, zero where nothing is observed.  `constants` (K,) are those of
    the log-likelihoods.  `kernels` (K, .) are the parameters of Gaussian kernels (`line_filters.kernel_of`), NaN where the
    transition is split.  `drifts` (K, Q, R) and `outputs` (K, P, R) are the factors of the terms of f and h, and `covariances`
    (K, Q) are G, at the Gauss nodes of an interval, or one number where they do not
    depend on time.
    """

    kinds: Array
    lengths: Array
    shares: Array
    precisions: Array
    constants: Array
    kernels: Array
    drifts: Array
    outputs: Array
    covariances: Array

    def part(self, rows: slice) -> Steps:
        """Return some of the intervals."""
        return Steps(*(part[rows] for part in self))


class Limits(NamedTuple):
    """What a step must keep.

    `negligible` is the spectrum that need not be resolved, `error` the largest error that is made, `splitting` that of the
    splitting of one interval, `cut` the density relative to its maximum that a grid must hold, `generous` the size of a grid that
    is kept though fewer points would do, and `finest` that of the largest grid that is taken so that kernels are filters of
    positive numbers.
    """

    negligible: float
    error: float
    splitting: float
    cut: float
    generous: float
    finest: float


class Segment(NamedTuple):
    """The densities (K, N) after the first steps and their reports (K, len(COLUMNS)).

    The column `start` of a report is the first point of the grid in the table.  `why` is why the loop ended, and `answer` the
    range of the grid that it needs, relative to the centre of the present one, and its spacing.
    """

    densities: Array
    reports: Array
    why: int
    answer: Array
