"""The Kolmogorov forward equation over an interval, in substeps on grids that follow the mass, with an estimate of the error.

A substep is the symmetric splitting of `space_transport`, of order two.  Taken once and in two halves it gives an estimate of its
error and, extrapolated in the logarithm, a result of order four.  Short intervals whose error is known to be small from
earlier ones are taken in single substeps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.space_grid import Grid, filtered, gaussian_response, padded
from zakai.numerics.space_survey import Survey, deviations_in_spacings, narrowest, survey
from zakai.numerics.space_transport import (
    Dynamics,
    Factor,
    Linearisation,
    characteristics,
    linearised,
    runge_kutta,
    steps_needed,
    transported,
)
from zakai.numerics.space_window import LEAST, Bounds, adjusted, enlargement, fitted_grid, padded_sizes

Array = NDArray[Any]
Potential = Callable[[Grid, float, float, bool], Factor]  # at the start (False) or the end (True) of a substep
SUPPORT = 400  # points that are moved to see where a density goes
TRIES = 7
MARGIN = 0.03  # of the bounds, for a grid of short steps
ACCEPTED = 3.0  # times the bound on tails, from a density that had such tails before
HARMFUL = 100.0  # times the bound on tails
MOST_PARTS, MOST_WORK = 512, 2**22  # substeps of an interval, and substeps times points
BALANCED = 0.5  # of the error that the grid makes, below which shorter substeps do not make that in time
MOST_ENLARGED = 8.0  # times its own volume that a grid may need for the noise of a substep
NEGLIGIBLE = 1e-40  # of the maximum
NOISE = 2.0  # the largest noise, as a multiple of the most negative value
CHECKED = 64  # intervals after which the error of single substeps is measured again
WORTH, SMALL = 1.5, 0.05  # least order in its length of a small error of a substep for which shorter ones are tried
_EXTRAPOLATED = 1.0  # the error that extrapolation leaves, as a multiple of difference^(5/3)


class Field(NamedTuple):
    """A density `values` (*sizes), but for exp(`log_scale`), on a grid."""

    values: Array
    grid: Grid
    log_scale: Any

    @property
    def log_mass(self) -> Any:
        """The logarithm of the integral."""
        return np.log(self.values.sum() * self.grid.cell) + self.log_scale


class Control(NamedTuple):
    """The error of a substep as it was measured last.

    `rate` is the error of a substep of length one (it grows as the cube), from substeps of length `measured`, `age` intervals
    ago, on a `fixed` grid or on grids that follow the mass.
    """

    rate: float
    measured: float
    age: int
    fixed: bool = False

    def known(self, tau: float, allowed: float) -> bool:
        """Return whether the error of a substep of length tau is known well enough: the larger it is, the sooner it expires."""
        error = self.rate * tau**3
        fresh = np.isfinite(error) and self.age * (1 + 4 * error / allowed) < CHECKED
        return bool(fresh and tau <= 2 * self.measured)


class Report(NamedTuple):
    """The errors of an interval, relative to the density.

    Those of the splitting in time, of interpolation, at the edges, in the tails of the spectrum, and the negative mass.
    """

    splitting: float
    interpolation: float
    edges: float
    tails: float
    negative: float

    def of_grid(self, reach: float) -> float:
        """Return the error that the grid makes; a Gaussian has fallen to the bound on edges at `reach` deviations."""
        return self.interpolation + 0.1 * reach**2 * self.edges + self.tails

    def worst(self, other: Report) -> Report:
        """Return the total of the errors of methods, and the largest of those of grids."""
        return Report(
            self.splitting + other.splitting,
            # The error of interpolation changes its sign with the phase of a point between two others.
            float(np.hypot(self.interpolation, other.interpolation)),
            max(self.edges, other.edges),
            max(self.tails, other.tails),
            max(self.negative, other.negative),
        )


def grid_report(found: Survey) -> Report:
    """Return the errors that a grid shows."""
    edges, tails = found.edges.tolist(), found.tails.tolist()
    # 1e-4 / s^6 for a standard deviation of s spacings that has such tails
    interpolation = sum(1e-4 / (-2 * math.log(min(max(tail, 1e-15), 0.9)) / math.pi**2) ** 3 for tail in tails)
    return Report(0.0, interpolation, max(edges), max(tails), found.negative)


NOTHING = Report(0.0, 0.0, 0.0, 0.0, 0.0)


class _Move(NamedTuple):
    """The linearised system, the steps of the characteristics and the target grid of a substep."""

    linear: Linearisation
    steps: int
    target: Grid


class Stepper:
    """Substeps of one interval."""

    def __init__(self, dynamics: Dynamics, bounds: Bounds, tolerance: float):
        self.dynamics, self.bounds, self.tolerance = dynamics, bounds, tolerance
        self._surveyed: tuple[Array, Survey] | None = None
        self._linearised: tuple[Array, tuple[float, ...], list[Linearisation]] | None = None

    def _survey(self, field: Field) -> Survey:
        """Return the survey of a density, which is kept for the last one."""
        if self._surveyed is None or self._surveyed[0] is not field.values:
            found = survey(field.values, field.grid, self.bounds.edge, self.bounds.tail)
            self._surveyed = field.values, found
        return self._surveyed[1]

    def _linear(self, field: Field, times: tuple[float, ...]) -> list[Linearisation]:
        """Return the system over intervals that follow each other, linearised in the middle of the path of the mean."""
        last = self._linearised
        if last is not None and last[0] is field.values and last[1] == times:
            return last[2]
        found, grid, (t0, t1) = self._survey(field), field.grid, (times[0], times[-1])
        mean, drift = grid.centre + found.mean, self.dynamics.drift
        with np.errstate(all="ignore"):
            middle = mean + 0.5 * (t1 - t0) * drift(mean[None], t0)[0, :-1].real
            jacobian = self.dynamics.jacobian(middle, 0.5 * (t0 + t1))
        jacobian = jacobian if np.all(np.isfinite(jacobian)) else np.zeros_like(jacobian)
        noises = [self.dynamics.noise(a, b) for a, b in pairwise(times)]
        if self.dynamics.diffusion is not None:
            largest = self._largest_noise(mean, found.cov, 0.5 * (t0 + t1))
            noises = [(largest, 0.5 * largest) for _ in noises]
        linears: list[Linearisation] = []
        for i, ((a, b), noise) in enumerate(zip(pairwise(times), noises, strict=True)):
            same = i > 0 and b - a == times[i] - times[i - 1] and all(map(np.array_equal, noise, noises[i - 1]))
            linears.append(linears[-1] if same else linearised(jacobian, *noise, b - a, t1 - t0, grid.basis))
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

    def _noises(self, source: Grid, target: Grid, t0: float, t1: float) -> tuple[Array, Array, float] | None:
        """Return G at the points of both grids and half of the substep, where the noise depends on the state."""
        diffusion, t = self.dynamics.diffusion, 0.5 * (t0 + t1)
        if diffusion is None:
            return None
        return diffusion(source.points, t), diffusion(target.points, t), 0.5 * (t1 - t0)

    def _moves(self, field: Field, times: tuple[float, ...]) -> list[_Move]:
        """Choose the target grids of substeps that follow each other by moving points of the density."""
        grid, real, bounds = field.grid, field.values.real, self.bounds
        found, linears = self._survey(field), self._linear(field, times)
        narrow, widths = narrowest(found, grid, bounds.tail, bounds.spacings)
        holds = bool(np.all(found.edges <= 0.5 * bounds.edge) and np.all(found.tails <= 0.5 * bounds.tail))
        holds = holds and self._fits(found.used, widths, grid)
        support = self._support(real)
        start, logs = grid.offsets[support], np.log(real.reshape(-1)[support] / real.max())
        tolerance = 0.05 * self.tolerance * np.exp(-0.5 * logs)
        inverse, variances = grid.inverse, np.maximum(np.diagonal(found.cov), 1e-300)
        moves: list[_Move] = []
        noise, moved, steps = np.zeros_like(found.cov), np.zeros_like(start), 0
        for (a, b), linear in zip(pairwise(times), linears, strict=True):
            if not steps:
                steps, moved = steps_needed(self._drift, grid.centre + start, a, b, grid.basis, tolerance, self.dynamics.varying)
            else:
                with np.errstate(all="ignore"):
                    moved = moved + runge_kutta(self._drift, grid.centre + start + moved, a, b, steps)[:, : grid.n]
            noise = linear.map.real @ noise @ linear.map.real.T + linear.noise.real
            good = np.isfinite(moved).all(axis=1)
            short = np.abs(moved[good] @ inverse.T).max(initial=0.0) < 1.5 and (np.diagonal(noise) / variances).max() < 0.2
            target = grid
            if not (short and holds) and good.any():
                target = fitted_grid((start + moved)[good], logs[good], grid.centre, noise, narrow, bounds, grid)
            moves.append(_Move(linear, steps, target))
        return moves

    def _drift(self, x: Array, t: Any) -> Array:
        """The drift without derivatives, for decisions."""
        return np.asarray(self.dynamics.drift(x, t).real)

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
        sizes = np.array(grid.sizes)
        needed = np.maximum((used[:, 1] - used[:, 0] + 4) * np.minimum(self.bounds.spacings / widths, 1.0), LEAST[grid.n])
        return bool(np.prod(np.minimum(needed / sizes, 1.0)) > 0.55)

    def _apply(
        self,
        field: Field,
        t0: float,
        t1: float,
        move: _Move,
        potential: Potential | None,
        begun: tuple[float, Array] | None = None,
    ) -> tuple[Field, Array]:
        """Return the density after a substep, and the displacement along the characteristics that end in the points of its grid.

        `begun` is their displacement from the end to a time in between.
        """
        goal = move.target
        sizes = padded_sizes(field.grid, move.linear.before.real, self.bounds)
        field = Field(*padded(field.values, field.grid, sizes), field.log_scale)
        moved = characteristics(self.dynamics, field.grid, goal, t0, t1, move.steps, self.bounds.periodic, begun)
        moved = self._within(moved, goal, t0)
        before = potential(field.grid, t0, t1, False) if potential else None
        after = potential(goal, t0, t1, True) if potential else None
        noises = self._noises(field.grid, goal, t0, t1)
        values, top = transported(field.values, field.grid, goal, moved, move.linear, self.bounds.periodic, before, after, noises)
        return Field(values, goal, field.log_scale + top), moved

    def _within(self, moved: Array, goal: Grid, t0: float) -> Array:
        """Return displacements without those that begin where the density is unknown: of a density they all count."""
        return moved

    def limit(self, field: Field, t0: float, t1: float) -> float:
        """Return the end, at most t1, of the longest substep by whose noise a density can be spread on a few times its grid."""
        for _ in range(80):
            first, second = self._linear(field, (t0, 0.5 * (t0 + t1), t1))
            if enlargement(field.grid, first.then(second).before.real, self.bounds) <= MOST_ENLARGED:
                break
            t1 = t0 + 0.5 * (t1 - t0)
        return t1

    def _moved(
        self, field: Field, t0: float, t1: float, move: _Move, potential: Potential | None, tails: Array
    ) -> tuple[Field, Array, Report]:
        """Return the density after one substep on a grid that fits it, as `_apply`, and the errors of the grid.

        `tails` (n,) are those of the density at the start of the interval, which no finer grid has made smaller.
        """
        n, reach = field.grid.n, self.bounds.reach
        before, best, coarse, ratio, smallest = np.ones(n), None, np.zeros(n, bool), np.ones(n), np.inf
        for attempt in range(TRIES):
            result, moved = self._apply(field, t0, t1, move, potential)
            found = survey(result.values, result.grid, self.bounds.edge)
            report, wide = grid_report(found), found.edges > 3 * self.bounds.edge
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

    def single(self, field: Field, t0: float, t1: float, potential: Potential | None) -> tuple[Field, Report]:
        """Return the density after one substep, on a grid that fits it."""
        result, _, report = self._moved(field, t0, t1, self._moves(field, (t0, t1))[0], potential, self._survey(field).tails)
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
        values = filtered(field.values, gaussian_response(np.diag(variances), field.grid.sizes))
        return field._replace(values=values), float(np.abs(values.real - real).sum() / np.abs(real).sum())

    def double(self, field: Field, t0: float, t1: float, potential: Potential | None) -> tuple[Field, Report, float]:
        """Return the extrapolated density after two halves of a substep, and the difference from the whole substep."""
        middle = 0.5 * (t0 + t1)
        one, two = self._moves(field, (t0, middle, t1))
        tails = self._survey(field).tails
        half, _, first = self._moved(field, t0, middle, one, potential, tails)
        fine, moved, second = self._moved(positive(half, self.bounds), middle, t1, two, potential, tails)
        whole = _Move(one.linear.then(two.linear), one.steps, fine.grid)
        coarse, _ = self._apply(field, t0, t1, whole, potential, (middle, moved))
        fine = positive(fine, self.bounds)
        values, difference = extrapolated(fine.values, coarse.values, coarse.log_scale - fine.log_scale)
        # Moments differ by a few times as much as densities; by more only where rounding far away counts.
        difference = max(difference, min(moments_difference(fine.values, coarse.values, fine.grid), 5 * difference))
        return Field(values, fine.grid, fine.log_scale), first.worst(second), difference


def refinable(tails: Array, before: Array, ratio: Array, start: Any, bounds: Bounds) -> Array:
    """Return along which axes (n,) a finer grid leaves smaller tails of the spectrum; `before` are those of the last grid.

    Small tails that the density had at the `start` need none.  `ratio` is that of the spacings of the last grid to those of this.
    """
    return np.asarray((tails > 3 * np.clip(start, bounds.tail, ACCEPTED * bounds.tail)) & better(tails, before, ratio, bounds))


def better(tails: Any, before: Any, ratio: Any, bounds: Bounds) -> Array:
    """Return along which axes spacings that are smaller by a ratio make the tails of the spectrum as small as they should.

    The logarithm of those of a Gaussian grows as the square of the ratio, of an analytic density as the ratio.  What a kink adds
    to the spectrum decreases as a power of the spacing, which is enough while it is `HARMFUL`; what interpolation adds does not.
    """
    logs, last = (np.log(np.clip(t, 1e-300, 0.99)) for t in (tails, before))
    return np.asarray(logs < np.maximum(ratio, 1.0) ** np.where(tails > HARMFUL * bounds.tail, 0.2, 0.5) * last)


def finer_by(grid: Grid, last: Grid) -> Array:
    """Return the ratio of the spacings of the last grid to those of a grid along each axis (n,)."""
    return np.asarray(np.linalg.norm(last.basis, axis=0) / np.linalg.norm(grid.basis, axis=0))


def positive(field: Field, bounds: Bounds) -> Field:
    """Return the density without negative values, those of denormal size, and the noise of interpolation.

    The noise is what is not larger than a few times the most negative value, and not larger than the bound on edges.
    """
    real = field.values.real
    noise = 0.0 if bounds.band_limited else min(-NOISE * real.min(), bounds.edge * real.max())
    return field._replace(values=np.where(real > max(NEGLIGIBLE * real.max(), noise), field.values, 0.0))


def extrapolated(fine: Array, coarse: Array, log_ratio: Any) -> tuple[Array, float]:
    """Return fine (fine / coarse)^(1/3), the extrapolation of an error of order two, and the relative difference."""
    coarse = coarse * np.exp(log_ratio)
    difference = float(np.abs(fine.real - coarse.real).sum() / np.abs(fine.real).sum())
    good = (fine.real > 0) & (coarse.real > 0.2 * fine.real) & (coarse.real < 5.0 * fine.real)
    ratio = np.where(good, fine, 1.0) / np.where(good, coarse, 1.0)
    return np.where(fine.real > 0, fine * np.exp(np.log(ratio) / 3), 0.0), difference


def moments_difference(fine: Array, coarse: Array, grid: Grid) -> float:
    """Return the largest difference of two densities on a grid: of means in deviations, and of variances, relative to them."""
    # Rounding far from the mean has a large variance.
    one, two = (survey(np.where(u.real > 1e-12 * u.real.max(), u.real, 0.0), grid) for u in (fine, coarse))
    variances = np.maximum(np.diagonal(one.cov), 1e-6 * np.diagonal(grid.basis @ grid.basis.T))
    means = np.abs(one.mean - two.mean) / np.sqrt(variances)
    return float(max(means.max(), (np.abs(np.diagonal(one.cov - two.cov)) / variances).max()))


def advance(
    stepper: Stepper,
    field: Field,
    t0: float,
    tau: float,
    potential: Potential | None,
    control: Control,
    allowed: float,
    least: int = 1,
) -> tuple[Field, Report, Control]:
    """Return the density after the interval from t0 of length tau, with an error of the splitting of about `allowed`.

    `least` is the number of substeps that resolve the coefficients' variation in time.
    """
    if tau <= 0:
        return field, NOTHING, control
    known = not control.fixed and control.known(tau, allowed)
    error = control.rate * tau**3 if known else np.inf
    singles = np.ceil(np.sqrt(error / allowed)) if np.isfinite(error) else np.inf
    doubles = max(1.0, np.ceil((_EXTRAPOLATED * (0.75 * min(error, 1.0)) ** (5 / 3) / allowed) ** 0.25)) if known else 1.0
    singles, doubles = max(singles, 2.0 * least if least > 1 else 1.0), max(doubles, least)
    if singles < 2 * doubles and stepper.limit(field, t0, t0 + tau / singles) >= t0 + tau / singles:
        parts, report = int(singles), NOTHING
        for i in range(parts):
            field, more = stepper.single(field, t0 + tau * i / parts, t0 + tau * (i + 1) / parts, potential)
            field, spread = stepper.resolved(field, more)
            field, report = positive(field, stepper.bounds), report.worst(more._replace(splitting=spread))
        return field, report._replace(splitting=report.splitting + error / parts**2), control._replace(age=control.age + 1)
    if not control.fixed and control.measured > 0 and tau > 2 * control.measured:
        doubles = max(doubles, np.ceil(min(tau / (1.5 * control.measured), MOST_PARTS)))
    return _adaptively(stepper, field, t0, tau, potential, int(doubles), allowed, 1.0 / least)


def _adaptively(
    stepper: Stepper, field: Field, t0: float, tau: float, potential: Potential | None, parts: int, allowed: float, longest: float
) -> tuple[Field, Report, Control]:
    """Return the density after an interval in extrapolated substeps whose lengths follow from the error of each.

    Shorter substeps are tried as long as the error is larger than the tolerance and than what the grid makes, and decreases with
    an order of at least `WORTH`: at a kink it does not.  No interval has more than about `MOST_PARTS` substeps, and fewer on
    large grids; its report says what error they make.
    """
    done, length, report, rate = 0.0, 1.0 / parts, NOTHING, 0.0
    left, before, stalled, growth, work = MOST_PARTS + 2.0 * parts, (np.inf, 1.0), False, 3.0, 0
    while done < 1 - 1e-12:
        length = min(max(length, (1 - done) / left), longest, 1 - done)
        if 1 - done - length < 0.3 * length:
            length = 1 - done if 1 - done <= 1.3 * length else 0.5 * (1 - done)
        begin, end = t0 + tau * done, t0 + tau * (done + length)
        limit = stepper.limit(field, begin, end)
        if limit < end:
            end, length = limit, (limit - begin) / tau
        result, more, difference = stepper.double(field, begin, end, potential)
        work += result.values.size
        difference = min(difference, 10.0) if np.isfinite(difference) else 10.0
        error = _EXTRAPOLATED * difference ** (5 / 3)
        wanted = max(allowed * length, BALANCED / 3 * min(more.of_grid(stepper.bounds.reach), 1.0))
        change = float(np.clip(0.9 * (wanted / max(error, 1e-30)) ** 0.25, 0.2, growth))
        left = max(min(left - 1, (MOST_WORK - work) / result.values.size), 1)
        stalled = stalled or SMALL > difference and error > before[0] * (length / before[1]) ** WORTH
        if error > 3 * wanted and left > 1 and not (stalled and difference < SMALL):
            before, length, growth = (error, length), length * min(change, 0.7), 1.0
            continue
        result, spread = stepper.resolved(result, more)
        field, report = positive(result, stepper.bounds), report.worst(more._replace(splitting=error + spread))
        before = np.inf, 1.0
        growth, rate = 3.0, max(rate, difference * (4 / 3) / max((tau * length) ** 3, 1e-300))
        done, last, length = done + length, length, length * (max(change, 1.0) if stalled else change)
    return field, report, Control(rate, tau * last, 0)
