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

from zakai.methods.line.choice import predicted
from zakai.methods.line.coefficients import coefficients, covariance_at, resolved_parts
from zakai.methods.line.message import LOWEST, SURE, Message, reliable
from zakai.methods.line.model import finite
from zakai.methods.line.prepared import Prepared, State, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import (
    MOST_SUBSTEPS,
    Coefficients,
    Substep,
    Trial,
    magnus,
    parts_of_split,
)
from zakai.methods.line.update import state_of
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import MOST_PARTS
from zakai.numerics.line.backward import FEWEST, ROUNDING
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import SUPPORT, TRIALS

Array = Any

DEGREE = 8  # of the polynomial l that follows a density
DEPTH = -20.0  # logarithm of the density, relative to its maximum, beyond which l is linear
BLEND = 3.0  # spacings over which it becomes linear
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
        product = np.where(self.values.real > SURE * np.abs(self.values.imag), self.values.real, 0.0) * weights
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
    result = np.polynomial.Chebyshev.fit(z[inside], logs[inside], DEGREE, w=np.exp(0.125 * logs[inside]))
    ends, width = z[inside[[0, -1]]], BLEND * (z[1] - z[0])
    beyond = np.stack([ends[0] - z, z - ends[1]]) / width
    share, beyond = expit(beyond), width * np.logaddexp(0.0, beyond)
    inner, slopes = z + beyond[0] - beyond[1], result.deriv()(ends)
    slopes = np.array([max(slopes[0], 0.0), min(slopes[1], 0.0)])
    speed, change = 1.0 - share[0] - share[1], share * (1.0 - share) / width
    value, slope, curvature = result(inner), result.deriv()(inner), result.deriv(2)(inner)
    signs = np.array([-1.0, 1.0]) * slopes
    return np.stack([
        value + signs @ beyond,
        slope * speed + slopes @ share,
        curvature * speed**2 + slope * (change[0] - change[1]) + signs @ change,
    ])


MARGIN = 1.2  # of a wider grid
ROUGH = 1e-3  # of the tolerance that noise of psi may leave
BEYOND = 1.3  # length of such a grid, in ranges of the product


