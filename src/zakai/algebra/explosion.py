"""Whether the drift takes states to infinity in a finite time, seen in a short plain simulation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from zakai.algebra.systems import affine_parts
from zakai.errors import InputError
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function

STARTS = 24  # states that are tried, in directions without any symmetry
RADII = (1.0, 10.0, 100.0)
MOVE = 0.1  # of the distance from the origin, at most, in one step
STEPS = 300
FAR = 1e3  # how often farther away than at first, and
FAST = 1e6  # how often faster: d log |x| / dt grows without end where x reaches infinity in finite time


@dataclass(frozen=True)
class Explosion:
    """The solution of dx/dt = f(x) from `start` (n,) passes every bound before `time`, in the model's units of time."""

    start: tuple[float, ...]
    time: float

    def __str__(self) -> str:
        start = ", ".join(f"{value:.3g}" for value in self.start)
        return (
            f"the drift alone takes x = ({start}) to infinity within t = {self.time:.2g}: where the noise reaches such states, "
            "paths explode with positive probability, and a simulation or a lattice cannot follow them"
        )


@lru_cache(maxsize=64)
def explosion(model: Model) -> Explosion | None:
    """A start from which the drift at the model's first time explodes; None where none was found, which proves nothing.

    dx/dt = f(x) is followed from 24 states at distances of 1, 10 and 100 from the origin, in a time that slows down as x
    speeds up, so that no step moves x by more than a tenth of its size.  It explodes if d log |x| / dt, which is bounded
    where |f| <= C (1 + |x|) (nothing explodes then, by Gronwall), has grown a millionfold when |x| has grown a
    thousandfold, and with half the step too.

        >>> import zakai
        >>> print(explosion(zakai.load_model("gallery:lorenz")))
        None
    """
    if affine_parts(model.drift, model.x) is not None:
        return None
    try:
        drift = numpy_function(model.drift, model)
    except InputError:  # an undetermined function
        return None
    directions = np.random.default_rng(0).normal(size=(STARTS, model.n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    starts = directions * np.resize(RADII, (STARTS, 1))
    with np.errstate(all="ignore"):
        while len(starts):
            found = _exploding(model, drift, starts, MOVE)
            if found is None:
                break
            start = starts[found[0]]
            again = _exploding(model, drift, start[None], MOVE / 2)
            if again is not None:
                return Explosion(tuple(float(value) for value in start), again[1])
            starts = np.delete(starts, found[0], axis=0)
    return None


def _exploding(model: Model, drift: NumericFunction, starts: np.ndarray, move: float) -> tuple[int, float] | None:
    """The first of the starts (k, n) whose path explodes, and the time that it took."""
    theta = model.theta()

    def slowed(path):
        x = path[:, :-1]
        f = drift(x, model.start, theta)
        size = 1.0 + np.linalg.norm(x, axis=-1, keepdims=True)
        speed = np.linalg.norm(f, axis=-1, keepdims=True)
        pace = np.where(np.isinf(speed), np.nan, size / (size + speed))
        return np.hstack([pace * f, pace])

    def outward(x):
        return np.sum(x * drift(x, model.start, theta), axis=-1) / np.sum(x * x, axis=-1)

    speed = 1.0 + np.linalg.norm(drift(starts, model.start, theta), axis=-1) / np.linalg.norm(starts, axis=-1)
    going = np.isfinite(speed)
    path = np.hstack([starts, np.zeros((len(starts), 1))])  # x and the time
    for _ in range(round(STEPS * MOVE / move)):
        if not np.any(going):
            break
        one = slowed(path)
        two = slowed(path + 0.5 * move * one)
        three = slowed(path + 0.5 * move * two)
        four = slowed(path + move * three)
        new = path + move / 6 * (one + 2 * two + 2 * three + four)
        there = np.all(np.isfinite(new), axis=-1)
        path = np.where((going & there)[:, None], new, path)
        x = path[:, :-1]
        far = np.linalg.norm(x, axis=-1) > FAR * np.linalg.norm(starts, axis=-1)
        exploded = np.flatnonzero(going & (far | ~there) & (outward(x) > FAST * speed))
        if len(exploded):
            return int(exploded[0]), float(path[exploded[0], -1])
        going &= there
    return None
