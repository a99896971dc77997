"""The product of a density on a grid with a likelihood that may be much narrower, lie far in its tails, or have kinks.

Of a function F with a kink, sums over a grid of F times a smooth function are accurate to second order only, and operators that
contain F too.  With the values

    F_j = int psi(t) F(x_j + t spacing) dt,     psi = sum_k c_k B(t - k),     B the cubic B-spline,

c such that psi has the moments of a point mass up to degree 2 K + 1, they are as accurate as those of smooth functions are: the
spectrum of psi is zero where the grid folds frequencies.  Sums over nodes between the points stand for the integral.  The
difference to a rule of smaller K estimates the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import float64, int64, void

from zakai.numerics.arrays import Array, Number
from zakai.numerics.compiled import kernel
from zakai.numerics.line import window as lw
from zakai.numerics.line.density import moments, support
from zakai.numerics.line.grid_choice import DEPTH, MOST_CELLS
from zakai.numerics.line.resolution import GROSS, RESOLVED, ROUNDING
from zakai.numerics.line.steps import LEAST, exponent_added


@dataclass(frozen=True)
class Gaussian:
    """log l(x) = constant - (value - h(x))'(precision)(value - h(x)) / 2; `observation` maps points (J,) to h (m, J).

    With `linear`, log l(x) = constant + h(x)'(precision) value.
    """

    observation: Callable[[Array], Array]
    value: Array
    precision: Array
    constant: Number
    linear: bool = False
    known: tuple[lw.Points, Array] | None = None  # h at the points of a grid

    def logs(self, points: Array) -> Array:
        """Return log l (J,), minus infinity where h has no value."""
        return self.of(self.observation(points))

    def of(self, h: Array) -> Array:
        """Return log l (J,) for values of h (m, J)."""
        if self.linear:
            logs = self.constant + np.sum(h * (self.precision @ self.value)[:, None], axis=0)
            return np.where(np.isnan(logs.real), -np.inf, logs)
        rest = self.value[:, None] - h
        with np.errstate(all="ignore"):
            logs = self.constant - 0.5 * np.sum(rest * (self.precision @ rest), axis=0)
        return np.where(np.isnan(logs.real), -np.inf, logs)


@dataclass(frozen=True)
class General:
    """Any likelihood, by its values: `log_density` maps points (J,) to log l (J,), NaN where there is none."""

    log_density: Callable[[Array], Array]
    linear = False

    def logs(self, points: Array) -> Array:
        """Return log l (J,), minus infinity where it has no value."""
        result = self.log_density(points)
        return np.where(np.isnan(result.real), -np.inf, result)


Likelihood = Gaussian | General


class Product(NamedTuple):
    """The normalised product on its grid, the logarithm of its mass, and how deep in the tails of the density it lies.

    `growth` is the factor by which an error that is uniform, relative to the maximum of the density, is relative to the product.
    """

    values: Array
    log_mass: Number
    depth: float
    growth: float
    window: lw.Window


def multiplied(values: Array, window: lw.Window, likelihood: Likelihood, rough: float) -> Product:
    """Return the product of probabilities and a likelihood, on a grid that resolves it.

    Args:
        values: (N,) probabilities of the points of `window`.
        rough: the largest spectrum at the highest frequencies, relative to the mass, with which the grid is kept.
    """
    product = _product(values, window, values, window, likelihood)
    check = lw.grid_check(product.values, window.closed)
    resolved = check.aliasing <= RESOLVED or (check.aliasing <= rough and check.rough)
    if resolved and max(check.left, check.right) < 1e-10:
        return product
    new = lw.fitted(check, window) if likelihood.linear else _placed(values, window, likelihood)
    for _ in range(12):
        new_values = lw.resampled(values, window, new)
        if not new_values.any():  # the observation contradicts all that is known, which the depth reports
            new_values = np.full_like(new_values, LEAST)
        product = _product(values, window, new_values, new, likelihood)
        if not np.isfinite(product.log_mass.real):
            return product
        check = lw.grid_check(product.values, new.closed)
        noisy = check.rough and check.aliasing < GROSS
        if check.aliasing <= RESOLVED or new.size >= (lw.LARGE if noisy else lw.SIZES[-1]):
            break
        before, new = new, finer(product.values, new, check)
        if new == before:
            break
    return product


def finer(values: Array, window: lw.Window, check: lw.GridCheck) -> lw.Window:
    """Return a finer grid that holds a density, of which modes may be far apart; the same grid where there is none."""
    low, high = window.offsets[list(support(np.ascontiguousarray(values.real), lw.CUT))]
    factor = max(1.0 / check.resolving, 2**0.5)
    while factor > 1.1:
        if window.closed:
            new, holds = lw.refined(window, factor), True
        else:
            new = lw.quantized(window, low, high, 1.001 * window.spacing / factor, most=lw.SIZES[-1])
            holds = new.size * new.spacing > 1.04 * (high - low)
        if holds and new.spacing < 0.95 * window.spacing:
            return new
        factor /= 2**0.25
    return window


def _product(values: Array, window: lw.Window, new_values: Array, new: lw.Window, likelihood: Likelihood) -> Product:
    if isinstance(likelihood, Gaussian) and likelihood.known is not None and likelihood.known[0] == new:
        logs = likelihood.of(likelihood.known[1])
    else:
        logs = likelihood.logs(new.points)
    top_of_density = float(values.real.max()) * new.spacing / window.spacing
    return Product(*normalized(new_values, logs, np.ones(new.size), top_of_density), new)


def normalized(density: Array, logs: Array, weights: Array, largest: float) -> tuple[Array, Number, float, float]:
    """Return the product of a density and a likelihood as probabilities.

    Args:
        density: at points (N,).
        logs: the logarithm of the likelihood there (N,).
        weights: those of the quadrature at the points (N,).
        largest: the maximum of the density before.

    Returns:
        The probabilities (N,), the logarithm of their sum before, how deep below `largest` the mass of the product is, and the
        growth of errors.
    """
    with np.errstate(all="ignore"):
        own, reference = np.where(density.real > 0, np.log(density.real), -np.inf), np.log(largest)
        top = np.max(own + logs.real)
        if not np.isfinite(top):
            return density, 0.0 * density[0] - np.inf, np.inf, np.inf
        # Relative to the largest product: neither factor needs to be a number there.
        result = weights * (density / np.exp(own) * np.exp(own + logs - top))
        result = np.where((own > -np.inf) & (logs.real > -np.inf), result, 0.0)
        mass = np.sum(result)
        result = result / mass
        growth = np.sum(weights * np.exp(np.minimum(logs.real + reference - top - np.log(mass.real), 80.0)))
        depth = np.sum(np.where(result.real > 0, result.real * (reference - own), 0.0))
        if abs(top) * ROUNDING > 1.0:  # no number compares likelihoods
            depth = np.inf
    return result, np.log(mass) + top, float(depth), float(growth)


def _placed(values: Array, window: lw.Window, likelihood: Likelihood) -> lw.Window:
    """Return a grid for the product; the same where no number compares parts of it, which the depth reports."""
    top = values.real.max()
    result = place(window.offsets, np.log(np.maximum(values.real, 1e-30 * top)), likelihood, window.origin)
    if result is None:
        return window
    low, high, finest = result
    spacing = min(window.spacing, max(finest, (high - low) / 370.0))
    if window.closed:
        size = lw.size_for(min(2 * np.pi / spacing, lw.SIZES[-1]))
        return window._replace(size=size, spacing=2 * np.pi / size)
    return lw.quantized(window, low, high, spacing, margin=0.3, most=lw.SIZES[-1])


def _surveyed(ends: Array, prior: Callable[[Array], Array], likelihood: Likelihood, origin: float) -> tuple[Array, Array, Array]:
    """Return for cells between offsets `ends` (J, 2) what the placing of a grid needs, from values at five points of each.

    A change d of the logarithm counts as the distance from the maximum of a Gaussian between depths D and D + d.

    Args:
        ends: (J, 2).
        prior: logarithm of the density at offsets.
        origin: the point from which offsets count.

    Returns:
        The logarithm of the product at the ends (J, 2), a bound of it (J,) and by how much it changes, in deviations (J,).
    """
    points = ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * np.linspace(0.0, 1.0, 5)
    logs = np.maximum(likelihood.logs(origin + points.reshape(-1)).real.reshape(points.shape), -1e150)
    product = prior(points) + logs
    highest, range_ = product.max(axis=1), logs.max(axis=1) - logs.min(axis=1)
    depth = np.maximum(product.max() - highest, 0.0)
    change = np.sqrt(2.0 * (depth + range_)) - np.sqrt(2.0 * depth)
    return product[:, [0, -1]], highest + 0.5 * range_ + 1.0, change


def place(offsets: Array, logs: Array, likelihood: Likelihood, origin: float) -> tuple[float, float, float] | None:
    """Return the ends of the product of a density and a likelihood, and the smallest cell that resolves it.

    Cells whose bound is far below the best value are left out, and the others divided until the likelihood hardly changes in any.

    Args:
        offsets: points (N,) relative to the origin.
        logs: the logarithm of the density at these (N,).
        origin: the point from which offsets count.
    """

    def prior(points: Array) -> Array:
        return np.asarray(np.interp(points.reshape(-1), offsets, logs, left=-200.0, right=-200.0)).reshape(points.shape)

    cells = np.stack([offsets[:-1], offsets[1:]], axis=1)
    while True:
        product, bound, change = _surveyed(cells, prior, likelihood, origin)
        best = float(product.max())
        if not np.isfinite(best):
            return None
        keep = bound >= best - DEPTH  # equal, where the logarithms are so large that nothing can be subtracted
        cells, change, product = cells[keep], change[keep], product[keep]
        widths = cells[:, 1] - cells[:, 0]
        divide = (change > 0.7) & (widths > 1e-14 * np.max(np.abs(offsets)) + 1e-300)
        if not divide.any() or len(cells) > MOST_CELLS:
            break
        quarters = cells[divide, :1] + widths[divide, None] * np.linspace(0.0, 1.0, 5)
        parts = np.stack([quarters[:, :-1], quarters[:, 1:]], axis=2).reshape(-1, 2)
        cells = np.concatenate([cells[~divide], parts])
    product, _, _ = _surveyed(cells, prior, likelihood, origin)
    good = (product >= product.max() - DEPTH).any(axis=1)
    return float(cells[good, 0].min()), float(cells[good, 1].max()), float((cells[good, 1] - cells[good, 0]).min())


_V, _M = float64[::1], float64[:, ::1]

NODES_OF_SPACING = 16  # nodes of a spacing
_WITHIN = 8  # places of which the mean is the value of a node
SPLINE_REACH = 5  # spacings on both sides of a point
WEAK_SHARE = 0.05  # of the tolerance that a sample may leave in the weak sense
_POSITIONS = (np.arange(2 * SPLINE_REACH * NODES_OF_SPACING) + 0.5) / NODES_OF_SPACING - SPLINE_REACH


def _rule(order: int, derivative: int) -> Array:
    """Return the weights of the nodes for K = `order`, of F or its derivative."""
    apart = _POSITIONS[:, None] - np.arange(-order, order + 1)
    near, far = (np.maximum(reach - np.abs(apart), 0.0) for reach in (1.0, 2.0))
    basis = (2.0 * near**2 - 0.5 * far**2) * np.sign(apart) if derivative else (far**3 - 4.0 * near**3) / 6.0
    degrees = np.arange(2 * order + 1) + derivative
    return np.asarray(basis @ np.linalg.solve((_POSITIONS[:, None] ** degrees).T @ basis, 1.0 * (degrees == derivative)))


_VALUES, _SLOPES, _OTHER = _rule(3, 0), _rule(3, 1), _rule(2, 0)


def nodes(points: Array, spacing: float) -> Array:
    """Return where `at_nodes` needs the values of a function on a grid (N,)."""
    count = (len(points) + 2 * SPLINE_REACH - 1) * NODES_OF_SPACING + 2
    first = points[0] - spacing * (SPLINE_REACH + 1.0 / NODES_OF_SPACING)
    return np.asarray(first + spacing / (NODES_OF_SPACING * _WITHIN) * (np.arange(count * _WITHIN) + 0.5))


def middles(points: Array, spacing: float) -> Array:
    """Return the nodes of a grid (N,), where the values of a function that is smooth within each are those of `at_nodes`."""
    count = (len(points) + 2 * SPLINE_REACH - 1) * NODES_OF_SPACING
    return np.asarray(points[0] - spacing * SPLINE_REACH + spacing / NODES_OF_SPACING * (np.arange(count) + 0.5))


def at_nodes(values: Array) -> Array:
    """Return a function at the nodes (..., (N + 2 REACH - 1) PARTS): means, less what the curvature of a smooth one adds."""
    means = values.reshape(*values.shape[:-1], -1, _WITHIN).mean(axis=-1)
    curvature = means[..., 2:] - 2.0 * means[..., 1:-1] + means[..., :-2]
    return np.ascontiguousarray(means[..., 1:-1] - (1.0 - _WITHIN**-2) / 24.0 * curvature)


def places_of_nodes(values: Array, jumps: bool) -> Array:
    """Return a function at the places (..., F, P) of the nodes of which the mean is the value of a node.

    Of one with jumps they are all, as what depends on the function jumps too; else the only one is the node.
    """
    if not jumps:
        return at_nodes(values)[..., None]
    return np.ascontiguousarray(values[..., _WITHIN:-_WITHIN].reshape(*values.shape[:-1], -1, _WITHIN))


def weak(values: Array, spacing: float) -> tuple[Array, Array]:
    """Return a function and its derivative (N,) from values at the nodes."""
    windows = np.lib.stride_tricks.sliding_window_view(values, len(_POSITIONS))[::NODES_OF_SPACING]
    return windows @ _VALUES, windows @ _SLOPES / spacing


@kernel(void(float64[:, :, ::1], int64, _M, _V, _V, _V, _V))
def weaken(fine: Array, start: int, precision: Array, observed: Array, centre: Array, b: Array, change: Array) -> None:
    """Replace log-likelihoods b (N,) of h at the points by those of its values at nodes.

    Args:
        fine: h at the places of the nodes (m, F, P) of a longer grid, see `places_of_nodes`.
        start: the first point.
        precision, observed: S^-1 and y.
        centre: the values of h of which b is zero.
        b: receives the logarithms.
        change: receives the relative difference of another rule, with half of the places.
    """
    m, size, places, count = fine.shape[0], b.size, fine.shape[2], (b.size + 2 * SPLINE_REACH - 1) * NODES_OF_SPACING
    h, inner = np.empty((m, count * places)), np.zeros(count * places)
    for i in range(m):
        for f in range(count):
            for p in range(places):
                h[i, f * places + p] = fine[i, start * NODES_OF_SPACING + f, p]
    exponent_added(h, centre, precision, observed, 1.0, 1.0, inner)
    tops, together = np.empty(count // NODES_OF_SPACING), NODES_OF_SPACING * places
    for cell in range(tops.size):
        tops[cell] = -np.inf
        for f in range(cell * together, (cell + 1) * together):
            tops[cell] = max(tops[cell], inner[f])
        for f in range(cell * together, (cell + 1) * together):
            inner[f] = np.exp(inner[f] - tops[cell])
    values = inner
    if places > 1:
        values = np.zeros(count)
        for f in range(count * places):
            values[f // places] += inner[f] / places
    for j in range(size):
        one, other, half, top = 0.0, 0.0, 0.0, max(tops[j + SPLINE_REACH - 1], tops[j + SPLINE_REACH])
        for cell in range(2 * SPLINE_REACH):
            here, there, first = 0.0, 0.0, (j + cell) * NODES_OF_SPACING
            for f in range(NODES_OF_SPACING):
                here += _VALUES[cell * NODES_OF_SPACING + f] * values[first + f]
                there += _OTHER[cell * NODES_OF_SPACING + f] * values[first + f]
            scale = np.exp(min(tops[j + cell] - top, 600.0))
            one, other = one + scale * here, other + scale * there
            if places > 1:
                for f in range(0, together, 2):
                    half += scale * _VALUES[cell * NODES_OF_SPACING + f // places] * inner[first * places + f] * 2.0 / places
        change[j] = 1.0
        if 0.0 < one < np.inf:
            b[j], change[j] = top + np.log(one), 1.0 - other / one
            if places > 1:
                change[j] += 1.0 - half / one


@kernel(float64(_V, _V))
def weak_error(density: Array, change: Array) -> float:
    """Return the change of mass, mean and variance, in deviations, by relative changes of a density."""
    mean, variance = moments(density)[1:]
    mass, first, second = 0.0, 0.0, 0.0
    for j in range(density.size):
        at, part = (j - density.size // 2 - mean) / np.sqrt(variance), density[j] * change[j]
        mass, first, second = mass + part, first + part * at, second + part * (at * at - 1.0)
    return abs(mass) + abs(first) + abs(second)
