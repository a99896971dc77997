"""Densities built on grids of their own, with the checks that every build passes: edges, values off the grid, mass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.errors import Missed
from zakai.methods.frame.placement import Mass, Placed, Rule, closed_axes, place, with_spacing
from zakai.methods.frame.state import Choice, Prepared
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried
from zakai.numerics.trains.cross import FLOOR, Options, cross
from zakai.numerics.trains.train import Train

CONTROLS = 600  # with 96 the tails of a skewed density of three states were never seen, at any tolerance
CLOUD = 1024
# Shares of the tolerance that a build and one of its cores have.  On 18 records of tracks and oscillators, on which they were
# chosen, the largest error of a mean without a warning is 1.7 tolerances (2e-2), 4.4 with .6 and .25: errors in tails become
# those of a mean where later observations lead there.
SHARE, CORES = 0.4, 0.2
LEAST = 0.6  # of the tolerance that earlier errors may leave
EDGE = 0.3  # share of the tolerance that may be near an end of an axis
ROUGH = 4.0  # tolerances of error off the grid, above which the grid is made finer
# A build whose rank meets its limit keeps an error, which the next one would have to resolve: at the same tolerance errors grow.
HELD = 2.0  # tolerances of error on the grid that such a build may have, or the tolerance of the next ones is doubled
LOOSEST = 0.1
# Share of a Gaussian's mass, in tolerances of a build, beyond whose radius it stands for the density.  An observation 5 to 8
# deviations away from a linear track has an error of .1 to 4 tolerances with shares from .1 to 1e-3; in the tails of a density
# that is not Gaussian (an angle whose noise depends on its rate) one has an error of .016 deviations with .1, .003 with 1e-3.
TAILS = 1e-3
WIDER = 0.25  # share of a box that is added at both ends of an axis with mass there


class Report(NamedTuple):
    """What one build needed, and its errors: in L1 on and off the grid, and the mass at the edges."""

    evaluations: int
    sweeps: int
    rank: int
    on_grid: float
    off_grid: float
    edge: float
    capped: bool


@dataclass
class Builder:
    """Builds densities for one step, and keeps the reports of all builds.

    The errors of the builds of an interval add up: each has a `share` of its tolerance.  So do those of intervals where the data
    leaves them: the `error` of the mean at the start, in deviations, lowers the tolerance.  It is `looser` by a factor where
    ranks met their limit, and `sharper` where an observation leads into the tails of what is built.  What the last build is wrong
    by is known at its control points.
    """

    prepared: Prepared
    error: float = 0.0
    looser: float = 1.0
    sharper: float = 1.0
    reports: list[Report] = field(default_factory=list)
    made: list[tuple[Train, Choice]] = field(default_factory=list)
    share: float = 1.0
    missed: Missed = field(init=False)

    def for_substeps(self, count: int) -> None:
        """Set the share for an interval of so many substeps, of which one has two builds."""
        self.share = 2.0 / (count + 1)

    @property
    def allowed(self) -> float:
        """The error of the mean that the ranks can hold: the tolerance, or more."""
        return min(self.looser * self.prepared.tolerance, max(LOOSEST, self.prepared.tolerance))

    def after(self) -> float:
        """Return `looser` for the next interval."""
        return self.looser if any(report.capped for report in self.reports) else max(1.0, 0.5 * self.looser)

    @property
    def left(self) -> float:
        """The error of the mean that an interval may add: less where earlier errors are left."""
        return self.allowed * min(1.0, max(self.allowed / max(self.error, 1e-300), LEAST))

    @property
    def _tolerance(self) -> float:
        """The error of a build."""
        return SHARE * self.share * self.sharper * self.left

    @property
    def rule(self) -> Rule:
        """The accuracy of a build."""
        return Rule.of(self._tolerance)

    @property
    def tails(self) -> float:
        """The share of the mass of a Gaussian that stands for the tails."""
        return TAILS * self._tolerance

    @property
    def options(self) -> Options:
        """The accuracy of a cross interpolation: the errors of the cores add up."""
        return Options(CORES * self._tolerance, self.prepared.most_rank)

    def build(
        self, function: Callable[[Array], Array], mass: Mass, noise: Array | None = None, stretch: float = 1.0, loose: float = 1.0
    ) -> tuple[Train, Array]:
        """Return a function as a density on a grid for it, and the noise in its frame.

        A grid with mass at an edge, or on which the values between its points are wrong, is made wider or finer once.

        Args:
            function: the density; of points (n, P).
            mass: points of it.
            noise: the covariance (n, n) that is to be diagonal in the frame.
            stretch: a factor of the box.
            loose: a factor of the tolerance; the errors of a density that only shows where mass is do not count.
        """
        angles = self.prepared.system.base.angles
        rule, options = self.rule, self.options
        if loose != 1.0:
            rule, options = rule._replace(tolerance=loose * rule.tolerance), options._replace(tolerance=loose * options.tolerance)
        mass = mass.unwrapped(angles)
        if angles.any() and isinstance(function, Carried):
            function = function.about(self._turn(mass))
        closed = closed_axes(mass, angles, rule)
        grid, D = place(function, mass, closed, rule, noise, stretch, self.prepared.system.order)
        if not (np.isfinite(grid.step).all() and np.isfinite(grid.basis).all() and np.isfinite(grid.low).all()):
            raise Unresolved("the points of a density have no finite bounds")
        control = mass.control(CONTROLS, rule.tolerance)
        found, report = self._crossed(Placed(grid, D), function, control, options)
        out = (self._edges > EDGE * rule.tolerance) & ~closed
        rough = report.off_grid > ROUGH * rule.tolerance and report.on_grid < 2.0 * rule.tolerance and not report.capped
        if out.any() or rough:
            span = np.where(out, WIDER * (grid.high - grid.low), 0.0)
            grid = with_spacing(grid, grid.low - span, grid.high + span, 0.7 * grid.step if rough else grid.step, rule)
            found, report = self._crossed(Placed(grid, D), function, control, options)
        if self.prepared.choices is not None:
            counted = control.points, control.moving
            self.made.append((found, Choice(found.grid, counted, options, found.ranks, self._turn(mass))))
        if loose == 1.0:
            self.reports.append(report)
            if report.capped and report.on_grid > HELD * rule.tolerance and self.allowed < LOOSEST:
                self.looser *= 2.0
        return found, D

    def _turn(self, mass: Mass) -> Array:
        """Return about which turn the angles of a density are (n,), NaN for other states."""
        return np.where(self.prepared.system.base.angles, mass.points @ mass.weights, np.nan)

    def choice(self, v: Train) -> Choice | None:
        """Return how a density was built, where choices are kept."""
        return next((choice for train, choice in reversed(self.made) if train is v), None)

    def _crossed(
        self, placed: Placed, function: Callable[[Array], Array], control: Mass, options: Options
    ) -> tuple[Train, Report]:
        expected = function.terms[0].density.ranks if isinstance(function, Carried) else None
        points = control.points, control.moving
        built = cross(placed.grid, function, points, options, self.prepared.system.periods, expected)
        v, self._edges = built.train, built.train.edges()
        self.missed = Missed(control, relative_difference(v.evaluate, function, control))
        edge = float(self._edges.max(initial=0.0))
        return v, Report(built.evaluations, built.sweeps, max(v.ranks), built.error, self.missed.size, edge, built.capped)


def relative_difference(one: Callable[[Array], Array], other: Callable[[Array], Array], control: Mass) -> Array:
    """Return the difference of two densities relative to the second (P,), at points of it.

    Where the second is not positive, although points of it are there, it is known by its errors alone: the first one counts.
    """
    found, values = one(control.points), other(control.points)
    floor = FLOOR * float(np.abs(values).max())
    if not floor > 0:
        return np.full(len(values), np.inf)
    return np.asarray((found - values) / np.where(values > floor, values, np.maximum(found, floor)))
