"""Samples of a Gaussian-sum method whose law is not N(h(x, t), S(t)): families, and noise that depends on the state.

A component is multiplied by p(z | x) itself.  How far that is from what one Gaussian can follow is measured by statistics s(x)
whose Fisher information is about one, in the place of S^(-1/2) h: 2 sqrt(h) of a count, 2 asin(sqrt(h)) of a probability, log h
of a waiting time.  Of
`observation_log_density` it is the deviance residual of the observation, sqrt(2 (max l - l)) with l = log p(z | x).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sympy as sp

from zakai.methods.system.observation import log_likelihood
from zakai.models.features import OF_OBSERVATION
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.sums.mixture import Array


def has_own_law(model: Model) -> bool:
    """Return whether samples have a law that is not N(h(x, t), S(t))."""
    return model.observation_kind == "samples" and bool(OF_OBSERVATION & model.features.keys())


def statistics_of(model: Model) -> list[tuple[int, sp.Expr]]:
    """Return the statistics s(x), each with the number of its coordinate."""
    found: list[tuple[int, sp.Expr]] = []
    for i, (family, h) in enumerate(zip(model.observation_family, model.observation, strict=True)):
        S = model.observation_noise[i, i]
        if family == "poisson":
            found.append((i, 2 * sp.sqrt(h)))
        elif family in ("bernoulli", "binomial"):
            trials = model.family_parameters.get(("trials", i), sp.Integer(1))
            found.append((i, 2 * sp.sqrt(trials) * sp.asin(sp.sqrt(h))))
        elif family == "negative-binomial":
            a = model.family_parameters["dispersion", i]
            found.append((i, 2 * sp.log(sp.sqrt(a * h) + sp.sqrt(1 + a * h)) / sp.sqrt(a)))
        elif family == "exponential":
            found.append((i, sp.log(h)))
        elif family == "von-mises":
            found.append((i, sp.sqrt(model.family_parameters["concentration", i]) * h))
        else:
            freedom = model.family_parameters.get(("degrees_of_freedom", i))
            scale = (1 if freedom is None else sp.sqrt((freedom + 1) / (freedom + 3))) / sp.sqrt(S)
            # An angle has the information of its sine and cosine together, which do not jump after half a turn.
            parts = (sp.sin(h), sp.cos(h)) if model.observation_law.angles[i] else (h,)
            found.extend((i, part * scale) for part in parts)
            if S.free_symbols & set(model.x):
                found.append((i, sp.log(S) / sp.sqrt(2)))
    return found


_DEEPEST = 1e8  # nats below the maximum at which a log density counts


class SampleLaw:
    """The law of the samples of a model, and its M statistics; `formulas` are those that depend on the state as the law does."""

    def __init__(self, model: Model):
        self.model, self._columns = model, np.zeros(1, int)
        self.formulas: list[sp.Expr] = [] if model.log_density is None else [model.log_density]
        self._statistics = None
        if model.log_density is None:
            found = statistics_of(model)
            self.formulas = [formula for _, formula in found]
            self._columns = np.array([column for column, _ in found])
            self._statistics = numpy_function(self.formulas, model)

    def __len__(self) -> int:
        return len(self.formulas)

    def energy(self, seen: Array) -> Array:
        """Return the metric (M, M) of the statistics of the coordinates `seen` (m,)."""
        return np.diag(1.0 * seen[self._columns])

    def statistics(self, x: Array, t: float, theta: Array, u: Array | None, values: Array | None) -> Array:
        """Return s (..., M) at points x (..., n), zero where it has no value; `values` (m,) are the observation, if known."""
        with np.errstate(all="ignore"):
            if self._statistics is not None:
                s = self._statistics(x, t, theta, u)
            elif values is None:
                return np.zeros((*x.shape[:-1], 1))
            else:
                logs = log_likelihood(self.model, values, np.ones(self.model.m, bool), x, t, theta, u)[..., None]
                top = np.max(logs, initial=-np.inf, where=np.isfinite(logs))
                s = np.sqrt(2.0 * np.clip(top - logs, 0.0, _DEEPEST))
        return np.where(np.isfinite(s), s, 0.0)

    def likelihood(
        self, seen: Array, t: float, theta: Array, u: Array | None, origin: Array
    ) -> Callable[[Array, Array], Array]:
        """Return log p(z | x, t) of the coordinates `seen` as a function of x - origin (..., n) and z (m,); NaN without a law."""
        return lambda offsets, values: log_likelihood(self.model, values, seen, origin + offsets, t, theta, u)
