"""Probabilities that paths of dx = f dt + g dv leave every bounded set, or reach a pole of f, within a time.

For one state they solve the backward equation p_s = f p' + G p'' / 2 on points whose spacing grows with the distance from the
density and falls towards a pole; the differences have positive rates, so that every time step and every rate is stable. For
several states paths are simulated, each with steps in which it moves by a share of its distance.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Array = Any
FAR = 1e30  # distance that counts as infinity, in units of the density or of the state, whichever is larger
GROWTH = 0.06  # spacing relative to the distance from the density, or from a pole
TIME_STEPS = 64  # the time of a passage has a relative spread of an eighth
LARGEST = 1e150  # coefficient beyond which the square of a rate overflows
FASTEST = 1e12  # jumps in a time step: with more, rounding hides how many paths stay

PATHS = 1024
MOVE = 0.2  # of its distance from the mean, in standard deviations plus one, by which a path moves in a step
FAR_PATH = 1e12  # distance that counts as infinity for a simulated path
SHORTER = 3  # times that a step is shortened, by at most ten each
MOST_STEPS = 2000  # after which a path counts as one that stays


class Ends(NamedTuple):
    """Where a state may leave: `lower` and `upper` infinite or an end that is not left, and sorted poles (P,) between them.

    A path has left by a pole when it is nearer than `margins` (P, 2), from below and from above.
    """

    lower: float
    upper: float
    poles: Array
    margins: Array


def points_between(ends: Ends, centre: float, scale: float) -> tuple[Array, Array]:
    """Return points (N,), and the number (N,) of poles below each."""
    reach = np.arcsinh(FAR * max(1.0, 1.0 / scale))
    steps = np.linspace(-reach, reach, 2 * int(reach / GROWTH) + 1)
    points = [centre + scale * np.sinh(steps)]
    for pole, (below, above) in zip(ends.poles, ends.margins, strict=True):
        for side, margin in ((-1.0, below), (1.0, above)):
            distances = margin * (1.0 + 2.0 * GROWTH) ** np.arange(int(np.log(10.0 * scale / margin) / GROWTH / 1.9))
            points.append(pole + side * distances)
    found = np.unique(np.concatenate(points))
    for pole, (below, above) in zip(ends.poles, ends.margins, strict=True):
        found = found[(found <= pole - 0.999 * below) | (found >= pole + 0.999 * above)]
    found = found[(found > ends.lower) & (found < ends.upper)]
    return found, np.searchsorted(ends.poles, found)


def escape(
    coefficients: Callable[[Array, float], tuple[Array, Array]], ends: Ends, centre: float, scale: float, length: float,
    steady: bool,
) -> tuple[Array, Array]:  # fmt: skip
    """Return starts (N,), and the probabilities (N, 1 + P) to reach an infinite end, and each pole, from them within a time.

    Args:
        coefficients: f and G (N,) at points (N,) and a time from 0 to `length`.
        ends: where paths may leave.
        centre: the middle of the density.
        scale: its width.
        length: the time.
        steady: whether the coefficients do not depend on the time.
    """
    from scipy.linalg.lapack import dgttrf, dgttrs

    x, part = points_between(ends, centre, scale)
    f, _ = coefficients(x, 0.0)
    inside = np.flatnonzero(np.isfinite(f) | (np.abs(x - centre) < 10.0 * scale))
    # What has no number, unlike what is too large, is no way to infinity.
    infinite_down = np.isinf(ends.lower) and not np.isnan(f[max(inside[0] - 1, 0)])
    infinite_up = np.isinf(ends.upper) and not np.isnan(f[min(inside[-1] + 1, len(x) - 1)])
    x, part = x[inside[0] : inside[-1] + 1], part[inside[0] : inside[-1] + 1]
    # The jump that leaves has the length of the spacing next to it.
    up, down = np.diff(x, append=2 * x[-1] - x[-2]), np.diff(x, prepend=2 * x[0] - x[1])
    last, first = np.flatnonzero(np.diff(part)), np.flatnonzero(np.diff(part)) + 1  # next to a pole, below and above
    up[last], down[first] = down[last], up[first]
    values = np.zeros((len(x), 1 + len(ends.poles)))
    dt, factors = length / TIME_STEPS, None
    for i in range(TIME_STEPS):
        if factors is None or not steady:
            f, noise = (np.clip(np.nan_to_num(a), -LARGEST, LARGEST) for a in coefficients(x, length - (i + 0.5) * dt))
            rise, fall = _rates(f, np.maximum(noise, 0.0), up, down)
            share = np.minimum(1.0, FASTEST / (dt * np.maximum(rise + fall, 1e-300)))  # of time; where paths go is the same
            rise, fall = share * rise, share * fall
            rise[-1], fall[0] = infinite_up * rise[-1], infinite_down * fall[0]
            gain = np.zeros_like(values)
            gain[-1, 0], gain[0, 0] = rise[-1], fall[0]
            gain[last, 1 + part[last]], gain[first, 1 + part[last]] = rise[last], fall[first]
            diagonal = 1.0 + dt * (rise + fall)
            above, below = -dt * rise[:-1], -dt * fall[1:]
            above[last], below[last] = 0.0, 0.0
            factors = dgttrf(below, diagonal, above)[:5]
        values = dgttrs(*factors, values + dt * gain)[0]
    return x, values


def _rates(f: Array, noise: Array, up: Array, down: Array) -> tuple[Array, Array]:
    """Return the rates of jumps to the next point above and below, exact for f and G where both are positive, else upwind."""
    both = up + down
    rise, fall = (noise + f * down) / (up * both), (noise - f * up) / (down * both)
    wrong = (rise < 0) | (fall < 0)
    rise = np.where(wrong, noise / (up * both) + np.maximum(f, 0.0) / up, rise)
    fall = np.where(wrong, noise / (down * both) + np.maximum(-f, 0.0) / down, fall)
    return rise, fall


def share_that_escapes(
    coefficients: Callable[[Array, Array], tuple[Array, Array]], mean: Array, root: Array, length: float
) -> tuple[float, Array]:
    """Return the share of simulated paths that leave every bounded set within a time, and the last place of one that does (n,).

    Args:
        coefficients: f (J, n) and G (J, n, n) at states (J, n) and times (J,) from 0 to `length`.
        mean: the mean (n,) of the density.
        root: a square root of its covariance (n, n), invertible.
        length: the time.
    """
    rng, n = np.random.default_rng(0), len(mean)
    z = rng.standard_normal((PATHS // 2, n))
    z, t = np.concatenate([z, -z]), np.zeros(PATHS)
    inverse, escaped, where = np.linalg.inv(root), 0, mean

    def velocity(z: Array, t: Array) -> Array:
        return coefficients(mean + z @ root.T, t)[0] @ inverse.T

    for _ in range(MOST_STEPS):
        f, noise = coefficients(mean + z @ root.T, t)
        speed = f @ inverse.T
        spread = np.linalg.norm(noise.reshape(len(z), n, n) @ inverse.T, axis=(1, 2)) * np.linalg.norm(inverse)
        size = 1.0 + np.linalg.norm(z, axis=1)
        pace = np.maximum(np.linalg.norm(speed, axis=1) / (MOVE * size), spread / (MOVE * size) ** 2)
        gone = ~np.isfinite(pace) | (size > FAR_PATH)
        if gone.any():
            escaped, where = escaped + int(gone.sum()), mean + root @ z[np.argmax(gone)]
        rest = length - t
        dt = np.minimum(rest, 1.0 / np.maximum(pace, 1e-300))
        for _ in range(SHORTER):  # a path near a point of rest moves slowly and turns fast
            turn = np.linalg.norm(velocity(z + 0.5 * dt[:, None] * speed, t + 0.5 * dt) - speed, axis=1) * dt
            dt = dt * np.clip(MOVE * size / np.maximum(turn, 1e-300), 0.1, 1.0)
        new = _carried(velocity, z, t, speed, dt) + _noise(noise, inverse, dt, rng)
        keep = ~gone & (dt < rest)
        if not keep.any():
            break
        z, t = new[keep], (t + dt)[keep]
    return escaped / PATHS, where


def _carried(velocity: Callable[[Array, Array], Array], z: Array, t: Array, first: Array, dt: Array) -> Array:
    """Return places (J, n) after a step of Runge and Kutta; Euler's would widen an oscillation at every turn until it escapes."""
    half, step = 0.5 * dt, dt[:, None]
    second = velocity(z + 0.5 * step * first, t + half)
    third = velocity(z + 0.5 * step * second, t + half)
    last = velocity(z + step * third, t + dt)
    return z + step / 6.0 * (first + 2.0 * second + 2.0 * third + last)


def _noise(noise: Array, inverse: Array, dt: Array, rng: np.random.Generator) -> Array:
    """Return increments (J, n) of the noise, in whitened coordinates."""
    white = inverse @ np.where(np.isfinite(noise), noise, 0.0) @ inverse.T
    if len(white) > 1 and np.array_equal(white[0], white[-1]) and np.ptp(white, axis=0).max() == 0:
        white = white[:1]
    values, vectors = np.linalg.eigh(white)
    scaled = rng.standard_normal((len(dt), inverse.shape[0])) * np.sqrt(np.maximum(values, 0.0))
    return np.einsum("...ij,...j->...i", vectors, scaled) * np.sqrt(dt)[:, None]
