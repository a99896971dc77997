"""Noise that depends on the state, as a sum over weak points: the flow of its fields for numbers that stand for its normal noise.

Nothing but values of the density is needed.  So is noise along a direction that no frame has as an axis, where the flows are
shifts: that of an angle on the whole circle together with what other states have of it.

References:
    Ninomiya and Victoir 2008, Weak approximation of stochastic differential equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from zakai.methods.frame.build import Builder
from zakai.methods.frame.placement import Mass
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.particles.events import Interval
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried, Path, Term

# Spacing of the trapezoidal rule in deviations of the noise times the density along it, of which its error is exp(-2 pi^2 / h^2).
SPACING = 1.3
MOST_NODES = 81
MOST_STEPS = 8  # of Runge-Kutta along a kick
# Covariance of the noise of a closed axis with that of another state that is left out, in deviations of both and tolerances of a
# build: a change of the covariance by so much moves the mean after an observation by about as much.
LEFT_OUT = 0.5


@dataclass
class WeakPoints:
    """The noise of one substep, by its `middle` and its length."""

    builder: Builder
    interval: Interval
    values: Array
    middle: tuple[float, float]

    def spread(self, function: Carried, mass: Mass, c: Array) -> tuple[Carried, Mass, tuple[Path, ...]]:
        """Return a density after one column c (r,) of the noise as a function, points of it, and the path back of each term."""
        motion, (t, length) = self.builder.prepared.motion, self.middle
        mass = mass.unwrapped(self.builder.prepared.system.base.angles)
        mean, P = mass.moments()
        scale = np.maximum(np.sqrt(np.diag(P)), 1e-12)
        moved = (self._ends(mean[:, None], c, 1)[:, 0] - mean) / scale
        unit = P / np.outer(scale, scale) + 1e-9 * np.eye(len(mean))
        reach = self.builder.rule.width
        nodes, weights = _nodes(float(moved @ np.linalg.solve(unit, moved)), reach, t)
        steps = self._steps(mass, scale, reach * c)
        (term,), points, shares = function.terms, mass.points.copy(), mass.weights.copy()
        order, terms, paths = np.random.default_rng(1).permutation(points.shape[1]), list[Term](), list[Path]()
        for q, (node, weight) in enumerate(zip(nodes, weights, strict=True)):
            back = motion.kick(self.interval, self.values, (t, -length), node * c, steps)
            one = np.array([weight * term.scale[0], term.scale[1]])
            terms.append(Term(term.density, one, term.program, back.then(term.path)))
            paths.append(back)
            own = order[q :: len(nodes)]
            points[:, own] = self._ends(points[:, own], node * c, steps)
            shares[own] *= weight
        return replace(function, terms=tuple(terms)), Mass(points, shares / shares.sum()), tuple(paths)

    def _ends(self, x: Array, c: Array, steps: int) -> Array:
        motion = self.builder.prepared.motion
        return motion.ends(x, motion.kick(self.interval, self.values, self.middle, c, steps))[0]

    def _steps(self, mass: Mass, scale: Array, c: Array) -> int:
        """Return the Runge-Kutta steps of the largest kick."""
        points, steps = mass.points[:, ::63], 1
        last = self._ends(points, c, 1)
        while steps < MOST_STEPS:
            finer = self._ends(points, c, 2 * steps)
            if np.abs((finer - last) / scale[:, None]).max() < 0.1 * self.builder.rule.tolerance:
                return steps
            steps, last = 2 * steps, finer
        return steps


def _nodes(square: float, reach: float, t: float) -> tuple[Array, Array]:
    """Return nodes of a normal number and their weights, for noise with the `square` of its deviation in that of the density."""
    spacing = SPACING / math.sqrt(1.0 + square) if math.isfinite(square) else 0.0
    if not reach < 0.5 * (MOST_NODES - 1) * spacing:
        raise Unresolved(f"the noise of a substep at t = {t:g} is much wider than the density")
    count = math.ceil(reach / spacing)
    nodes = spacing * np.arange(-count, count + 1)
    weights = np.exp(-0.5 * nodes**2)
    return nodes, weights / weights.sum()


def along_closed_axes(Q: Array, scale: Array, closed: Array, tolerance: float) -> tuple[list[Array], Array]:
    """Return the directions (n,) of noise of closed axes together with other states, and the noise (n, n) without them.

    The noise of a closed axis j is a normal number times Q_j / root Q_jj, and independent noise of the other states.

    Args:
        Q: the noise (n, n).
        scale: standard deviations of the states (n,).
        closed: which axes are closed (n,).
        tolerance: of the build.
    """
    found = list[Array]()
    for j in np.flatnonzero(closed):
        shared = np.abs(np.delete(Q[j] / scale / scale[j], j))
        if shared.max(initial=0.0) > LEFT_OUT * tolerance:
            found.append(Q[j] / math.sqrt(Q[j, j]))
            Q = Q - np.outer(found[-1], found[-1])
            Q[j] = Q[:, j] = 0.0
    return found, Q


def shifted(function: Carried, mass: Mass, direction: Array, reach: float, t: float) -> tuple[Carried, Mass, Array]:
    """Return a density after noise along a direction (n,) as a function, points of it, and the shift of each term (n, Q)."""
    _, P = mass.moments()
    scale = np.maximum(np.sqrt(np.diag(P)), 1e-12)
    unit, moved = P / np.outer(scale, scale) + 1e-9 * np.eye(len(P)), direction / scale
    nodes, weights = _nodes(float(moved @ np.linalg.solve(unit, moved)), reach, t)
    (term,), points, shares = function.terms, mass.points.copy(), mass.weights.copy()
    shifts, order, terms = direction[:, None] * nodes, np.random.default_rng(1).permutation(points.shape[1]), list[Term]()
    for q, weight in enumerate(weights):
        u = term.density
        moved_grid = u.grid._replace(centre=u.grid.centre + shifts[:, q])
        terms.append(term._replace(density=replace(u, grid=moved_grid), scale=np.array([weight * term.scale[0], term.scale[1]])))
        own = order[q :: len(nodes)]
        points[:, own] += shifts[:, [q]]
        shares[own] *= weight
    return replace(function, terms=tuple(terms)), Mass(points, shares / shares.sum()), shifts
