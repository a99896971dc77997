"""The density of one state after an interval whose transition has a Gaussian kernel, in the gauge e^phi."""

from __future__ import annotations

import numpy as np

from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import Prediction
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.gaussian_kernels import WIDE, Channel, applied, around, chosen, wrapped
from zakai.numerics.line.resolution import TRIALS, noise_bound


def by_kernel(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, kernel: Channel, report: Report
) -> Prediction | None:
    """Return the density after an interval, None where its kernel is too narrow for the grid or no grid fits.

    Args:
        values, window: the density (N,) and its grid.
        kernel: that of the interval, for x relative to the origin of `window`.
        report: receives the figures of the density.
    """
    arguments = prepared, values, window, kernel
    prediction = _around(*arguments) if window.closed else _along(*arguments, interval.start, interval.length)
    if prediction is not None and prediction.check is not None:
        report.density(prediction.check)
    return prediction


def _around(prepared: Prepared, values: Array, window: lw.Window, kernel: Channel) -> Prediction | None:
    """Return a density on the circle convolved with a wrapped Gaussian, None where the kernel is none or too narrow."""
    if np.iscomplexobj(values) or np.iscomplexobj(kernel.variance) or np.iscomplexobj(kernel.shift):
        return None
    variance = kernel.variance.real / window.spacing**2
    if kernel.scale != 1.0 or kernel.slope != 0.0 or kernel.curvature != 0.0 or not variance >= WIDE:
        return None
    result = np.array(values, float)
    wrapped(result, np.empty_like(result), kernel.shift / window.spacing, variance, 8.0 - np.log(prepared.cut))
    mass = np.sum(result)
    return Prediction(result / mass, window, np.log(mass) + kernel.constant, lw.grid_check(result, True, prepared.negligible))


def _along(
    prepared: Prepared, values: Array, window: lw.Window, kernel: Channel, start: float, length: float
) -> Prediction | None:
    """Return a density on the line after an interval."""
    yau, theta, cut, negligible = prepared.yau, prepared.theta, prepared.cut, prepared.negligible
    width, rough = np.sqrt(np.abs(kernel.variance.real)), noise_bound(prepared.tolerance)
    if yau is None or not width**2 > WIDE * (window.spacing * kernel.scale.real) ** 2:
        return None
    sources = window.offsets
    logs = np.log(np.where(values.real > 0, values, 0.0)) - yau.potential(window.points, start, theta)
    weights = logs + kernel.constant + sources * (kernel.slope + kernel.curvature * sources)
    top = float(np.max(np.where(np.isfinite(weights.real), weights.real, -np.inf)))
    weights = np.where(np.isfinite(weights.real), np.exp(weights - top), 0.0)
    new = window
    for trial in range(TRIALS):
        first = new.centre - new.spacing * (new.size // 2)
        result = applied(sources, first, new.spacing, new.size, weights, kernel.scale, kernel.shift, kernel.variance)
        result = result * new.spacing
        positive, gauge = result.real > 0, yau.potential(new.points, start + length, theta)
        logs = np.where(positive, np.log(np.where(positive, result, 1.0)) + gauge, -np.inf)
        best = float(np.max(logs.real))
        result = np.exp(logs - best) if np.isfinite(best) else np.zeros_like(result)
        check, left, right, coarse = lw.grid_check(result, False, negligible, cut), True, True, False
        if result.any():
            left, right = check.left > 10 * cut, check.right > 10 * cut
            coarse = check.unresolved(negligible, rough)
        if not (left or right or coarse):
            mass = np.sum(result)
            return Prediction(result / mass, new, np.log(mass) + top + best, check)
        if trial == 0:
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
    own = lw.grid_check(values, False, negligible, cut)
    ends = kernel.scale.real * window.offsets[[own.first, own.last]] + kernel.shift.real
    spacing = float(np.sqrt((kernel.scale.real * window.spacing) ** 2 + kernel.variance.real / 6.0))
    reach = float(np.sqrt(-2.0 * np.log(cut)))
    low, high = float(ends.min() - reach * width), float(ends.max() + reach * width)
    return lw.quantized(window, low, high, max(spacing, (high - low) / 400), most=lw.SIZES[-1])


def kernel_of(prepared: Prepared, interval: TimeInterval, window: lw.Window, report: Report) -> Channel | None:
    """Return the Gaussian kernel of an interval, for x relative to the origin of the window, None where there is none."""
    kernels = prepared.kernels
    if kernels is None or kernels.place[interval.k] < 0:
        return None
    place = int(kernels.place[interval.k])
    report.time += float(kernels.errors[place])
    inputs = np.concatenate([np.ones(1), interval.rates])
    return around(chosen(kernels.transitions, place, inputs), window.origin - kernels.origin)
