"""The backward pass for one state: what the observations after t say of the state at t, as a function on a grid.

Backward in time a message b obeys the adjoint of the filter's equation,

    -b_t = G b'' / 2 + f b' + V b.

Only the product of b with the filter's density matters.  A grid covers the support of this product at the end of an interval
and the density at its start; b need not decrease beyond.  What is moved is therefore psi = e^s b with s' = (mu - G'/2) / G, where
mu is the drift of a process that keeps to the grid: f in its middle, f + G F'/F towards its ends, with an F that falls to zero.
Where no coefficient depends on t, psi obeys a symmetric equation (`numerics/line_operator.py`, Spectral).  Where s has
such a range that rounding would count, s is replaced by a bounded function of it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import erfc, erfcx

from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods import _line
from zakai.methods._line_coefficients import coefficients, offset_of, resolved_parts
from zakai.methods._line_moves import MAGNUS, Report
from zakai.methods._line_paths import draw
from zakai.methods._line_system import Prepared, State, covariance_at, covariance_between, drift_at, finite, state_moments
from zakai.methods._line_update import exponential_factor, factor_at_end
from zakai.methods._line_volumes import pulled_back
from zakai.methods._protocol import Backward, Info
from zakai.numerics import line_window as lw
from zakai.numerics.line_operator import Spectral, derivatives, exponential_action
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS

Array = Any

FALL = 3.3  # spacings over which F falls
HALF = 14.0  # spacings from where F is one to where it is one half
PAD = 28  # spacings over which F falls to zero
MOST_SUBSTEPS = 2000
FEW = 4  # substeps of an interval beyond which finite volumes are tried
BOUND = 12.0  # range of a bounded gauge
NOISE = 1e-11  # of the maximum: what is rounding in psi
SMALLEST = 1e-13  # value of a smoothed density relative to its maximum that is not rounding
EXCURSION = 3.9  # standard deviations of the noise that a path between two points goes beyond them, but for exp(-30)
RESOLVED = 0.25  # spacing in standard deviations of the noise
SURE = 10.0  # errors of a density from which its small values count
LOWEST = -30.0  # logarithm of the largest error of small values, relative to the largest value
FEWEST = 12  # points of a message
WIDTH = 0.8  # spacing in standard deviations of a Gaussian kernel at which sums are integrals
MOST_POINTS = 4000  # of such sums


class Message(NamedTuple):
    """The logarithm of the function b at the points of a grid (N,), constant beyond them.

    The grid covers where b matters.  `needed` is the spacing that its product with the density needs; `error` is the estimate of
    its relative error.
    """

    logs: np.ndarray
    origin: float
    centre: float
    spacing: float
    unit: float
    closed: bool
    needed: float
    error: float

    @property
    def window(self) -> lw.Window:
        """The grid."""
        return lw.Window(self.origin, self.centre, self.spacing, len(self.logs), self.closed, self.unit)

    @property
    def ends(self) -> tuple[float, float]:
        """The first and the last point, as offsets from the origin."""
        half = len(self.logs) // 2
        return self.centre - half * self.spacing, self.centre + (len(self.logs) - 1 - half) * self.spacing

    def at(self, offsets: Array) -> Array:
        """Return log b at offsets from the origin (J,)."""
        return lw.local_polynomial(self.logs, self.window, offsets)

    def between(self, low: float, high: float) -> Message:
        """Return the message on its points between two offsets, and on those that hold them."""
        if self.closed:
            return self
        size, first = len(self.logs), self.ends[0]
        i = int(np.clip(np.floor((low - first) / self.spacing + 1e-9), 0, size - FEWEST))
        j = int(np.clip(np.ceil((high - first) / self.spacing - 1e-9), i + FEWEST - 1, size - 1))
        return self._replace(logs=self.logs[i : j + 1], centre=first + self.spacing * (i + (j - i + 1) // 2))

    def on(self, window: lw.Window) -> Message:
        """Return the message on another grid."""
        origin, centre, spacing, _, closed, unit = window
        return Message(self.at(window.offsets), origin, centre, spacing, unit, closed, self.needed, self.error)

    @property
    def variance(self) -> float:
        """The variance of b as a density."""
        values = np.exp(self.logs - np.max(self.logs))
        return float(lw.moments(values / np.sum(values), self.window)[1])


def _taper(offsets: Array, ends: tuple[float, float], spacing: float) -> Array:
    """Return F of a grid that ends `PAD` spacings beyond two offsets."""
    beyond = np.maximum(ends[0] - offsets, offsets - ends[1]) / spacing
    return 0.5 * erfc((beyond - HALF) / FALL)


def _covering(window: lw.Window, low: float, high: float, spacing: float) -> lw.Window:
    """Return the grid of at most this spacing for offsets from `low` to `high` and the fall of F beyond, of any size."""
    if window.closed:
        size = lw.size_for(2 * np.pi / spacing * 0.999)
        return window._replace(size=size, spacing=2 * np.pi / size)
    spacing = lw.quantized(window, low, high, spacing).spacing
    centre = 8.0 * spacing * np.round((low + high) / (16.0 * spacing))
    size = int(np.ceil(((high - low) / spacing + 2 * PAD + 8) / 16.0)) * 16
    return window._replace(centre=float(centre), spacing=spacing, size=size)


def _points(window: lw.Window, low: float, high: float, spacing: float) -> lw.Window:
    """Return the grid of at most this spacing between two offsets, without the fall of F."""
    if window.closed:
        return _covering(window, low, high, spacing)
    spacing = lw.quantized(window, low, high, spacing).spacing
    first, last = np.floor(low / spacing + 1e-9), np.ceil(high / spacing - 1e-9)
    size = max(int(last - first) + 1, FEWEST)
    return window._replace(centre=float((first + size // 2) * spacing), spacing=spacing, size=size)


def message(prepared: Prepared, state: State) -> Message:
    """Return the message one at the last time.

    Raises:
        InputError: the model has reflecting ends, or cross_noise.
    """
    if prepared.system.reflecting:
        raise InputError(f"{prepared.model.source}: smooth: there is no backward pass for a state with reflecting ends yet")
    if prepared.system.cross is not None:
        raise InputError(f"{prepared.model.source}: smooth: grids have no backward pass with cross_noise yet; take kalman-bucy")
    origin, centre, spacing, size, closed, unit = state.window
    return Message(np.zeros(size), origin, centre, spacing, unit, closed, spacing, 0.0)


@lru_cache(maxsize=64)
def _fall(size: int, closed: bool) -> tuple[Array, Array, Array]:
    """Return F, F'/F and its derivative at the points of a grid (size,) with the spacing one."""
    if closed:
        return np.ones(size), np.zeros(size), np.zeros(size)
    i = np.arange(size)
    y = (np.maximum(PAD - i, PAD - i[::-1]) - HALF) / FALL
    side = np.where(i < size / 2, -1.0, 1.0)
    with np.errstate(over="ignore"):
        slope = -2.0 / (np.sqrt(np.pi) * erfcx(y)) / FALL  # of log(erfc(y) / 2)
    return 0.5 * erfc(y), slope * side, -slope * (2.0 * y / FALL + slope)


