"""A message of one state over one interval, backward in time, on a grid that moves and scales with it.

What is moved is psi = e^l b on a grid x = m(t) + s(t) z, with m' = f(m) and an s that grows as the width of b; l is a quadratic
polynomial of z, so that psi at the end of the interval is about the smoothed density:

    -psi_t = (d - g l') psi_z + g psi_zz / 2 + (V - d l' + g (l'^2 - l'') / 2) psi,
    d = (f(x, t) - m' - (x - m) s' / s) / s,    g = G / s^2.

The same operators take back an estimate of the error of psi, by rounding and by what is not known of b beyond its ends: where it
is large b is not retained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.line.coefficients import Coefficients, coefficients, covariance_at, resolved_parts
from zakai.methods.line.message import SURE_OF_DENSITY, Message, reliable
from zakai.methods.line.model import finite
from zakai.methods.line.prepared import Prepared, State, TimeInterval
from zakai.methods.line.transition import MOST_SUBSTEPS, Substep, Trial, magnus, parts_of_split
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.backward import FEWEST, SMALLEST
from zakai.numerics.line.density import support
from zakai.numerics.line.resolution import SUPPORT, TRIALS, noise_bound

BULK = 1e-7  # of the maximum: there smaller values may be tails
POINTS_OF_CURVATURE = 5  # points of a message that tell the curvature of its logarithm beyond an end
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
        product = np.where(self.values.real > SURE_OF_DENSITY * np.abs(self.values.imag), self.values.real, 0.0) * weights
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


NARROWEST = 0.3  # deviation of the product, in spacings, that a grid can hold


def placed(message: Message, centre: float, deviation: float, spacing: float, reach: float) -> Psi | None:
    """Return psi of a message on a grid about a mean, None where that is too large or too coarse, or psi is not finite.

    Beyond the ends of the message psi differs from a Gaussian by a factor.
    """
    count = 2.0 * reach / spacing
    if not count <= lw.LARGEST:
        return None
    window = message.window._replace(centre=centre, spacing=spacing, size=lw.size_for(count))
    deviation /= spacing
    if not deviation > NARROWEST:
        return None
    ends = np.array(message.ends)
    z, inner = lw.index(window.size) / deviation, np.clip(window.offsets, *ends)
    at, logs = (inner - centre) / (spacing * deviation), message.at(inner)
    if not np.isfinite(logs).all():
        return None
    c2, c1, c0 = np.polyfit(at, logs, 2, w=np.exp(-0.25 * z * z))
    curvature = min(-1.0 - 2.0 * c2, 0.0)
    gauges = np.stack([z * (0.5 * curvature * z - c1), curvature * z - c1, np.full(len(z), curvature)])
    # Beyond its ends the message is continued with its slopes, and psi falls.
    outer, unit = (ends - centre) / (spacing * deviation), message.spacing / (spacing * deviation)
    slopes = (message.logs[[2, -1]] - message.logs[[0, -3]]) / (2.0 * unit) + np.interp(outer, z, gauges[1])
    curvatures = np.abs(np.diff(message.logs, 2)) / unit**2
    left, right = np.minimum(z - outer[0], 0.0), np.maximum(z - outer[1], 0.0)
    exponents = logs + np.where(left + right == 0.0, gauges[0], np.interp(at, z, gauges[0]))
    exponents += max(slopes[0], STEEP) * left + min(slopes[1], -STEEP) * right
    top = float(np.max(exponents))
    values = np.exp(exponents - top)
    total = float(np.sum(values))
    if not np.isfinite(total):
        return None
    unknown = np.max(curvatures[:POINTS_OF_CURVATURE]) * left**2 + np.max(curvatures[-POINTS_OF_CURVATURE:]) * right**2
    values = values + 1j * (values * np.minimum(unknown, 1.0) + SMALLEST)
    scales = deviation ** -np.arange(3.0)[:, None]
    return Psi(values / total, window, gauges * scales, top + float(np.log(total)))


WIDER_GRID = 1.2  # of a wider grid


def by_moving_grid(
    prepared: Prepared, interval: TimeInterval, state: State, message: Message, accepted: float
) -> tuple[Message, float] | None:
    """Return the message at the start of interval k, and the error that the interval adds; None where this does not serve.

    Args:
        state: the filter's state at its start.
        message: the message at its end.
        accepted: the values relative to the maximum that do not count.
    """
    spacing, error, noise, scaled = message.needed, 0.0, 0.0, message.scaled
    psi, source, centre, deviation = None, message, message.mean, message.deviation
    stack, count, tried = [(0.0, interval.length)], 0, 0
    while stack:
        first, last = stack.pop()
        if psi is None:
            psi = placed(source, centre, deviation, spacing, SUPPORT * deviation * WIDER_GRID ** (tried // 2))
            if psi is None or tried > TRIALS:
                return None
            psi = psi._replace(scaled=scaled)
            if prepared.system.varying and last == interval.length and not tried:
                stack, error = resolved_parts(prepared, psi.values, psi.window, interval)
                first, last = stack.pop()
        trial, propagated = _substep(prepared, psi, interval.part(first, last))
        count += 1
        if trial.split:
            if count + len(stack) >= MOST_SUBSTEPS or not np.isfinite(trial.error):
                return None
            stack += parts_of_split(prepared, first, last, trial.error)
            continue
        check = lw.grid_check(propagated.values.real, False, accepted)
        made = max(check.aliasing, 0.1 * check.left, 0.1 * check.right)
        if made <= min(accepted * 10.0**tried if not check.rough else 1.0, noise_bound(prepared.tolerance)):
            error, noise, psi, tried = error + trial.error, max(noise, made), propagated, 0
            continue
        # Take another grid about psi, then wider and finer ones.
        stack.append((first, last))
        if tried == 0:
            spacing = psi.window.spacing
            if last < interval.length:
                source, error = psi.message(message.error, *psi.reliable()), error + float(np.sum(np.abs(psi.values.imag)))
            mean, variance = lw.moments(psi.values.real, psi.window)
            centre, deviation = float(mean), float(np.sqrt(variance))
        tried, scaled = tried + 1, psi.scaled
        if tried % 2 and check.aliasing > accepted:
            spacing /= 1.4
        psi = None
    assert psi is not None
    return _reliable_message(psi, state, message.error, noise, error)


def _reliable_message(psi: Psi, state: State, before: float, noise: float, error: float) -> tuple[Message, float] | None:
    """Return the message where its product with the density is reliable, and the error with that of this product."""
    density, highest = reliable(state, psi.window), float(np.max(psi.values.real))
    logs = np.where(density > 0.0, np.log(density) - psi.gauges[0], -np.inf)
    shift = float(np.max(logs + np.log(np.maximum(psi.values.real, 0.0))))
    if not np.isfinite(shift):
        return None
    weights = np.exp(np.minimum(logs - shift, 600.0))
    first, last = psi.reliable(weights)
    if last - first < FEWEST:
        return None
    here, window = slice(first, last + 1), part_of(psi.window, first, last)
    product, wrong = weights[here] * psi.values.real[here], weights[here] * (np.abs(psi.values.imag[here]) + noise * highest)
    total = float(np.sum(product))
    mean, variance = lw.moments(product / total, window)
    moment = 1.0 + (window.offsets - mean) ** 2 / variance  # the error of the variance by that of a point
    padded = np.concatenate([[0.0], density, [0.0]])
    wrong[[0, -1]] += product[[0, -1]] * (padded[[first, last + 2]] > 0.0)  # beyond the ends
    error += float(wrong @ moment) / total
    result = psi.message(before, first, last)._replace(scaled=psi.scaled, mean=float(mean), deviation=float(np.sqrt(variance)))
    return (result, error) if np.isfinite(error) else None


def _flow(prepared: Prepared, x: float, apart: float, variance: float, time: float, length: float) -> tuple[float, float, float]:
    """Return f and f' at a state, by differences, and the rate at which a message of this variance becomes wider forward."""
    theta, points = prepared.theta.real, x + apart * np.array([0.0, -1.0, 1.0])
    speed, below, above = finite(prepared.system.drift(points[:, None], time, theta)[:, 0]).tolist()
    slope = (above - below) / (2.0 * apart)
    noise = covariance_at(prepared.system, points[:1], time, theta).reshape(-1)[0] * length
    return speed, slope, slope - 0.5 * float(np.log1p(noise / variance)) / length


