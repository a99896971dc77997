"""The motion of a density over an interval, by builds and convolutions in affine frames of its own.

One interval of length tau with s substeps of length d = tau / s, from the density u at its start:

    u_1(x) = u(phi(x)) |phi'(x)|,            phi = flow backwards by d / 2,          u_1 <- u_1 * N(0, Q)
    u_j(x) = u_{j-1}(phi(x)) |phi'(x)|,      phi = flow backwards by d,              u_j <- u_j * N(0, Q),      j = 2 .. s
    u(x)  = u_s(phi(x)) |phi'(x)| L(x) / Z,  phi = flow backwards by d / 2

Q is the noise of the linearised system, carried to the middle of the substep, so that linear systems are exact; in general the
error is of order d^2.  Noise after the flow is of first order, and noise in halves needs two builds.  The frame of u_j makes Q
nearly diagonal, that of u is free.  The log weights of increments are integrated along the flows.

The representation of a density (`numerics/trains/train.py`) offers: a build by cross interpolation, values at points, the
convolution with a diagonal noise, moments and marginals, weighted points of its mass, and the mass at its edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from zakai.methods.frame.build import CLOUD, Builder
from zakai.methods.frame.errors import Missed
from zakai.methods.frame.moves import Flow, Kick, Move, Noise, Shift
from zakai.methods.frame.placement import Mass, closed_axes
from zakai.methods.frame.state import Half, Prepared
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.frame.weak_points import WeakPoints, along_closed_axes, shifted
from zakai.methods.particles.events import Interval
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried, Likelihood, Term
from zakai.numerics.trains.train import Train

STRETCHES = (1.0, 1.35, 1.8)  # of a box, while the mass of a motion differs from one
DEFECT = 3.0  # tolerances of mass that a motion may lose or gain before its box is made wider
LOST = 0.2  # mass that a chain of substeps may lose before it is divided
MOST_SUBSTEPS = 128
FAR = 1e100  # a state that has left every bounded set
# Share of the error of a core that rounding after a convolution may add.  Rounding leaves out what is small beside the largest
# values: with .3, in a fifth less time, a robot's mean is off by 13 tolerances after observations in a tail, without by 3.
ROUNDING = 0.01
ALONE = 1e-9  # off-diagonal noise in a frame that needs no correction


@dataclass
class Prediction:
    """A density before an observation, as a function, with points of it.

    `log_mass` is the logarithm of its mass, `defect` the mass that was lost, `slope` (n, n) the linearised motion.  The errors
    of its builds count by factors.
    """

    function: Carried
    mass: Mass
    log_mass: float
    defect: float
    slope: Array
    motions: tuple[tuple[Half, ...], ...] = ()
    missed: tuple[tuple[float, Missed], ...] = ()

    @property
    def log_scale(self) -> float:
        """The logarithm of the density over the values of the function."""
        return self.log_mass + float(self.function.terms[0].scale[1])


@dataclass
class Chain:
    """The motion of a density over one interval, and the `moves` of the last prediction, in the order of time.

    Lost is the largest share of the mass that a flow has carried out of every bounded set.
    """

    prepared: Prepared
    interval: Interval
    values: Array
    builder: Builder
    moves: list[Move] = field(default_factory=list)
    lost: float = 0.0
    halves: list[Half] = field(default_factory=list)
    missed: list[Missed] = field(default_factory=list)
    _slope: Array = field(init=False)

    def _carried(self, u: Train, t0: float, t1: float) -> tuple[Carried, Mass]:
        """Return a density after the flow from t0 to t1 as a function, and points of it; note the linearised motion."""
        prepared, motion = self.prepared, self.prepared.motion
        points, weights = u.cloud(CLOUD)
        steps = motion.steps(self.interval, points, (t0, t1), self.values, 0.1 * self.builder.rule.tolerance)
        path = motion.path(self.interval, t0, t1, self.values, steps)
        ends, logs = motion.ends(points, path)
        self.missed = [part.at(motion.ends(part.mass.points, path)[0]) for part in self.missed]
        finite = (np.abs(ends) < FAR).all(axis=0) & np.isfinite(logs)  # NaN is not below, either
        if not finite.all():
            self.lost = max(self.lost, float(weights[~finite].sum()))
            points, ends = (np.ascontiguousarray(part[:, finite]) for part in (points, ends))
            logs, weights = logs[finite], weights[finite]
        if not weights.sum() > 0:
            raise Unresolved(f"no part of the density is finite after the drift from t = {t0:g} to {t1:g}")
        mass, top = Mass(ends, weights / weights.sum()), 0.0
        angles = prepared.system.base.angles
        before = Mass(points, mass.weights).unwrapped(angles)
        self._slope = before.slope(mass.unwrapped(angles).points) @ self._slope
        if prepared.system.weighted:
            top = float(logs.max())
            mass = mass.reweighted(logs)
        function = self.carried(u, (t0, t1), steps, top)
        self.moves.append(Flow(motion, function.terms[0].path))
        self.halves.append(Half(steps, top))
        return function, mass

    def carried(self, u: Train, span: tuple[float, float], steps: int, top: float) -> Carried:
        """Return a density after the flow over a span as a function, divided by the exponential of `top`."""
        motion, (t0, t1) = self.prepared.motion, span
        back = motion.path(self.interval, t1, t0, self.values, steps)
        term = Term(u, np.array([1.0, top]), motion.backward, back)
        nothing = Likelihood(motion.coefficients.law, np.zeros(0), np.zeros(0), t1, 1.0, 0.0)
        return Carried((term,), motion.box, np.full(u.grid.n, np.nan), nothing)

    def _middle(self, u: Train, t0: float, t1: float, length: float) -> tuple[Train, float, float]:
        """Return the density after the flow from t0 to t1 and the noise about t1, the logarithm of its mass, and the defect."""
        prepared = self.prepared
        function, mass = self._carried(u, t0, t1)
        if prepared.system.kicked:
            return self._kicked(function, mass, t1, length)
        mass = mass.unwrapped(prepared.system.base.angles)
        mean, P = mass.moments()
        scale = np.maximum(np.sqrt(P.diagonal()), 1e-12)
        Q, _ = prepared.motion.noise(self.interval, self.values, t1, length, (mean, scale))
        closed = closed_axes(mass, prepared.system.base.angles, self.builder.rule)
        directions, Q = along_closed_axes(Q, scale, closed, self.builder.rule.tolerance)
        v, D, total = self._built(function, mass, Q)
        self.halves[-1] = self.halves[-1]._replace(about=(mean, scale), choice=self.builder.choice(v))
        variances, turned = np.maximum(D.diagonal(), 0.0), corrections(D)
        self.moves.append(Noise(v, variances, turned, self.builder.tails))
        v = v.convolve(variances, ROUNDING * self.builder.options.tolerance)
        v = v.in_basis(np.ascontiguousarray(v.grid.basis @ turned))
        log_mass, defect = self._of_mass(function, total)
        v = v.scaled(1.0 / total)
        for direction in directions:
            here, mass = self._standing(v, t1)
            spread, mass, shifts = shifted(here, mass, direction, self.builder.rule.width, t1)
            self.moves.append(Shift(spread, shifts))
            v, _, total = self._built(spread, mass, None)
            gained, lost = self._of_mass(spread, total)
            log_mass, defect, v = log_mass + gained, defect + lost, v.scaled(1.0 / total)
        return v, log_mass, defect

    def _standing(self, v: Train, t: float) -> tuple[Carried, Mass]:
        """Return a density as a function that no flow has moved, and points of it."""
        motion = self.prepared.motion
        nowhere = motion.path(self.interval, t, t, self.values, 1)
        nothing = Likelihood(motion.coefficients.law, np.zeros(0), np.zeros(0), t, 1.0, 0.0)
        term = Term(v, np.array([1.0, 0.0]), motion.backward, nowhere)
        mass = Mass(*v.cloud(CLOUD)).unwrapped(self.prepared.system.base.angles)
        return Carried((term,), motion.box, np.full(v.grid.n, np.nan), nothing), mass

    def _of_mass(self, function: Carried, total: float) -> tuple[float, float]:
        """Return the logarithm of the mass that a motion leaves, and the defect where it should be one."""
        if self.prepared.system.weighted:
            return math.log(total) + float(function.terms[0].scale[1]), 0.0
        return 0.0, abs(total - 1.0)

    def _built(self, function: Carried, mass: Mass, noise: Array | None) -> tuple[Train, Array, float]:
        """Return a moved density, the noise in its frame, and its mass; on a wider box where mass is missing."""
        prepared = self.prepared
        best: tuple[float, Train, Array, Missed] | None = None
        for stretch in STRETCHES:
            v, D = self.builder.build(function, mass, noise, stretch)
            defect = abs(v.mass - 1.0)
            if best is None or prepared.system.weighted or defect < best[0]:
                best = defect, v, D, self.builder.missed
            tolerance = self.builder.rule.tolerance
            # What the cross interpolation misses is not outside of the box.
            if prepared.system.weighted or defect < DEFECT * tolerance or self.builder.reports[-1].on_grid > tolerance:
                break
        assert best is not None
        _, v, D, missed = best
        self.missed.append(missed)
        if not v.mass > 0 or not math.isfinite(v.mass):
            raise Unresolved(f"a density has mass {v.mass:.1g} after a motion")
        return v, D, v.mass

    def _kicked(self, function: Carried, mass: Mass, t: float, length: float) -> tuple[Train, float, float]:
        """Return a moved density after noise that depends on the state: one build for each column of its root."""
        motion = self.prepared.motion
        log_mass, defect, v = 0.0, 0.0, function.terms[0].density
        kicks = motion.kicks(self.interval, t, length)
        for c in kicks or [np.zeros(self.prepared.system.base.r)]:
            spread, mass, paths = WeakPoints(self.builder, self.interval, self.values, (t, length)).spread(function, mass, c)
            self.moves.append(Kick(motion, spread, paths))
            v, _, total = self._built(spread, mass, None)
            gained, lost = self._of_mass(function, total)
            log_mass, defect = log_mass + gained, defect + lost
            v = v.scaled(1.0 / total)
            function, mass = self._standing(v, t)
        return v, log_mass, defect

    def predict(self, u: Train, count: int) -> Prediction:
        """Return the prediction by so many substeps; Unresolved where the density is lost."""
        start, stop = self.interval.start, self.interval.stop
        self.moves, self.halves, self.missed = [], [], []
        self._slope = np.eye(self.prepared.model.n)
        if stop <= start:
            return Prediction(*self._carried(u, start, stop), 0.0, 0.0, self._slope, (tuple(self.halves),))
        self.builder.for_substeps(count)
        length, at, log_mass, defect = (stop - start) / count, start, 0.0, 0.0
        for j in range(count):
            middle = start + (j + 0.5) * length
            u, gained, lost = self._middle(u, at, middle, length)
            log_mass, defect, at = log_mass + gained, defect + lost, middle
        function, mass = self._carried(u, at, stop)
        missed = tuple((1.0, part) for part in self.missed)
        return Prediction(function, mass, log_mass, defect, self._slope, (tuple(self.halves),), missed)

    def first(self, u: Train, count: int) -> tuple[Prediction, int]:
        """Return the prediction by the fewest substeps, `count` or more, that keep the mass, and their number."""
        while True:
            try:
                found = self.predict(u, count)
            except (Unresolved, np.linalg.LinAlgError):
                if count >= MOST_SUBSTEPS:
                    raise
            else:
                if found.defect < LOST or count >= MOST_SUBSTEPS or self.builder.reports[-1].on_grid > LOST:
                    return found, count  # what a cross interpolation misses is not a matter of substeps
            count *= 2


def corrections(D: Array) -> Array:
    """Return the map (n, n) by which a density has its covariance after noise D (n, n), of which the diagonal was applied."""
    one = np.eye(len(D))
    if np.abs(D - np.diag(np.diag(D))).max() < ALONE:
        return one
    return np.asarray(np.linalg.cholesky(one + D) / np.sqrt(1.0 + np.diag(D)))


def extrapolated(finer: Prediction, coarser: Prediction) -> Carried:
    """Return (4 v - u) / 3 for predictions by substeps d (u) and d / 2 (v), as a function with the mass of v."""
    (one,), (other,) = finer.function.terms, coarser.function.terms
    first = Term(one.density, np.array([4.0 / 3.0, one.scale[1]]), one.program, one.path)
    divisor = one.scale[1] - (coarser.log_mass - finer.log_mass)
    second = Term(other.density, np.array([-1.0 / 3.0, divisor]), other.program, other.path)
    return replace(finer.function, terms=(first, second))
