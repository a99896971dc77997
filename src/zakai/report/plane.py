"""Frames of the joint density of two states at several times, which `static/plane.js` draws."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.densities._values import wrap
from zakai.densities.conditional import ConditionalParticleDensity
from zakai.densities.grid import GridDensity, interpolation
from zakai.densities.points import PointMasses
from zakai.errors import InputError
from zakai.numerics.cells import SEEN, arc
from zakai.report.charts import clock_header
from zakai.report.frames import pack
from zakai.report.heatmap import is_periodic, state_names, true_states
from zakai.report.picture import number_of

SIZE = 121  # points along an axis of the window; odd, so that the mean is one
PROBABILITIES = (0.5, 0.95)
_FAR = 5.0  # distances of the quartiles of the times, or usual widths, beyond which a window is left out of the range
_REACH = 5.0  # standard deviations along each axis of the window
_SCALE = 65535
_MOST_KERNELS = 1000  # of a mixture that is evaluated at every point


def plane_bytes(
    result: Any, pair: Sequence[int | str] = (0, 1), index: Sequence[int] = (-1,), size: int = SIZE, truth: Any = None
) -> bytes:
    """Return the frame of the joint density of two states.

    Args:
        result: a `FilterResult` with densities.
        pair: two states, by name or number.
        index: positions in `result.times`; negative ones count from the end.
        size: the number of values along each axis of the window.
        truth: the true states where they are known, as for `FilterResult.plot`.

    Raises:
        InputError: an unknown state, a position outside of the result, or a density of the two states that is not finite.
    """
    numbers = [number_of(result, one) for one in pair]
    if len(numbers) != 2 or numbers[0] == numbers[1]:
        raise InputError(f"plane: the states are {pair!r}; give two different ones")
    places = np.arange(len(result.times))[list(index)]
    names = state_names(result)
    windows = [_window(result.density(int(k)).marginal(numbers), size) for k in places]
    values = np.stack([one[2] for one in windows])
    peaks = values.max(axis=(1, 2))
    if not (np.isfinite(peaks).all() and (peaks > 0).all()):
        raise InputError(f"plane: {names[numbers[0]]} and {names[numbers[1]]} have no joint density at some of these times")
    arrays = {
        "times": np.asarray(result.times, dtype=float)[places],
        "index": places.astype(float),
        "origin": np.stack([one[0] for one in windows]),
        "basis": np.stack([one[1] for one in windows]),
        "values": np.rint(values * (_SCALE / peaks)[:, None, None]).astype(np.uint16),
        "peak": peaks,
        "levels": np.stack([_levels(one) for one in values]) / peaks[:, None],
        "mean": np.asarray(result.mean, dtype=float)[places][:, numbers],
    }
    states = true_states(truth, result)
    if states is not None:
        arrays["truth"] = states[places][:, numbers]
    header = {
        "kind": "plane",
        "names": [names[i] for i in numbers],
        "periodic": [is_periodic(result, i) for i in numbers],
        "clock": clock_header(getattr(result, "clock", None)),
        "range": {axis: _range(arrays, k, is_periodic(result, i), size) for k, (axis, i) in enumerate(zip("xy", numbers))},
        "probabilities": list(PROBABILITIES),
    }
    return pack(header, arrays)


def _window(density: Density, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origin (2,), basis (2, 2) and values (size, size): value [j, i] is that at origin + basis (i, j)."""
    if isinstance(density, GridDensity):
        return _of_grid(density, size)
    if isinstance(density, ConditionalParticleDensity):
        density = density.thinned(_MOST_KERNELS).smoothed
    mean, cov = density.mean(), density.cov()
    floor = 1e-18 * np.maximum(1.0, mean**2)
    factor = np.linalg.cholesky(cov + np.diag(np.maximum(floor, 1e-12 * np.diag(cov))))
    half: Any = _REACH
    if any(density.periodic):  # an axis of its own for each, no wider than the circle
        factor = np.diag(np.sqrt(np.diag(cov) + floor))
        half = np.where(density.periodic, np.minimum(_REACH, np.pi / np.diag(factor)), _REACH)
    step = 2.0 * half * np.ones(2) / (size - 1)
    basis = factor * step
    origin = mean - basis @ np.full(2, 0.5 * (size - 1))
    if isinstance(density, PointMasses):
        return origin, basis, _of_points(density, origin, basis, size)
    i, j = np.meshgrid(np.arange(size), np.arange(size))
    points = origin + np.stack([i, j], axis=-1) @ basis.T
    points = np.where(density.periodic, wrap(points), points)
    logs = np.asarray(density.log_density(points.reshape(-1, 2)), dtype=float).reshape(size, size)
    return origin, basis, np.exp(np.where(np.isnan(logs), -np.inf, logs))


