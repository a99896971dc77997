"""`limited-direct` in two and three states: the transition of a time-varying Yau system is Gaussian in the gauge u = e^phi v.

    v(t1, c1 + A xi) = exp(kappa + tilt.xi + xi'B xi) (N(0, Sigma) * v(t0, c0 + .))(xi)

The density is kept on an affine grid that A moves: spreading is exact in frequency, the rest is pointwise.  Increments of a
nonlinear h whose energy is quadratic act in substeps around the transition, extrapolated until the tolerance is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from zakai.algebra.systems import yau_system
from zakai.methods import _space_kolmogorov as base
from zakai.methods._affine_system import Matrices, precision_of
from zakai.methods._options import tolerance_of
from zakai.methods._protocol import Info
from zakai.methods._series_kernel import PowerSeries
from zakai.methods._space import State
from zakai.methods._space_observed import Observations
from zakai.methods._space_system import grid_of, moments_of, prior_on_grid, system_of
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.complex_step import is_complex
from zakai.numerics.flow import Coefficients, Flow, at, integrate, motion, spread_first
from zakai.numerics.space_grid import (
    Grid,
    gradient,
    padded,
    refined,
    rounded_size,
    sinc_resampled,
    spread,
    triangular_resampled,
)
from zakai.numerics.space_step import MOST_ENLARGED, Control, Field, Report, advance, extrapolated, positive
from zakai.numerics.space_survey import deviations_in_spacings, narrowest, survey
from zakai.numerics.space_unrolled import MOST as MOST_WIDE
from zakai.numerics.space_unrolled import folded, opened, widths, wrapped
from zakai.numerics.space_update import Update, updated
from zakai.numerics.space_window import LEAST, MOST, Bounds, enlargement, padded_sizes, whitened_grid
from zakai.records.schedule import Schedule

Array = Any
DEFAULT_TOLERANCE = 1e-5  # of the splitting of increments of a nonlinear h
EDGE, TAIL = 1e-12, 1e-12
MOST_GROWTH = 3.0  # of the characteristics in one application of the flow, in nats
TRIES = 8
RESOLVED = 1e-9


class YauSystem:
    """The coefficients of the equation of v as functions of time, and the gauge."""

    def __init__(self, model: Model):
        yau = yau_system(model)
        assert yau is not None
        n, m = model.n, model.m
        self.affine = yau.slope is not None and model.observation_kind != "samples"
        self.unobserved, self.full = yau.unobserved is not None, yau.full is not None
        slope = yau.slope if self.affine else sp.zeros(m, n)
        intercept = yau.intercept if self.affine else sp.zeros(m, 1)
        blocks = [yau.form.matrix, yau.form.offset, model.covariance]
        for quadratic in (yau.unobserved or yau.full, yau.full or yau.unobserved):
            assert quadratic is not None
            blocks += [quadratic.matrix, quadratic.linear, sp.Matrix([quadratic.constant])]
        self.blocks = [entry for block in blocks for entry in block.flat()]
        self.matrices = Matrices([*blocks, slope, intercept], model)
        self._noise = Matrices([model.observation_noise], model)
        self.gauged = yau.form.potential != 0
        self.gauge_varies = yau.form.potential.has(model.t)
        self._potential = numpy_function([yau.form.potential], model, ())

    def potential(self, points: Array, t: float, theta: Array) -> Array:
        """Return phi (J,)."""
        return self._potential(points, t, theta)

    def coefficients(self, times: Array, theta: Array, origin: Array, inside: Array, full: bool) -> Coefficients:
        """Return the coefficients at times (J,) in coordinates relative to the origin.

        With an affine h the coordinates `inside` (m,) act with inputs; otherwise `full` tells whether -h'S^-1 h / 2 is inside.
        """
        L, l, G, Q, p, r, Qf, pf, rf, C, c = self.matrices(times, theta)
        if full:
            Q, p, r = Qf, pf, rf
        pushed = Q @ origin[:, None]
        r = r + np.swapaxes(p + pushed, 1, 2) @ origin[:, None]
        l, p, c = l + L @ origin[:, None], p + 2.0 * pushed, c + C @ origin[:, None]
        if not (self.affine and inside.any()):
            return Coefficients(L, l, G, Q, p, r[:, :, 0])
        S = self._noise(times, theta)[0]
        precision = precision_of(S, np.broadcast_to(inside, (len(times), len(inside))))
        gain, driven = np.swapaxes(C, 1, 2) @ precision, precision @ c
        linear = np.concatenate([p - gain @ c, gain], axis=2)
        constant = np.concatenate([r[:, :, 0] - 0.5 * (np.swapaxes(c, 1, 2) @ driven)[:, :, 0], driven[:, :, 0]], axis=1)
        offset = np.concatenate([l, np.zeros((*l.shape[:2], len(inside)))], axis=2)
        return Coefficients(L, offset, G, Q - 0.5 * gain @ C, linear, constant)

    def varies(self, inside: Array) -> bool:
        """Return whether the coefficients depend on time."""
        return bool(self.matrices.varying or (self.affine and inside.any() and self._noise.varying))


@lru_cache(maxsize=32)
def yau_of(model: Model) -> YauSystem:
    """Return the equation of a model, made once."""
    return YauSystem(model)


@lru_cache(maxsize=32)
def power_series_of(model: Model, order: int | None) -> PowerSeries:
    """Return the equation of a model as Taylor series in time, made once."""
    return PowerSeries(model, yau_of(model).blocks, order)


class Stepper:
    """Substeps of one interval: flows around halves of the factor of a nonlinear h."""

    def __init__(
        self,
        yau: YauSystem,
        theta: Array,
        bounds: Bounds,
        origin: Array,
        inside: Array,
        inputs: Array,
        full: bool,
        series: PowerSeries | None = None,
    ):
        self.series = series
        self.yau, self.theta, self.bounds, self.origin = yau, theta, bounds, origin
        self.inside, self.inputs, self.full = inside, inputs, full
        self.error = 0.0
        self.exponent = 0.0
        self._flows: dict[tuple[float, float], Flow] = {}

    def flow(self, t0: float, t1: float) -> Flow:
        """Return the flow of a substep."""
        varies = self.yau.varies(self.inside)
        key = (t0, t1) if varies else (0.0, t1 - t0)
        if key not in self._flows:
            if self.series is not None:
                start, length = np.array([key[0]]), np.array([key[1] - key[0]])
                found = self.series.integrate(start, length, self.theta, self.origin, self.full)
            else:
                found = integrate(
                    lambda times, rows: self.yau.coefficients(times, self.theta, self.origin, self.inside, self.full),
                    np.array([key[0]]), np.array([key[1]]), not varies,
                )  # fmt: skip
            self.error = max(self.error, float(found.error[0]))
            self._flows[key] = at(spread_first(found.transition), 0)
        return self._flows[key]

    def parts(self, t0: float, t1: float) -> int:
        """Return the parts in which an interval is moved, so that no flow grows much."""
        c = self.yau.coefficients(np.linspace(t0, t1, 5), self.theta.real, self.origin, self.inside, self.full)
        waves = np.sqrt(2 * np.abs(np.linalg.eigvals(c.covariance @ c.quadratic)).max())
        grows = (t1 - t0) * float(np.abs(np.linalg.eigvals(c.matrix)).max() + waves)
        return int(np.clip(np.ceil(grows / MOST_GROWTH), 1, 4096)) if np.isfinite(grows) else 1

    def apply(self, source: Field, t0: float, t1: float, potential: Any) -> Field:
        """Return the density after one substep on the grid that the flow moves."""
        grid, flow = source.grid, self.flow(t0, t1)
        values, scale = source.values, source.log_scale
        if potential is not None:
            values, top = _weighed(values, potential(grid, t0, t1, False).log / 2)
            scale = scale + top
        if self.yau.gauged:
            values, top = _weighed(values, -self.yau.potential(grid.points, t0, self.theta).reshape(grid.sizes))
            scale, self.exponent = scale + top, max(self.exponent, _range(values, source.values))
        centre = grid.centre - self.origin
        moved = motion(flow, centre, self.inputs)
        wide = spread(values, grid, flow.spread)
        new = Grid(self.origin + moved.centre.real, flow.map.real @ grid.basis, grid.sizes, grid.closed)
        xi = grid.offsets
        if np.iscomplexobj(moved.centre) or np.iscomplexobj(flow.map):
            # The grid is real: the derivative of its motion is one of the density.
            full = np.linalg.solve(flow.map, (new.centre - self.origin - moved.centre)[:, None]).T
            change = full + xi @ (np.linalg.inv(flow.map) @ flow.map.real).T - xi
            slopes = gradient(np.ascontiguousarray(wide.real), grid).reshape(grid.n, -1)
            along = change.imag @ grid.inverse.T
            wide = wide + 1j * (slopes.T * along).sum(axis=1).reshape(grid.sizes)
            xi = xi + 1j * change.imag
        exponent = xi @ moved.tilt + ((xi @ flow.curvature) * xi).sum(axis=1)
        values, top = _weighed(wide, exponent.reshape(grid.sizes))
        scale = scale + top + moved.log_mass
        if self.yau.gauged:
            values, top = _weighed(values, self.yau.potential(new.points, t1, self.theta).reshape(new.sizes))
            scale = scale + top
        if potential is not None:
            values, top = _weighed(values, potential(new, t0, t1, True).log / 2)
            scale = scale + top
        return Field(values, new, scale)

    def _adapted(self, source: Field, result: Field) -> Field | None:
        """Return the source on a wider or finer grid, or None where the result is within bounds or nothing can be changed."""
        found = survey(result.values.real, result.grid, self.bounds.edge)
        wide, coarse = found.edges > 10 * self.bounds.edge, found.tails > 10 * self.bounds.tail
        if not (wide.any() or coarse.any()):
            return None
        grid, n = source.grid, source.grid.n
        ratio = np.clip(self.bounds.spacings / deviations_in_spacings(found.tails), 1.15, 2.0)
        sizes = tuple(
            rounded_size(size * ratio[d] if coarse[d] else size, size, 2 * self.bounds.most) for d, size in enumerate(grid.sizes)
        )
        larger = tuple(rounded_size(s * 1.25 if wide[d] else s, LEAST[n], 2 * self.bounds.most) for d, s in enumerate(sizes))
        if larger == grid.sizes:
            return None
        values, grid = refined(source.values, grid, sizes) if sizes != grid.sizes else (source.values, grid)
        larger = tuple(max(a, b) for a, b in zip(larger, sizes, strict=True))
        return Field(*padded(values, grid, larger), source.log_scale)

    def _prepared(self, source: Field, t0: float, t1: float) -> Field:
        sizes = padded_sizes(source.grid, self.flow(t0, t1).spread.real, self.bounds)
        return Field(*padded(source.values, source.grid, sizes), source.log_scale)

    def single(self, source: Field, t0: float, t1: float, potential: Any) -> tuple[Field, Report]:
        """Return the density after a substep, in parts where the flow grows."""
        parts, begin_time = self.parts(t0, t1), t0
        longest = (t1 - t0) / parts
        while True:
            length = min(longest, t1 - begin_time)
            length = self.limit(source, begin_time, begin_time + length) - begin_time
            last = begin_time + length >= t1 - 1e-12 * (t1 - t0)
            a, b = begin_time, t1 if last else begin_time + length
            begin = self._prepared(source, a, b)
            for _ in range(TRIES):
                result = self.apply(begin, a, b, potential)
                better = self._adapted(begin, result)
                if better is None:
                    break
                begin = better
            if last and a == t0:
                return result, self.report(result)
            source, begin_time = regridded(result, self.bounds), b
            if last:
                return source, self.report(source)

    def limit(self, field: Field, t0: float, t1: float) -> float:
        """Return the end, at most t1, of the longest substep by whose noise a density can be spread on a few times its grid."""
        for _ in range(80):
            if enlargement(field.grid, self.flow(t0, t1).spread.real, self.bounds) <= MOST_ENLARGED:
                break
            t1 = t0 + 0.5 * (t1 - t0)
        return t1

    def double(self, source: Field, t0: float, t1: float, potential: Any) -> tuple[Field, Report, float]:
        """Return the extrapolated density after two halves of a substep, and the difference from the whole substep."""
        middle = 0.5 * (t0 + t1)
        begin = self._prepared(source, t0, t1)
        for _ in range(TRIES):
            fine = self.apply(self.apply(begin, t0, middle, potential), middle, t1, potential)
            better = self._adapted(begin, fine)
            if better is None:
                break
            begin = better
        coarse = self.apply(begin, t0, t1, potential)
        # Where Q is not zero two flows move a grid elsewhere than one flow.
        whole = _at(coarse, fine.grid)
        values, difference = extrapolated(fine.values, whole, coarse.log_scale - fine.log_scale)
        result = Field(values, fine.grid, fine.log_scale)
        return regridded(result, self.bounds), self.report(result), difference

    def resolved(self, field: Field, report: Report) -> tuple[Field, float]:
        """Return the density as it is: what its grid does not resolve is reported."""
        return field, 0.0

    def report(self, result: Field) -> Report:
        """Return the errors that the grid shows."""
        found = survey(result.values.real, result.grid, self.bounds.edge)
        real = result.values.real
        negative = float(-np.minimum(real, 0.0).sum() / real.sum())
        return Report(0.0, 0.0, float(found.edges.max()), float(found.tails.max()), negative)


def _at(field: Field, new: Grid) -> Array:
    """Return the band-limited interpolant of a density on a grid whose basis is nearly its own."""
    grid, n = field.grid, field.grid.n
    upper, lower = grid.inverse @ new.basis, np.eye(n)
    for i in range(n):
        if abs(upper[i, i]) < 0.3:
            return sinc_resampled(field.values, grid, new)
        lower[i + 1 :, i] = upper[i + 1 :, i] / upper[i, i]
        upper = upper - np.outer(np.where(np.arange(n) > i, lower[:, i], 0.0), upper[i])
    between = Grid(new.centre, grid.basis @ lower, new.sizes, grid.closed)
    values = triangular_resampled(field.values, grid, between)
    # An upper triangle is a lower one with the axes in the opposite order.
    between, new = (Grid(g.centre, g.basis[:, ::-1], g.sizes[::-1], g.closed[::-1]) for g in (between, new))
    return np.ascontiguousarray(triangular_resampled(np.ascontiguousarray(values.T), between, new).T)


def _weighed(values: Array, logs: Array) -> tuple[Array, float]:
    """Return the values times exp(logs - top), and top, the largest logarithm of a product."""
    real = np.abs(values.real)
    with np.errstate(divide="ignore"):
        product = np.log(real) + np.where(np.isfinite(logs.real), logs.real, -np.inf)
    top = float(product.max() - np.log(real.max())) if np.isfinite(product.max()) else 0.0
    shifted = np.where(np.isfinite(logs.real), logs, -1e4) - top
    return values * np.exp(np.where(shifted.real > 300.0, 300.0, np.where(shifted.real < -600.0, -600.0, shifted))), top


def _range(gauged: Array, values: Array) -> float:
    """Return by how many nats the gauge lifts the tails above the maximum of the density."""
    peak = int(np.argmax(values.real))
    return float(np.log(max(gauged.real.max() / max(gauged.real.flat[peak], 1e-300), 1.0)))


def regridded(field: Field, bounds: Bounds) -> Field:
    """Return the density on a grid with as many points as it needs, where its own has many more or its axes are skew."""
    grid = field.grid
    real = np.where(field.values.real > 0, field.values.real, 0.0)
    narrow, _ = narrowest(survey(real, grid, bounds.edge, bounds.tail), grid, bounds.tail)
    used = np.flatnonzero(real > bounds.edge * real.max())
    with np.errstate(divide="ignore"):
        logs = np.log(real.reshape(-1)[used] / real.max())
    new = whitened_grid(grid.offsets[used], logs, np.zeros((grid.n, grid.n)), narrow, bounds, grid)
    if np.prod(new.sizes) > 0.7 * np.prod(grid.sizes):
        return field
    values = triangular_resampled(field.values, grid, new)
    if np.any(survey(values.real, new, bounds.edge).tails > 10 * bounds.tail):
        return field
    return Field(values, new, field.log_scale)


@dataclass(frozen=True, eq=False)
class Prepared(base.Prepared):
    """A model, a schedule and parameters, with the equation of its gauge."""

    yau: YauSystem = field(default=None)  # type: ignore[assignment]
    series: PowerSeries | None = None

    def init(self, prior: Any) -> State:
        """Return the prior on a grid; an angle with a Gaussian or a mixture is not wrapped."""
        tolerance = min(self.bounds.edge, self.bounds.tail)
        periodic = self.angles if isinstance(prior, DensityPrior) else self.bounds.periodic
        found = prior_on_grid(self.model, prior, self.theta, tolerance, periodic)
        values = np.exp(found.log_values - np.max(found.log_values.real))
        values, grid = opened(values, Grid(found.centre, found.basis, values.shape, found.closed))
        error = found.error if found.error > 1e-6 else 0.0
        return self._started(positive(self._folded(Field(values, grid, 0.0)), self.bounds), error)

    def density(self, state: State) -> Field:
        """Return the posterior on a grid, folded onto the circle where it is wide."""
        field = super().density(state)
        if not any(self.angles) or not np.any(widths(field.grid)[np.array(self.angles)] > 2 * np.pi):
            return field
        return Field(*wrapped(field.values, field.grid, self.angles), field.log_scale)

    def _folded(self, source: Field) -> Field:
        """Return a density on the line that spreads over at most three turns in an angle, and one peak only once."""
        if not any(self.angles):
            return source
        angle = np.array(self.angles)
        width = widths(source.grid)[angle]
        mean, cov = moments_of(source.values.real, source.grid, self.angles)
        deviation = np.sqrt(np.diagonal(cov)[angle])
        narrow = bool(np.all(self.bounds.reach * deviation < 0.8 * np.pi))
        if not np.any(width > (2 * np.pi if narrow else MOST_WIDE)):
            return source
        values, grid = folded(source.values, source.grid, self.angles, mean, narrow)
        return Field(values, grid, source.log_scale)

    def step(self, k: int, state: State, values: np.ndarray) -> tuple[State, Info]:
        """Return the state after interval k and its observation, and what the step reports."""
        schedule, yau, bounds = self.schedule, self.yau, self.bounds
        begin, observations = Field(state.values, grid_of(state, bounds.periodic), 0.0), self.observations
        start, length = float(schedule.starts[k]), float(observations.lengths[k])
        inside = observations.inside[k]
        linear = yau.affine and not self.lie and self.series is None  # the series has no inputs
        full = (bool(inside.all()) and not linear and yau.full) or not yau.unobserved
        inputs = np.ones(1)
        potential, extra = None, None
        if linear and inside.any() and length > 0:
            inputs = np.concatenate([inputs, np.where(inside, values, 0.0) / length])
        elif self.lie and inside.any():
            extra = self._whole(k, inside, values, full)
        elif length > 0 and (inside.any() or full):
            potential = self._remaining(inside, values, start, length, full)
        acting = inside if linear else np.zeros(self.model.m, bool)
        stepper = Stepper(yau, self.theta, bounds, begin.grid.centre, acting, inputs, full, self.series)
        control = Control(state.rate, state.measured, state.age) if potential is not None else Control(0.0, np.inf, 0)
        allowed = self.allowed(state)
        predicted, report, after = advance(stepper, begin, start, length, potential, control, allowed)  # type: ignore[arg-type]
        factor, constant = observations.factor(k, inside, values)
        factors = [one for one in (factor, extra) if one is not None]
        update = Update(predicted, report.edges, report.tails, 0.0, False)
        if factors:
            update = updated(predicted, lambda grid: sum(one(grid) for one in factors), bounds, report.tails)
        update = update._replace(field=regridded(self._folded(update.field), bounds))
        if potential is None:
            after = Control(state.rate, state.measured, state.age)
        noise = 1e-15 * float(np.exp(min(stepper.exponent, 50.0))) + max(stepper.error, 0.0)
        report = report._replace(interpolation=noise)
        kept = self._kept(begin, predicted, update.field)
        new, info = self._reported(state, update, report, after, constant, kept, None)
        health = {**info.health, "gauge_exponent": stepper.exponent}
        return new, info._replace(health=health)

    def _whole(self, k: int, inside: Array, values: Array, full: bool) -> Any:
        """Return the factor exp(h'S^-1 dy) at the end; with -h'S^-1 h dt / 2 where the transition does not hold it."""
        stop, length = float(self.schedule.stops[k]), float(self.observations.lengths[k])
        S = self.system.noise(np.zeros(self.model.n), stop, self.theta)
        precision = precision_of(S[None], inside[None])[0]

        def log_factor(grid: Grid) -> Array:
            h = self.observations.observed(grid, stop)
            energy = 0.0 if full and inside.all() else 0.5 * length
            return (h * ((values - energy * h) @ precision)).sum(axis=1)

        return log_factor

    def _remaining(self, inside: Array, values: Array, start: float, length: float, full: bool) -> Any:
        """Return the factor of what the transition does not hold: rates, and the energy where it is not that of `inside`."""
        whole = np.ones(self.model.m, bool)
        acting = self.observations.potential(inside, values, start, length) if inside.any() else None
        energy = self.observations.potential(whole, np.zeros(self.model.m), start, length) if full else None

        def potential(grid: Grid, a: float, b: float, end: bool) -> Any:
            first = None if acting is None else acting(grid, a, b, end)
            if energy is None:
                return first
            held = energy(grid, a, b, end)
            log = -held.log if first is None else first.log - held.log
            return held._replace(log=log)

        return potential


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    splitting: str = "strang",
    tolerance: float | None = None,
    kernel: str = "flow",
    order: int | None = None,
    **_: Any,
) -> base.Prepared:
    """Return what is known without data."""
    tolerance = tolerance_of(tolerance, DEFAULT_TOLERANCE)
    bounds = Bounds(EDGE, TAIL, MOST[model.n], (False,) * model.n, band_limited=True)
    theta = np.asarray(theta)
    yau = yau_of(model)
    series = power_series_of(model, order) if kernel == "power-series" else None
    lie = splitting == "lie"
    system = system_of(model)
    observations = Observations(model, schedule, system, theta, {} if is_complex(theta) else system.caches(theta)[0])
    return Prepared(model, schedule, theta, system, tolerance, bounds, observations, lie=lie, yau=yau, series=series)
