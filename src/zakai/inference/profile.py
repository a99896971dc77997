"""Confidence intervals of parameters by their profile likelihood.

The interval of theta_i holds the values x at which

    2 (l(estimates) - max l(theta | theta_i = x)) <= the quantile of chi^2 with one degree of freedom.

References:
    Venzon and Moolgavkar 1988, A method for computing profile-likelihood-based confidence intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.stats import norm

from zakai.errors import InputError

Array = NDArray[Any]
DOUBLINGS, HALVINGS = 16, 30  # of a step away from the estimate, and of one that ends where there is no log-likelihood
ACCURACY = 1e-4  # of an end, in steps of one standard error
HIGHER = 1e-2  # nats by which a profile may exceed the fit's log-likelihood


class Quadratic(NamedTuple):
    """A log-likelihood with random errors as the quadratic that was fitted to it.

    The estimates (p,), their covariance (p, p), the random errors (p,) of the estimates, the bounds (p, 2) and the names.
    """

    estimates: Array
    covariance: Array
    errors: Array
    box: Array
    names: tuple[str, ...]

    def intervals(self, level: float) -> dict[str, tuple[float, float]]:
        """Return the interval of each parameter, estimate -+ a multiple of (variance + random error^2)^1/2, within the bounds."""
        deviations = np.sqrt(np.diag(self.covariance) + self.errors**2)
        if not np.isfinite(deviations).all():
            raise InputError(
                "intervals: the log-likelihood has random errors and no maximum that they leave visible; name more particles and "
                "fit again"
            )
        reach = float(norm.ppf(0.5 + 0.5 * level)) * deviations
        ends = np.clip(self.estimates[:, None] + np.outer(reach, [-1.0, 1.0]), self.box[:, :1], self.box[:, 1:])
        return {name: (float(low), float(high)) for name, (low, high) in zip(self.names, ends, strict=True)}


class Profile(NamedTuple):
    """The log-likelihood with its gradient, the estimates (p,), their covariance (p, p), the bounds (p, 2) and the names."""

    function: Callable[[Array], tuple[float, Array]]
    estimates: Array
    covariance: Array
    box: Array
    names: tuple[str, ...]

    def intervals(self, level: float) -> dict[str, tuple[float, float]]:
        """Return the interval of each parameter; an end is a bound, or infinite, where the likelihood does not fall enough."""
        best = self.function(self.estimates)[0]
        reach = float(norm.ppf(0.5 + 0.5 * level))
        deviations = np.sqrt(np.diag(self.covariance))
        known = np.isfinite(deviations) & (deviations > 0)
        deviations = np.where(known, deviations, 0.1 * np.maximum(np.abs(self.estimates), 0.1))
        return {
            name: (self._end(i, -1.0, best, reach, deviations), self._end(i, 1.0, best, reach, deviations))
            for i, name in enumerate(self.names)
        }

    def _end(self, i: int, side: float, best: float, reach: float, deviations: Array) -> float:
        """Return an end of the interval of parameter i."""
        place, limit = self.estimates[i], float(self.box[i, 0 if side < 0 else 1])
        latest: dict[str, Array] = {"others": self.estimates}

        def excess(x: float) -> float:
            """Return the square root of twice the fall of the profile, less the reach; NaN without a log-likelihood."""
            value, latest["others"] = self._highest(i, x, latest["others"], deviations)
            if value > best + HIGHER:
                raise InputError(
                    f"intervals: the log-likelihood at {self.names[i]} = {x:.6g} is larger than at the estimates by "
                    f"{value - best:.2g}; fit again, with start={{{self.names[i]!r}: {x:.6g}}}"
                )
            return float(np.sqrt(2.0 * max(best - value, 0.0))) - reach if np.isfinite(value) else np.nan

        inner, step = place, reach * deviations[i]
        for _ in range(DOUBLINGS):
            outer = inner + side * step
            outer = max(outer, limit) if side < 0 else min(outer, limit)
            found = excess(outer)
            if np.isnan(found):
                return self._before(excess, inner, outer, deviations[i])
            if found >= 0:
                return float(brentq(excess, *sorted((inner, outer)), xtol=ACCURACY * deviations[i], rtol=1e-12))
            if outer == limit:
                return limit
            inner, step = outer, 2.0 * step
        return side * np.inf

    def _before(self, excess: Callable[[float], float], inner: float, outer: float, deviation: float) -> float:
        """Return the end between a value inside of the interval and one without a log-likelihood."""
        for _ in range(HALVINGS):
            middle = 0.5 * (inner + outer)
            found = excess(middle)
            if np.isnan(found):
                outer = middle
            elif found >= 0:
                return float(brentq(excess, *sorted((inner, middle)), xtol=ACCURACY * deviation, rtol=1e-12))
            else:
                inner = middle
            if abs(outer - inner) < ACCURACY * deviation:
                break
        return outer

    def _highest(self, i: int, x: float, near: Array, deviations: Array) -> tuple[float, Array]:
        """Return the largest log-likelihood with parameter i at x, and the parameters there; the search begins at `near`."""
        theta = near.copy()
        others = np.flatnonzero(np.arange(len(theta)) != i)
        if np.isfinite(self.covariance).all() and self.covariance[i, i] > 0:  # along the regression on parameter i
            theta = theta + self.covariance[:, i] / self.covariance[i, i] * (x - theta[i])
            theta = np.clip(theta, self.box[:, 0], self.box[:, 1])
        theta[i] = x
        if not np.isfinite(self.function(theta)[0]):
            theta = np.where(np.arange(len(theta)) == i, x, near)
        if not np.isfinite(self.function(theta)[0]) or not len(others):
            return float(self.function(theta)[0]), theta
        scale = deviations[others]

        def objective(u: Array) -> tuple[float, Array]:
            full = theta.copy()
            full[others] = u * scale
            value, gradient = self.function(full)
            if not (np.isfinite(value) and np.isfinite(gradient).all()):
                return 1e300, np.zeros(len(u))
            return -float(value), -scale * gradient[others]

        bounds = list(zip(self.box[others, 0] / scale, self.box[others, 1] / scale, strict=True))
        options = {"ftol": 1e-10, "gtol": 1e-4, "maxiter": 100}
        found = minimize(objective, theta[others] / scale, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        theta[others] = found.x * scale
        return -float(found.fun), theta
