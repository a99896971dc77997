"""Refuse an interval of several states in which the density reaches infinity or holds a pole of the drift."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.system.escape import FAR, FASTER, STEEP, EscapeError, divisors_of, formula_text, infinite_text
from zakai.models.kept import kept, once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function
from zakai.numerics.escape import share_that_escapes

Array = Any
RARE = 1e-2  # share of paths that may escape, which is ten times the default tolerance
DIRECTIONS = 64
TOGETHER = 64  # intervals in which the drift far out is seen together
CALM = 5.0, 2.5  # standard deviations of the prediction: where the drift is seen, and how far it may move a path from the mean's
PATH_STEPS = 2  # Runge-Kutta steps of the mean's path in half of an interval
SAMPLES = 256  # points of the density among which poles are sought
FAR_OUT = 1e3  # standard deviations that show which states escape
DOUBTFUL = "the density of the interval before is wrong, and guided-particles gives another one"


class Interval(NamedTuple):
    """Interval `row`; `at` returns f and G in one row (..., n + n n) at points and times."""

    model: Model
    at: Any
    row: int
    start: float
    length: float

    def error(self, words: str) -> EscapeError:
        """Return the error of this interval."""
        return EscapeError(f"{self.model.source}: {words}", self.row, self.start, self.length)


def check_escape(prepared: Any, k: int, moments: Callable[[], tuple[Array, Array]], infinity: bool = True) -> None:
    """Raise InputError where paths escape in interval k.

    Args:
        prepared: what a method prepares, with a model, a schedule and parameters.
        k: the number of the interval.
        moments: returns the mean (n,) and the covariance (n, n) of the density at its start.
        infinity: whether paths to infinity are sought, and not only poles.
    """
    divisors = divisors_of(prepared.model)
    if divisors is None and not infinity:
        return
    model, schedule, theta = prepared.model, prepared.schedule, prepared.theta.real
    start, length = float(schedule.starts[k]), float(schedule.lengths[k])
    if length <= 0:
        return
    hold, inputs, motion = model.input_hold, schedule.inputs, _motion(model)

    def at(points: Array, t: Any, function: NumericFunction = motion) -> Array:
        u = None if inputs is None else inputs.at(np.minimum(t, np.nextafter(start + length, start)), hold)
        return function(points, t, theta, u)

    with np.errstate(all="ignore"):
        grows = infinity and bool(growing(prepared, slice(k, k + 1))[0])
        if not grows and divisors is None:
            return
        mean, cov = moments()
        if not (np.isfinite(mean).all() and np.isfinite(cov).all() and (np.diagonal(cov) > 0).all()):
            return
        if grows:
            _check_infinity(Interval(model, at, k, start, length), mean, cov)
        if divisors is not None:
            points = mean + _directions(model.n, SAMPLES) @ _root(cov).T
            _check_poles(Interval(model, at, k, start, length), points, at(points, start + 0.5 * length, divisors))


def growing(prepared: Any, rows: slice) -> Array:
    """Return in which of some intervals d log |x| / dt may grow without limit (K,).

    Args:
        prepared: a model, a schedule and parameters.
        rows: the intervals.
    """
    model, schedule, theta = prepared.model, prepared.schedule, prepared.theta.real
    middles = schedule.starts[rows] + 0.5 * schedule.lengths[rows]
    if not _varies(model):
        whole = kept(model, growing, lambda: _grows(model, theta, middles[:1], None)[0], theta.tobytes(), 8)
        return np.full(len(middles), whole)
    found = [np.zeros(0, bool)]
    for first in range(0, len(middles), TOGETHER):
        times = middles[first : first + TOGETHER]
        u = None if schedule.inputs is None else schedule.inputs.at(times, model.input_hold)
        found.append(_grows(model, theta, times, u))
    return np.concatenate(found)


@once_for_a_model
def _varies(model: Model) -> bool:
    """Return whether the drift depends on t or on inputs."""
    return bool(model.drift.free_symbols & {model.t, *model.u})


def _motion(model: Model) -> NumericFunction:
    return kept(model, _motion, lambda: numpy_function([*model.drift, *model.covariance], model))


@lru_cache(maxsize=32)
def _directions(n: int, count: int) -> Array:
    return np.random.default_rng(1).standard_normal((count, n))


@lru_cache(maxsize=32)
def _far_points(n: int) -> Array:
    directions = _directions(n, DIRECTIONS)
    return FAR[:, None, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _grows(model: Model, theta: Array, times: Array, u: Array | None) -> Array:
    """Return whether d log |x| / dt may grow without limit at times (K,), from the drift at the far points."""
    points, n = _far_points(model.n), model.n
    places = np.broadcast_to(points, (len(times), *points.shape))
    inputs = None if u is None else np.broadcast_to(u[:, None, None], (*places.shape[:-1], u.shape[-1]))
    with np.errstate(all="ignore"):
        drift = _motion(model)(places, np.broadcast_to(times[:, None, None], places.shape[:-1]), theta, inputs)[..., :n]
        rates = np.einsum("krdi,rdi->krd", drift, points) / FAR[:, None] ** 2
        rates = np.where(np.isnan(rates), np.inf * np.isinf(drift).any(axis=-1), rates).max(axis=2)
        return np.asarray((rates.max(axis=1) > FASTER * np.maximum(rates[:, 0], 0.0)) & (rates.max(axis=1) > 1e-6))


def _root(cov: Array) -> Array:
    values, vectors = np.linalg.eigh(cov)
    return vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1]))


def _check_infinity(interval: Interval, mean: Array, cov: Array) -> None:
    model, at, _, start, length = interval
    n = model.n
    directions = _directions(n, DIRECTIONS)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    noise = np.nan_to_num(at(mean, start)[n:].reshape(n, n))
    if _calm(interval, mean, _root(cov + noise * length), directions):
        return

    def coefficients(points: Array, times: Array) -> tuple[Array, Array]:
        found = at(points, start + times)
        return found[:, :n], found[:, n:].reshape(-1, n, n)

    share, place = share_that_escapes(coefficients, mean, _root(cov), length)
    if share > RARE:
        drift = np.abs(at(place, start + length)[:n])
        worst = int(np.argmax(np.where(np.isnan(drift), np.inf, drift)))
        apart = np.abs(place - mean) / np.sqrt(np.diagonal(cov))
        names = [name for name, far in zip(model.state, apart, strict=True) if not far < FAR_OUT] or list(model.state)
        text = infinite_text(model, worst, ", ".join(names), share)
        raise interval.error(text if interval.row == 0 else f"{text}; or {DOUBTFUL}")


def _calm(interval: Interval, mean: Array, reach: Array, directions: Array) -> bool:
    """Return whether the drift hardly moves a far path away from that of the mean, and the noise out there is no larger."""
    at, start, length, n = interval.at, interval.start, interval.length, len(mean)
    path, times = _path_of_mean(interval, mean), start + length * np.array([0.0, 0.5, 1.0])
    points = path[:, None] + CALM[0] * directions @ reach.T
    far = at(points.reshape(-1, n), np.repeat(times, len(directions))).reshape(*points.shape[:2], -1)
    near = at(path, times)
    moved = np.linalg.norm((far[..., :n] - near[:, None, :n]) @ np.linalg.inv(reach).T, axis=2) * length
    # A value that is not a number is not below a bound.
    return bool(np.max(moved) < CALM[1] and np.max(far[..., n:]) < 2.0 * np.max(near[:, n:]) + 1e-300)


def _path_of_mean(interval: Interval, mean: Array) -> Array:
    """Return where the drift takes the mean at the start, the middle and the end of the interval (3, n)."""
    at, n, path, x, t = interval.at, len(mean), [mean], mean, interval.start
    step = interval.length / (2 * PATH_STEPS)
    for i in range(2 * PATH_STEPS):
        first = at(x, t)[:n]
        second = at(x + 0.5 * step * first, t + 0.5 * step)[:n]
        third = at(x + 0.5 * step * second, t + 0.5 * step)[:n]
        x = x + step / 6.0 * (first + 2.0 * second + 2.0 * third + at(x + step * third, t + step)[:n])
        t += step
        if i % PATH_STEPS == PATH_STEPS - 1:
            path.append(x)
    return np.array(path)


def _check_poles(interval: Interval, points: Array, divisors: Array) -> None:
    """Raise InputError where a divisor changes its sign in the density and the drift or the noise grows as 1 / d there."""
    model, at, _, start, length = interval
    for column in range(divisors.shape[1]):
        signs = np.sign(divisors[:, column])
        below, above = points[signs < 0], points[signs > 0]
        count = min(len(below), len(above), 16)
        if min(len(below), len(above)) < max(RARE * len(points), 1):
            continue
        low, high = below[:count], above[:count]
        apart = high - low
        for _ in range(60):
            middle = 0.5 * (low + high)
            negative = at(middle, start + 0.5 * length, divisors_of(model))[:, column, None] < 0
            low, high = np.where(negative, middle, low), np.where(negative, high, middle)
        near, nearer = (np.abs(at(low + share * apart, start + 0.5 * length)) for share in (1e-3, 1e-6))
        steep = nearer > STEEP * near
        if np.mean(steep.any(axis=1)) > 0.5:
            index = int(np.argmax(steep.sum(axis=0)))
            key, row = ("drift", index) if index < model.n else ("diffusion", (index - model.n) // model.n)
            place = ", ".join(f"{name} = {value:.3g}" for name, value in zip(model.state, low[0], strict=True))
            raise interval.error(
                f"{formula_text(key, row, model)} is infinite within the density at t = START, as at {place}, and there is "
                "no density to filter; give a prior on one side and far from it, or another formula"
            )
