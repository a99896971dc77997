"""Observations on density grids: increments inside an interval as a potential, all others as a factor at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from zakai.methods.space.system import System
from zakai.methods.system.observation import log_likelihood
from zakai.models.model import Model
from zakai.numerics.complex_step import is_complex, log_determinant
from zakai.numerics.space.average import average, panel_rule
from zakai.numerics.space.field import Field, cut_off
from zakai.numerics.space.grid import Grid
from zakai.numerics.space.splitting import Factor, weighed
from zakai.numerics.space.transport import Dynamics
from zakai.numerics.space.window import Bounds
from zakai.records.schedule import Schedule

Array = Any
CACHED = 2_000_000  # numbers of tables that are kept
UNMOVED = 0.5  # deviations by which an increment moves the mean of a density that hardly reaches the end of its support
MOST_PANELS = 1024  # substeps for the variation of coefficients within an interval


@dataclass(frozen=True, eq=False)
class Observations:
    """What a schedule observes; `tables` keeps h, and its energy, at the points of grids."""

    model: Model
    schedule: Schedule
    system: System
    theta: Array
    tables: dict[Any, Any]

    @cached_property
    def inside(self) -> Array:
        """Whether a coordinate (K, m) is an increment over just its interval."""
        samples = self.model.observation_kind == "samples"
        return np.zeros(self.schedule.seen.shape, bool) if samples else self.schedule.inside

    @cached_property
    def lengths(self) -> Array:
        """The lengths (K,) of the intervals."""
        return self.schedule.lengths

    @cached_property
    def _precisions(self) -> dict[bytes, Array]:
        return {}

    @cached_property
    def _laws(self) -> dict[bytes, tuple[Array, Any]]:
        return {}

    @cached_property
    def dynamics(self) -> Dynamics:
        """The drift and the noise."""
        return self.system.dynamics(self.theta)

    def start(self, k: int) -> float:
        """Return when interval k begins; zero where nothing depends on time, so that equal intervals are the same."""
        return float(self.schedule.starts[k]) if self.system.varies else 0.0

    def parts(self, k: int) -> list[tuple[float, float]]:
        """Return the starts and lengths of the parts of interval k in which no input has a jump or a kink."""
        inputs, start, stop = self.schedule.inputs, float(self.schedule.starts[k]), float(self.schedule.stops[k])
        if inputs is None:
            return [(self.start(k), float(self.lengths[k]))]
        times = [start, *inputs.within(start, stop).tolist(), stop]
        return [(a, b - a) for a, b in pairwise(times)]

    def over(self, start: float, length: float) -> Observations:
        """Return the observations with the inputs of a part of an interval."""
        inputs = self.schedule.inputs
        return self if inputs is None else replace(self, system=self.system.over(inputs, start, start + length))

    def inputs_within(self, times: Array, start: float, stop: float) -> Array | None:
        """Return the inputs at times of a part of an interval, whose end counts as the limit from inside."""
        inputs = self.schedule.inputs
        return None if inputs is None else inputs.at(np.clip(times, start, np.nextafter(stop, start)), self.system.hold)

    def inputs_at(self, t: float) -> Array | None:
        """Return the inputs at a time."""
        return None if self.schedule.inputs is None else self.schedule.inputs.at(t, self.system.hold)

    def _kept(self, grid: Grid, what: Any, make: Callable[[], tuple[Array, ...]]) -> Any:
        """Return what is made for a grid, from the tables where nothing depends on time."""
        system = self.system
        if system.observation_varies or system.noise_varies or is_complex(self.theta):
            return make()
        key = (grid.centre.tobytes(), grid.basis.tobytes(), grid.sizes, what)
        found = self.tables.get(key)
        if found is None:
            found = make()
            if len(self.tables) * sum(a.size for a in found) > CACHED:
                self.tables.clear()
            self.tables[key] = found
        return found

    def observed(self, grid: Grid, t: float) -> Array:
        """Return h (J, m) at the points of a grid."""
        return self._kept(grid, None, lambda: (self.system.observe(grid.points, t, self.theta),))[0]

    def fields(self, grid: Grid, t: float) -> tuple[Array, Array]:
        """Return h and its derivatives (m, n + 1, J) at the points of a grid, zero where h is not finite, and those numbers."""

        def make() -> tuple[Array, Array]:
            points = grid.points
            h = self.system.observe(points, t, self.theta).T
            slopes = np.moveaxis(self.system.slopes(points, t, self.theta), 0, -1)
            fields = np.concatenate([h[:, None], slopes], axis=1)
            lost = np.flatnonzero(~np.isfinite(fields.real).all(axis=(0, 1)))
            fields[:, :, lost] = 0.0
            return fields, lost

        found: tuple[Array, Array] = self._kept(grid, "fields", make)
        return found

    def potential(self, inside: Array, values: Array, start: float, length: float) -> Any:
        """Return the factor of the increments `inside` over a substep, as a function of a grid."""
        system, theta, n, m = self.system, self.theta, self.model.n, self.model.m
        rates, stop, every, dynamics = (values[inside] / length)[:, None], start + length, bool(inside.all()), self.dynamics

        def precision(times: Array) -> Array:
            noise = np.broadcast_to(system.noise(np.zeros(n), times, theta), (len(times), m, m))
            return np.linalg.inv(noise[:, inside][:, :, inside])

        fixed = None if system.noise_varies else self._precisions.get(inside.tobytes())
        if fixed is None and not system.noise_varies:
            fixed = self._precisions[inside.tobytes()] = precision(np.zeros(1))[0]

        def parts(grid: Grid, a: float, b: float) -> list[tuple[float, float, Array]]:
            if not system.observation_varies:
                return [(b - a, 0.5 * (a + b), average(precision, a, b - a).whole if fixed is None else fixed)]
            shares, weight = panel_rule(self._panels(grid, a, b, precision))
            times = a + (b - a) * shares
            return list(zip((b - a) * weight, times, precision(times), strict=True))

        def potential(grid: Grid, a: float, b: float, end: bool) -> Factor:
            a, b = max(a, start), min(b, stop)
            log: Array = 0.0
            slope: Array = 0.0
            for weight, t, P in parts(grid, a, b):
                fields, lost = self.fields(grid, t)
                fields = fields if every else fields[inside]
                h = fields[:, 0]
                residual = (weight * P) @ (rates - h)
                log = log + (h * (residual + (0.5 * weight * P) @ h)).sum(axis=0)
                if lost.size:  # the density ends where h is not finite
                    log[lost] = -1e300
                slope = slope + (fields[:, 1:] * residual[:, None]).sum(axis=0)
            if dynamics.diffusion is None:
                noise = dynamics.noise(a, b)[0]
                pairs = [(d, e) for d in range(n) for e in range(n) if noise[d, e] != 0.0]
                steep = sum((noise[d, e] * slope[d] * slope[e] for d, e in pairs), np.zeros(len(log)))
            else:
                steep = np.einsum("jde,dj,ej->j", dynamics.diffusion(grid.points, 0.5 * (a + b)), slope, slope)
            return Factor(log.reshape(grid.sizes), ((a - b) / 144 * steep).reshape(grid.sizes))

        return potential

    def cut_off(self, begin: Field, moved: Array, potential: Any, start: float, length: float, bounds: Bounds) -> float:
        """Return the error of the moments after an interval because a density is zero beyond its support.

        The potential acts on the density as it is until the drift or the noise has changed it as much as it is wide.  An interval
        over which the mean has `moved` (n,) by a small share of the deviations does not count.
        """
        found, grid, dynamics = begin.survey(bounds), begin.grid, self.dynamics
        inverse = grid.inverse
        deviations = np.sqrt(np.maximum(np.diagonal(inverse @ found.cov @ inverse.T), 1e-12))
        inverse = inverse / deviations[:, None]
        if np.abs(inverse @ moved).max() < UNMOVED:
            return 0.0
        mean = grid.centre + found.mean
        if dynamics.diffusion is None:
            noise = dynamics.noise(start, start + length)[0].real
        else:
            noise = dynamics.diffusion(mean[None], start)[0].real
        with np.errstate(all="ignore"):
            motion = np.nan_to_num(inverse @ dynamics.jacobian(mean[None], start)[0].real @ (grid.basis * deviations))
        rate = max(float(np.abs(motion).sum(axis=1).max()), float(np.diagonal(inverse @ noise @ inverse.T).max()))
        logs = potential(grid, start, start + min(length, 1.0 / max(rate, 1e-300)), False).log.real
        before, after = (cut_off(begin.values, u, grid.closed) for u in (begin.values, weighed(begin.values.real, logs)[0]))
        return max(min(after, 1.0) - before, 0.0)  # what was cut off before was counted then

    def wider(self, begin: Field, predicted: Field, parts: list[tuple[float, float]], bounds: Bounds) -> float:
        """Return by how much noise has made the variances of a density larger than the drift alone would have, at most 20."""
        first, last, n = begin.survey(bounds), predicted.survey(bounds), self.model.n
        mean, volume = (begin.grid.centre + first.mean)[None], 0.0
        with np.errstate(all="ignore"):
            for start, length in parts:
                volume += length * float(np.nan_to_num(self.over(start, length).dynamics.drift(mean, start)[0, n].real))
            ratio = np.linalg.det(last.cov) / max(float(np.linalg.det(first.cov)), 1e-300)
            found = np.exp(-2 * volume / n) * max(ratio, 0.0) ** (1 / n)
        return float(np.clip(np.nan_to_num(found), 1.0, 20.0))

    def _panels(self, grid: Grid, a: float, b: float, precision: Any) -> int:
        """Return the panels that resolve S^-1 and h at some points of the grid over an interval."""
        x = grid.points[:: max(1, len(grid.points) // 16)]

        def function(times: Array) -> Array:
            h = self.system.observe(x[None], times[:, None], self.theta).real
            parts = precision(times).real if self.system.noise_varies else np.ones((len(times), 1))
            rows = [np.where(np.isfinite(h), h, 0.0), parts]
            return np.concatenate([part.reshape(len(times), -1) for part in rows], axis=1)

        return average(function, a, b - a, 1e-7).panels

    def least(self, points: Array, start: float, length: float, inside: Array) -> int:
        """Return how many substeps resolve the variation of the coefficients in time at some points (J, n)."""
        system, theta, origin = self.system, self.theta.real, np.zeros(self.model.n)

        def function(times: Array) -> Array:
            parts = []
            if system.covariance_varies:
                parts.append(system.covariance(points[None] if system.state_dependent else origin, times[:, None], theta))
            if system.drift_varies:
                parts.append(system.drift(points[None], times[:, None], theta))
            if inside.any() and system.observation_varies:
                parts.append(system.observe(points[None], times[:, None], theta))
            if inside.any() and system.noise_varies:
                parts.append(np.linalg.inv(system.noise(origin, times, theta)))
            rows = [np.where(np.isfinite(part), part, 0.0).reshape(len(times), -1) for part in parts]
            # Each coefficient counts relative to its own size.
            rows = [row / max(float(np.abs(row).max()), 1e-300) for row in rows]
            return np.concatenate([*rows, np.ones((len(times), 1))], axis=1)

        return min(average(function, start, length, 1e-2).panels, MOST_PANELS)

    def _law(self, seen: Array, stop: float, elapsed: Array) -> tuple[Array, Any]:
        """Return the precision of what is `seen` (m,) at a time and the logarithm of the constant of its density."""
        system, theta, samples = self.system, self.theta, self.model.observation_kind == "samples"
        key = seen.tobytes() + elapsed.tobytes()
        if key in self._laws:
            return self._laws[key]
        rows, origin, spans = np.ix_(seen, seen), np.zeros(self.model.n), np.minimum(elapsed[:, None], elapsed)
        if samples or not system.noise_varies:
            cov = system.noise(origin, stop, theta) * spans
        else:
            distinct, which = np.unique(spans, return_inverse=True)
            noise = np.stack([s * average(lambda t: system.noise(origin, t, theta), stop - s, s).whole for s in distinct])
            cov = np.take_along_axis(noise, which.reshape(1, *spans.shape), axis=0)[0]
        law = np.linalg.inv(cov[rows]), -0.5 * (log_determinant(cov[rows]) + int(seen.sum()) * np.log(2 * np.pi))
        if not system.noise_varies and samples:
            self._laws[key] = law
        return law

    def factor(self, k: int, inside: Array, values: Array) -> tuple[Any, Any]:
        """Return the log-likelihood of what is observed at the end of interval k, without a constant, and the constant."""
        schedule, system, theta, m = self.schedule, self.system, self.theta, self.model.m
        seen = schedule.seen[k] & ~inside
        if not seen.any():
            return None, 0.0
        if system.general:
            stop, u = float(schedule.stops[k]), self.inputs_at(float(schedule.stops[k]))
            return lambda grid: log_likelihood(self.model, values, seen, grid.points, stop, theta, u), 0.0
        stop, elapsed = self.start(k) + float(self.lengths[k]), np.ones(m)
        if self.model.observation_kind != "samples":
            elapsed = schedule.elapsed[k]
        precision, normalisation = self._law(seen, stop, elapsed)
        z = values[seen]
        # A sample by its density; an increment relative to noise alone.
        constant = normalisation if self.model.observation_kind == "samples" else 0.5 * z @ precision @ z

        def log_factor(grid: Grid) -> Array:
            residual = z - self.observed(grid, stop)[:, seen] * elapsed[seen]
            return -0.5 * (residual * (residual @ precision)).sum(axis=1)

        return log_factor, constant
