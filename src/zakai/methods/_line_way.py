"""A message of one state over one interval, backward in time.

A Gaussian kernel is a sum over a grid.  Else a grid covers the support of the message at the end of the interval, that of the
density at its start, and the paths between them; psi is moved by its decomposition, or by the exponential of its operator.  Where
rounding in psi counts, or the operator depends on t, finite volumes take the message back (`_line_volumes.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods import _line
from zakai.methods._line_attempt import MAGNUS
from zakai.methods._line_coefficients import coefficients, offset_of, resolved_parts
from zakai.methods._line_course import course_of, ends_of
from zakai.methods._line_gauge import Gauge, gauge_of, generator
from zakai.methods._line_message import FEWEST, PAD, Message, covering, points_of, reliable, support, taper
from zakai.methods._line_moves import Report
from zakai.methods._line_system import Prepared, State
from zakai.methods._line_tables import covariance_at
from zakai.methods._line_volumes import pulled_back
from zakai.numerics import line_window as lw
from zakai.numerics.line_adjoint import EXCURSION
from zakai.numerics.line_operator import Spectral, exponential_action
from zakai.numerics.line_panels import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line_polynomial import local_polynomial

Array = Any

MOST_SUBSTEPS = 500
ROUNDING = 1e-15  # of the maximum: smaller values of psi are not kept
NOISE = 1e-11  # of the maximum: what is rounding in psi
LAST = 1.0 / 64.0  # part of an interval over which a narrow message is taken back by itself
RESOLVED = 0.25  # spacing in standard deviations of the noise
WIDTH = 0.8  # spacing in standard deviations of a Gaussian kernel at which sums are integrals
TAIL = 4.0  # standard deviations of the noise beyond EXCURSION to where such a message matters
BEYOND = 200.0  # logarithm of the maximum over the values of a message beyond its ends
MOST_POINTS = 4000  # of such sums


def negligible(prepared: Prepared) -> float:
    """Return the values relative to the maximum that do not count."""
    return float(np.clip(1e-5 * prepared.tolerance, 1e-13, 1e-10))


def smoothing_tolerance(prepared: Prepared) -> float:
    """Return the error of an interval above which a smoother warns."""
    return max(prepared.tolerance, 1e-6)


def _decayed(values: Array, modes: Spectral, length: float) -> tuple[Array, float]:
    """Return exp(tau A) of values by a decomposition, and its rounding."""
    decay = np.exp(-length * modes.rates)
    noise = 4e-16 * float(np.sqrt(np.sum(values * values))) * max(1.0, float(decay.max()))
    return modes.modes @ (decay * (modes.modes.T @ values)), noise


class Way:
    """One interval backward in time; `error` adds up what its parts leave."""

    def __init__(self, prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State):
        self.prepared, self.k, self.inside, self.rates, self.state = prepared, k, inside, rates, state
        self.start, self.length = float(prepared.schedule.starts[k]), float(prepared.lengths[k])
        self.accepted = max(negligible(prepared), 30.0 * prepared.negligible)
        self.error, self.tolerance = 0.0, smoothing_tolerance(prepared)
        own = state.window
        first, last = support(np.asarray(state.values).real, 1e-13)
        self.ends = float(own.offsets[first]), float(own.offsets[last])

    def back(self, later: Message) -> Message:
        """Return the message at the start of the interval."""
        if not later.closed:
            found = self._by_kernel(later)
            if found is None and not (self.prepared.system.varying or self.prepared.system.rough):
                found = self._substep(later, 0.0, self.length, False)
            if found is None:
                later = self._eased(later)
                found = self._by_volumes(later)
            if found is not None:
                return found
        return self._in_parts(later)

    def _in_parts(self, later: Message) -> Message:
        """Return the same by as many substeps as are needed."""
        stack, count = [(0.0, self.length)], 0
        if self.prepared.system.varying:
            values = np.exp(later.logs - np.max(later.logs))
            stack, error = resolved_parts(self.prepared, values, later.window, self.start, self.length, self.inside)
            self.error += error
        longest = max(last - first for first, last in stack)
        while stack and np.isfinite(later.logs).all():
            first, last = stack.pop()
            count += 1
            forced = count + len(stack) >= MOST_SUBSTEPS or last - first <= 2e-3 * min(self.length, longest)
            found = self._substep(later, first, last, forced)
            if found is None:
                middle = 0.5 * (first + last)
                stack += [(first, middle), (middle, last)]
            else:
                later = found
        if count >= MOST_SUBSTEPS:
            self.error = np.inf
        return later

    def _eased(self, later: Message) -> Message:
        """Take a message that is far narrower than the noise of the interval back over the last part, which is left out then."""
        part, (low, high) = LAST * self.length, later.ends
        least, most = self._noise(low, high, part)
        if high - low > least:
            return later
        found = self._substep(later, self.length - part, self.length, False, (low - TAIL * most, high + TAIL * most))
        self.length -= 0.0 if found is None else part
        return later if found is None else found

    def _substep(
        self, later: Message, first: float, last: float, forced: bool, ends: tuple[float, float] | None = None
    ) -> Message | None:
        """Return the message at the start of a substep; None where a shorter one, or another way, is needed.

        The message there is wanted between `ends`, those of the density at the start of the interval by default.
        """
        begins = self.ends if ends is None else ends
        low, high = min(later.ends[0], begins[0]), max(later.ends[1], begins[1])
        least, most = self._noise(low, high, last - first)
        low, high = low - EXCURSION * most, high + EXCURSION * most  # paths from one support to the other leave both
        spacing = later.needed if self.inside.any() or later.closed else max(later.needed, RESOLVED * least)
        for attempt in range(7):
            window = covering(later.window, low, high, spacing)
            if window.size > lw.SIZES[-1] and not forced:
                return None
            gauge = self._gauge(window)
            psi, top = self._psi(later, window, gauge.values)
            found = self._attempt(psi, window, gauge, first, last)
            if found is None or not np.isfinite(found[0]).all() or not found[0].any():
                return later._replace(logs=np.full(len(later.logs), np.nan)) if forced else None
            moved, offset, error = found
            if gauge.modes is not None and not self._exact(moved, gauge, window, error, ends):
                if not forced:
                    return None
                error = np.inf
            look = lw.figures(moved, window.closed, self.accepted)
            coarse = look.aliasing > self.accepted and not (look.rough and look.aliasing < 1e-3 * self.tolerance)
            if not coarse or window.size >= lw.LARGEST or (look.rough and attempt > 1):
                break
            spacing = window.spacing / 1.5
        made = error + 2.0 * look.aliasing + 10.0 * max(look.left, look.right)
        if made > self.tolerance and not (later.closed or forced):
            return None
        self.error += made
        moved = np.maximum(moved, ROUNDING * np.max(moved))
        origin, centre, spacing, _, closed, unit = window
        logs = np.log(moved / spacing) - gauge.values + (top + offset)
        needed = spacing * float(np.clip(look.resolving, 1.0, 2.0))
        kept = Message(logs, origin, centre, spacing, unit, closed, needed, later.error)
        if first == 0.0:
            return kept.between(*self.ends)
        counts = np.flatnonzero(moved > NOISE * np.max(moved))[[0, -1]]
        reach = window.offsets[counts]
        return kept.between(max(low, float(reach[0])), min(high, float(reach[1])))

    def _psi(self, later: Message, window: lw.Window, gauge: Array) -> tuple[Array, float]:
        """Return the values of psi on a grid times its spacing, divided by the exponential of the second number."""
        if window.closed or window.spacing <= 1.01 * later.spacing:
            logs = later.at(window.offsets) + gauge
            top = float(np.max(logs))
            values = window.spacing * np.exp(logs - top)
            return values if window.closed else values * taper(window.offsets, later.ends, window.spacing), top
        # Integrals of psi with what the coarse grid resolves.
        fine = covering(later.window, *later.ends, later.spacing)
        logs = later.at(fine.offsets) + local_polynomial(gauge, window, fine.offsets)
        top = float(np.max(logs))
        values = fine.spacing * np.exp(logs - top) * taper(fine.offsets, later.ends, fine.spacing)
        return lw.gathered(values, fine.offsets, window), top

    def _by_kernel(self, later: Message) -> Message | None:
        """Return the message at the start of an interval whose kernel is Gaussian, None where it is not or needs many points."""
        prepared, report = self.prepared, Report()
        kernel = _line.kernel_of(prepared, self.k, later.window, self.rates, report)
        if kernel is None or prepared.yau is None or not kernel.variance > 0:
            return None
        deviation, (low, high), begins = float(np.sqrt(kernel.variance)), later.ends, self.ends
        if (high - low) > MOST_POINTS * WIDTH * deviation:
            return None
        spacing = min(max(later.needed, RESOLVED * deviation) / max(abs(kernel.scale), 1e-3), (begins[1] - begins[0]) / FEWEST)
        fine = points_of(later.window, low, high, min(later.spacing, WIDTH * deviation))
        new = points_of(later.window, *begins, spacing)
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
        narrow, state, window = self.length < self.prepared.lengths[self.k], self.state, self.state.window
        values = np.asarray(state.values).real
        interval = self.start, self.length, self.inside, float(np.sqrt(later.variance))
        course = course_of(self.prepared, values, window, ends_of(values, window), *interval)

        def density(offsets: Array) -> Array:
            return lw.density_at(values, window, offsets)

        def log_worth(offsets: Array) -> Array:
            (low, high), logs = later.ends, later.at(offsets)
            return np.where((offsets >= low) & (offsets <= high), logs, logs - BEYOND) if narrow else logs

        found = pulled_back(self.prepared, log_worth, density, course, self.start, self.inside, self.rates)
        if found is None:
            return None
        least, _ = self._noise(*self.ends, self.length)
        needed = min(max(later.needed, 0.5 * RESOLVED * least), window.spacing)
        new = points_of(later.window, *self.ends, needed)
        values = found.at(new.offsets)
        self.error += found.error
        logs = np.log(np.maximum(values, ROUNDING * np.max(values))) + found.log_scale
        origin, centre, spacing, _, closed, unit = new
        return Message(logs, origin, centre, spacing, unit, closed, needed, later.error)

    def _noise(self, low: float, high: float, length: float) -> tuple[float, float]:
        """Return the smallest and the largest standard deviation of the noise of a substep between two offsets."""
        points = self.state.origin + np.linspace(low, high, 9)
        middle = self.start + 0.5 * self.length
        covariance = covariance_at(self.prepared.system, points, middle, self.prepared.theta.real) * np.ones(9)
        return float(np.sqrt(max(np.min(covariance), 0.0) * length)), float(np.sqrt(np.max(covariance) * length))

    def _attempt(
        self, values: Array, window: lw.Window, gauge: Gauge, first: float, last: float
    ) -> tuple[Array, float, float] | None:
        """Return psi at the start of a substep, the logarithm of its scale, and its error; None asks for a shorter substep."""
        prepared, inside, length = self.prepared, self.inside, last - first
        steady = not prepared.system.varying
        if gauge.modes is not None and not inside.any():
            moved, noise = _decayed(values, gauge.modes, length)
            highest = float(np.max(moved))
            return (moved, 0.0, noise / highest) if highest > 0.0 else None
        times = self.start + first + length * (np.full(1, 0.5) if steady else GAUSS_NODES)
        drift, covariance, potential, constant = coefficients(prepared, window, times, inside, self.rates, values)
        zeroth, moment = length * GAUSS_WEIGHTS, 2.0 * length * GAUSS_WEIGHTS * (GAUSS_NODES - 0.5)
        weights = [np.full(1, length)] if steady else [0.5 * zeroth - moment, 0.5 * zeroth + moment]
        offset, split = offset_of(sum(weights) @ potential, values)
        if split or any(np.any(w @ covariance < 0) for w in weights):
            return None
        parts = [generator(window, gauge, drift, covariance, w) + np.diag(w @ potential - offset / len(weights)) for w in weights]
        moved, error = exponential_action(np.ascontiguousarray(parts[-1]), values)
        if not steady:  # what the commutator-free integrator of order four omits, as in the filter
            total, difference = parts[0] + parts[1], parts[1] - parts[0]
            commutator = 0.25 * (total @ (difference @ moved) - difference @ (total @ moved))
            inner = slice(None) if window.closed else slice(PAD, -PAD)
            omitted = 5.0 * float(np.sum(np.abs(commutator[inner])) / np.sum(moved)) ** (5.0 / 3.0)
            if omitted > MAGNUS * self.tolerance:
                return None
            moved, more = exponential_action(np.ascontiguousarray(parts[0]), moved)
            error += omitted + more
        return moved, offset + float(sum(weights) @ constant), error

    def _exact(
        self, psi: Array, gauge: Gauge, window: lw.Window, error: float, ends: tuple[float, float] | None = None
    ) -> bool:
        """Return whether the error of psi, relative to its maximum, is small in the product with the density at the start.

        With `ends`, whether it is small in the message itself between these.
        """
        own, top = self.state.window, float(np.max(psi))
        if ends is not None:
            between = (window.offsets >= ends[0]) & (window.offsets <= ends[1])
            return bool(max(error, 1e-15) * np.exp(np.ptp(gauge.values[between])) < 1e-2 * self.tolerance)
        if own.spacing < window.spacing:  # of which the grid may have no point
            density = reliable(self.state, own)
            density, offsets = density[density > 0.0], own.offsets[density > 0.0]
            log_gauge = local_polynomial(gauge.values, window, offsets)
            log_psi = local_polynomial(np.log(np.maximum(psi, ROUNDING * top) / top), window, offsets)
        else:
            density = reliable(self.state, window)
            inside = density > 0.0
            density, log_gauge, log_psi = density[inside], gauge.values[inside], np.log(np.maximum(psi[inside], 0.0) / top)
        logs, product = np.log(density) - log_gauge, np.log(density) - log_gauge + log_psi
        shift = np.max(product)
        return bool(max(error, 1e-15) * np.sum(np.exp(logs - shift)) < 1e-2 * self.tolerance * np.sum(np.exp(product - shift)))

    def _gauge(self, window: lw.Window) -> Gauge:
        """Return the gauge of the interval on a grid."""
        prepared = self.prepared
        if prepared.system.varying:
            return gauge_of(prepared, window, self.start + 0.5 * self.length)
        found: Gauge = prepared.once(("gauge", window), lambda: gauge_of(prepared, window, prepared.model.start))
        return found
