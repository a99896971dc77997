"""A density after a motion and times a likelihood, as a function of points for `cross`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.particles.formulas import evaluate
from zakai.numerics.trains.kernels import add_train, flow, weigh
from zakai.numerics.trains.train import Train

Array = Any


class Path(NamedTuple):
    """Runge-Kutta steps: `times` at both ends (E, 2), and the given numbers there (E, 2, L)."""

    times: Array
    given: Array

    def then(self, other: Path) -> Path:
        """Return the steps of this path and those of another one after it."""
        return Path(np.concatenate([self.times, other.times]), np.concatenate([self.given, other.given]))


class Likelihood(NamedTuple):
    """The program of a log density, its given numbers, which terms count, the time, the power, and the log of what divides it."""

    program: tuple[Any, ...]
    given: Array
    counted: Array
    time: float
    power: float
    top: float


class Term(NamedTuple):
    """A density, [factor, logarithm of what divides it], and the path from a point back to it, with the program of its motion."""

    density: Train
    scale: Array
    program: tuple[Any, ...]
    path: Path


@dataclass(frozen=True, eq=False)
class Carried:
    """The sum of some terms, times a likelihood; zero outside of `box` and beyond half a turn from `turn` (n,)."""

    terms: tuple[Term, ...]
    box: tuple[Array, Array]
    turn: Array
    likelihood: Likelihood

    def __call__(self, x: Array) -> Array:
        """Return the values (P,) at points x (n, P)."""
        x, out = np.ascontiguousarray(x), np.zeros(x.shape[1])
        for term in self.terms:
            ends, moved = x, len(term.path.times) > 0
            if moved:
                ends = np.empty((len(x) + 1, x.shape[1]))
                flow(term.program, self.box, (term.path.times, term.path.given), x, ends)
            add_train(term.density.arrays, ends, moved, term.scale, out)
        law, logs = self.likelihood, np.empty((0, len(out)))
        used = law.counted > 0
        if used.any():
            logs = np.empty((len(used), len(out)))
            evaluate(law.program, self.box, x, law.time, law.given, 0, len(out), logs)
            logs = np.ascontiguousarray(logs[used])
        weigh(logs, np.array([law.power, law.top]), self.box, self.turn, x, out)
        return out

    def times(self, likelihood: Likelihood) -> Carried:
        """Return the same density times another likelihood."""
        return replace(self, likelihood=likelihood)

    def with_tails(self, share: float) -> Carried:
        """Return the same density with Gaussian tails, of a share of the mass: see `Train`."""
        terms = (term._replace(density=replace(term.density, tails=share)) for term in self.terms)
        return replace(self, terms=tuple(terms))

    def about(self, turn: Array) -> Carried:
        """Return the same density with angles on another turn."""
        return replace(self, turn=turn)

    def scaled(self, log_factor: float) -> Carried:
        """Return the density times the exponential of a number."""
        terms = (term._replace(scale=term.scale - np.array([0.0, log_factor])) for term in self.terms)
        return replace(self, terms=tuple(terms))