class _Product(NamedTuple):
    """The product of a state and a message on the finer of their grids, of sum one, and the logarithm of the sum before."""

    values: Array
    window: lw.Window
    log_mass: float


def _reliable(state: State, window: lw.Window) -> Array:
    """Return the density on another grid, zero where its error is as large."""
    values = np.asarray(state.values).real
    floor = SURE * float(np.exp(min(state.log_floor, LOWEST))) * float(np.max(values))
    return lw.resampled(np.where(values > floor, values, 0.0), state.window, window)


def _product(state: State, later: Message) -> _Product:
    finer = state.window
    if later.spacing < 0.9999 * finer.spacing:
        finer = _points(finer, float(finer.offsets[0]), float(finer.offsets[-1]), later.spacing)
    density = _reliable(state, finer)
    logs = np.where(density > 0, np.log(density) + later.at(finer.offsets), -np.inf)
    top = float(np.max(logs))
    values = np.exp(logs - top)
    first, last = _support(values, SMALLEST)
    values[:first], values[last + 1 :] = 0.0, 0.0
    total = float(np.sum(values))
    return _Product(values / total, finer, float(np.log(total)) + top)


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: State, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised and without what is negligible in its product with the state, and the product's report."""
    found = _product(state, later)
    window = found.window
    look = lw.figures(found.values, window.closed, prepared.negligible)
    mean, variance = lw.moments(found.values, window)
    spacings = float(np.sqrt(max(variance, 0.0))) / window.spacing
    mean, variance = state_moments(prepared, found.values, window, mean, variance)
    if window.closed:
        mean = mean - 2 * np.pi * np.ceil((mean - np.pi) / (2 * np.pi))
    health = {
        "error_estimate": float(state.error) + later.error,
        "tolerance_ratio": later.error / max(prepared.tolerance, 1e-8),
        "edge_mass": max(look.left, look.right),
        "negative_mass": look.negative,
        "aliasing": look.aliasing,
        "std_in_spacings": spacings,
    }
    first, last = _support(found.values, negligible(prepared))
    needed = min(later.needed, window.spacing * max(look.resolving, 1.0), float(state.spacing))
    kept = later.between(float(window.offsets[first]), float(window.offsets[last]))
    kept = kept._replace(logs=kept.logs - found.log_mass, needed=needed)
    return kept, Info(found.log_mass, np.array([mean]), np.array([[variance]]), health)


