"""A message of one state times a gauge, on a grid: psi = e^l b, of which the tails are continued and their errors known."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from zakai.methods.line.message import Message, reliable
from zakai.methods.line.system import State
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
