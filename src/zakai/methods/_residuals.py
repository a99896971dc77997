"""Likelihoods of nonlinear observations as sums of squares, for methods that multiply a density by them.

    log factor(x) = constant - |R (h(x, t) - target)|^2 / 2,        summed over the times t of a quadrature
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function
from zakai.numerics.complex_step import cholesky, log_determinant
from zakai.records.schedule import Schedule

MOST_NODES = 256
CLOSE = 1e-8  # relative change of an integral over time from which more nodes are taken
Array = np.ndarray


class Factor(NamedTuple):
    """What multiplies a density: `times` (Q,), `roots` R (Q, r, m), `target` (m,), and the `constant`."""

    times: Array
    roots: Array
    target: Array
    constant: Any

    def residuals(self, observed: NumericFunction, points: Array, theta: Array) -> Array:
        """Return R (h - target) (Q r, ...) at the points (..., n); an unobserved coordinate of h does not enter."""
        used = np.flatnonzero(np.any(self.roots != 0, axis=(0, 1)))
        if not len(used):
            return np.zeros((0, *points.shape[:-1]))
        flat = points.reshape(-1, points.shape[-1])
        apart = observed(flat, self.times[:, None], theta)[..., used] - self.target[used]
        rows = self.roots[:, :, used] @ np.swapaxes(apart, -1, -2)
        return np.asarray(rows.reshape(-1, *points.shape[:-1]))


class Sensors(NamedTuple):
    """h and S of a model as functions, and whether they depend on time."""

    model: Model
    observed: NumericFunction
    noise: NumericFunction
    varies: tuple[bool, bool]

    @classmethod
    def of(cls, model: Model) -> Sensors:
        """Return the sensors of a model."""
        noise = numpy_function(model.observation_noise, model, (model.m, model.m))
        varies = model.observation.has(model.t), model.observation_noise.has(model.t)
        return cls(model, numpy_function(model.observation, model), noise, varies)

    def noise_at(self, times: Array, theta: Array, which: Array, u: Array | None = None) -> Array:
        """Return the block (Q, k, k) of S at times (Q,) and inputs u."""
        S = self.noise(np.zeros(self.model.n), np.asarray(times, float), theta, u)
        return np.array(np.broadcast_to(S, (len(times), self.model.m, self.model.m))[:, which[:, None], which])

    def at_end(
        self, schedule: Schedule, k: int, values: Array, theta: Array, seen: Array, u: Array | None = None
    ) -> Factor:
        """Return the likelihood of the coordinates `seen` (m,) at the stop of interval k, with inputs u there, as one factor."""
        which, stop = np.flatnonzero(seen), schedule.stops[k]
        m, v = len(seen), values[which]
        # The length is free of the rounding of the times.
        spans = np.where(schedule.inside[k], schedule.lengths[k], schedule.elapsed[k])[which]
        if not len(which):
            return Factor(np.array([stop]), np.zeros((1, 0, m)), np.zeros(m), 0.0)
        target = np.zeros(m, v.dtype)
        if self.model.observation_kind == "samples":
            S = self.noise_at(np.array([stop]), theta, which, u)[0]
            root, scale = np.linalg.inv(cholesky(S)), np.ones(len(which))
            constant = -0.5 * (log_determinant(S) + len(which) * np.log(2 * np.pi))
        else:
            # Increments that end together share the noise of the time that they have in common.
            shared = np.minimum(spans[:, None], spans)
            cov = self._mean_noise(stop, shared, theta, which) * shared
            root, scale = np.linalg.inv(cholesky(cov)), spans
            white = root @ v
            constant = 0.5 * white @ white
        target[which] = v / scale
        full = np.zeros((len(which), m), root.dtype)
        full[:, which] = root * scale
        return Factor(np.array([stop]), full[None], target, constant)

    def _mean_noise(self, stop: float, spans: Array, theta: Array, which: Array) -> Array:
        """Return the mean of S_ij over the time `spans` (k, k) before the stop."""
        if not self.varies[1]:
            return np.asarray(self.noise_at(np.array([stop]), theta, which)[0])

        def mean(count: int) -> Array:
            s, w = _gauss(count)
            times = stop - spans[..., None] * s
            blocks = np.stack([self.noise_at(row, theta, which) for row in times.reshape(-1, count)])
            return np.asarray(np.einsum("q,ijqij->ij", w, blocks.reshape(*times.shape, len(which), len(which))))

        return _converged(mean)[0]

    def inside(self, schedule: Schedule, k: int, values: Array, theta: Array, probe: Array) -> tuple[Factor, Factor, float]:
        """Return the factors at the two ends of interval k for increments with y linear inside of it, and an error in nats.

            log factors = int (1 - s) l dt,  int s l dt,      l = h'S^-1 dy/dt - h'S^-1 h / 2

        at a fixed x, with nodes added until two rules agree at the points `probe` (count, n).
        """
        which, start = np.flatnonzero(schedule.inside[k]), schedule.starts[k]
        span, m = float(schedule.lengths[k]), schedule.inside.shape[1]
        target = np.zeros(m, values.dtype)
        target[which] = values[which] / span

        def precision(s: Array, w: Array) -> Array:
            inverse: Array = np.linalg.inv(self.noise_at(start + span * s, theta, which))
            return np.asarray(inverse * (span * w)[:, None, None])

        def factor(times: Array, weights: Array, constant: Any) -> Factor:
            full = np.zeros((len(weights), len(which), m), weights.dtype)
            full[:, :, which] = np.swapaxes(cholesky(weights), -1, -2)
            return Factor(times, full, target, constant)

        def both(count: int) -> tuple[Array, Array, Array]:
            s, w = _gauss(count)
            P = precision(s, w)
            early, late = P * (1 - s)[:, None, None], P * s[:, None, None]
            if self.varies[0]:
                return start + span * s, early, late
            return np.array([start + 0.5 * span]), early.sum(axis=0)[None], late.sum(axis=0)[None]

        def logs(count: int) -> Array:
            times, early, late = both(count)
            pair = [factor(times, P, 0.0).residuals(self.observed, probe, theta) for P in (early, late)]
            return np.stack([0.5 * np.sum(e * e, axis=0) for e in pair])

        count, error = 1, 0.0
        if any(self.varies):
            _, error, count = _converged(logs)
        times, early, late = both(count)
        rate = target[which]
        constant = 0.5 * rate @ (early + late).sum(axis=0) @ rate
        return factor(times, early, 0.0), factor(times, late, constant), error


def _gauss(count: int) -> tuple[Array, Array]:
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (x + 1), 0.5 * w


def _converged(rule: Callable[[int], Array]) -> tuple[Array, float, int]:
    """Return an integral by a rule of more and more nodes until two agree twice; the last change; and the number of nodes."""
    count, last, agreed = 4, rule(4), 0
    while True:
        count *= 2
        value = rule(count)
        change = np.abs(value - last).real
        fine = bool(np.all(change <= CLOSE * (1 + np.abs(value))))
        agreed = agreed + 1 if fine else 0
        if agreed == 2 or count >= MOST_NODES:
            error = 0.0 if fine else float(np.max(np.where(np.isfinite(change), change, np.inf)))
            return value, error, count // 2 if agreed == 2 else count
        last = value
