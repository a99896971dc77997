"""Predictions over short intervals on a grid that stays."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from zakai.methods.space.system import System
from zakai.numerics.complex_step import is_complex
from zakai.numerics.space.advance import Control
from zakai.numerics.space.field import ACCEPTED, Field, Report, extrapolated, grid_report, moments_difference, positive
from zakai.numerics.space.fixed import LARGEST_RANGE, Motion, fits, fixed_step, motion, refitted
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.survey import Survey
from zakai.numerics.space.window import Bounds

Array = Any
MOST_TABLES = 64  # grids whose motion is kept
MOST_FIXED = 8  # substeps of an interval on a grid that stays
MOST_REDUCED = 16.0  # reduction of the error of extrapolated substeps that twice as many may be expected to bring


class Prepared(Protocol):
    """What is used here of a prepared filter; its `observations` have the `dynamics`."""

    @property
    def system(self) -> System: ...

    @property
    def theta(self) -> Array: ...

    @property
    def bounds(self) -> Bounds: ...

    @property
    def observations(self) -> Any: ...

    @property
    def motions(self) -> dict[Any, Any]: ...


def predicted_on(
    prepared: Prepared, begin: Field, control: Control, allowed: float, length: float, potential: Any
) -> tuple[Field, Report, Control, Survey] | None:
    """Return the prediction of a short interval in which the grid can stay, and its survey, or None.

    What is prepared depends on the grid and the length alone; whether an interval is short depends on the state and on the
    interval.
    """
    grid = begin.grid
    if prepared.system.varies or prepared.system.state_dependent or length == 0 or prepared.bounds.periodic != grid.closed:
        return None
    known, singles, pairs = control.known(length, allowed), MOST_FIXED, 1
    if known:
        singles, pairs = control.parts(length, allowed)
    if min(singles, 3 * pairs) > MOST_FIXED:
        return None
    moved, removed = motion_of(prepared, grid, length), 0.0
    found = begin.survey(prepared.bounds)
    if length <= moved.longest and not fits(found, grid, prepared.bounds):
        if prepared.system.rough and found.tails.max() > ACCEPTED * prepared.bounds.tail:
            return None  # the noise makes kinks smooth before the density is on another grid
        begin = positive(refitted(begin, prepared.bounds), prepared.bounds)
        removed = begin.removed
        grid, moved = begin.grid, motion_of(prepared, begin.grid, length)
    if not length <= moved.longest:
        return None
    factor = None if potential is None else potential(grid, 0.0, length, True)
    if factor is not None and not np.ptp(factor.log.real) < LARGEST_RANGE:
        return None

    def substeps(parts: int) -> Field:
        values, top, factors = begin.values, 0.0, None
        if factor is not None:
            top = float(factor.log.real.max())
            outer = np.exp((factor.log - top) / (6 * parts))
            factors = outer, outer * outer * np.exp(factor.correction / parts**3)
        for _ in range(parts):
            values = fixed_step(values, grid, moved, length / parts, factors)
        return Field(values, grid, begin.log_scale + top)

    if known and control.fixed and singles <= 3 * pairs:
        result, splitting = substeps(singles), control.rate * length**3 / singles**2
        control = control._replace(age=control.age + 1)
    else:
        coarse = substeps(pairs)
        while True:
            result = substeps(2 * pairs)
            values, difference = extrapolated(result.values, coarse.values, 0.0)
            difference = max(difference, min(moments_difference(result.values, coarse.values, grid), 5 * difference))
            splitting = difference ** (5 / 3)
            if splitting <= allowed:
                break
            coarse, pairs = result, 2 * pairs
            if not splitting <= MOST_REDUCED * allowed or 3 * pairs > MOST_FIXED:
                return None
        result = result._replace(values=values)
        control = Control(difference * (4 / 3) * pairs**2 / length**3, length, 0, True)
    found = result.survey(prepared.bounds)
    report = grid_report(found)
    if not (report.edges <= 3 * prepared.bounds.edge and report.tails <= prepared.bounds.tail):
        return None
    result = positive(result, prepared.bounds)
    return result, report._replace(splitting=splitting, removed=math.hypot(removed, result.removed)), control, found


def motion_of(prepared: Prepared, grid: Grid, length: float) -> Motion:
    """Return the motion of a grid, which is kept where it depends on the grid alone."""
    dynamics = prepared.observations.dynamics
    if is_complex(prepared.theta):
        return motion(dynamics, grid, length)
    key = (grid.centre.tobytes(), grid.basis.tobytes(), grid.sizes, np.ceil(np.log2(length)))
    kept = prepared.motions.get(key)
    if kept is None:
        if len(prepared.motions) >= MOST_TABLES:
            prepared.motions.clear()
        kept = motion(dynamics, grid, length)
        if kept.longest:
            prepared.motions[key] = kept
    return kept
