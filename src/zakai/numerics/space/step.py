"""Substeps of the Kolmogorov forward equation on grids that follow the mass, with an estimate of the error.

A substep is the symmetric splitting of `space/splitting.py`, of order two.  Taken once and in two halves it gives an estimate of
its error and, extrapolated in the logarithm, a result of order four.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.exhausted import ExhaustedError
from zakai.numerics.space.field import (
    Field,
    Report,
    better,
    extrapolated,
    finer_by,
    grid_report,
    moments_difference,
    positive,
    refinable,
)
from zakai.numerics.space.grid import Grid, filtered, inverted
from zakai.numerics.space.splitting import Move, Potential, Source, after_motion, before_motion
from zakai.numerics.space.survey import deviations_in_spacings, narrowest, smoothed, survey
from zakai.numerics.space.transport import (
    Dynamics,
    Linearisation,
    linearised,
    moved_points,
    steps_needed,
)
from zakai.numerics.space.window import LEAST, Bounds, Points, adjusted, enlargement, fitted_grid

Array = NDArray[Any]
SUPPORT = 400  # points that are moved to see where a density goes
FEW = 64  # points that show how many Runge-Kutta steps a short substep needs
TRIES = 7
MARGIN = 0.03  # of the bounds, for a grid of short steps
STEP_WORK = 0.1  # of a point
SUBSTEP_WORK = 1e4  # points that take as long as all else in a computation of a density (measured: 1.5 ms, and 150 ns a point)
MOST_ENLARGED = 8.0  # times its own volume that a grid may need for the noise of a substep


class Substep(NamedTuple):
    """A substep between two `times`, with the density at its start and the grid at its end."""

    begin: Field
    times: tuple[float, float]
    linear: Linearisation
    steps: int
    potential: Potential | None
    end: Grid


class Stepper:
    """Substeps of one interval.

    `work` are the grid points at which a density was computed, and `SUBSTEP_WORK` for each computation; a Runge-Kutta step of a
    point counts as `STEP_WORK` points.  Before it is more than `most_work` an ExhaustedError is raised.  Densities are `rough`
    where a likelihood has kinks or jumps.
    """

    def __init__(self, dynamics: Dynamics, bounds: Bounds, tolerance: float, most_work: float = math.inf, rough: bool = False):
        self.rough = rough
        self.dynamics, self.bounds, self.tolerance, self.most_work, self.work = dynamics, bounds, tolerance, most_work, 0.0
        self.taken: list[tuple[Substep, ...]] = []  # single substeps, and the two halves of extrapolated ones
        self._linearised: tuple[Array, tuple[float, ...], list[Linearisation]] | None = None

    def _linear(self, field: Field, times: tuple[float, ...]) -> list[Linearisation]:
        """Return the system over intervals that follow each other, linearised in the middle of the path of the mean."""
        last = self._linearised
        if last is not None and last[0] is field.values:
            if last[1] == times:
                return last[2]
            if last[1][::2] == times:
                return [last[2][0].then(last[2][1])]
        found, grid, (t0, t1) = field.survey(self.bounds), field.grid, (times[0], times[-1])
        mean, drift = grid.centre + found.mean, self.dynamics.drift
        with np.errstate(all="ignore"):
            middle = mean + 0.5 * (t1 - t0) * drift(mean[None], t0)[0, :-1].real
            jacobian = self.dynamics.jacobian(middle[None], 0.5 * (t0 + t1))[0]
        jacobian = jacobian if np.all(np.isfinite(jacobian)) else np.zeros_like(jacobian)
        responds = self.dynamics.diffusion is not None
        if responds:
            largest = self._largest_noise(mean, found.cov, 0.5 * (t0 + t1))
            noises = [(largest, 0.5 * largest) for _ in times[1:]]
        else:
            noises = [self.dynamics.noise(a, b) for a, b in pairwise(times)]
        linears: list[Linearisation] = []
        for i, ((a, b), noise) in enumerate(zip(pairwise(times), noises, strict=True)):
            same = i > 0 and b - a == times[i] - times[i - 1] and all(map(np.array_equal, noise, noises[i - 1]))
            linears.append(linears[-1] if same else linearised(jacobian, *noise, b - a, t1 - t0, grid.basis, responds))
        self._linearised = field.values, times, linears
        return linears

    def _largest_noise(self, mean: Array, cov: Array, t: float) -> Array:
        """Return G (n, n) at the mean, enlarged along each axis to the largest within four deviations, to choose a grid."""
        assert self.dynamics.diffusion is not None
        offsets = np.concatenate([np.zeros((1, len(mean))), *(s * np.diag(np.sqrt(np.diagonal(cov))) for s in (-4, -2, 2, 4))])
        noise = self.dynamics.diffusion(mean + offsets, t).real
        variances = np.diagonal(noise, axis1=1, axis2=2).max(axis=0)
        own = np.diagonal(noise[0])
        scale = np.sqrt(variances / np.where(own > 0, own, 1.0))
        return np.asarray(np.where(np.eye(len(mean)) > 0, variances, noise[0] * np.outer(scale, scale)))

    def _moves(self, field: Field, times: tuple[float, ...]) -> list[Move]:
        """Choose the target grids of substeps that follow each other by moving points of the density."""
        grid, real, bounds, dynamics = field.grid, field.values.real, self.bounds, self._deciding()
        found, linears = field.survey(self.bounds), self._linear(field, times)
        narrow, widths = narrowest(found, real, bounds.tail, bounds.spacings)
        holds = bool(np.all(found.edges <= 0.5 * bounds.edge) and np.all(found.tails <= 0.5 * bounds.tail))
        holds = holds and self._fits(found.used, widths, grid)
        support = self._support(real)
        start, logs = grid.offsets[support], np.log(real.reshape(-1)[support] / real.max())
        tolerance = 0.05 * self.tolerance * np.exp(-0.5 * logs)
        inverse, variances = grid.inverse, np.maximum(np.diagonal(found.cov), 1e-300)
        moves: list[Move] = []
        noise, moved, steps, through_all = np.zeros_like(found.cov), np.zeros_like(start), 0, np.eye(grid.n)
        for (a, b), linear in zip(pairwise(times), linears, strict=True):
            if not steps:
                steps, moved = steps_needed(dynamics, grid.centre + start, a, b, inverse, tolerance)
            else:
                with np.errstate(all="ignore"):
                    moved = moved + moved_points(dynamics, grid.centre + start + moved, a, b, steps)[:, : grid.n]
            through_all = linear.map.real @ through_all
            carried = linear.map.real @ noise @ linear.map.real.T
            noise = carried + linear.noise.real
            good = np.isfinite(moved).all(axis=1)
            short = np.abs(moved[good] @ inverse.T).max(initial=0.0) < 1.5 and (np.diagonal(noise) / variances).max() < 0.2
            target = grid
            if not (short and holds) and good.any():
                # The half of its noise that acts before the motion makes narrow parts wider before they are on the new grid.
                through = inverse @ inverted(through_all)
                before = through @ (carried + 0.5 * linear.noise.real) @ through.T
                smooth = smoothed(narrow, found.conditional, before) if self.rough else narrow
                target = fitted_grid(Points((start + moved)[good], logs[good], grid.centre), noise, smooth, bounds, grid)
            moves.append(Move(linear, steps, target))
        return moves

    def _deciding(self) -> Dynamics:
        """Return the drift without derivatives, for decisions."""
        dynamics = self.dynamics
        return dynamics if dynamics.formulas is not None else dynamics._replace(drift=lambda x, t: dynamics.drift(x, t).real)

    def _support(self, real: Array) -> Array:
        """Return the numbers of some points that cover the support of a density."""
        used = np.flatnonzero(real > MARGIN * self.bounds.edge * real.max())
        if not used.size:
            return np.array([np.argmax(real)])
        chosen = [used[np.linspace(0, used.size - 1, min(SUPPORT, used.size)).astype(int)]]
        for index in np.unravel_index(used, real.shape):
            chosen.append(used[[np.argmin(index), np.argmax(index)]])
        return np.concatenate(chosen)

    def _fits(self, used: Array, widths: Array, grid: Grid) -> bool:
        """Return whether a grid is neither too wide nor too fine for its density."""
        needed = np.maximum((used[:, 1] - used[:, 0] + 4) * np.minimum(self.bounds.spacings / widths, 1.0), LEAST[grid.n])
        return bool(np.prod(np.minimum(needed / grid.shape, 1.0)) > 0.55)

    def _before(self, field: Field, t0: float, t1: float, linear: Linearisation, potential: Potential | None) -> Source:
        return before_motion(field, self.dynamics, linear, (t0, t1), potential, self.bounds)

    def _after(
        self,
        source: Source,
        t0: float,
        t1: float,
        move: Move,
        potential: Potential | None,
        begun: tuple[float, Array] | None = None,
    ) -> tuple[Field, Array]:
        """Return the density after a substep, and the displacement along the characteristics that end in the points of its grid.

        `begun` is their displacement from the end to a time in between.
        """
        self.work += SUBSTEP_WORK + math.prod(move.target.sizes) * (1.0 + STEP_WORK * move.steps)
        if self.work > self.most_work:
            raise ExhaustedError
        return after_motion(source, move, self.dynamics, (t0, t1), potential, self.bounds, begun)

    def limit(self, field: Field, t0: float, t1: float) -> float:
        """Return the end, at most t1, of the longest substep by whose noise a density can be spread on a few times its grid."""
        for _ in range(80):
            first, second = self._linear(field, (t0, 0.5 * (t0 + t1), t1))
            if enlargement(field.grid, first.then(second).before.real, self.bounds) <= MOST_ENLARGED:
                break
            t1 = t0 + 0.5 * (t1 - t0)
        return t1

    def _moved(
        self, field: Field, t0: float, t1: float, move: Move, potential: Potential | None, tails: Array
    ) -> tuple[Field, Array, Report]:
        """Return the density after one substep on a grid that fits it, as `_after`, and the errors of the grid.

        `tails` (n,) are those of the density at the start of the interval, which no finer grid has made smaller.
        """
        n, reach, source = field.grid.n, self.bounds.reach, self._before(field, t0, t1, move.linear, potential)
        before, best, coarse, ratio, smallest = np.ones(n), None, np.zeros(n, bool), np.ones(n), np.inf
        for attempt in range(TRIES):
            result, moved = self._after(source, t0, t1, move, potential)
            found = result.survey(self.bounds)
            report, wide = grid_report(found, self.bounds.finer), found.edges > 3 * self.bounds.edge
            # A finer grid may have the same tails, and a wider one that has no more points the noise of its spacings.
            same = coarse.any() and not better(found.tails, before, ratio, self.bounds)[coarse].any()
            if best is not None and (same or report.of_grid(reach) >= smallest):
                break
            best, smallest = (result, moved, report), report.of_grid(reach)
            coarse = refinable(found.tails, before, ratio, tails, self.bounds)
            if attempt == TRIES - 1 or not (wide.any() or coarse.any()) or found.tails.max() >= 1.0:
                break
            ends = 0.2 * np.where(wide, 1.0, 0.0)
            finer = np.where(coarse, np.clip(self.bounds.spacings / deviations_in_spacings(found.tails), 1.1, 2.0), 1.0)
            changed = adjusted(result.grid, ends, ends, finer, self.bounds)
            if changed is None:
                break
            before, ratio = np.where(coarse, found.tails, before), finer_by(changed, result.grid)
            move = move._replace(target=changed)
        assert best is not None
        return best

    def _take(self, *substeps: Substep) -> None:
        """Keep substeps, instead of earlier ones that were longer."""
        while self.taken and self.taken[-1][0].times[0] >= substeps[0].times[0]:
            self.taken.pop()
        self.taken.append(substeps)

    def equal(self, field: Field, times: Array, potential: Potential | None, extrapolated: bool) -> None:
        """Take substeps of a density that stays as it is."""
        ends, grid, real = list(pairwise(times.tolist())), field.grid, field.values.real
        used = np.flatnonzero(real > MARGIN * self.bounds.edge * real.max())
        used = used[:: max(1, len(used) // FEW)]
        tolerance = 0.05 * self.tolerance * np.sqrt(real.max() / real.reshape(-1)[used])
        steps, _ = steps_needed(self._deciding(), grid.points[used], *ends[0], grid.inverse, tolerance)
        linears = self._linear(field, tuple(times.tolist()))
        substeps = [Substep(field, end, linear, steps, potential, grid) for linear, end in zip(linears, ends, strict=True)]
        count = 2 if extrapolated else 1
        for first in range(0, len(substeps), count):
            self._take(*substeps[first : first + count])

    def replayed(self, field: Field, one: Substep) -> Field:
        """Return the density after a substep that was taken, from another one at its start."""
        source = self._before(field, *one.times, one.linear, one.potential)
        result, _ = self._after(source, *one.times, Move(one.linear, one.steps, one.end), one.potential)
        return positive(result, self.bounds)

    def single(self, field: Field, t0: float, t1: float, potential: Potential | None) -> tuple[Field, Report]:
        """Return the density after one substep, on a grid that fits it."""
        tails, move = field.survey(self.bounds).tails, self._moves(field, (t0, t1))[0]
        result, _, report = self._moved(field, t0, t1, move, potential, tails)
        self._take(Substep(field, (t0, t1), move.linear, move.steps, potential, result.grid))
        return result, report

    def resolved(self, field: Field, report: Report) -> tuple[Field, float]:
        """Return a density whose noise does not grow, and the relative difference from the one that is given.

        What the grid does not resolve to the tolerance is spread until it does.
        """
        if not self.tolerance < report.tails < np.inf:
            return field, 0.0
        real = field.values.real
        tails = survey(real, field.grid, self.bounds.edge).tails
        variances = 2 * np.log(np.maximum(tails / self.tolerance, 1.0)) / np.pi**2
        values = filtered(field.values, np.diag(variances))
        return field._replace(values=values), float(np.abs(values.real - real).sum() / np.abs(real).sum())

    def double(self, field: Field, t0: float, t1: float, potential: Potential | None) -> tuple[Field, Report, float]:
        """Return the extrapolated density after two halves of a substep, and the difference from the whole substep."""
        middle = 0.5 * (t0 + t1)
        one, two = self._moves(field, (t0, middle, t1))
        tails = field.survey(self.bounds).tails
        half, _, first = self._moved(field, t0, middle, one, potential, tails)
        half = positive(half, self.bounds)
        fine, moved, second = self._moved(half, middle, t1, two, potential, tails)
        self._take(
            Substep(field, (t0, middle), one.linear, one.steps, potential, half.grid),
            Substep(half, (middle, t1), two.linear, two.steps, potential, fine.grid),
        )
        whole = Move(one.linear.then(two.linear), one.steps, fine.grid)
        source = self._before(field, t0, t1, whole.linear, potential)
        coarse, _ = self._after(source, t0, t1, whole, potential, (middle, moved))
        fine = positive(fine, self.bounds)
        values, difference = extrapolated(fine.values, coarse.values, coarse.log_scale - fine.log_scale)
        # Moments differ by a few times as much as densities; by more only where rounding far away counts.
        difference = max(difference, min(moments_difference(fine.values, coarse.values, fine.grid), 5 * difference))
        report = first.worst(second)._replace(removed=math.hypot(half.removed, fine.removed))
        return Field(values, fine.grid, fine.log_scale), report, difference