def negligible(prepared: Prepared) -> float:
    """Return the values relative to the maximum that do not count."""
    return float(np.clip(1e-5 * prepared.tolerance, 1e-13, 1e-10))


def _support(values: Array, cut: float) -> tuple[int, int]:
    counts = np.flatnonzero(values > cut * np.max(values))
    return (int(counts[0]), int(counts[-1])) if len(counts) else (0, len(values) - 1)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, later: Message, observed: np.ndarray, state: State) -> Message:
    """Return the message at the start of interval k from that at its end; `state` is the filter's at the start."""
    length = float(prepared.lengths[k])
    later = later.on(_points(later.window, *later.ends, later.needed))
    before = later.variance
    inside = prepared.inside[k]
    if prepared.lie and not inside.all():
        inside = np.zeros_like(inside)
    at_end = prepared.schedule.seen[k] & ~inside
    if at_end.any() or (prepared.lie and inside.any()):
        exact, window = bool(at_end.any()), later.window
        likelihood = factor_at_end(prepared, k, at_end, observed, window) if exact else exponential_factor(prepared, k, observed)
        later = later._replace(logs=later.logs + likelihood.logs(window.points).real)
    if length == 0:
        return later
    between = later.variance
    rates = np.where(inside & (not prepared.lie), observed, 0.0) / length
    way = _Way(prepared, k, inside, rates, state)
    later = way.by_kernel(later, k) or way.back(later)
    kept = float(np.clip(between / np.sqrt(max(before * later.variance, 1e-300)), 0.3, 1.0))
    return later._replace(error=way.error + kept * later.error)


