"""The motion of points along the characteristics of a drift, and the linearised system that goes with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.formula_kernel import Formulas
from zakai.numerics.space.grid import Grid, inverted, transformed

Array = NDArray[Any]
_TERMS = 18
_LARGEST = 4.0  # of tau L
_MOST_STEPS = 256
_TOGETHER = 2**15  # points that are moved together: many more take memory, and time to fetch it


class Dynamics(NamedTuple):
    """The drift and the noise of a system.

    `drift(x, t)` returns f and its divergence (J, n + 1) at points (J, n), `jacobian(x, t)` (J, n, n), `noise(t0, t1)`
    the averages of G and of (1 - s) G over an interval; `varying` is true if f depends on t; `diffusion(x, t)` returns G
    (J, n, n) at points where it depends on the state, for which `noise` is not used; `formulas` is the drift as arrays.
    """

    drift: Callable[[Array, Any], Array]
    jacobian: Callable[[Array, Any], Array]
    noise: Callable[[float, float], tuple[Array, Array]]
    varying: bool
    diffusion: Callable[[Array, float], Array] | None = None
    formulas: Formulas | None = None


def runge_kutta(
    drift: Callable[[Array, Any], Array],
    x: Array,
    t0: float,
    t1: float,
    steps: int,
    beyond: Callable[[Array], Array] | None = None,
) -> Array:
    """Return the displacement and the integral of the divergence (J, n + 1) along characteristics from t0 to t1.

    The steps are those of the classical formula of order four. A point for which `beyond` is true after a step is given up: its
    displacement is NaN.
    """
    count, n = x.shape
    h = (t1 - t0) / steps
    x = np.asfortranarray(x)
    alive: Array | None = None
    moved = np.zeros((), float)
    for i in range(steps):
        t = t0 + i * h
        start = x + moved[:, :n] if i else x
        k1 = drift(start, t)
        k2 = drift(start + (0.5 * h) * k1[:, :n], t + 0.5 * h)
        k3 = drift(start + (0.5 * h) * k2[:, :n], t + 0.5 * h)
        k4 = drift(start + h * k3[:, :n], t + h)
        k2 = k2 + k3
        k2 *= 2.0
        k2 += k1
        k2 += k4
        k2 *= h / 6
        moved = moved + k2
        if beyond is not None and i < steps - 1 and (steps < 8 or i % 4 == 1):
            keep = ~beyond(x + moved[:, :n])
            if keep.sum() < 0.8 * len(keep):
                alive = np.flatnonzero(keep) if alive is None else alive[keep]
                x, moved = np.asfortranarray(x[keep]), np.asfortranarray(moved[keep])
                if not len(x):
                    break
    if alive is None:
        return moved
    result = np.full((count, n + 1), np.nan, moved.dtype)
    result[alive] = moved
    return result


def moved_points(dynamics: Dynamics, x: Array, t0: float, t1: float, steps: int) -> Array:
    """Return the displacement and the integral of the divergence (J, n + 1) along characteristics from t0 to t1."""
    if dynamics.formulas is not None and dynamics.formulas.fast(len(x)):
        n = x.shape[1]
        return dynamics.formulas.flow(x, t0, t1, steps, np.zeros(n), np.zeros((n, n)), np.full(n, np.inf))
    return runge_kutta(dynamics.drift, x, t0, t1, steps)


def steps_needed(
    dynamics: Dynamics, x: Array, t0: float, t1: float, inverse: Array, tolerance: Array
) -> tuple[int, Array]:
    """Return how many Runge-Kutta steps move points x (J, n) to a tolerance, and their displacement.

    The `tolerance` (J,) is that of a component in the basis with an inverse (n, n).
    """
    n, steps = x.shape[1], 1
    if dynamics.varying:
        steps = _fastest(dynamics.drift, x[:: max(1, len(x) // 8)], t0, t1)
    with np.errstate(all="ignore"):
        last = moved_points(dynamics, x, t0, t1, steps)[:, :n]
        while steps < _MOST_STEPS:
            finer = moved_points(dynamics, x, t0, t1, 2 * steps)[:, :n]
            error = np.abs((finer - last) @ inverse.T).max(axis=1) / tolerance
            worst = float(np.max(np.where(np.isfinite(error), error, np.inf)))
            if worst <= 1:
                return steps, finer
            steps, last = 2 * steps, finer
            if worst <= 16:
                break
    return steps, last


def _fastest(drift: Callable[[Array, Any], Array], x: Array, t0: float, t1: float) -> int:
    """Return steps that are short enough for the fastest variation of f in time that 256 irregular times show."""
    count = 256
    shares = (np.arange(count) + 0.5 + 0.4 * np.sin(7.0 * np.arange(count))) / count
    with np.errstate(all="ignore"):
        values = drift(x[None], t0 + (t1 - t0) * shares[:, None]).real
    low, high = values.min(axis=0), values.max(axis=0)
    span = np.where(high - low > 1e-9 * np.maximum(np.abs(low), np.abs(high)), high - low, np.inf)
    speed = np.abs(np.diff(values, axis=0)) / np.diff(shares)[:, None, None] / span
    worst = float(np.nanmax(speed)) if np.isfinite(speed).any() else 1.0
    return int(np.clip(np.ceil(worst / 4), 1, _MOST_STEPS // 2))


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Phi and the noise Q of a linear system over an interval.

    Q is linear in G: `response` (n^2, n^2) has that of each element of G, where the noise depends on the state.
    """

    map: Array
    noise: Array
    response: Array | None = None

    @cached_property
    def before(self) -> Array:
        """The half of the noise before the motion, Phi^-1 (Q / 2) Phi^-T."""
        inverse = inverted(self.map)
        return np.asarray(0.5 * inverse @ self.noise @ inverse.T)

    def halves(self, noise: Array, end: bool) -> Array:
        """Return the half of Q for each of several G (J, n, n), before (False) or after (True) the motion."""
        assert self.response is not None
        half = 0.5 * self.response
        if not end:
            inverse = inverted(self.map)
            half = np.kron(inverse, inverse) @ half
        return np.asarray((noise.reshape(len(noise), -1) @ half.T).reshape(noise.shape))

    def then(self, other: Linearisation) -> Linearisation:
        """Return the linear system over both intervals."""
        response = None
        if self.response is not None and other.response is not None:
            response = np.kron(other.map, other.map) @ self.response + other.response
        return Linearisation(other.map @ self.map, other.map @ self.noise @ other.map.T + other.noise, response)


