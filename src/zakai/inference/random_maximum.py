"""The maximum of a function with random errors: quadratics through values with common random numbers.

    l(theta) ~ l0 + g.(theta - c) + (theta - c)'H (theta - c) / 2,  by least squares over points around c,  c <- c - H^-1 g

The distance of the points is about a standard error of the parameters, over which l falls by one half: nearer points would see
the jumps of the function, and not its curvature.  The spread of the maxima for several seeds says how far the
maximum is known; of a function that has small jumps but no seed, that for points around several centres.

References:
    Myers, Montgomery and Anderson-Cook 2009, Response surface methodology.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Array = Any
ROUNDS, SEEDS, FEWEST = 12, 4, 2  # rounds of a search; sets of values at its end, and without seeds at least
USUAL = 2, 6  # rounds of a search
CERTAIN = 0.025  # of a standard error: two maxima so near to each other are known well enough
FIRST = 0.1  # distance of the first points, relative to a parameter
CLOSE = 0.2  # of a step, in distances of the points, that ends the search
DISTANCE = 1.5  # of the points, in standard errors
NEAR = 0.5  # the same for jumps of some thousandths: further away a likelihood is no quadratic
SHIFT = 0.1  # between centres, in distances of the points: the jumps of tensor trains are independent from 1e-3 on
_FACTOR = 3.0  # by which the distances change in a round, at most


def usual_values(p: int, seeds: bool, final: float = 1.0) -> tuple[float, float]:
    """Return the fewest and the most values that a search in p parameters usually takes.

    Each of those at its end counts as so many as `final` says.
    """
    each = 1 + p + p * p  # of a quadratic
    return (USUAL[0] * (1 + seeds) + final * (SEEDS if seeds else FEWEST)) * each, (USUAL[1] * (1 + seeds) + final * SEEDS) * each


class RandomMaximum(NamedTuple):
    """The maximum (p,), the inverse of the negative Hessian (p, p), the random error of the maximum (p,), and how it ended.

    `sets` is the number of sets of values, or of seeds, by which the error is known.
    """

    values: Array
    covariance: Array
    errors: Array
    converged: bool
    iterations: int
    sets: int


def random_maximum(function: Callable[[Array, int], float], start: Array, box: Array, seeds: bool = True) -> RandomMaximum:
    """Return the maximum of a function of p parameters and a seed, within bounds (p, 2).

    Args:
        function: the function of the parameters and the seed; without seeds, of what the values of one quadratic have in common.
        start: the parameters from which the search begins (p,).
        box: the bounds.
        seeds: whether the values depend on the seed; else centres are shifted instead, and negative seeds are those of the
            search, the values of which may be less accurate than those at its end.
    """
    centre = np.array(start, float)
    apart = np.maximum(FIRST * np.abs(centre), 0.5 * FIRST)
    converged, rounds, distance = False, 0, DISTANCE if seeds else NEAR
    while rounds < ROUNDS and not converged:
        rounds += 1
        one, two = (0, 1) if seeds else (-rounds, -rounds)
        slope, H = _quadratic(
            lambda theta, one=one, two=two: 0.5 * (function(theta, one) + function(theta, two)),  # type: ignore[misc]
            centre, apart, box,
        )  # fmt: skip
        step = _step(slope, H, apart)
        moved = np.clip(centre + step, box[:, 0], box[:, 1]) - centre
        centre = centre + moved
        curvature = -np.diag(H)
        wanted = np.where(curvature > 0, distance / np.sqrt(np.maximum(curvature, 1e-300)), _FACTOR * apart)
        changed = np.clip(wanted, apart / _FACTOR, apart * _FACTOR)
        settled = bool(np.all(np.abs(np.log(changed / apart)) < np.log(1.5)))
        apart = changed
        converged = settled and bool(np.all(np.abs(moved) <= CLOSE * apart) and np.all(curvature > 0))
    maxima, hessians = [], []
    for seed, shift in zip(range(SEEDS), (-0.5, 0.5, -1.5, 1.5), strict=True):
        own = centre if seeds else np.clip(centre + SHIFT * shift * apart, box[:, 0], box[:, 1])
        slope, H = _quadratic(lambda theta, seed=seed: function(theta, seed), own, apart, box)  # type: ignore[misc]
        maxima.append(own + _step(slope, H, apart))
        hessians.append(H)
        if not seeds and len(maxima) == FEWEST:
            curvature = -np.diag(np.mean(hessians, axis=0))
            if np.all(curvature > 0) and np.all(np.ptp(maxima, axis=0) * np.sqrt(curvature) <= CERTAIN):
                break
    H = np.mean(hessians, axis=0)
    errors = np.std(maxima, axis=0, ddof=1) / np.sqrt(len(maxima))
    values = np.clip(np.mean(maxima, axis=0), box[:, 0], box[:, 1])
    definite = bool(np.all(np.isfinite(H)) and np.linalg.eigvalsh(-H).min() > 0)
    covariance = np.linalg.inv(-H) if definite else np.full_like(H, np.nan)
    return RandomMaximum(values, covariance, errors, converged and definite, rounds, len(maxima))


def _quadratic(function: Callable[[Array], float], centre: Array, apart: Array, box: Array) -> tuple[Array, Array]:
    """Return the slope (p,) and the Hessian (p, p) of the quadratic through the values at a design around the centre."""
    p = len(centre)
    offsets = [np.zeros(p), *np.eye(p), *-np.eye(p)]
    offsets += [a * np.eye(p)[i] + b * np.eye(p)[j] for i in range(p) for j in range(i) for a, b in ((1, 1), (-1, -1))]
    points = np.clip(centre + np.array(offsets) * apart, box[:, 0], box[:, 1])
    values = np.array([function(point) for point in points])
    z = (points - centre) / apart
    pairs = [(i, j) for i in range(p) for j in range(i + 1)]
    columns = [np.ones(len(z)), *z.T, *(z[:, i] * z[:, j] * (0.5 if i == j else 1.0) for i, j in pairs)]
    exists = np.isfinite(values)
    if not exists.any():
        return np.zeros(p), np.zeros((p, p))
    # Where the function does not exist it is taken as far below the smallest value.
    values = np.where(exists, values, values[exists].min() - 10.0)
    found, *_ = np.linalg.lstsq(np.column_stack(columns), values, rcond=None)
    H = np.zeros((p, p))
    for (i, j), entry in zip(pairs, found[1 + p :], strict=True):
        H[i, j] = H[j, i] = entry
    return found[1 : 1 + p] / apart, H / np.outer(apart, apart)


def _step(slope: Array, H: Array, apart: Array) -> Array:
    """Return the step to the maximum of a quadratic, or uphill where it has none, of at most two distances of the points."""
    scaled, gradient = H * np.outer(apart, apart), slope * apart
    values, vectors = np.linalg.eigh(scaled)
    step = vectors @ ((vectors.T @ gradient) / np.maximum(-values, 0.1 * max(np.abs(values).max(), 1e-12)))
    return np.clip(step, -2.0, 2.0) * apart


def sentence(names: Sequence[str], found: RandomMaximum, seeds: bool = True) -> str:
    """Return how far the maximum is known."""
    known = ", ".join(f"{name} +- {error:.2g}" for name, error in zip(names, found.errors, strict=True))
    what, by = ("random errors", "seeds") if seeds else ("small jumps", "sets of values")
    return f"the log-likelihood has {what}: by {found.sets} {by} its maximum is known to {known}, beside the standard errors"
