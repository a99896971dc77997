"""Noise that depends on the state, as a sum over weak points: the flow of its fields for numbers that stand for its normal noise.

Nothing but values of the density is needed.

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
from zakai.methods.particles.interval import Interval
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried, Path, Term

# Spacing of the trapezoidal rule in deviations of the noise times the density along it, of which its error is exp(-2 pi^2 / h^2).
SPACING = 1.3
MOST_NODES = 81
MOST_STEPS = 8  # of Runge-Kutta along a kick


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
        square = float(moved @ np.linalg.solve(unit, moved))
        spacing = SPACING / math.sqrt(1.0 + square) if math.isfinite(square) else 0.0
        reach = self.builder.rule.width
        if not reach < 0.5 * (MOST_NODES - 1) * spacing:
            raise Unresolved(f"the noise of a substep at t = {t:g} is much wider than the density")
        count = math.ceil(reach / spacing)
        nodes = spacing * np.arange(-count, count + 1)
        weights = np.exp(-0.5 * nodes**2)
        weights = weights / weights.sum()
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
        points, steps = mass.points[:, ::64], 1
        last = self._ends(points, c, 1)
        while steps < MOST_STEPS:
            finer = self._ends(points, c, 2 * steps)
            if np.abs((finer - last) / scale[:, None]).max() < 0.1 * self.builder.rule.tolerance:
                return steps
            steps, last = 2 * steps, finer
        return steps
