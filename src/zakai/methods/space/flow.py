"""Substeps of `limited-direct`: the density is spread in frequency on a grid that the Gaussian flow moves."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from zakai.methods.yau.kernel import PowerSeries
from zakai.methods.yau.system import YauSystem
from zakai.numerics.flow import Flow, at, integrate, motion, spread_first
from zakai.numerics.space.field import Field, Report, extrapolated, positive
from zakai.numerics.space.grid import Grid, gradient, rounded_size, spread
from zakai.numerics.space.resample import padded, refined, sinc_resampled, triangular_resampled
from zakai.numerics.space.step import MOST_ENLARGED
from zakai.numerics.space.survey import Survey, deviations_in_spacings, narrowest, survey
from zakai.numerics.space.window import LEAST, Bounds, enlargement, padded_sizes, whitened_grid

Array = Any
MOST_GROWTH = 3.0  # of the characteristics in one application of the flow, in nats
TRIES = 8
ROUNDING = 1e-15  # of values that are spread, relative to the largest: that of a Fourier transform is below 3e-16
MOST_LIFTED = 1e-4  # largest share of the maximum that counts as rounding when a grid is chosen


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
        self.lifted = 0.0  # rounding of the last substep, relative to the largest value of the density
        self.rounding = 0.0  # the largest of the interval
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

    @property
    def resolvable(self) -> Bounds:
        """The bounds, but not below the rounding that the last substep left."""
        least = min(self.lifted, MOST_LIFTED)
        return self.bounds._replace(edge=max(self.bounds.edge, least), tail=max(self.bounds.tail, least))

    def apply(self, source: Field, t0: float, t1: float, potential: Any) -> Field:
        """Return the density after one substep on the grid that the flow moves.

            (N(0, S) * v)(x + S b) = e^(-b.x - b'S b / 2) (N(0, S) * e^(b.x) v)(x)

        Spreading has a rounding error that is the same at all points, and the exponents after it lift that in the tails. The
        slope b of these exponents is therefore applied before. Values below the error are zero, or they would be taken for mass.
        """
        grid, flow = source.grid, self.flow(t0, t1)
        values, scale, gauge = source.values, source.log_scale, np.zeros(grid.points.shape[0])
        moved = motion(flow, grid.centre - self.origin, self.inputs)
        if potential is not None:
            values, top = _weighed(values, potential(grid, t0, t1, False).log / 2)
            scale = scale + top
        if self.yau.gauged:
            gauge = self.yau.potential(grid.points, t0, self.theta)
        slope = _slope(gauge.real, values.real.ravel() > self.bounds.edge * values.real.max(), grid.offsets)
        slope = slope + _pull(source.survey(self.bounds), slope, flow, moved.tilt)
        values, top = _weighed(values, (grid.offsets @ slope - gauge).reshape(grid.sizes))
        scale, self.exponent = scale + top, max(self.exponent, _range(values, source.values))
        shift = flow.spread @ slope
        wide = spread(values, grid, flow.spread)
        centre = moved.centre + flow.map @ shift
        new = Grid(self.origin + centre.real, flow.map.real @ grid.basis, grid.sizes, grid.closed)
        xi = grid.offsets + shift
        if np.iscomplexobj(centre) or np.iscomplexobj(flow.map):
            # The grid is real: the derivative of its motion is one of the density.
            xi = np.linalg.solve(flow.map, (new.points - self.origin - moved.centre).T).T
            slopes = gradient(np.ascontiguousarray(wide.real), grid).reshape(grid.n, -1)
            along = (xi - shift).imag @ grid.inverse.T
            wide = wide + 1j * (slopes.T * along).sum(axis=1).reshape(grid.sizes)
        logs = (xi @ (moved.tilt - slope) + ((xi @ flow.curvature) * xi).sum(axis=1)).reshape(grid.sizes)
        if self.yau.gauged:
            logs = logs + self.yau.potential(new.points, t1, self.theta).reshape(new.sizes)
        if potential is not None:
            logs = logs + potential(new, t0, t1, True).log / 2
        floor = ROUNDING * float(wide.real.max()) if np.any(flow.spread) else 0.0
        wide = np.where(wide.real > floor, wide, 0.0)
        values, top = _weighed(wide, logs)
        lift = float(np.max(logs.real, where=wide.real > 0, initial=-np.inf)) - top
        self.lifted = floor * float(np.exp(min(lift, 300.0))) / max(float(values.real.max()), 1e-300)
        # e^(-b.x - b'S b / 2) at x = xi - S b is e^(-b.xi + b'S b / 2).
        scale = scale + top + moved.log_mass + 0.5 * slope @ shift
        return Field(values, new, scale)

    def _adapted(self, source: Field, result: Field) -> Field | None:
        """Return the source on a wider or finer grid, or None where the result is within bounds or nothing can be changed."""
        found, bounds = result.survey(self.bounds), self.resolvable
        wide, coarse = found.edges > 10 * bounds.edge, found.tails > 10 * bounds.tail
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

    def _moved(self, begin: Field, move: Callable[[Field], Field]) -> tuple[Field, Field]:
        """Return the source on a grid on which it can be moved, and the result: of larger grids those that make it better.

        A gauge that increases outwards lifts rounding, the more the wider the grid is.
        """
        result = move(begin)
        for _ in range(TRIES - 1):
            larger = self._adapted(begin, result)
            if larger is None:
                break
            new = move(larger)
            if not self._excess(new) < self._excess(result):
                break
            begin, result = larger, new
        return begin, result

    def _excess(self, result: Field) -> float:
        """Return the largest of edges and tails, relative to their bounds."""
        found = result.survey(self.bounds)
        return float(max(found.edges.max() / self.bounds.edge, found.tails.max() / self.bounds.tail))

    def _prepared(self, source: Field, t0: float, t1: float) -> Field:
        sizes = padded_sizes(source.values, source.grid, self.flow(t0, t1).spread.real, self.bounds)
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
            _, result = self._moved(self._prepared(source, a, b), partial(self.apply, t0=a, t1=b, potential=potential))
            self.rounding = max(self.rounding, self.lifted)
            if last and a == t0:
                return result, self.report(result)
            source, begin_time = regridded(result, self.bounds, self.lifted), b
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

        def halves(begin: Field) -> Field:
            return self.apply(self.apply(begin, t0, middle, potential), middle, t1, potential)

        begin, fine = self._moved(self._prepared(source, t0, t1), halves)
        coarse = self.apply(begin, t0, t1, potential)
        # Where Q is not zero two flows move a grid elsewhere than one flow.
        self.rounding = max(self.rounding, self.lifted)
        whole = _at(coarse, fine.grid)
        values, difference = extrapolated(fine.values, whole, coarse.log_scale - fine.log_scale)
        result = Field(values, fine.grid, fine.log_scale)
        return regridded(result, self.bounds, self.lifted), self.report(result), difference

    def resolved(self, field: Field, report: Report) -> tuple[Field, float]:
        """Return the density as it is: what its grid does not resolve is reported."""
        return field, 0.0

    def report(self, result: Field) -> Report:
        """Return the errors that the grid shows."""
        found = result.survey(self.bounds)
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


def _slope(phi: Array, used: Array, offsets: Array) -> Array:
    """Return the slope (n,) of the affine function nearest to phi (J,) where a density is `used` (J,)."""
    used &= np.isfinite(phi)
    x = offsets[used] - offsets[used].mean(axis=0)
    found: Array = np.linalg.lstsq(x, phi[used] - phi[used].mean(), rcond=None)[0]
    return found


def _pull(found: Survey, slope: Array, flow: Flow, tilt: Array) -> Array:
    """Return the slope (n,) of tilt.x + x'B x at the mean of the Gaussian near its product with a spread density."""
    noise, curvature = flow.spread.real, flow.curvature.real
    mean, cov = found.mean + noise @ slope, found.cov + noise
    ratio = np.eye(len(mean)) - 2.0 * cov @ curvature
    values = np.linalg.eigvals(ratio) if np.isfinite(ratio).all() else np.zeros(1)
    if not (np.isfinite(tilt).all() and values.real.min() > 0):  # there is no such mean
        return np.zeros(len(mean))
    pull: Array = tilt.real + 2.0 * curvature @ np.linalg.solve(ratio, mean + cov @ tilt.real)
    return pull


def _range(gauged: Array, values: Array) -> float:
    """Return by how many nats the gauge lifts the tails above the maximum of the density."""
    peak = int(np.argmax(values.real))
    return float(np.log(max(gauged.real.max() / max(gauged.real.flat[peak], 1e-300), 1.0)))


def regridded(field: Field, bounds: Bounds, rounding: float = 0.0) -> Field:
    """Return the density on a grid with as many points as it needs, where its own has many more or its axes are skew.

    `rounding` is the share of the maximum up to which values are rounding errors where interpolation is as large.
    """
    grid = field.grid
    real = np.where(field.values.real > 0, field.values.real, 0.0)
    found = survey(real, grid, bounds.edge)
    narrow, _ = narrowest(found, real, bounds.tail)
    used = np.flatnonzero(real > bounds.edge * real.max())
    with np.errstate(divide="ignore"):
        logs = np.log(real.reshape(-1)[used] / real.max())
    new = whitened_grid(grid.offsets[used], logs, np.zeros((grid.n, grid.n)), narrow, bounds, grid)
    if np.prod(new.sizes) > 0.7 * np.prod(grid.sizes):
        return field
    values = triangular_resampled(field.values, grid, new)
    if np.any(survey(values.real, new, bounds.edge).tails > np.maximum(10 * bounds.tail, 2 * found.tails.max())):
        return field
    result = Field(values, new, field.log_scale)
    return positive(result, bounds._replace(edge=rounding, band_limited=False)) if rounding > bounds.edge else result
