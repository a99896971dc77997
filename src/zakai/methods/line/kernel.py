"""The density of one state after an interval whose transition has a Gaussian kernel, in the gauge e^phi."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.prepared import Prepared
from zakai.methods.line.transition import Moved, Report
from zakai.numerics.line import window as lw
from zakai.numerics.line.gaussian_kernels import WIDE, Channel, applied, wrapped

Array = Any

KEPT_SPACING = 160  # points up to which the spacing of a grid is kept where it is enlarged
NARROWEST = 1.4  # spacings that the standard deviation of a kernel must have
MOST_GRIDS = 13


def by_kernel(
    prepared: Prepared, values: Array, window: lw.Window, start: float, length: float, kernel: Channel, report: Report
) -> Moved | None:
    """Return the density after an interval, None where its kernel is too narrow for the grid or no grid fits.

    Args:
        prepared: the system.
        values, window: the density (N,) and its grid.
        start, length: the interval.
        kernel: that of the interval, for x relative to the origin of `window`.
        report: receives the figures of the density.
    """
    arguments = prepared, values, window, kernel
    moved = _around(*arguments) if window.closed else _along(*arguments, start, length)
    if moved is not None and moved.look is not None:
        report.density(moved.look)
    return moved


def _around(prepared: Prepared, values: Array, window: lw.Window, kernel: Channel) -> Moved | None:
    """Return a density on the circle convolved with a wrapped Gaussian, None where the kernel is none or too narrow."""
    if np.iscomplexobj(values) or np.iscomplexobj(kernel.variance) or np.iscomplexobj(kernel.shift):
        return None
    variance = kernel.variance / window.spacing**2
    if kernel.scale != 1.0 or kernel.slope != 0.0 or kernel.curvature != 0.0 or not variance >= WIDE:
        return None
    found = np.array(values, float)
    wrapped(found, np.empty_like(found), kernel.shift / window.spacing, variance, 8.0 - np.log(prepared.cut))
    mass = np.sum(found)
    return Moved(found / mass, window, np.log(mass) + kernel.constant, lw.figures(found, True, prepared.negligible))


def _along(
    prepared: Prepared, values: Array, window: lw.Window, kernel: Channel, start: float, length: float
) -> Moved | None:
    """Return a density on the line after an interval."""
    yau, theta, cut, negligible = prepared.yau, prepared.theta, prepared.cut, prepared.negligible
    width, rough = np.sqrt(np.abs(kernel.variance.real)), max(1e-10, 1e-3 * prepared.tolerance)
    if yau is None or not width > NARROWEST * window.spacing * abs(kernel.scale.real):
        return None
    sources = window.offsets
    logs = np.log(np.where(values.real > 0, values, 0.0)) - yau.potential(window.points, start, theta)
    weights = logs + kernel.constant + sources * (kernel.slope + kernel.curvature * sources)
    top = float(np.max(np.where(np.isfinite(weights.real), weights.real, -np.inf)))
    weights = np.where(np.isfinite(weights.real), np.exp(weights - top), 0.0)
    new = window
    for attempt in range(MOST_GRIDS):
        first = new.centre - new.spacing * (new.size // 2)
        found = applied(sources, first, new.spacing, new.size, weights, kernel.scale, kernel.shift, kernel.variance) * new.spacing
        positive, gauge = found.real > 0, yau.potential(new.points, start + length, theta)
        logs = np.where(positive, np.log(np.where(positive, found, 1.0)) + gauge, -np.inf)
        best = float(np.max(logs.real))
        found = np.exp(logs - best) if np.isfinite(best) else np.zeros_like(found)
        look, left, right, coarse = lw.figures(found, False, negligible, cut), True, True, False
        if found.any():
            left, right = look.left > 10 * cut, look.right > 10 * cut
            coarse = look.aliasing > 30.0 * negligible and (look.aliasing > rough or not look.rough)
        if not (left or right or coarse):
            mass = np.sum(found)
            return Moved(found / mass, new, np.log(mass) + top + best, look)
        if attempt == 0:
            larger = _reached(values, window, kernel, float(width), cut, negligible)
        else:
            larger = lw.enlarged(new, left, right) if left or right else new
            larger = lw.refined(larger) if coarse else larger
            if larger.size >= lw.SIZES[-1] and larger.size == new.size:
                return None
        new = larger
    return None


def _reached(values: Array, window: lw.Window, kernel: Channel, width: float, cut: float, negligible: float) -> lw.Window:
    """Return a grid for all that a density reaches with a kernel of this standard deviation."""
    own = lw.figures(values, False, negligible, cut)
    ends = kernel.scale.real * window.offsets[[own.first, own.last]] + kernel.shift.real
    spacing = float(np.sqrt((kernel.scale.real * window.spacing) ** 2 + kernel.variance.real / 6.0))
    reach = float(np.sqrt(-2.0 * np.log(cut)))
    low, high = float(ends.min() - reach * width), float(ends.max() + reach * width)
    if (high - low) / window.spacing < KEPT_SPACING:
        spacing = min(spacing, window.spacing)
    return lw.quantized(window, low, high, max(spacing, (high - low) / 400), most=lw.SIZES[-1])
