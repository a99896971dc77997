"""Uniform grids on the line and the circle that follow a density: choice of the grid, interpolation, moments.

A density is a vector of probabilities of the grid points.  A smooth density that the grid resolves is band-limited, so that its
sums are integrals and its values between the points are those of the sinc (line) or trigonometric (circle) interpolant, both to
rounding.  Logarithms and messages are interpolated by polynomials through the nearest eight values.  Grids are taken out of few
(spacings a factor of 2^(1/4) apart, centres at multiples of 8 spacings), so that what was computed for a grid is used again.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import angle, is_complex, real_product
from zakai.numerics.line.density import spectrum, spectrum_of_many, waves
from zakai.numerics.line.operator import FourierOperator, generator
from zakai.numerics.line.resolution import SPECTRUM_FACTOR

_STENCIL = np.arange(-3, 5)
STENCIL_WEIGHTS = np.array([1.0 / np.prod([float(i - j) for j in _STENCIL if j != i]) for i in _STENCIL])


def local_polynomial(values: Array, window: Window, offsets: Array) -> Array:
    """Return the polynomials through the nearest eight values of functions (..., N) at offsets (J,), constant beyond the grid."""
    at = (offsets - window.centre) / window.spacing + window.size // 2
    weights, own = _nearest(values, window, at if window.closed else np.clip(at, 0.0, window.size - 1.0))
    return np.asarray(np.sum(weights * own, axis=-1))


def interpolated_logs(values: Array, window: Window, offsets: Array) -> Array:
    """Return the exponential of the polynomial through eight logarithms, zero where a value is zero or beyond the grid."""
    at = (offsets - window.centre) / window.spacing + window.size // 2
    weights, own = _nearest(values, window, at)
    with np.errstate(all="ignore"):
        result = np.exp(np.sum(weights * np.log(own), axis=1))
    inside = (own.real > 0).all(axis=1) & np.isfinite(result.real)
    if not window.closed:
        inside &= (at > -0.5) & (at < window.size - 0.5)
    return np.where(inside, result, 0.0)


def _nearest(values: Array, window: Window, at: Array) -> tuple[Array, Array]:
    """Return the weights (J, 8) and the values (..., J, 8) of the polynomials at indices of a grid (J,)."""
    near = np.floor(at)
    if not window.closed:
        near = np.clip(near, -_STENCIL[0], window.size - 1 - _STENCIL[-1])
    distance = (at - near)[:, None] - _STENCIL
    exact = np.abs(distance) < 1e-12
    weights = np.where(exact.any(axis=1, keepdims=True), exact, STENCIL_WEIGHTS / np.where(exact, 1.0, distance))
    own = values[..., (near[:, None].astype(int) + _STENCIL) % window.size]
    return weights / np.sum(weights, axis=1, keepdims=True), own


Operator = Array | FourierOperator

SIZES = (32, 48, 64, 80, 96, 112, 128, 160, 192, 256, 320, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)
LARGEST = 384  # points of a grid on which matrices propagate densities
LARGE = 1024  # points of a grid on which matrices propagate messages, and kernels and splitting densities
CUT = 1e-13  # density relative to its maximum that a new grid must hold
DEEP = 1e-20  # the same of densities whose small values are accurate
SMALL = 1e-8  # density relative to its maximum below which its logarithm is interpolated
ALIGNMENT = 8  # centres are at multiples of so many spacings


class Points(Protocol):
    """Points that carry a density: those of a uniform grid, or of Gauss-Lobatto elements."""

    @property
    def origin(self) -> float:
        """The state from which offsets count."""

    @property
    def closed(self) -> bool:
        """Whether they go once around the circle."""

    @property
    def points(self) -> Array:
        """The points, first those that carry probabilities."""

    def __hash__(self) -> int:
        """Equal points have equal tables."""


class Window(NamedTuple):
    """The grid x_i = origin + centre + spacing (i - size // 2), i = 0 .. size - 1; `closed` if it goes once around the circle.

    `unit` is the scale of the spacings, which are unit 2^(j/4).
    """

    origin: float
    centre: float
    spacing: float
    size: int
    closed: bool
    unit: float

    @property
    def offsets(self) -> Array:
        """The points (size,) relative to the origin."""
        return self.centre + self.spacing * index(self.size)

    @property
    def points(self) -> Array:
        """The points (size,)."""
        return self.origin + self.offsets

    def generator(self, covariance: Array, drift: Array, potential: Array) -> Operator:
        """Return the Kolmogorov operator L for G, f and V at the points, or integrals over time of these."""
        if self.size > LARGEST:
            return FourierOperator(covariance, drift, potential, self.spacing * self.size)
        return generator(self.closed, self.spacing, covariance, drift, potential)


@lru_cache(maxsize=64)
def index(size: int) -> Array:
    """Return i - size // 2 (size,)."""
    result = np.arange(size) - size // 2.0
    result.setflags(write=False)
    return result


def size_for(count: float) -> int:
    """Return the smallest size of at least `count` points, or the largest of all."""
    for size in SIZES:
        if size >= count:
            return size
    return SIZES[-1]


def quantized(window: Window, low: float, high: float, spacing: float, margin: float = 0.12, most: int = LARGEST) -> Window:
    """Return the grid for offsets from `low` to `high` with at most this spacing, and a margin on both sides."""
    power = np.floor(4.0 * np.log2(spacing / window.unit) + 1e-6)
    spacing = float(window.unit * 2.0 ** (power / 4.0))
    needed = (high - low) / spacing * (1.0 + margin)
    size = min(size_for(needed + ALIGNMENT), most)
    apart = spacing * ALIGNMENT
    if size > 96 and needed + 2 * ALIGNMENT <= most:  # few large grids, which take long to prepare
        size, apart = min(size_for(needed + 2 * ALIGNMENT), most), 2 * apart
    centre = apart * np.round(0.5 * (low + high) / apart)
    return window._replace(centre=float(centre), spacing=spacing, size=size)


class GridCheck(NamedTuple):
    """What decisions about a density are made of.

    `left` and `right` are the largest moduli of the two outermost points on each side, relative to the maximum; `first` and
    `last` the support; the negative share of the mass; `aliasing` the largest spectrum in the highest eighth of the
    frequencies, relative to the mass; `rough` tells that the spectrum falls like a power of the frequency, as that of kinks does,
    or not at all, as that of noise; `resolving` is the spacing that is needed, in spacings.
    """

    left: float
    right: float
    first: int
    last: int
    negative: float
    aliasing: float
    rough: bool
    resolving: float

    def unresolved(self, negligible: float, noise: float) -> bool:
        """Return whether a finer grid is needed: the spectrum is not negligible, and not that of kinks or noise up to a level."""
        return self.aliasing > SPECTRUM_FACTOR * negligible and (self.aliasing > noise or not self.rough)


def grid_check(values: Array, closed: bool, negligible: float = CUT, cut: float = CUT) -> GridCheck:
    """Return the figures of a density.

    Args:
        values: probabilities (N,).
        closed: whether the grid goes around the circle.
        negligible: the spectrum that need not be resolved.
        cut: the smallest value that counts, relative to the largest.
    """
    real = np.ascontiguousarray(values.real)
    large = len(real) > LARGE
    result = spectrum_of_many(real, cut, negligible) if large else spectrum(real, cut, negligible, *waves(len(real)), True)
    left, right, first, last, negative, aliasing, middle, highest, nyquist = result
    rough = middle < 6.0 * aliasing
    if aliasing <= negligible or (rough and aliasing < 1e-9):
        resolving = 0.92 * nyquist / (max(highest, 0.0) + 1.0)
    else:  # the spectrum of a Gaussian falls as exp(-c k^2)
        share = min(max(aliasing, 1e-15), 0.3)
        resolving = 1.0 / min(max((np.log(negligible) / np.log(share)) ** 0.5, 1.05), 4.0)
    if closed:
        left = right = 0.0
    return GridCheck(left, right, int(first), int(last), negative, aliasing, rough, float(resolving))


def fitted(check: GridCheck, window: Window, most: int = LARGEST, generous: int = 64) -> Window:
    """Return the grid to go on with: the same where it serves, else one that fits the density.

    Args:
        check: the figures of the density.
        most: the largest size.
        generous: a grid of up to so many points is kept though fewer would do.
    """
    needed = check.resolving * window.spacing
    if not 0.0 < needed < np.inf:  # the values are not finite
        return window
    if window.closed:
        size = min(size_for(2 * np.pi / needed), most)
        if window.size >= size and (window.size <= 2 * size or window.size <= generous):
            return window
        return window._replace(size=size, spacing=2 * np.pi / size)
    first, last = check.first, check.last
    width = last - first + 1
    least = max(3, window.size // 16)
    inside = first >= least and last < window.size - least
    resolved = check.resolving >= 0.97
    enough = width * min(1.0, 1.0 / check.resolving) * 1.12 + ALIGNMENT
    thrifty = window.size <= max(generous, 1.6 * size_for(enough))
    if inside and resolved and thrifty and window.size <= most:
        return window
    # Rather too coarse than without a part of the mass.
    needed = max(needed, window.spacing * width / (most - 12) * 1.12 * 2**0.25)
    low = window.centre + window.spacing * (first - window.size // 2)
    high = window.centre + window.spacing * (last - window.size // 2)
    return quantized(window, low, high, needed, most=most)


def enlarged(window: Window, left: bool, right: bool) -> Window:
    """Return the grid with the same spacing and a third as many points more on each side that asks for them."""
    more = window.size // 3
    low = window.centre - window.spacing * (window.size // 2 + more * left)
    high = window.centre + window.spacing * (window.size - 1 - window.size // 2 + more * right)
    return quantized(window, low, high, window.spacing, margin=0.0, most=SIZES[-1])


def translated(window: Window, by: float) -> Window:
    """Return a grid that is displaced by about a number of its spacings."""
    return window._replace(centre=window.spacing * round((window.centre + by) / window.spacing)) if by else window


def refined(window: Window, factor: float = 2**0.5) -> Window:
    """Return the grid over the same range with a spacing smaller by a factor."""
    if window.closed:
        size = size_for(window.size * factor * 0.999)
        return window._replace(size=size, spacing=2 * np.pi / size)
    low = window.centre - window.spacing * (window.size // 2)
    high = window.centre + window.spacing * (window.size - 1 - window.size // 2)
    return quantized(window, low, high, window.spacing / factor * 1.001, margin=0.0, most=SIZES[-1])


def interpolated(values: Array, window: Window, offsets: Array) -> Array:
    """Return the interpolants of values (..., N) at offsets (J,) from the origin."""
    if len(offsets) > LARGEST and window.size > LARGE:
        parts = np.array_split(offsets, -(-len(offsets) // LARGEST))
        return np.concatenate([interpolated(values, window, part) for part in parts], axis=-1)
    at = (offsets - window.centre) / window.spacing + window.size // 2
    nearest = np.round(at)
    # sin(pi (at - j)) = (-1)^(nearest - j) sin(pi (at - nearest)).
    distance = at[:, None] - np.arange(window.size)
    sine = np.sin(np.pi * (at - nearest)) * np.where(nearest % 2 == 0, 1.0, -1.0)
    signed = values * np.where(np.arange(window.size) % 2 == 0, 1.0, -1.0)
    exact = np.abs(at - nearest) < 1e-12
    with np.errstate(all="ignore"):
        if window.closed:
            result = real_product(1.0 / np.tan(np.pi / window.size * distance), signed.T).T * (sine / window.size)
        else:
            result = real_product(1.0 / distance, signed.T).T * (sine / np.pi)
    if window.closed:
        return np.asarray(np.where(exact, values[..., nearest.astype(int) % window.size], result))
    inside = (at > -0.5) & (at < window.size - 0.5)
    own = values[..., np.where(inside, nearest, 0.0).astype(int)]
    return np.asarray(np.where(inside, np.where(exact, own, result), 0.0))


def resampled(values: Array, window: Window, new: Window) -> Array:
    """Return the probabilities of the points of another grid."""
    if new == window:
        return values
    if not window.closed and new.spacing == window.spacing:
        shift = (new.centre - window.centre) / window.spacing + window.size // 2 - new.size // 2
        if abs(shift - round(shift)) < 1e-6:
            return shifted(values, round(shift), new.size)
    return density_at(values, window, new.offsets) * (new.spacing / window.spacing)


def density_at(values: Array, window: Window, offsets: Array) -> Array:
    """Return the density at offsets (J,) from the origin, times the spacing of the grid."""
    result = interpolated(values, window, offsets)
    result = np.where(result.real > 0, result, 0.0)
    bound = SMALL * values.real.max()
    small = np.flatnonzero(result.real < bound)
    if len(small):
        # There the interpolant is the rounding of large values; small values are interpolated by their logarithms.
        logs = interpolated_logs(values, window, offsets[small])
        result[small] = np.where(logs.real < 2.0 * bound, logs, 0.0)
    return result


def shifted(values: Array, by: int, size: int) -> Array:
    """Return values (..., N) on a grid of another size that begins `by` points later, zero where there are none."""
    result = np.zeros((*values.shape[:-1], size), values.dtype)
    first, last = max(by, 0), min(by + size, values.shape[-1])
    if last > first:
        result[..., first - by : last - by] = values[..., first:last]
    return result


def _sums_of_waves(values: Array, first: float, k: Array) -> tuple[Array, Array]:
    """Return the sums of real values (N,) with cos(k x) and sin(k x), for the N points x of a circle from the first one on."""
    result = np.exp(-1j * k * first) * np.fft.rfft(values)[k]
    return result.real, -result.imag


def moments(values: Array, window: Window) -> tuple[Any, Any]:
    """Return the mean, relative to the origin, and the variance of probabilities with the sum one.

    On the circle the mean is the argument of E exp(i x) and deviations are wrapped.
    """
    if not window.closed:
        i = index(window.size)
        first = i @ values
        apart = i - first
        return window.centre + window.spacing * first, (window.spacing * window.spacing) * ((apart * apart) @ values)
    x = window.points
    cosine, sine = np.cos(x) @ values, np.sin(x) @ values
    length = np.sqrt(cosine**2 + sine**2)
    mean: Any = 0.0 * cosine if length.real < 1e-9 else angle(sine, cosine)
    # The square of a wrapped deviation d is pi^2 / 3 + 4 sum (-1)^k cos(k d) / k^2.
    k = np.arange(1, window.size // 2)
    cosines, sines = _sums_of_waves(values.real, x[0], k)
    if is_complex(values):
        others = _sums_of_waves(values.imag, x[0], k)
        cosines, sines = cosines + 1j * others[0], sines + 1j * others[1]
    waves = np.cos(k * mean) * cosines + np.sin(k * mean) * sines
    return mean - window.origin, np.pi**2 / 3 + 4.0 * np.sum(np.where(k % 2 == 0, 1.0, -1.0) / k**2 * waves)
