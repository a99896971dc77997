"""A message of one state over one interval, backward in time, on grids that move and scale with it or are fixed.

What is moved is psi = e^l b.  On a grid that moves and scales with b, x = m(t) + s(t) z, with m' = f(m) and an s that grows as
the width of b, l is a quadratic polynomial of z, so that psi at the end of the interval is about the smoothed density:

    -psi_t = (d - g l') psi_z + g psi_zz / 2 + (V - d l' + g (l'^2 - l'') / 2) psi,
    d = (f(x, t) - m' - (x - m) s' / s) / s,    g = G / s^2.

On a fixed grid l follows the logarithm of the filter's density at the start, so that psi is the smoothed density there; an
interval in which the density changes much has several parts.  The same operators take back an estimate of the error of psi, by
rounding and by what is not known of b beyond its ends: where it is large b is not retained.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.message import FEWEST, Message, reliable
from zakai.methods.line.model import finite
from zakai.methods.line.prepared import Prepared, State
from zakai.methods.line.transition import (
    MOST_SUBSTEPS,
    Attempt,
    Coefficients,
    Report,
    Substep,
    by_substeps,
    magnus,
    parts_of_split,
)
from zakai.methods.line.update import state_of
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import support

Array = Any

ROUNDING = 1e-15  # of the maximum: the error of psi by rounding
DEGREE = 8  # of the polynomial l that follows a density
DEPTH = -20.0  # logarithm of the density, relative to its maximum, beyond which l is linear
BLEND = 3.0  # spacings over which it becomes linear
UNSURE = 10.0  # errors of psi from which its values count
BULK = 1e-7  # of the maximum: there smaller values may be tails
NEAR = 5  # points of a message that tell the curvature of its logarithm beyond an end
STEEP = 3.0  # least fall beyond the ends of a message, in deviations
RELAXED = 4.0  # spacings that a message may need: its product with the density shows whether it does


class Psi(NamedTuple):
    """psi (N,) at the points of a grid, of sum one, with the logarithm of the sum before.

    The imaginary part of `values` is an estimate of the error of psi, which the same operators take back.  The rows of `gauges`
    (3, N) are l and its two derivatives, in spacings; the drift has made psi wider by `scaled`.
    """

    values: Array
    window: lw.Window
    gauges: Array
    scale: float
    scaled: float = 1.0

    def message(self, error: float, first: int, last: int) -> Message:
        """Return b from one point to another."""
        here, window = slice(first, last + 1), part_of(self.window, first, last)
        logs = np.log(self.values.real[here]) - self.gauges[0][here] + self.scale
        return Message.of(logs, window, RELAXED * self.window.spacing, error)

    def reliable(self, weights: Array | float = 1.0) -> tuple[int, int]:
        """Return the first and the last point of psi times weights that are no noise, as far outward as this falls."""
        product = np.where(self.values.real > UNSURE * np.abs(self.values.imag), self.values.real, 0.0) * weights
        first, last = support(product, BULK)
        while first > 0 and 0.0 < product[first - 1] < product[first]:
            first -= 1
        while last < len(product) - 1 and 0.0 < product[last + 1] < product[last]:
            last += 1
        return first, last


def part_of(window: lw.Window, first: int, last: int) -> lw.Window:
    """Return the grid from one point to another."""
    size = last - first + 1
    return window._replace(size=size, centre=float(window.offsets[first + size // 2]))


def placed(later: Message, centre: float, deviation: float, spacing: float, reach: float, state: State | None) -> Psi | None:
    """Return psi of a message on a grid about a mean, None where that is too large or psi is not finite.

    Beyond the ends of the message psi differs from a Gaussian by a factor.  With a state l follows its density.
    """
    count = 2.0 * reach / spacing
    if not count <= lw.LARGEST:
        return None
    window = later.window._replace(centre=centre, spacing=spacing, size=lw.size_for(count))
    deviation /= spacing
    ends = np.array(later.ends)
    z, inner = lw.index(window.size) / deviation, np.clip(window.offsets, *ends)
    at, logs = (inner - centre) / (spacing * deviation), later.at(inner)
    if not np.isfinite(logs).all():
        return None
    c2, c1, c0 = np.polyfit(at, logs, 2, w=np.exp(-0.25 * z * z))
    curvature = min(-1.0 - 2.0 * c2, 0.0)
    gauges = np.stack([z * (0.5 * curvature * z - c1), curvature * z - c1, np.full(len(z), curvature)])
    density = np.zeros(0) if state is None else reliable(state, window)
    if np.count_nonzero(density > np.exp(DEPTH) * np.max(density, initial=0.0)) > 2 * DEGREE:
        gauges = _logarithms(density, z)
    # Beyond its ends the message is continued with its slopes, and psi falls.
    outer, unit = (ends - centre) / (spacing * deviation), later.spacing / (spacing * deviation)
    slopes = (later.logs[[2, -1]] - later.logs[[0, -3]]) / (2.0 * unit) + np.interp(outer, z, gauges[1])
    curvatures = np.abs(np.diff(later.logs, 2)) / unit**2
    left, right = np.minimum(z - outer[0], 0.0), np.maximum(z - outer[1], 0.0)
    exponents = logs + np.where(left + right == 0.0, gauges[0], np.interp(at, z, gauges[0]))
    exponents += max(slopes[0], STEEP) * left + min(slopes[1], -STEEP) * right
    top = float(np.max(exponents))
    values = np.exp(exponents - top)
    total = float(np.sum(values))
    if not np.isfinite(total):
        return None
    unknown = np.max(curvatures[:NEAR]) * left**2 + np.max(curvatures[-NEAR:]) * right**2
    values = values + 1j * (values * np.minimum(unknown, 1.0) + ROUNDING)
    scales = deviation ** -np.arange(3.0)[:, None]
    return Psi(values / total, window, gauges * scales, top + float(np.log(total)))


def _logarithms(density: Array, z: Array) -> Array:
    """Return a polynomial near the logarithm of a density (N,) at points (N,), linear in its tails, and its derivatives."""
    logs = np.log(np.maximum(density, 1e-300) / np.max(density))
    inside = np.flatnonzero(logs > DEPTH)
    found = np.polynomial.Chebyshev.fit(z[inside], logs[inside], DEGREE, w=np.exp(0.125 * logs[inside]))
    ends, width = z[inside[[0, -1]]], BLEND * (z[1] - z[0])
    beyond = np.stack([ends[0] - z, z - ends[1]]) / width
    share, beyond = expit(beyond), width * np.logaddexp(0.0, beyond)
    inner, slopes = z + beyond[0] - beyond[1], found.deriv()(ends)
    slopes = np.array([max(slopes[0], 0.0), min(slopes[1], 0.0)])
    speed, change = 1.0 - share[0] - share[1], share * (1.0 - share) / width
    value, slope, curvature = found(inner), found.deriv()(inner), found.deriv(2)(inner)
    signs = np.array([-1.0, 1.0]) * slopes
    return np.stack([
        value + signs @ beyond,
        slope * speed + slopes @ share,
        curvature * speed**2 + slope * (change[0] - change[1]) + signs @ change,
    ])


WIDTH = 8.8  # standard deviations of psi from its mean to the ends of a grid
MARGIN = 1.2  # of a wider grid
ROUGH = 1e-3  # of the tolerance that noise of psi may leave
MOST_GRIDS = 7  # that are finer or wider
STANDS = 1.0  # deviations by which a message may move and change its width on a grid that stands
BEYOND = 1.3  # length of such a grid, in ranges of the product
MOST_PARTS = 16  # of an interval
NOISE = -32.0  # logarithm of the error of small values of a density within an interval, relative to the largest


class _Interval(NamedTuple):
    """An interval: when it begins, and which increments act within it, at which rates."""

    start: float
    inside: np.ndarray
    rates: np.ndarray


def by_moving_grid(
    prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State, later: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the message at the start of interval k, and the error that the interval adds; None where this does not serve.

    Args:
        prepared: the system.
        k: the interval.
        inside, rates: which increments act within it, and their rates.
        state: the filter's state at its start.
        later: the message at its end.
        accepted: the values relative to the maximum that do not count.
    """
    interval = _Interval(float(prepared.schedule.starts[k]), inside, rates)
    return _taken_back(prepared, interval, (0.0, float(prepared.lengths[k])), state, later, accepted, False)


