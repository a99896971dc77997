"""The distribution function of a density that is known at points, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import atan, inf, isfinite, log, nan, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
NODES, MOST_NODES = 12, 1536  # of the quadrature: doubled until it has converged
CHANGE = 3e-3  # between two numbers of nodes; the error of the larger is about its square
NEGLIGIBLE = 11.0  # nats below the maximum of the density
HOPELESS = 60.0  # nats below the maximum of two nodes, between which none is taken even where mass is missing
FARTHEST = atan(3.0)  # likewise; at a scale of three deviations, at most 1/81 of the mass lies beyond (Chebyshev)
MASS_ERROR = 0.02  # of the mass, in nats, from which nodes beyond the negligible are taken


def distribution(
    log_density: Callable[[float], float], ends: Sequence[float], centre: float, scale: float
) -> tuple[list[float], float]:
    """Return the distribution function of a density at some ends, normalised, and the logarithm of the density's mass.

    With z = centre + scale tan(u) the density of u is periodic and smooth, and so is the sum of its Fourier series, which is
    integrated term by term; the error falls exponentially with the number of nodes (Trefethen and Weideman 2014).  A scale of
    zero stands for an angle, z = 2 u.
    """
    angle = scale == 0.0
    places = 0.5 * np.asarray(ends) if angle else np.arctan((np.asarray(ends) - centre) / scale)

    def log_value(u: float) -> float:
        if angle:
            return log_density(2.0 * u) + log(2.0)
        return log_density(centre + scale * float(np.tan(u))) + log(scale) - 2.0 * log(np.cos(u))

    count, logs = NODES, _first_values(log_value, angle)
    previous, found, log_mass = np.full(len(places), inf), np.full(len(places), nan), -inf
    skip = True  # nodes that add nothing; until mass is missing
    while True:
        top = logs.max()
        if isfinite(top):
            found, mass = _integrated(np.exp(logs - top), places)
            before, log_mass = log_mass, log(mass) + top if mass > 0 else -inf
            if np.abs(found - previous).max() < CHANGE:
                settled = not skip and abs(log_mass - before) < CHANGE  # the density itself is not normalised
                if abs(log_mass) < MASS_ERROR or settled or count >= 16 * NODES:
                    break
                skip = False
        if count >= MOST_NODES:
            break
        previous, count = found, 2 * count
        finer = np.full(count, -inf)
        finer[::2] = logs
        near = np.maximum(finer, np.maximum(np.roll(finer, 1), np.roll(finer, -1)))
        for j in np.flatnonzero(np.isneginf(finer)):
            u = pi * (j / count - 0.5)
            empty = -inf < near[j] < top - HOPELESS or (abs(u) > FARTHEST and not angle)
            if (j % 2 and near[j] > top - NEGLIGIBLE) or not (isfinite(top) and (skip or empty)):
                finer[j] = log_value(u) if j or angle else -inf
        logs = finer
    return [float(np.clip(value, 0.0, 1.0)) for value in found], log_mass


def _first_values(log_value: Callable[[float], float], angle: bool) -> Array:
    """Return the logarithms at the first nodes, from the middle outward; the tails end where an extrapolation is negligible.

    An observation far in the tail can cost a method many times more than a usual one.
    """
    nodes = pi * (np.arange(NODES) / NODES - 0.5)
    if angle:
        return np.array([log_value(u) for u in nodes])
    logs, z, middle = np.full(NODES, -inf), np.tan(nodes), NODES // 2
    for j in range(middle - 2, middle + 3):
        logs[j] = log_value(nodes[j])
    for side in (-1, 1):
        for j in (middle + side * step for step in range(3, middle)):
            last = [j - 3 * side, j - 2 * side, j - side]
            if np.isfinite(logs[last]).all():
                expected = np.polyval(np.polyfit(z[last], logs[last], 2), z[j])
                if max(expected, logs[j - side] - NEGLIGIBLE / 2) < logs.max() - NEGLIGIBLE:
                    break
            logs[j] = log_value(nodes[j])
    return logs


def _integrated(values: Array, places: Array) -> tuple[Array, float]:
    """Return the share of the integral of a function of period pi that lies below each place, and the integral from -pi/2."""
    count = len(values)
    coefficients = np.fft.rfft(values) / count
    order = np.arange(1, len(coefficients))
    weights = np.where(2 * order == count, 1.0, 2.0) * coefficients[1:] / (2j * order)
    mean = coefficients[0].real
    waves = np.exp(2j * np.multiply.outer(places + 0.5 * pi, order)) - 1.0
    return ((waves @ weights).real + mean * (places + 0.5 * pi)) / (mean * pi), mean * pi