class _Way:
    """One interval backward in time, in substeps; `error` adds up what they leave."""

    def __init__(self, prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State):
        self.prepared, self.inside, self.rates, self.state = prepared, inside, rates, state
        self.start, self.length = float(prepared.schedule.starts[k]), float(prepared.lengths[k])
        self.accepted = max(negligible(prepared), 30.0 * prepared.negligible)
        self.error = 0.0
        self.bounded = prepared.system.varying
        own = state.window
        first, last = _support(np.asarray(state.values).real, 1e-13)
        self.ends = float(own.offsets[first]), float(own.offsets[last])

    def back(self, later: Message) -> Message:
        """Return the message at the start of the interval."""
        stack, count, tried = [(0.0, self.length)], 0, False
        if self.prepared.system.varying:
            values = np.exp(later.logs - np.max(later.logs))
            stack, error = resolved_parts(self.prepared, values, later.window, self.start, self.length, self.inside)
            self.error += error
        longest = max(last - first for first, last in stack)
        whole = later
        while stack:
            first, last = stack.pop()
            count += 1
            if (self.bounded > self.prepared.system.varying or count + len(stack) > FEW) and not (tried or later.closed):
                tried = True
                found = self._by_volumes(whole)
                if found is not None:
                    return found
            forced = count + len(stack) >= MOST_SUBSTEPS or last - first <= 2e-3 * min(self.length, longest)
            found = self._substep(later, first, last, forced)
            if found is None:
                if not (self.bounded > self.prepared.system.varying and not tried):
                    middle = 0.5 * (first + last)
                    stack += [(first, middle), (middle, last)]
                else:
                    stack.append((first, last))
                continue
            later = found
            if not np.isfinite(later.logs).all():
                break
        if count >= MOST_SUBSTEPS:
            self.error = np.inf
        return later

    def _substep(self, later: Message, first: float, last: float, forced: bool) -> Message | None:
        """Return the message at the start of a substep; None where a shorter one, or another way, is needed."""
        (low, high), begins = later.ends, self.ends
        low, high = min(low, begins[0]), max(high, begins[1])
        least, most = self._noise(low, high, last - first)
        low, high = low - EXCURSION * most, high + EXCURSION * most  # paths from one support to the other leave both
        spacing = later.needed if self.inside.any() or later.closed else max(later.needed, RESOLVED * least)
        for attempt in range(7):
            window = _covering(later.window, low, high, spacing)
            if window.size > lw.LARGEST and not forced:
                return None
            gauge = self._gauge(window, self.bounded or last - first < self.length)
            psi, top = self._psi(later, window, gauge.values)
            found = self._attempt(psi, window, gauge, first, last)
            if found is None or not np.isfinite(found[0]).all() or not found[0].any():
                return later._replace(logs=np.full(len(later.logs), np.nan)) if forced else None
            moved, offset, error = found
            if gauge.modes is not None and not self._exact(moved, gauge, window, error):
                self.bounded = True
                return None
            look = lw.figures(moved, window.closed, self.accepted)
            coarse = look.aliasing > self.accepted and not (look.rough and look.aliasing < 1e-3 * self.prepared.tolerance)
            if not coarse or window.size >= lw.LARGEST or (look.rough and attempt > 1):
                break
            spacing = window.spacing / 1.5
        self.error += error + 2.0 * look.aliasing + 10.0 * max(look.left, look.right)
        needed = window.spacing * float(np.clip(look.resolving, 1.0, 2.0))
        moved = np.maximum(moved, 1e-300 * np.max(moved))
        origin, centre, spacing, _, closed, unit = window
        logs = np.log(moved / spacing) - gauge.values + (top + offset)
        kept = Message(logs, origin, centre, spacing, unit, closed, needed, later.error)
        if first == 0.0:
            return kept.between(*begins)
        counts = np.flatnonzero(moved > NOISE * np.max(moved))[[0, -1]]
        ends = window.offsets[counts]
        return kept.between(max(low, float(ends[0])), min(high, float(ends[1])))

    def _psi(self, later: Message, window: lw.Window, gauge: Array) -> tuple[Array, float]:
        """Return the values of psi on a grid times its spacing, divided by the exponential of the second number."""
        if window.closed or window.spacing <= 1.01 * later.spacing:
            logs = later.at(window.offsets) + gauge
            top = float(np.max(logs))
            values = window.spacing * np.exp(logs - top)
            return values if window.closed else values * _taper(window.offsets, later.ends, window.spacing), top
        # Integrals of psi with what the coarse grid resolves.
        fine = _covering(later.window, *later.ends, later.spacing)
        logs = later.at(fine.offsets) + lw.local_polynomial(gauge, window, fine.offsets)
        top = float(np.max(logs))
        values = fine.spacing * np.exp(logs - top) * _taper(fine.offsets, later.ends, fine.spacing)
        return lw.gathered(values, fine.offsets, window), top

    def by_kernel(self, later: Message, k: int) -> Message | None:
        """Return the message at the start of an interval whose kernel is Gaussian, None where it is not or needs many points."""
        prepared, report = self.prepared, Report()
        kernel = None if prepared.yau is None or later.closed else _line.kernel_of(prepared, k, later.window, self.rates, report)
        if kernel is None or not kernel.variance > 0:
            return None
        assert prepared.yau is not None
        deviation, (low, high), begins = float(np.sqrt(kernel.variance)), later.ends, self.ends
        if (high - low) > MOST_POINTS * WIDTH * deviation:
            return None
        spacing = min(max(later.needed, RESOLVED * deviation) / max(abs(kernel.scale), 1e-3), (begins[1] - begins[0]) / FEWEST)
        fine = _points(later.window, low, high, min(later.needed, WIDTH * deviation))
        new = _points(later.window, *begins, spacing)
        x, y, theta = fine.offsets, new.offsets, prepared.theta.real
        after = later.at(x) + prepared.yau.potential(fine.points, self.start + self.length, theta)
        logs = after - 0.5 * ((x - kernel.scale * y[:, None] - kernel.shift) / deviation) ** 2
        top = np.max(logs, axis=1)
        found = np.log(np.sum(np.exp(logs - top[:, None]), axis=1) * fine.spacing / (deviation * np.sqrt(2 * np.pi))) + top
        found += kernel.constant + y * (kernel.slope + kernel.curvature * y)
        found -= prepared.yau.potential(new.points, self.start, theta)
        self.error = report.time
        origin, centre, spacing, _, closed, unit = new
        return Message(found, origin, centre, spacing, unit, closed, new.spacing, later.error)

    def _by_volumes(self, later: Message) -> Message | None:
        """Return the message at the start of the interval from finite volumes, None where they do not serve."""
        state, window = self.state, self.state.window
        interval = self.start, self.length, self.inside, self.rates
        found = pulled_back(self.prepared, later.at, np.asarray(state.values).real, window, *interval)
        if found is None:
            return None
        new = _points(later.window, *self.ends, min(later.needed, window.spacing))
        values = found.at(new.offsets)
        self.error = found.error
        logs = np.log(np.maximum(values, 1e-300 * np.max(values))) + found.log_scale
        origin, centre, spacing, _, closed, unit = new
        return Message(logs, origin, centre, spacing, unit, closed, later.needed, later.error)

    def _noise(self, low: float, high: float, length: float) -> tuple[float, float]:
        """Return the smallest and the largest standard deviation of the noise of a substep between two offsets."""
        points = self.state.origin + np.linspace(low, high, 9)
        middle = self.start + 0.5 * self.length
        covariance = covariance_at(self.prepared.system, points, middle, self.prepared.theta.real) * np.ones(9)
        return float(np.sqrt(max(np.min(covariance), 0.0) * length)), float(np.sqrt(np.max(covariance) * length))

    def _attempt(
        self, values: Array, window: lw.Window, gauge: _Gauge, first: float, last: float
    ) -> tuple[Array, float, float] | None:
        """Return psi at the start of a substep, the logarithm of its scale, and its error; None asks for a shorter substep."""
        prepared, inside, length = self.prepared, self.inside, last - first
        steady = not prepared.system.varying
        if steady and gauge.modes is not None and not inside.any():
            decay = np.exp(-length * gauge.modes.rates)
            moved = gauge.modes.modes @ (decay * (gauge.modes.modes.T @ values))
            noise = 4e-16 * float(np.sqrt(np.sum(values * values))) * max(1.0, float(decay.max()))
            return moved, 0.0, noise / float(np.max(moved))
        times = self.start + first + length * (np.full(1, 0.5) if steady else GAUSS_NODES)
        drift, covariance, potential, constant = coefficients(prepared, window, times, inside, self.rates, values)
        generators = self._generators(window, gauge, drift, covariance)
        zeroth, moment = length * GAUSS_WEIGHTS, 2.0 * length * GAUSS_WEIGHTS * (GAUSS_NODES - 0.5)
        weights = [np.full(1, length)] if steady else [0.5 * zeroth - moment, 0.5 * zeroth + moment]
        offset, split = offset_of(sum(weights) @ potential, values)
        if split or any(np.any(w @ covariance < 0) for w in weights):
            return None
        parts = [generators(w) + np.diag(w @ potential - offset / len(weights)) for w in weights]
        error = 0.0
        if not steady:  # what the commutator-free integrator of order four omits, as in the filter
            total, difference = parts[0] + parts[1], parts[1] - parts[0]
            commutator = 0.25 * (total @ (difference @ values) - difference @ (total @ values))
            inner = slice(None) if window.closed else slice(PAD, -PAD)
            error = 5.0 * float(np.sum(np.abs(commutator[inner])) / np.sum(values)) ** (5.0 / 3.0)
            if error > MAGNUS * prepared.tolerance:
                return None
        moved = values
        for part in reversed(parts):
            moved, more = exponential_action(np.ascontiguousarray(part), moved)
            error += more
        return moved, offset + float(sum(weights) @ constant), error

    def _generators(self, window: lw.Window, gauge: _Gauge, drift: Array, covariance: Array) -> Any:
        """Return the function that integrates the operator of psi over time with given weights.

        G psi'' / 2 + (mu - G s') psi' + (G (s'^2 - s'') / 2 - mu s') psi.
        """
        first, second = derivatives(window.size, window.closed)
        scale = 1.0 if window.closed else window.spacing
        _, slope, _ = _fall(window.size, window.closed)
        spread = covariance if np.ndim(covariance) == np.ndim(drift) else np.asarray(covariance)[..., None]
        mu = drift + spread * slope / window.spacing

        def integrated(weights: Array) -> Array:
            if gauge.modes is not None and not self.prepared.system.varying:
                return -weights[0] * (gauge.modes.modes * gauge.modes.rates) @ gauge.modes.modes.T
            G, m = weights @ (spread * np.ones(window.size)), weights @ mu
            found = (0.5 * G / scale**2)[:, None] * second + ((m - G * gauge.slope) / scale)[:, None] * first
            return found + np.diag(0.5 * G * (gauge.slope**2 - gauge.curvature) - m * gauge.slope)

        return integrated

    def _exact(self, psi: Array, gauge: _Gauge, window: lw.Window, error: float) -> bool:
        """Return whether the error of psi, relative to its maximum, is small in the product with the density at the start."""
        density = _reliable(self.state, window)
        weights = np.where(density > 0.0, np.exp(np.log(density) - gauge.values), 0.0)
        top = float(np.max(psi))
        return bool(max(error, 1e-15) * top * np.sum(weights) < max(1e-9, 1e-2 * self.prepared.tolerance) * (weights @ psi))

    def _gauge(self, window: lw.Window, bounded: bool) -> _Gauge:
        """Return the gauge of the interval on a grid."""
        prepared = self.prepared
        if prepared.system.varying:
            return _bounded(_gauge_of(prepared, window, self.start + 0.5 * self.length), window)
        found: _Gauge = prepared.once(("gauge", window), lambda: _gauge_of(prepared, window, prepared.model.start))
        return _bounded(found, window) if bounded and not window.closed else found