def by_standing_grids(
    prepared: Prepared, k: int, inside: np.ndarray, rates: np.ndarray, state: State, later: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the same by grids that stand, each for a part of the interval in which the density changes by little."""
    interval, length = _Interval(float(prepared.schedule.starts[k]), inside, rates), float(prepared.lengths[k])
    count = _parts(prepared, later, interval.start + length, length)
    while count <= MOST_PARTS:
        cuts, found, error = np.linspace(0.0, length, count + 1).tolist(), later, 0.0
        parts = list(zip(cuts[:-1], cuts[1:], _states(prepared, interval, cuts, state), strict=True))
        for first, last, before in parts[::-1]:
            back = _taken_back(prepared, interval, (first, last), before, found, accepted, True)
            if back is None:
                break
            found, error = back[0]._replace(needed=back[0].spacing), error + back[1]
        else:
            if error <= prepared.tolerance:
                return found._replace(needed=RELAXED * found.spacing), error
        count *= 3
    return None


def _states(prepared: Prepared, interval: _Interval, cuts: list[float], state: State) -> list[State]:
    """Return the filter's states at the cuts of an interval but the last."""
    found, (start, inside, rates) = [state], interval
    for first, last in zip(cuts[:-2], cuts[1:-1], strict=True):
        moved = by_substeps(prepared, found[-1].values, found[-1].window, start + first, last - first, inside, rates, Report())
        found.append(state_of(moved.values, moved.window, state.error, max(float(state.log_floor), NOISE)))
    return found


def _taken_back(
    prepared: Prepared, interval: _Interval, part: tuple[float, float], state: State, later: Message, accepted: float,
    stands: bool,
) -> tuple[Message, float] | None:  # fmt: skip
    """Return the message at the start of a part of an interval, and the error that it adds; None where this does not serve."""
    start, inside, rates = interval
    spacing, error, noise, scaled = later.needed, 0.0, 0.0, later.scaled
    now, begin, centre, deviation, reach = None, later, later.mean, later.deviation, WIDTH * later.deviation
    if stands:  # the ends of the product
        centre, reach = 0.5 * (later.ends[0] + later.ends[1]), 0.5 * BEYOND * (later.ends[1] - later.ends[0])
    stack, count, tried = [part], 0, 0
    while stack:
        first, last = stack.pop()
        if now is None:
            if not stands:
                reach = WIDTH * deviation
            now = placed(begin, centre, deviation, spacing, reach * MARGIN ** (tried // 2), state if stands else None)
            if now is None or tried > MOST_GRIDS:
                return None
            now = now._replace(scaled=scaled)
            if prepared.system.varying and last == part[1] and not tried:
                stack, error = resolved_parts(prepared, now.values, now.window, start + part[0], part[1] - part[0], inside)
                stack = [(part[0] + low, part[0] + high) for low, high in stack]
                first, last = stack.pop()
        attempt, moved = _substep(prepared, now, start, first, last, inside, rates, stands)
        count += 1
        if attempt.split:
            if count + len(stack) >= MOST_SUBSTEPS or not np.isfinite(attempt.error):
                return None
            stack += parts_of_split(prepared, first, last, attempt.error)
            continue
        look = lw.figures(moved.values.real, False, accepted)
        made = max(look.aliasing, 0.1 * look.left, 0.1 * look.right)
        if made <= min(accepted * 10.0**tried if not look.rough else 1.0, ROUGH * prepared.tolerance):
            error, noise, now, tried = error + attempt.error, max(noise, made), moved, 0
            continue
        # Another grid about psi as it is, then wider and finer ones.
        stack.append((first, last))
        if tried == 0:
            spacing = now.window.spacing
            if last < part[1]:
                begin, error = now.message(later.error, *now.reliable()), error + float(np.sum(np.abs(now.values.imag)))
            mean, variance = lw.moments(now.values.real, now.window)
            centre, deviation = centre if stands else float(mean), float(np.sqrt(variance))
        tried, scaled = tried + 1, now.scaled
        if tried % 2 and look.aliasing > accepted:
            spacing /= 1.4
        now = None
    assert now is not None
    return _kept(now, state, later.error, noise, error)


def _kept(now: Psi, state: State, before: float, noise: float, error: float) -> tuple[Message, float] | None:
    """Return the message where its product with the density is reliable, and the error with that of this product."""
    density, highest = reliable(state, now.window), float(np.max(now.values.real))
    logs = np.where(density > 0.0, np.log(density) - now.gauges[0], -np.inf)
    shift = float(np.max(logs + np.log(np.maximum(now.values.real, 0.0))))
    if not np.isfinite(shift):
        return None
    weights = np.exp(np.minimum(logs - shift, 600.0))
    first, last = now.reliable(weights)
    if last - first < FEWEST:
        return None
    here, window = slice(first, last + 1), part_of(now.window, first, last)
    product, wrong = weights[here] * now.values.real[here], weights[here] * (np.abs(now.values.imag[here]) + noise * highest)
    total = float(np.sum(product))
    mean, variance = lw.moments(product / total, window)
    moment = 1.0 + (window.offsets - mean) ** 2 / variance  # the error of the variance by that of a point
    padded = np.concatenate([[0.0], density, [0.0]])
    wrong[[0, -1]] += product[[0, -1]] * (padded[[first, last + 2]] > 0.0)  # beyond the ends
    error += float(wrong @ moment) / total
    found = now.message(before, first, last)._replace(scaled=now.scaled, mean=float(mean), deviation=float(np.sqrt(variance)))
    return (found, error) if np.isfinite(error) else None


def _parts(prepared: Prepared, later: Message, time: float, length: float) -> int:
    """Return in how many parts grids stand while an interval that ends at a time is taken back."""
    variance = later.deviation**2
    speed, _, growth = _flow(prepared, later.origin + later.mean, 0.1 * later.deviation, variance, time, length)
    count = length * (abs(speed) / later.deviation + abs(growth)) / STANDS
    return max(int(np.ceil(count)), 1) if count <= MOST_PARTS else MOST_PARTS + 1  # NaN too


def _flow(prepared: Prepared, x: float, apart: float, variance: float, time: float, length: float) -> tuple[float, float, float]:
    """Return f and f' at a state, by differences, and the rate at which a message of this variance becomes wider forward."""
    theta, points = prepared.theta.real, x + apart * np.array([0.0, -1.0, 1.0])
    speed, below, above = finite(prepared.system.drift(points[:, None], time, theta)[:, 0]).tolist()
    slope = (above - below) / (2.0 * apart)
    noise = covariance_at(prepared.system, points[:1], time, theta).reshape(-1)[0] * length
    return speed, slope, slope - 0.5 * float(np.log1p(noise / variance)) / length


def _substep(
    prepared: Prepared, later: Psi, start: float, first: float, last: float, inside: np.ndarray, rates: np.ndarray,
    stands: bool,
) -> tuple[Attempt, Psi]:  # fmt: skip
    """Return psi before the part from start + first to start + last of an interval."""
    window, points = later.window, lw.index(later.window.size)
    length, spacing, (_, derivative, curvature) = last - first, window.spacing, later.gauges
    variance = float(lw.moments(later.values.real, window)[1])
    speed, slope, growth = _flow(prepared, window.origin + window.centre, spacing, variance, start + last, length)
    scaled = later.scaled * float(np.exp(-slope * length))
    if stands:
        speed, slope, growth = 0.0, 0.0, 0.0

    def place(times: Array) -> tuple[Array, Array, Array]:
        """Return m - m(t), m' and s at times after the end."""
        s = np.exp(growth * times)
        by = np.expm1(slope * times) / slope if abs(slope) * length > 1e-8 else times
        return speed * by, speed * np.exp(slope * times), s

    def at(nodes: Array) -> Coefficients:
        by, velocity, s = (one[:, None] for one in place(length * (nodes - 1.0)))
        shifts = by + (s - 1.0) * spacing * points
        times = start + first + length * nodes
        f, G, V, constant = coefficients(prepared, window, times, inside, rates, later.values, shifts)
        d = (f - velocity) / (s * spacing) - growth * points
        g = G.reshape(len(times), -1) / (s * spacing) ** 2
        added = (0.5 * g * derivative - d) * derivative - 0.5 * g * curvature
        return d - g * derivative, g if G.ndim > 1 else g[:, 0], V + added, constant

    by, _, s = place(np.array([-length]))
    unit = lw.Window(0.0, 0.0, 1.0, window.size, False, 1.0)
    attempt = magnus(prepared, later.values, unit, Substep(start + first, length, inside, rates), at, True, not stands)
    total = float(np.sum(attempt.values.real))
    before = window._replace(centre=window.centre + float(by[0]), spacing=spacing * float(s[0]))
    scale = later.scale + float(attempt.offset) + float(np.log(total))
    return attempt, later._replace(values=attempt.values / total, window=before, scale=scale, scaled=scaled)
