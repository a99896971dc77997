"""A uniform grid that covers and resolves a density of which only the logarithm is known."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.errors import InputError
from zakai.numerics.complex_step import log_sum_exp
from zakai.numerics.peak_search import box_of_peaks

Array = NDArray[Any]
LARGEST = {1: 16384, 2: 640, 3: 128, 4: 40}  # points along an axis
_FIRST = {1: 64, 2: 48, 3: 32, 4: 20}


class PriorGrid(NamedTuple):
    """A density by `log_values` (not normalised) at x = `centre` + `basis` (i - size // 2), i the index (n,).

    `closed` (n,) tells which axes go once around the circle.  `error` estimates the part of the mass that the grid does not
    cover or resolve.
    """

    centre: Array
    basis: Array
    log_values: Array
    closed: tuple[bool, ...]
    error: float

    @property
    def points(self) -> Array:
        """The grid points (*sizes, n)."""
        return self.centre + self.offsets

    @property
    def offsets(self) -> Array:
        """The grid points (*sizes, n) relative to the centre."""
        return _index(self.log_values.shape) @ self.basis.T

    @property
    def log_mass(self) -> Any:
        """The logarithm of the integral of the density."""
        return log_sum_exp(self.log_values.ravel()) + np.log(abs(np.linalg.det(self.basis)))


def _index(sizes: Sequence[int] | Array) -> Array:
    return np.stack(np.meshgrid(*[np.arange(size) - size // 2 for size in sizes], indexing="ij"), axis=-1)


def prior_grid(
    log_density: Callable[[Array], Array],
    n: int,
    periodic: Sequence[bool] | None = None,
    *,
    tolerance: float = 1e-12,
    aligned: bool = True,
    source: str = "prior: log_density",
    box: tuple[Array, Array] | None = None,
) -> PriorGrid:
    """Return a grid for a density with unknown location and scale, which may have several peaks.

    The peaks are found by a pattern search from many starts over 26 decades.  A grid around them is enlarged until the density at
    its edges is below `tolerance` of the maximum, and refined until the spectrum at its highest frequencies is.

    Args:
        log_density: function of points (J, n), complex values (J,) allowed; not a number far from the mass means zero.
        n: number of coordinates, 1 to 4.
        periodic: whether a coordinate is an angle (n,); the density is evaluated in (-pi, pi].
        tolerance: bound on the neglected density, relative to its maximum.
        aligned: whether the axes of the grid are the coordinate axes; else the Cholesky factor of the covariance where n > 1.
        source: what an error message calls the density.
        box: the ends, low and high (n,), of a box that holds the peaks, which are not sought then.

    Returns:
        The grid; `error` above `tolerance` tells that the density has kinks or jumps, or needs more points than allowed.

    Raises:
        InputError: the density does not decay, is infinite or zero everywhere, or is not a number where its mass is.
    """
    angles = tuple(periodic) if periodic is not None else (False,) * n

    def evaluate(centre: Array, offsets: Array) -> Array:
        x = (centre + offsets).reshape(-1, n)
        for i in np.flatnonzero(angles):
            x[:, i] = np.pi - np.mod(np.pi - x[:, i], 2 * np.pi)
        with np.errstate(all="ignore"):
            values = np.asarray(log_density(x)).reshape(offsets.shape[:-1])
        return values

    low, high = box_of_peaks(evaluate, n, angles, tolerance, source) if box is None else box
    grid = _fitted(evaluate, np.asarray(low, float), np.asarray(high, float), np.eye(n), angles, tolerance, source)
    if n > 1 and not aligned and not any(angles):
        weights = np.exp(grid.log_values.real - np.max(grid.log_values.real)).ravel()
        weights /= weights.sum()
        offsets = grid.offsets.reshape(-1, n)
        mean = weights @ offsets
        factor = np.linalg.cholesky((offsets - mean).T @ ((offsets - mean) * weights[:, None]))
        shape = factor / np.linalg.norm(factor, axis=1, keepdims=True)
        if np.abs(shape - np.eye(n)).max() > 0.1:
            centre = grid.centre + mean
            reach = np.abs(np.linalg.solve(factor, (offsets - mean)[weights > tolerance * weights.max()].T)).max(axis=1)
            grid = _fitted(evaluate, -reach, reach, factor, angles, tolerance, source, centre)
    return grid


def mixture_log_density(
    weights: Array, means: Array, covs: Array, periodic: Sequence[bool] | None = None
) -> Callable[[Array, Array], Array]:
    """Return log sum_k weights_k N(centre + offset; means_k, covs_k), wrapped where periodic, as a function (centre, offsets).

    Args:
        weights: (k,) positive.
        means: (k, n).
        covs: (k, n, n) positive definite.
        periodic: whether a coordinate is an angle (n,).
    """
    n = means.shape[1]
    turns = np.zeros((1, n))
    if periodic is not None and any(periodic):
        spread = np.sqrt(np.max(np.diagonal(np.real(covs), axis1=1, axis2=2), axis=0))
        counts = [
            int(min(np.ceil((np.pi + 9 * spread[i]) / (2 * np.pi)), 40)) if angle else 0 for i, angle in enumerate(periodic)
        ]
        turns = 2 * np.pi * np.array(list(itertools.product(*[range(-c, c + 1) for c in counts])), float)
    factors = np.linalg.inv(np.linalg.cholesky(covs))
    log_scale = np.log(weights) + np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1) - 0.5 * n * np.log(2 * np.pi)

    def log_density(centre: Array, offsets: Array) -> Array:
        flat = offsets.reshape(-1, n)
        logs = []
        for mean, factor, scale in zip(means, factors, log_scale, strict=True):
            start = centre - mean
            if periodic is not None:
                start = np.where(periodic, start - 2 * np.pi * np.round(start.real / (2 * np.pi)), start)
            for turn in turns:
                z = (flat + (start + turn)) @ factor.T
                logs.append(scale - 0.5 * np.sum(z * z, axis=1))
        total = logs[0] if len(logs) == 1 else log_sum_exp(np.stack(logs), axis=0)
        return total.reshape(offsets.shape[:-1])

    return log_density


def mixture_grid(
    weights: Array,
    means: Array,
    covs: Array,
    periodic: Sequence[bool] | None = None,
    *,
    tolerance: float = 1e-12,
    aligned: bool = True,
    source: str = "prior",
) -> PriorGrid:
    """Return a grid for a mixture of Gaussians (one Gaussian: k = 1), wrapped where periodic.

    Args:
        weights: (k,).
        means: (k, n).
        covs: (k, n, n).
        periodic: as for `prior_grid`.
        tolerance: as for `prior_grid`.
        aligned: as for `prior_grid`.
        source: as for `prior_grid`.

    Raises:
        InputError: a variance is zero, relative to the square of the mean and the other variances.
    """
    means, covs = np.asarray(means, float), np.asarray(covs, float)
    n = means.shape[1]
    angles = tuple(periodic) if periodic is not None else (False,) * n
    spread = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    zero = (spread <= 1e-14 * np.abs(means)) | (spread == 0)
    try:
        scaled = np.linalg.cholesky(covs / (spread[:, :, None] * spread[:, None, :])) if not zero.any() else np.zeros((1, n, n))
        zero_direction = np.diagonal(scaled, axis1=1, axis2=2).min() < 1e-7
    except np.linalg.LinAlgError:
        zero_direction = True
    if zero_direction:
        raise InputError(f"{source}: a variance is zero; a grid needs a density in every direction, so give it a small variance")
    evaluate = mixture_log_density(np.asarray(weights, float), means, covs, angles)
    axes, centre = np.eye(n), np.average(means, axis=0, weights=weights)
    if n > 1 and not aligned and not any(angles):
        deviation = means - centre
        axes = np.linalg.cholesky(np.einsum("k,kij->ij", weights, covs + deviation[:, :, None] * deviation[:, None, :]))
    inverse = np.linalg.inv(axes)
    middle = (means - centre) @ inverse.T
    reach = np.sqrt(-2 * np.log(tolerance)) * np.sqrt(np.einsum("ai,kij,aj->ka", inverse, covs, inverse))
    low, high = (middle - reach).min(axis=0), (middle + reach).max(axis=0)
    return _fitted(evaluate, low, high, axes, angles, tolerance, source, centre)


def _fitted(
    evaluate: Callable[[Array, Array], Array],
    low: Array,
    high: Array,
    axes: Array,
    angles: tuple[bool, ...],
    tolerance: float,
    source: str,
    origin: Array | None = None,
) -> PriorGrid:
    """Return a grid over the box low <= z <= high, x = origin + axes z, enlarged, cut and refined until it fits."""
    n = len(low)
    origin = np.zeros(n) if origin is None else origin
    turn = np.where(angles, 2 * np.pi, np.inf)
    size = np.full(n, _FIRST[n])
    narrow = np.log(tolerance) - 1.0
    first_width, previous = np.maximum(high - low, 1e-300), np.full(n, np.inf)
    for _ in range(80):
        closed = high - low >= turn * (1 - 1e-12)
        low, high = np.where(closed, (low + high - turn) / 2, low), np.where(closed, (low + high + turn) / 2, high)
        spacing = (high - low) / np.where(closed, size, size - 1)
        centre = origin + axes @ (low + spacing * (size // 2))
        basis = axes * spacing
        logs = evaluate(centre, _index(size) @ basis.T)
        real = np.where(np.isnan(logs.real), -np.inf, logs.real)
        top = real.max()
        if top == np.inf:
            raise InputError(f"{source} is infinite at x = {(centre + _index(size)[real == np.inf][0] @ basis.T).tolist()}")
        if not np.isfinite(top):
            raise InputError(f"{source} is not finite anywhere; give a density")
        used = real > top + narrow
        changed = False
        for d in range(n):
            line = np.flatnonzero(used.any(axis=tuple(a for a in range(n) if a != d)))
            width, left, right = high[d] - low[d], line[0], line[-1]
            if closed[d]:
                gaps = np.diff(np.append(line, line[0] + size[d]))
                if max(gaps) > 0.6 * size[d] and np.argmax(gaps) < len(line) - 1:  # the mass lies across the cut of the circle
                    shift = spacing[d] * (line[np.argmax(gaps)] + gaps.max() // 2)
                    low[d], high[d], changed = low[d] + shift - 2 * np.pi, high[d] + shift - 2 * np.pi, True
                elif 0 < left and right < size[d] - 1 and right - left < 0.4 * size[d]:
                    low[d], high[d] = low[d] + spacing[d] * (left - 1.5), low[d] + spacing[d] * (right + 1.5)
                    changed = True
                continue
            if left == 0 or right == size[d] - 1:
                low[d] -= 0.4 * width * (left == 0)
                high[d] += 0.4 * width * (right == size[d] - 1)
                if high[d] - low[d] > 1e6 * first_width[d]:
                    raise InputError(f"{source} does not decay in coordinate {d + 1}, so it is not a density")
                changed = True
            elif right - left + 3 < 0.8 * size[d]:
                low[d], high[d] = low[d] + spacing[d] * (left - 1.5), low[d] + spacing[d] * (right + 1.5)
                changed = True
        if changed:
            continue
        tails = spectral_tails(np.exp(real - top))
        # Rounding of the coordinates does not decrease with the spacing.
        coarse = (tails > tolerance) & (size < LARGEST[n]) & ((tails < 0.5 * previous) | (tails > 1e-5))
        previous = tails
        if not coarse.any():
            break
        # The spectrum of a Gaussian falls as exp(-c k^2).
        ratio = np.clip(np.sqrt(np.log(tolerance) / np.log(np.clip(tails, 1e-16, 0.3))), 1.1, 2.0)
        size = np.where(coarse, np.minimum(np.ceil(size * ratio / 4).astype(int) * 4, LARGEST[n]), size)
    if np.isnan(logs.real).any():
        bad = np.isnan(logs.real)
        inner = used & _beside(bad)
        if inner.any():
            x = centre + _index(size)[bad][0] @ basis.T
            raise InputError(f"{source} is not a number at x = {x.tolist()}")
        logs = np.where(bad, -np.inf, logs)
    error = float(max(tails.max(), 0.0))
    if error > 0.05:
        shape = " x ".join(map(str, size))
        raise InputError(f"{source} has features that {shape} grid points do not resolve; give peaks that are wider or nearer")
    return PriorGrid(centre, basis, logs, tuple(bool(c) for c in closed), error)


def _beside(marked: Array) -> Array:
    """Return which points have a marked neighbour along an axis."""
    out = np.zeros_like(marked)
    for axis in range(marked.ndim):
        out |= np.roll(marked, 1, axis) | np.roll(marked, -1, axis)
    return out


def spectral_tails(values: Array) -> Array:
    """Return for each axis (n,) the largest spectrum of a density in its highest eighth of frequencies, relative to its mass."""
    spectrum = np.abs(np.fft.fftn(values))
    out = np.zeros(values.ndim)
    for axis, size in enumerate(values.shape):
        if size > 3:
            middle = np.arange(-(-size * 7 // 16), size * 9 // 16 + 1)
            out[axis] = np.take(spectrum, middle, axis=axis).max()
    return out / max(float(spectrum.flat[0]), np.finfo(float).tiny)