def by_moving_grid(
    prepared: Prepared, interval: TimeInterval, state: State, later: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the message at the start of interval k, and the error that the interval adds; None where this does not serve.

    Args:
        prepared: the system.
        interval: the interval.
        state: the filter's state at its start.
        later: the message at its end.
        accepted: the values relative to the maximum that do not count.
    """
    return _over_part(prepared, interval, (0.0, interval.length), state, later, accepted, False)


def by_fixed_grids(
    prepared: Prepared, interval: TimeInterval, state: State, later: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the same by fixed grids, each for a part of the interval in which the density changes by little."""
    length = interval.length
    count = _parts(prepared, later, interval.start + length, length)
    while count <= MOST_PARTS:
        cuts, result, error = np.linspace(0.0, length, count + 1).tolist(), later, 0.0
        parts = list(zip(cuts[:-1], cuts[1:], _states(prepared, interval, cuts, state), strict=True))
        for first, last, before in parts[::-1]:
            back = _over_part(prepared, interval, (first, last), before, result, accepted, True)
            if back is None:
                break
            result, error = back[0]._replace(needed=back[0].spacing), error + back[1]
        else:
            if error <= prepared.tolerance:
                return result._replace(needed=RELAXED * result.spacing), error
        count *= 3
    return None


def _states(prepared: Prepared, interval: TimeInterval, cuts: list[float], state: State) -> list[State]:
    """Return the filter's states at the cuts of an interval but the last."""
    result = [state]
    for first, last in zip(cuts[:-2], cuts[1:-1], strict=True):
        before = result[-1]
        propagated, _ = predicted(prepared, before.values, before.window, interval.part(first, last), Report())
        result.append(state_of(propagated.values, propagated.window, state.error, max(float(state.log_floor), LOWEST)))
    return result


def _over_part(
    prepared: Prepared, interval: TimeInterval, part: tuple[float, float], state: State, later: Message, accepted: float,
    is_fixed: bool,
) -> tuple[Message, float] | None:  # fmt: skip
    """Return the message at the start of a part of an interval, and the error that it adds; None where this does not serve."""
    spacing, error, noise, scaled = later.needed, 0.0, 0.0, later.scaled
    now, begin, centre, deviation, reach = None, later, later.mean, later.deviation, SUPPORT * later.deviation
    if is_fixed:  # the ends of the product
        centre, reach = 0.5 * (later.ends[0] + later.ends[1]), 0.5 * BEYOND * (later.ends[1] - later.ends[0])
    stack, count, tried = [part], 0, 0
    while stack:
        first, last = stack.pop()
        if now is None:
            if not is_fixed:
                reach = SUPPORT * deviation
            now = placed(begin, centre, deviation, spacing, reach * MARGIN ** (tried // 2), state if is_fixed else None)
            if now is None or tried > TRIALS:
                return None
            now = now._replace(scaled=scaled)
            if prepared.system.varying and last == part[1] and not tried:
                stack, error = resolved_parts(prepared, now.values, now.window, interval.part(*part))
                stack = [(part[0] + low, part[0] + high) for low, high in stack]
                first, last = stack.pop()
        trial, propagated = _substep(prepared, now, interval.part(first, last), is_fixed)
        count += 1
        if trial.split:
            if count + len(stack) >= MOST_SUBSTEPS or not np.isfinite(trial.error):
                return None
            stack += parts_of_split(prepared, first, last, trial.error)
            continue
        check = lw.grid_check(propagated.values.real, False, accepted)
        made = max(check.aliasing, 0.1 * check.left, 0.1 * check.right)
        if made <= min(accepted * 10.0**tried if not check.rough else 1.0, ROUGH * prepared.tolerance):
            error, noise, now, tried = error + trial.error, max(noise, made), propagated, 0
            continue
        # Take another grid about psi, then wider and finer ones.
        stack.append((first, last))
        if tried == 0:
            spacing = now.window.spacing
            if last < part[1]:
                begin, error = now.message(later.error, *now.reliable()), error + float(np.sum(np.abs(now.values.imag)))
            mean, variance = lw.moments(now.values.real, now.window)
            centre, deviation = centre if is_fixed else float(mean), float(np.sqrt(variance))
        tried, scaled = tried + 1, now.scaled
        if tried % 2 and check.aliasing > accepted:
            spacing /= 1.4
        now = None
    assert now is not None
    return _reliable_message(now, state, later.error, noise, error)


def _reliable_message(now: Psi, state: State, before: float, noise: float, error: float) -> tuple[Message, float] | None:
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
    result = now.message(before, first, last)._replace(scaled=now.scaled, mean=float(mean), deviation=float(np.sqrt(variance)))
    return (result, error) if np.isfinite(error) else None


def _parts(prepared: Prepared, later: Message, time: float, length: float) -> int:
    """Return in how many parts an interval that ends at a time has fixed grids."""
    variance = later.deviation**2
    speed, _, growth = _flow(prepared, later.origin + later.mean, 0.1 * later.deviation, variance, time, length)
    count = length * (abs(speed) / later.deviation + abs(growth))  # one deviation in each
    return max(int(np.ceil(count)), 1) if count <= MOST_PARTS else MOST_PARTS + 1  # NaN too


def _flow(prepared: Prepared, x: float, apart: float, variance: float, time: float, length: float) -> tuple[float, float, float]:
    """Return f and f' at a state, by differences, and the rate at which a message of this variance becomes wider forward."""
    theta, points = prepared.theta.real, x + apart * np.array([0.0, -1.0, 1.0])
    speed, below, above = finite(prepared.system.drift(points[:, None], time, theta)[:, 0]).tolist()
    slope = (above - below) / (2.0 * apart)
    noise = covariance_at(prepared.system, points[:1], time, theta).reshape(-1)[0] * length
    return speed, slope, slope - 0.5 * float(np.log1p(noise / variance)) / length


def _substep(
    prepared: Prepared, later: Psi, interval: TimeInterval, is_fixed: bool
) -> tuple[Trial, Psi]:
    """Return psi before an interval."""
    window, points = later.window, lw.index(later.window.size)
    (_, start, length, inside, rates), spacing, (_, derivative, curvature) = interval, window.spacing, later.gauges
    variance = float(lw.moments(later.values.real, window)[1])
    speed, slope, growth = _flow(prepared, window.origin + window.centre, spacing, variance, start + length, length)
    scaled = later.scaled * float(np.exp(-slope * length))
    if is_fixed:
        speed, slope, growth = 0.0, 0.0, 0.0

    def place(times: Array) -> tuple[Array, Array, Array]:
        """Return m - m(t), m' and s at times after the end."""
        s = np.exp(growth * times)
        by = np.expm1(slope * times) / slope if abs(slope) * length > 1e-8 else times
        return speed * by, speed * np.exp(slope * times), s

    def at(nodes: Array) -> Coefficients:
        by, velocity, s = (one[:, None] for one in place(length * (nodes - 1.0)))
        shifts = by + (s - 1.0) * spacing * points
        times = start + length * nodes
        f, G, V, constant = coefficients(prepared, window, times, inside, rates, later.values, shifts)
        d = (f - velocity) / (s * spacing) - growth * points
        g = G.reshape(len(times), -1) / (s * spacing) ** 2
        added = (0.5 * g * derivative - d) * derivative - 0.5 * g * curvature
        return d - g * derivative, g if G.ndim > 1 else g[:, 0], V + added, constant

    by, _, s = place(np.array([-length]))
    unit = lw.Window(0.0, 0.0, 1.0, window.size, False, 1.0)
    trial = magnus(prepared, later.values, unit, Substep(start, length, inside, rates), at, True, not is_fixed)
    total = float(np.sum(trial.values.real))
    before = window._replace(centre=window.centre + float(by[0]), spacing=spacing * float(s[0]))
    scale = later.scale + float(trial.offset) + float(np.log(total))
    return trial, later._replace(values=trial.values / total, window=before, scale=scale, scaled=scaled)