def linearised(
    matrix: Array, mean: Array, falling: Array, tau: float, span: float, basis: Array, responds: bool = False
) -> Linearisation:
    """Return exp(tau L) and the integral of exp((tau - s) L) G exp((tau - s) L') for averages of G and of (1 - s) G.

    With `responds` the result has the `response` to each element of G. Where the eigenvalues of L times the span are large L is
    reduced: it is a means to a smaller error of the splitting only.
    """
    size = np.abs(inverted(basis) @ matrix.real @ basis).sum(axis=1).max()
    rate = span * np.abs(np.linalg.eigvals(matrix.real)).max() if span * size > _LARGEST else 0.0
    shrunk = _LARGEST / rate if rate > _LARGEST else 1.0
    L = shrunk * matrix
    doublings = int(np.clip(np.ceil(np.log2(max(tau * size * shrunk, 1e-3))), 0, 30))
    n, step = len(L), tau / 2**doublings
    # The exponential of [[L, G], [0, -L']] holds exp(L) and the noise times exp(-L') (Van Loan 1978).
    block = np.zeros((2 * n, 2 * n), np.result_type(L, mean))
    block[:n, :n], block[:n, n:], block[n:, n:] = step * L, step * mean, -step * L.T
    one = np.eye(2 * n)
    result = one + block / _TERMS
    for k in range(_TERMS - 1, 0, -1):
        result = one + (block / k) @ result
    transition = result[:n, :n]
    noise = result[:n, n:] @ transition.T
    if doublings == 0:
        uneven = 2.0 * falling - mean
        noise = noise + 0.5 * tau**2 * (L @ uneven + uneven @ L.T)
    response, rate = None, np.kron(step * L, one[:n, :n]) + np.kron(one[:n, :n], step * L)
    if responds:
        response = unit = np.eye(n * n)
        for k in range(_TERMS, 1, -1):
            response = unit + (rate / k) @ response
        response = step * response
    for _ in range(doublings):
        noise = noise + transition @ noise @ transition.T
        response = None if response is None else response + np.kron(transition, transition) @ response
        transition = transition @ transition
    return Linearisation(transition, 0.5 * (noise + noise.T), response)


def characteristics(
    dynamics: Dynamics,
    source: Grid,
    target: Grid,
    t0: float,
    t1: float,
    steps: int,
    periodic: tuple[bool, ...],
    begun: tuple[float, Array] | None,
) -> Array:
    """Return the displacement along characteristics to the points of the target grid, and the log of the change of volume.

    The result is (J, n + 1); `begun` is a time between t0 and t1, and what is known from t1 back to it.
    """
    inverse, sizes, open_axes = source.inverse, source.shape, ~source.circles
    points = target.points
    if begun is not None:
        points, t1 = points + begun[1][:, : source.n], begun[0]
    if dynamics.formulas is not None and dynamics.formulas.fast(len(points)):
        limits = np.where(open_axes & (not any(periodic)), sizes, np.inf)
        moved = dynamics.formulas.flow(points, t1, t0, steps, source.centre, inverse, limits)
        return moved if begun is None else begun[1] + moved

    def beyond(x: Array) -> Array:
        z = np.abs(transformed(x.real - source.centre, inverse))
        return np.asarray(np.any(~(z < sizes) & open_axes, axis=1))

    end = None if any(periodic) else beyond
    parts = np.array_split(points, -(-len(points) // _TOGETHER))
    with np.errstate(all="ignore"):
        moved = np.concatenate([runge_kutta(dynamics.drift, part, t1, t0, steps, end) for part in parts])
    return moved if begun is None else begun[1] + moved