class _Gauge(NamedTuple):
    """s, s' and s'' at the points of a grid (N,), and the decomposition of the operator where no coefficient depends on t."""

    values: Array
    slope: Array
    curvature: Array
    modes: Spectral | None


def _gauge_of(prepared: Prepared, window: lw.Window, t: float) -> _Gauge:
    """Return the gauge for the coefficients at a time; that of F alone where f or G is not smooth, or s is not periodic."""
    system, theta, spacing = prepared.system, prepared.theta.real, window.spacing
    fall, slope, curvature = _fall(window.size, window.closed)
    slope, curvature = slope / spacing, curvature / spacing**2
    with np.errstate(divide="ignore"):
        plain = _Gauge(np.log(fall), slope, curvature, None)
    if system.slope is None or system.spread is None:
        return plain._replace(values=np.zeros(window.size))
    points = window.points[:, None]
    G, spread = covariance_at(system, window.points, t, theta) * np.ones(window.size), np.zeros(window.size)
    if system.state_dependent:
        spread = finite(system.spread(points, t, theta)[:, 0])
    if not (G > 0).all():
        return plain._replace(values=np.zeros(window.size))
    f, f_slope = drift_at(system, window, t, theta), finite(system.slope(points, t, theta)[:, 0])
    nodes = (points + spacing * GAUSS_NODES).reshape(-1, 1)
    inner = finite(system.drift(nodes, t, theta)[:, 0]) / (covariance_at(system, nodes[:, 0], t, theta) * np.ones(len(nodes)))
    steps = spacing * (inner.reshape(window.size, -1) @ GAUSS_WEIGHTS)
    if window.closed and abs(np.sum(steps)) > 1e-12 * max(1.0, float(np.sum(np.abs(steps)))):
        return plain._replace(values=np.zeros(window.size))
    s = np.concatenate([np.zeros(1), np.cumsum(steps[:-1])]) - 0.5 * np.log(G)
    s = s - s[window.size // 2]
    mu, mu_slope = f + G * slope, f_slope + spread * slope + G * curvature
    own = (mu - 0.5 * spread) / G
    modes = None
    if not system.varying and window.size <= lw.SIZES[-1]:
        potential, between = 0.5 * ((mu - 0.5 * spread) ** 2 / G + mu_slope), float(G[0])
        if system.state_dependent:
            potential = potential - 0.25 * finite(system.spread(points, t, theta)[:, 1])
            between = covariance_between(system, window, t, theta)
        modes = Spectral(window.closed, spacing, between, potential, s)
    change = mu_slope / G - mu * spread / G**2
    if system.state_dependent:
        change = _derivative(own, spacing, window.closed)
    return _Gauge(s, own, change, modes)


def _bounded(gauge: _Gauge, window: lw.Window) -> _Gauge:
    """Return S = -B (1 - exp((s - top) / B)) + log F for the gauge s, without the decomposition."""
    if window.closed:
        return gauge._replace(modes=None)
    fall, slope, curvature = _fall(window.size, False)
    slope, curvature = slope / window.spacing, curvature / window.spacing**2
    s, first, second = gauge.values, gauge.slope - slope, gauge.curvature - curvature
    share = np.exp((s - np.max(s[PAD:-PAD])) / BOUND)
    share, first = np.minimum(share, 1.0), np.where(share < 1.0, first, 0.0)
    return _Gauge(-BOUND * (1.0 - share), share * first + slope, share * (second + first**2 / BOUND) + curvature, None)


def _derivative(values: Array, spacing: float, closed: bool) -> Array:
    """Return the derivative of a function on a grid by differences of order six."""
    found = np.gradient(values, spacing, edge_order=2)
    inner = sum(c * (np.roll(values, -j) - np.roll(values, j)) for j, c in ((1, 0.75), (2, -0.15), (3, 1 / 60))) / spacing
    return inner if closed else np.concatenate([found[:3], inner[3:-3], found[-3:]])


@np.errstate(all="ignore")
def density(prepared: Prepared, state: State, later: Message) -> Density:
    """Return the smoothed density."""
    found = _product(state, later)
    origin, centre, spacing, _, closed, unit = found.window
    return _line.density(prepared, State(found.values, origin, centre, spacing, unit, closed, state.error, state.log_floor))


BACKWARD: Backward[Prepared, State, Message] = Backward(message, step, smoothed, density, draw=draw)
