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
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS, panels
from zakai.records.schedule import Schedule

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
            root, scale = np.linalg.inv(cholesky(self.shared_noise(stop, spans, theta, which))), spans
            white = root @ v
            constant = 0.5 * white @ white
        target[which] = v / scale
        full = np.zeros((len(which), m), root.dtype)
        full[:, which] = root * scale
        return Factor(np.array([stop]), full[None], target, constant)

    def shared_noise(self, stop: float, spans: Array, theta: Array, which: Array) -> Array:
        """Return the covariance (k, k) of the noise of increments over `spans` (k,) that end together.

        It is the integral of S over the time that two of them have in common.
        """
        shared = np.minimum(spans[:, None], spans)
        if not self.varies[1]:
            return np.asarray(shared * self.noise_at(np.array([stop]), theta, which)[0])

        def entries(times: Array) -> Array:
            return self.noise_at(times, theta, which).reshape(len(times), -1)

        found = np.zeros(shared.shape, np.result_type(theta, float))
        for span in np.unique(shared[shared > 0]):
            times, weights, _ = _quadrature(entries, stop - span, stop)
            found = np.where(shared == span, (weights @ entries(times)).reshape(shared.shape), found)
        return found

    def inside(self, schedule: Schedule, k: int, values: Array, theta: Array, probe: Array) -> tuple[Factor, Factor, float]:
        """Return the factors at the two ends of interval k for increments with y linear inside of it, and an error in nats.

            log factors = int (1 - s) l dt,  int s l dt,      l = h'S^-1 dy/dt - h'S^-1 h / 2

        at a fixed x, in parts of the interval in which few nodes resolve the rate at the points `probe` (count, n).
        """
        which, start = np.flatnonzero(schedule.inside[k]), float(schedule.starts[k])
        span, m = float(schedule.lengths[k]), schedule.inside.shape[1]
        target = np.zeros(m, values.dtype)
        target[which] = values[which] / span

        def precision(times: Array) -> Array:
            return np.asarray(np.linalg.inv(self.noise_at(times, theta, which)))

        def energies(times: Array) -> Array:
            """Return (h - y')'S^-1 (h - y') (T, count) at the probes."""
            apart = (self.observed(probe, times[:, None], theta) - target)[..., which].real
            return np.asarray(np.sum((apart @ precision(times).real) * apart, axis=-1))

        def factor(times: Array, weights: Array, constant: Any) -> Factor:
            full = np.zeros((len(weights), len(which), m), weights.dtype)
            full[:, :, which] = np.swapaxes(cholesky(weights), -1, -2)
            return Factor(times, full, target, constant)

        times, weights, error = np.array([start + 0.5 * span]), np.array([span]), 0.0
        if any(self.varies):
            times, weights, relative = _quadrature(lambda t: np.nan_to_num(energies(t), posinf=0.0), start, start + span)
            found = weights @ energies(times)
            error = 0.5 * relative * float(np.max(found, initial=0.0)) if np.isfinite(found).all() else np.inf
        whole, share = precision(times) * weights[:, None, None], ((times - start) / span)[:, None, None]
        early, late = whole * (1.0 - share), whole * share
        if not self.varies[0]:
            times, early, late = times[:1], early.sum(axis=0)[None], late.sum(axis=0)[None]
        rate = target[which]
        constant = 0.5 * rate @ (early + late).sum(axis=0) @ rate
        return factor(times, early, 0.0), factor(times, late, constant), error


def _quadrature(coefficients: Callable[[Array], Array], start: float, stop: float) -> tuple[Array, Array, float]:
    """Return times and weights that integrate functions of times (T,) with values (T, C), and the relative error that remains."""
    found = panels(coefficients, start, stop)
    first, last = np.array(found.bounds).T[:, :, None]
    return (first + (last - first) * GAUSS_NODES).ravel(), ((last - first) * GAUSS_WEIGHTS).ravel(), found.error
