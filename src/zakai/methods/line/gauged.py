"""A message of one state over one interval, backward in time, on a grid that moves and scales with it.

In x = m(t) + s(t) z, with m' = f(m) and an s that grows as the width of a message b, this one keeps its width.  What is moved is
psi = e^l b with a quadratic polynomial l of z, so that psi at the end of the interval is about the smoothed density:

    -psi_t = (d - g l') psi_z + g psi_zz / 2 + (V - d l' + g (l'^2 - l'') / 2) psi,
    d = (f(x, t) - m' - (x - m) s' / s) / s,    g = G / s^2.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.attempt import Attempt, Coefficients, Substep, magnus, parts_of_split
from zakai.methods.line.coefficients import coefficients, resolved_parts
from zakai.methods.line.message import Message, reliable
from zakai.methods.line.moves import MOST_SUBSTEPS
from zakai.methods.line.system import Prepared, State
from zakai.methods.line.tables import covariance_at, finite
from zakai.numerics.line import window as lw

Array = Any

WIDTH = 8.8  # standard deviations of psi from its mean to the ends of a grid
MARGIN = 1.2  # of a wider grid
ROUNDING = 1e-15  # of the maximum: smaller values are not kept
ROUGH = 1e-3  # of the tolerance that noise of psi may leave
MOST_GRIDS = 7  # that are finer or wider
RELAXED = 4.0  # spacings that a message may need: its product with the density shows whether it does


class _Psi(NamedTuple):
    """psi (N,) at the points of a grid, of sum one, with the logarithm of the sum before.

    l is slope i + curvature i^2 / 2 at the points i of the grid, in its spacings; the drift has made psi wider by `scaled`.
    """

    values: Array
    window: lw.Window
    slope: float
    curvature: float
    scale: float
    scaled: float = 1.0

    @property
    def gauge(self) -> Array:
        """l (N,)."""
        points = lw.index(self.window.size)
        return points * (self.slope + 0.5 * self.curvature * points)

    def kept(self, noise: float) -> tuple[int, int]:
        """Return the first and the last point around the maximum with values above a noise relative to it."""
        small, top = np.flatnonzero(self.values < 10.0 * noise * np.max(self.values)), int(np.argmax(self.values))
        at = int(np.searchsorted(small, top))
        first = int(small[at - 1]) + 1 if at > 0 else 0
        last = int(small[at]) - 1 if at < len(small) else len(self.values) - 1
        return first, last

    def message(self, error: float, noise: float) -> Message:
        """Return b, continued by its slopes where psi is noise."""
        (first, last), points = self.kept(noise), lw.index(self.window.size)
        logs = np.log(np.maximum(self.values, ROUNDING * np.max(self.values))) - self.gauge + self.scale
        left, right = 0.5 * (logs[first + 2] - logs[first]), 0.5 * (logs[last] - logs[last - 2])
        inner = logs[np.clip(np.arange(len(logs)), first, last)]
        logs = inner + left * np.minimum(points - points[first], 0.0) + right * np.maximum(points - points[last], 0.0)
        return Message.of(logs, self.window, RELAXED * self.window.spacing, error)


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
    start, length = float(prepared.schedule.starts[k]), float(prepared.lengths[k])
    spacing, error, noise, scaled = later.needed, 0.0, 1e-14, 1.0
    now, begin, centre, deviation = None, later, later.mean, later.deviation
    stack, count, tried = [(0.0, length)], 0, 0
    while stack:
        first, last = stack.pop()
        if now is None:
            now = _placed(begin, centre, deviation, spacing, MARGIN ** (tried // 2))
            if now is None or tried > MOST_GRIDS or not np.isfinite(now.values).all():
                return None
            now = now._replace(scaled=scaled)
            if prepared.system.varying and last == length and not tried:
                stack, error = resolved_parts(prepared, now.values, now.window, start, length, inside)
                first, last = stack.pop()
        attempt, moved = _substep(prepared, now, start, first, last, inside, rates)
        count += 1
        if attempt.split:
            if count + len(stack) >= MOST_SUBSTEPS or not np.isfinite(attempt.error):
                return None
            stack += parts_of_split(prepared, first, last, attempt.error)
            continue
        look = lw.figures(moved.values, False, accepted)
        made = max(look.aliasing, 0.1 * look.left, 0.1 * look.right)
        if made <= min(accepted * 10.0**tried if not look.rough else 1.0, ROUGH * prepared.tolerance):
            error, noise, now, tried = error + attempt.error, max(noise, made), moved, 0
            continue
        # Another grid about psi as it is, then wider and finer ones.
        stack.append((first, last))
        if tried == 0:
            begin, spacing = now.message(later.error, noise), now.window.spacing
            mean, variance = lw.moments(now.values, now.window)
            centre, deviation = float(mean), float(np.sqrt(variance))
        tried, scaled = tried + 1, now.scaled
        if tried % 2 and look.aliasing > accepted:
            spacing /= 1.4
        now = None
    assert now is not None
    first_kept, last_kept = now.kept(noise)
    here = slice(first_kept, last_kept + 1)
    weights = reliable(state, now.window)[here] * np.exp(-now.gauge[here] - np.max(-now.gauge[here]))
    product = weights * now.values[here]
    error += 2.0 * float(max(product[[0, -1]]) / np.max(product))
    error += 2.0 * noise * float(np.max(now.values) * np.sum(weights) / np.sum(product))
    return (now.message(later.error, noise)._replace(scaled=now.scaled), error) if np.isfinite(error) else None


def _placed(later: Message, centre: float, deviation: float, spacing: float, wider: float) -> _Psi | None:
    """Return psi of a message on a grid about a mean, None where that is too large.

    Beyond the ends of the message psi differs from a Gaussian by a factor.
    """
    count = 2.0 * WIDTH * wider * deviation / spacing
    if not count <= lw.LARGEST:
        return None
    window = later.window._replace(centre=centre, spacing=spacing, size=lw.size_for(count))
    deviation /= spacing
    ends = np.array(later.ends) + later.spacing * np.array([1.0, -1.0])  # the outermost values may be continued
    z, inner = lw.index(window.size) / deviation, np.clip(window.offsets, *ends)
    at, logs = (inner - centre) / (spacing * deviation), later.at(inner)
    c2, c1, c0 = np.polyfit(at, logs, 2, w=np.exp(-0.25 * z * z))
    curvature = min(-1.0 - 2.0 * c2, 0.0)
    rest = logs - at * (c1 + at * c2)
    slopes = (later.logs[[3, -2]] - later.logs[[1, -4]]) / (2.0 * later.spacing)
    outer = (ends - centre) / (spacing * deviation)
    slopes = slopes * spacing * deviation - c1 - 2.0 * c2 * outer
    rest += slopes[0] * np.minimum(z - outer[0], 0.0) + slopes[1] * np.maximum(z - outer[1], 0.0)
    exponents = rest + z * z * (c2 + 0.5 * curvature)
    top = float(np.max(exponents))
    values = np.exp(exponents - top)
    total = float(np.sum(values))
    return _Psi(values / total, window, -c1 / deviation, curvature / deviation**2, top + float(np.log(total)))


def _substep(
    prepared: Prepared, later: _Psi, start: float, first: float, last: float, inside: np.ndarray, rates: np.ndarray
) -> tuple[Attempt, _Psi]:
    """Return psi before the part from start + first to start + last of an interval."""
    window, points = later.window, lw.index(later.window.size)
    theta, length, spacing, derivative = prepared.theta.real, last - first, window.spacing, later.slope + later.curvature * points
    x = window.origin + window.centre + spacing * np.array([0.0, -1.0, 1.0])
    speed, below, above = finite(prepared.system.drift(x[:, None], start + last, theta)[:, 0]).tolist()
    slope = (above - below) / (2.0 * spacing)
    noise = covariance_at(prepared.system, x[:1], start + last, theta).reshape(-1)[0] * length
    variance = lw.moments(later.values, window)[1]
    growth = slope - 0.5 * float(np.log1p(noise / variance)) / length  # that of the width of psi

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
        added = (0.5 * g * derivative - d) * derivative - 0.5 * g * later.curvature
        return d - g * derivative, g if G.ndim > 1 else g[:, 0], V + added, constant

    by, _, s = place(np.array([-length]))
    unit = lw.Window(0.0, 0.0, 1.0, window.size, False, 1.0)
    attempt = magnus(prepared, later.values, unit, Substep(start + first, length, inside, rates), at, True, True)
    total = float(np.sum(attempt.values))
    before = window._replace(centre=window.centre + float(by[0]), spacing=spacing * float(s[0]))
    scale = later.scale + float(attempt.offset) + float(np.log(total))
    scaled = later.scaled * float(np.exp(-slope * length))
    return attempt, later._replace(values=attempt.values / total, window=before, scale=scale, scaled=scaled)