def _of_grid(density: GridDensity, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origin, basis and values along the axes of the density's own grid."""
    top = float(density.log_values.max())
    values, ends, kernels = np.exp(density.log_values - top), [], []
    for axis, (count, closed) in enumerate(zip(values.shape, density._closed, strict=True)):
        inside = values.max(axis=1 - axis) > SEEN
        first, length = (
            arc(inside) if closed else (int(np.argmax(inside)), int(count - np.argmax(inside[::-1]) - np.argmax(inside)))
        )
        low, high = (first - 1.0, first + length + 0.0) if closed else (max(first - 1.0, -0.5), min(first + length, count - 0.5))
        index = np.linspace(low, min(high, low + count), size) - count // 2
        ends.append((index[0], index[1] - index[0]))
        kernels.append(interpolation(index, count, closed))
    fine = np.maximum(kernels[0] @ values @ kernels[1].T, 0.0) * np.exp(top - density._log_scale)
    starts, steps = np.array(ends).T
    return density.centre + density.basis @ starts, density.basis * steps, fine.T


def _of_points(density: PointMasses, origin: np.ndarray, basis: np.ndarray, size: int) -> np.ndarray:
    """Return the values of Gaussian kernels around particles: those of the points of the window, blurred."""
    from scipy.ndimage import gaussian_filter

    kernels = density.smoothed
    apart = kernels.means - origin
    turn = 2.0 * np.pi * np.round((apart - basis @ np.full(2, 0.5 * (size - 1))) / (2.0 * np.pi))
    apart = np.where(density.periodic, apart - turn, apart)
    place = np.linalg.solve(basis, apart.T)
    edges = np.arange(size + 1) - 0.5
    mass = np.histogram2d(place[1], place[0], bins=(edges, edges), weights=kernels.weights)[0]
    inverse = np.linalg.inv(basis)
    width = np.sqrt(np.diag(inverse @ kernels.covs[0] @ inverse.T))  # the kernels have the shape of the window
    modes = ["wrap" if angle else "constant" for angle in density.periodic[::-1]]
    return np.asarray(gaussian_filter(mass, width[::-1], mode=modes, truncate=5.0)) / abs(np.linalg.det(basis))


def _levels(values: np.ndarray) -> np.ndarray:
    """Return the values on the borders of the smallest regions that hold the probabilities."""
    order = np.sort(values.ravel())[::-1]
    total = np.cumsum(order)
    return order[np.minimum(np.searchsorted(total, np.array(PROBABILITIES) * total[-1]), order.size - 1)]


def _range(arrays: dict[str, np.ndarray], axis: int, periodic: bool, size: int) -> list[float]:
    """Return the range to show of one axis: four fifths of the windows, without those that lie far off, and the truth."""
    if periodic:
        return [-np.pi, np.pi]
    middle = arrays["origin"][:, axis] + arrays["basis"][:, axis].sum(axis=1) * 0.5 * (size - 1)
    half = 0.8 * np.sqrt((arrays["basis"][:, axis] ** 2).sum(axis=1)) * 0.5 * (size - 1)
    low, centre, high = np.nanquantile(middle, [0.25, 0.5, 0.75])
    usual = float(np.nanmedian(half))
    near = (np.abs(middle - centre) <= _FAR * max(high - low, usual)) & (half <= _FAR * max(high - low, usual))
    middle, half = (middle[near], half[near]) if near.any() else (middle, half)
    ends = np.concatenate([middle - half, middle + half, arrays.get("truth", np.zeros((0, 2)))[:, axis]])
    ends = ends[np.isfinite(ends)]
    return [float(ends.min()), float(ends.max())]