def _substep(prepared: Prepared, psi: Psi, interval: TimeInterval) -> tuple[Trial, Psi]:
    """Return psi before an interval."""
    window, points = psi.window, lw.index(psi.window.size)
    (_, start, length, inside, rates), spacing, (_, derivative, curvature) = interval, window.spacing, psi.gauges
    variance = float(lw.moments(psi.values.real, window)[1])
    speed, slope, growth = _flow(prepared, window.origin + window.centre, spacing, variance, start + length, length)
    scaled = psi.scaled * float(np.exp(-slope * length))

    def place(times: Array) -> tuple[Array, Array, Array]:
        """Return m - m(t), m' and s at times after the end."""
        s = np.exp(growth * times)
        by = np.expm1(slope * times) / slope if abs(slope) * length > 1e-8 else times
        return speed * by, speed * np.exp(slope * times), s

    def at(nodes: Array) -> Coefficients:
        by, velocity, s = (one[:, None] for one in place(length * (nodes - 1.0)))
        shifts = by + (s - 1.0) * spacing * points
        times = start + length * nodes
        f, G, V, constant = coefficients(prepared, window, times, inside, rates, psi.values, shifts)
        d = (f - velocity) / (s * spacing) - growth * points
        g = G.reshape(len(times), -1) / (s * spacing) ** 2
        added = (0.5 * g * derivative - d) * derivative - 0.5 * g * curvature
        return Coefficients(d - g * derivative, g if G.ndim > 1 else g[:, 0], V + added, constant)

    by, _, s = place(np.array([-length]))
    unit = lw.Window(0.0, 0.0, 1.0, window.size, False, 1.0)
    trial = magnus(prepared, psi.values, unit, Substep(start, length, inside, rates), at, True, True)
    total = float(np.sum(trial.values.real))
    before = window._replace(centre=window.centre + float(by[0]), spacing=spacing * float(s[0]))
    scale = psi.scale + float(trial.offset.real) + float(np.log(total))
    return trial, psi._replace(values=trial.values / total, window=before, scale=scale, scaled=scaled)
