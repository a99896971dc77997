"""`yau-yau` in two to four states: any smooth f and h, singular G, angles in any coordinate, coefficients that vary in time.

Inside an interval the density obeys the Kolmogorov equation, with -h'S^-1 h / 2 + h'S^-1 dy/dt for increments; samples and
increments over more than the interval multiply it at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import sympy

from zakai.errors import InputError
from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Info
from zakai.methods._space import State
from zakai.methods._space_functions import point_function
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, GaussianPrior
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.prior_grid import PriorGrid, mixture_grid, prior_grid
from zakai.numerics.space_average import average, panel_rule
from zakai.numerics.space_grid import Grid, deviations_in_spacings, moments, weighted_products
from zakai.numerics.space_short import increment_factors, short_step, tables
from zakai.numerics.space_step import CHECKED, Control, Field, Report, Stepper, advance, positive
from zakai.numerics.space_transport import Dynamics, Factor
from zakai.numerics.space_update import Update, updated
from zakai.numerics.space_window import MOST, Bounds
from zakai.records.schedule import Schedule

Array = Any
DEFAULT_TOLERANCE = 1e-3
OUTLIER_EDGE = 1e-15
ACCURATE_DEPTH = 27.0  # nats below the maximum that rounding leaves accurate
ALIKE = 0.1  # how much the errors of different intervals have in common
MOST_PANELS = 1024  # substeps for the variation of coefficients within an interval
REGRID = 32  # short steps after which the size of the grid is considered again
CACHED = 2_000_000  # numbers of tables that are kept


class System:
    """The formulas of a model as functions of many points."""

    def __init__(self, model: Model):
        n, m, x, t = model.n, model.m, model.x, model.t
        divergence = sum((sympy.diff(f, s) for f, s in zip(model.drift, x, strict=True)), start=sympy.S.Zero)
        self.drift = point_function([*model.drift, divergence], model, (n + 1,))
        self.jacobian = numpy_function(model.drift.jacobian(x), model, (n, n))
        self.covariance = numpy_function(model.covariance, model, (n, n))
        self.observe = point_function(list(model.observation), model, (m,))
        self.slopes = point_function(list(model.observation.jacobian(x)), model, (m, n))
        self.noise = numpy_function(model.observation_noise, model, (m, m))
        self.drift_varies = model.drift.has(t)
        self.covariance_varies = model.covariance.has(t)
        self.observation_varies = model.observation.has(t)
        self.noise_varies = model.observation_noise.has(t)
        self._caches: dict[bytes, tuple[dict[Any, Any], dict[Any, Any], dict[Any, Any]]] = {}
        self.varies = self.drift_varies or self.covariance_varies or self.observation_varies or self.noise_varies

    def caches(self, theta: Array) -> tuple[dict[Any, Any], dict[Any, Any], dict[Any, Any]]:
        """Return the tables that are kept for some parameters: what they hold does not depend on who asks for it."""
        key = np.asarray(theta).tobytes()
        if key not in self._caches:
            if len(self._caches) >= 4:
                self._caches.clear()
            self._caches[key] = {}, {}, {}
        return self._caches.get(key, ({}, {}, {}))


@lru_cache(maxsize=32)
def system_of(model: Model) -> System:
    """Return the functions of a model, made once."""
    return System(model)


def grid_of(state: State, periodic: tuple[bool, ...]) -> Grid:
    """Return the grid of a state."""
    sizes = state.values.shape
    closed = tuple(angle and abs(state.basis[d, d] * sizes[d] - 2 * np.pi) < 1e-9 for d, angle in enumerate(periodic))
    return Grid(state.centre, state.basis, sizes, closed)


def prior_on_grid(model: Model, prior: Any, theta: Array, tolerance: float) -> PriorGrid:
    """Return the prior on a grid; InputError where it has no density."""
    periodic = tuple(name in model.periodic for name in model.state)
    source = f"{model.source}: prior"
    aligned = any(periodic)
    if isinstance(prior, DensityPrior):
        function = numpy_function([prior.log_density], model, ())
        return prior_grid(
            lambda x: function(x, model.start, theta), model.n, periodic, tolerance=tolerance, aligned=aligned,
            source=f"{source}: log_density",
        )  # fmt: skip
    if isinstance(prior, GaussianPrior):
        weights, means, covs = np.ones(1), prior.mean[None], prior.cov[None]
    else:
        weights, means, covs = prior.weights, prior.means, prior.covs
    return mixture_grid(weights, means, covs, periodic, tolerance=tolerance, aligned=aligned, source=source)


def moments_of(values: Array, grid: Grid, periodic: tuple[bool, ...]) -> tuple[Array, Array]:
    """Return the mean (n,) and covariance (n, n); angles by their resultant, with deviations wrapped to (-pi, pi]."""
    weights = values.reshape(-1) / values.sum()
    offsets = grid.offsets
    centre = grid.centre
    mean = np.array([weights @ offsets[:, d] for d in range(grid.n)])
    if any(periodic):
        angle = np.array(periodic)
        cos, sin = weights @ np.cos(offsets), weights @ np.sin(offsets)
        change = (cos.real * sin.imag - sin.real * cos.imag) / np.maximum(cos.real**2 + sin.real**2, 1e-30)
        direction = np.arctan2(sin.real, cos.real)
        direction = direction + 1j * change if np.iscomplexobj(weights) else direction
        known = np.hypot(sin.real, cos.real) > 1e-9
        mean = np.where(angle, np.where(known, direction, -centre), mean)
        apart = offsets - mean
        apart = np.where(angle, apart - 2 * np.pi * np.round(apart.real / (2 * np.pi)), apart)
    else:
        apart = offsets - mean
    cov = weighted_products(weights, apart)
    where = centre + mean
    if any(periodic):
        where = np.where(angle, np.pi - np.mod(np.pi - where.real, 2 * np.pi) + (where - where.real), where)
    return where, cov


@dataclass(frozen=True, eq=False)
class Prepared:
    """A model, a schedule and parameters, with the bounds that follow from the tolerance."""

    model: Model
    schedule: Schedule
    theta: np.ndarray
    system: System
    tolerance: float
    bounds: Bounds
    notes: tuple[str, ...] = ()
    tables: dict[Any, Any] = field(default_factory=dict)
    moves: dict[Any, Any] = field(default_factory=dict)
    short: dict[Any, Any] = field(default_factory=dict)

    def init(self, prior: Any) -> State:
        """Return the prior on a grid."""
        found = prior_on_grid(self.model, prior, self.theta, min(self.bounds.edge, self.bounds.tail))
        values = np.exp(found.log_values - np.max(found.log_values.real))
        error = found.error if found.error > 1e-6 else 0.0
        return self._state(Field(values, Grid(found.centre, found.basis, values.shape, found.closed), 0.0),
                           Control(np.inf, 0.0, 0), error, 0.9)  # fmt: skip

    def step(self, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
        """Return the state after interval k and its observation, and what the step reports."""
        periodic, schedule = self.bounds.periodic, self.schedule
        begin = Field(state.values, grid_of(state, periodic), 0.0)
        start, length = self._start(k), float(schedule.lengths[k])
        inside = schedule.inside[k] if self.model.observation_kind != "samples" else np.zeros(self.model.m, bool)
        control = Control(state.rate, state.measured, state.age)
        quick = self._short(k, state, begin.grid, inside, values, length)
        if quick is not None:
            return quick
        allowed = 0.3 * self.tolerance * float(np.sqrt(1 - min(state.kept, 0.98) ** 2))
        potential = self._potential(inside, values, start, length) if inside.any() and length > 0 else None
        factor, constant = self._factor(k, inside, values)
        bounds, least = self.bounds, self._least(begin, start, length, inside)
        for _ in range(3):
            cache = self.moves if not self.system.drift_varies and not np.iscomplexobj(self.theta) else None
            stepper = Stepper(self._dynamics(), bounds, self.tolerance, cache)
            predicted, report, after = advance(stepper, begin, start, length, potential, control, allowed, least)
            if least >= MOST_PANELS:  # not resolved
                report = report._replace(splitting=max(report.splitting, 1.0))
            update = Update(predicted, report.edges, report.tails, 0.0, False)
            if factor is not None:
                update = updated(predicted, factor, bounds)
            if not update.truncated or length == 0 or bounds.edge <= OUTLIER_EDGE:
                break
            # The observation is where the prediction was cut off.
            bounds = bounds._replace(edge=max(bounds.edge**2, OUTLIER_EDGE))
        return self._reported(state, begin, predicted, update, report, after, constant)

    def _short(self, k: int, state: State, grid: Grid, inside: Array, values: Array, length: float) -> tuple[State, Info] | None:
        """Return the step of a short interval in which the grid can stay, or None.

        What is prepared depends on the grid, the length and the observed coordinates alone; whether a step is short depends on
        the state and the interval.
        """
        system, m = self.system, self.model.m
        made = state.rate * length**3
        known = self.model.n == 2 and 0 < state.age < CHECKED - 1 and state.age % REGRID and 0 < length <= 2 * state.measured
        at_end = bool((self.schedule.seen[k] & ~inside).any())
        allowed = 0.3 * self.tolerance * float(np.sqrt(1 - min(state.kept, 0.98) ** 2))
        if not known or at_end or system.varies or any(self.bounds.periodic) or made > allowed:
            return None
        if np.iscomplexobj(state.values) or np.iscomplexobj(self.theta) or np.count_nonzero(grid.basis) != 2:
            return None
        key = (grid.centre.tobytes(), grid.basis.tobytes(), grid.sizes, length)
        if key not in self.short:
            if len(self.short) > 64:
                self.short.clear()
            self.short[key] = tables(self._dynamics(), grid, length, self.bounds.periodic)
        table = self.short[key]
        if table is None or table.error > allowed:
            return None
        u = state.values
        outer = inner = u
        top = 0.0
        if inside.any():
            h, slopes = self._observed(grid, 0.0)
            S = system.noise(np.zeros(2), 0.0, self.theta)
            both = inside[:, None] & inside
            precision = np.where(both, np.linalg.inv(np.where(both, S, 0.0) + np.diag(1.0 * ~inside)), 0.0)
            outer, inner = np.empty_like(u), np.empty_like(u)
            G = system.covariance(np.zeros(2), 0.0, self.theta)
            top = increment_factors(
                u, h, slopes, precision, np.where(inside, values, 0.0).reshape(m), np.ascontiguousarray(G), length, outer, inner
            )
        out, sums = np.empty_like(u), np.empty(11)
        short_step(
            u, table.spread0, table.spread1, table.spline0, table.spline1, table.base, table.weights0, table.weights1,
            table.volume, table.closed0, table.closed1, bool(inside.any()), outer, inner, out, sums,
        )  # fmt: skip
        tails, edges = float(max(sums[8], sums[9])), float(max(sums[6], sums[7]))
        if not (edges <= 3 * self.bounds.edge and tails <= self.bounds.tail and np.isfinite(sums).all()):
            return None
        step = np.diagonal(grid.basis)
        area = float(step[0] * step[1])
        first = sums[1:3] / sums[0]
        cov = np.array([[sums[3], sums[4]], [sums[4], sums[5]]]) / sums[0] - first[:, None] * first
        deviation = float(deviations_in_spacings(np.array(tails)))
        own = made + table.error + 2e-4 / deviation**6 + self.bounds.reach**2 * edges * 0.1 + tails
        left = state.kept * state.error
        error = float(np.sqrt(left**2 + 2 * ALIKE * left * own + own**2))
        health = {
            "error_estimate": error,
            "tolerance_ratio": max(error / self.tolerance, edges / (100 * self.bounds.edge)),
            "splitting_error": made + table.error,
            "tail_depth": 0.0,
            "edge_mass": edges,
            "negative_mass": max(-float(sums[10]), 0.0),
            "std_in_spacings": deviation,
        }
        out *= 1.0 / (sums[0] * area)
        new = state._replace(values=out, age=state.age + 1, error=error)
        info = Info(float(np.log(sums[0] * area)) + top, grid.centre + step * first, cov * step * step[:, None], health)
        return new, info

    def _start(self, k: int) -> float:
        """Return when interval k begins; zero where nothing depends on time, so that equal intervals are the same."""
        return float(self.schedule.starts[k]) if self.system.varies else 0.0

    def _reported(
        self, state: State, begin: Field, predicted: Field, update: Update, report: Report, control: Control, constant: Any
    ) -> tuple[State, Info]:
        periodic = self.bounds.periodic
        result = update.field
        gained = result.log_mass - begin.log_mass + constant
        mean, cov = moments_of(result.values, result.grid, periodic)
        made = (report.splitting + report.interpolation) * (1 + update.depth)
        noise = 1e-15 * np.exp(min(update.depth, 40.0))
        edge = max(report.edges, update.edges)
        made = made + noise + self.bounds.reach**2 * edge * 0.1 + max(report.tails, update.tails)
        kept = self._kept(begin, predicted, result)
        left = kept * state.error
        error = float(np.sqrt(left**2 + 2 * ALIKE * left * made + made**2))
        if update.truncated or not np.isfinite(gained):
            error = max(error, 1.0)
        ratio = max(error / self.tolerance, edge / (100 * self.bounds.edge), max(report.tails, update.tails) / self.tolerance)
        health = {
            "error_estimate": error,
            "tolerance_ratio": float(ratio),
            "splitting_error": report.splitting,
            "tail_depth": float(update.depth) / ACCURATE_DEPTH,
            "edge_mass": edge,
            "negative_mass": report.negative,
            "std_in_spacings": float(deviations_in_spacings(np.array(max(report.tails, update.tails)))),
        }
        new = self._state(result, control, min(error, 1e3), kept)
        return new, Info(gained, mean, cov, health)

    def _state(self, found: Field, control: Control, error: float, kept: float) -> State:
        values = positive(found).values
        values = values / (values.sum() * abs(np.linalg.det(found.grid.basis)))
        return State(
            values, found.grid.centre, found.grid.basis, float(control.rate), float(control.measured), int(control.age),
            float(error), float(kept),
        )  # fmt: skip

    def _kept(self, begin: Field, predicted: Field, result: Field) -> float:
        """Return the share of an error of the mean, in deviations, that an interval leaves."""
        n = self.model.n
        before, between, after = (
            max(float(np.linalg.det(moments(f.values.real, f.grid).cov)), 1e-300) for f in (begin, predicted, result)
        )
        contracted = (min(before, between) / between) ** (0.5 / n) * (min(after, between) / between) ** (0.5 / n)
        return float(np.clip(contracted, 0.0, 0.98))

    def _dynamics(self) -> Dynamics:
        system, theta, n = self.system, self.theta, self.model.n

        def noise(t0: float, t1: float) -> tuple[Array, Array]:
            origin = np.zeros(n)
            if not system.covariance_varies:
                G = system.covariance(origin, t0, theta)
                return G, 0.5 * G
            found = average(lambda t: system.covariance(origin, t, theta), t0, t1 - t0)
            return found.whole, found.falling

        return Dynamics(
            lambda x, t: system.drift(x, t, theta), lambda x, t: system.jacobian(x, t, theta), noise, system.drift_varies
        )

    def _observed(self, grid: Grid, t: float) -> tuple[Array, Array]:
        """Return h (J, m) and its slopes (J, m, n) at the points of a grid."""
        system = self.system
        if system.observation_varies or np.iscomplexobj(self.theta):
            points = grid.points
            return system.observe(points, t, self.theta), system.slopes(points, t, self.theta)
        key = (grid.centre.tobytes(), grid.basis.tobytes(), grid.sizes)
        found = self.tables.get(key)
        if found is None:
            points = grid.points
            found = (
                np.ascontiguousarray(system.observe(points, t, self.theta)),
                np.ascontiguousarray(system.slopes(points, t, self.theta)),
            )
            if sum(a.size + b.size for a, b in list(self.tables.values())) > CACHED:
                self.tables.clear()
            self.tables[key] = found
        return found

    def _potential(self, inside: Array, values: Array, start: float, length: float) -> Any:
        """Return the factor of the increments inside a substep."""
        system, theta, n, m = self.system, self.theta, self.model.n, self.model.m
        rate, rows = values[inside] / length, np.ix_(inside, inside)
        origin = np.zeros(n)
        stop = start + length

        def precision(times: Array) -> Array:
            noise = np.broadcast_to(system.noise(origin, times, theta), (len(times), m, m))
            return np.linalg.inv(noise[:, rows[0], rows[1]])

        def weights(a: float, b: float) -> Array:
            if not system.noise_varies:
                return (b - a) * precision(np.array([a]))[0]
            return (b - a) * average(precision, a, b - a).whole

        def potential(grid: Grid, a: float, b: float, end: bool) -> Factor:
            a, b = max(a, start), min(b, stop)
            if not system.observation_varies:
                parts = [(0.5 * (a + b), weights(a, b))]
            else:
                shares, weight = panel_rule(self._panels(grid, a, b, precision))
                times = a + (b - a) * shares
                parts = [(t, (b - a) * w * S) for t, w, S in zip(times, weight, precision(times), strict=True)]
            log: Array = 0.0
            slope: Array = 0.0
            for t, W in parts:
                h, dh = self._observed(grid, t)
                h, dh = h[:, inside], dh[:, inside]
                log = log + (h * ((rate - 0.5 * h) @ W)).sum(axis=1)
                slope = slope + (dh * ((rate - h) @ W)[:, :, None]).sum(axis=1)
            G = self._dynamics().noise(a, b)[0]
            steep = (slope @ G * slope).sum(axis=1)
            log, steep = np.where(np.isfinite(log), log, -1e6), np.where(np.isfinite(steep), steep, 0.0)
            return Factor(log.reshape(grid.sizes), (-(b - a) / 144 * steep).reshape(grid.sizes))

        return potential

    def _least(self, begin: Field, start: float, length: float, inside: Array) -> int:
        """Return how many substeps resolve the variation of the coefficients in time."""
        system, theta, n = self.system, self.theta.real, self.model.n
        if not system.varies or length <= 0:
            return 1
        mean, cov = moments_of(begin.values.real, begin.grid, self.bounds.periodic)
        points = mean + np.concatenate([np.zeros((1, n)), np.diag(np.sqrt(np.diagonal(cov)))])
        origin = np.zeros(n)

        def function(times: Array) -> Array:
            parts = [system.covariance(origin, times, theta)] if system.covariance_varies else []
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

        return min(-(-average(function, start, length, 1e-2).panels // 2), MOST_PANELS)

    def _panels(self, grid: Grid, a: float, b: float, precision: Any) -> int:
        """Return the panels that resolve S^-1 and h at some points of the grid over an interval."""
        x = grid.points[:: max(1, len(grid.points) // 16)]

        def function(times: Array) -> Array:
            h = self.system.observe(x[None], times[:, None], self.theta).real
            parts = precision(times).real if self.system.noise_varies else np.ones((len(times), 1))
            rows = [np.where(np.isfinite(h), h, 0.0), parts]
            return np.concatenate([part.reshape(len(times), -1) for part in rows], axis=1)

        return average(function, a, b - a, 1e-7).panels

    def _factor(self, k: int, inside: Array, values: Array) -> tuple[Any, Any]:
        """Return the log-likelihood of what is observed at the end of interval k, but for a constant, and the constant."""
        schedule, system, theta, m = self.schedule, self.system, self.theta, self.model.m
        seen = schedule.seen[k] & ~inside
        if not seen.any():
            return None, 0.0
        stop, rows = self._start(k) + float(schedule.lengths[k]), np.ix_(seen, seen)
        samples = self.model.observation_kind == "samples"
        elapsed = np.ones(m) if samples else schedule.elapsed[k]
        if samples or not system.noise_varies:
            S = system.noise(np.zeros(self.model.n), stop, theta)
            cov = S if samples else S * np.minimum(elapsed[:, None], elapsed)
        else:
            lengths = np.minimum(elapsed[:, None], elapsed)
            distinct, which = np.unique(lengths, return_inverse=True)
            noise = [
                span * average(lambda t: system.noise(np.zeros(self.model.n), t, theta), stop - span, span).whole
                for span in distinct
            ]
            i, j = np.meshgrid(np.arange(m), np.arange(m), indexing="ij")
            cov = np.stack(noise)[which.reshape(m, m), i, j]
        precision = np.linalg.inv(cov[rows])
        z = values[seen]
        count = int(seen.sum())
        # A sample by its density; an increment relative to noise alone.
        constant = -0.5 * (log_determinant(cov[rows]) + count * np.log(2 * np.pi)) if samples else 0.5 * z @ precision @ z

        def log_factor(grid: Grid) -> Array:
            h, _ = self._observed(grid, stop)
            residual = z - h[:, seen] * elapsed[seen]
            return -0.5 * (residual * (residual @ precision)).sum(axis=1)

        return log_factor, constant


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    tolerance: float | None = None,
) -> Prepared:
    """Return what is known without data.

    Args:
        model: two to four states.
        schedule: the intervals.
        theta: parameters (p,).
        tolerance: bound on the relative error of the density; 1e-3 by default.
    """
    tolerance = tolerance_of(tolerance, DEFAULT_TOLERANCE)
    n = model.n
    if n > 4:
        raise InputError(f"{model.source}: a density grid is for at most four states, and there are {n}")
    most = MOST[n]
    periodic = tuple(name in model.periodic for name in model.state)
    bounds = Bounds(1e-3 * tolerance, 1e-5 * tolerance, most, periodic)
    system, theta = system_of(model), np.asarray(theta)
    caches = ({}, {}, {}) if np.iscomplexobj(theta) else system.caches(theta)
    return Prepared(model, schedule, theta, system, tolerance, bounds, (), *caches)
