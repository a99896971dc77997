"""Whether the drift takes states to infinity in a finite time, seen in a short plain simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zakai.algebra.systems import affine_parts
from zakai.errors import InputError
from zakai.models.features import STATE_DEPENDENT_DIFFUSION, of_dynamics
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function

STARTS = 24  # states that are tried, in directions without any symmetry
RADII = (1.0, 10.0, 100.0)
MOVE = 0.1  # of the distance from the origin, at most, in one step
STEPS = 300
FAR = 1e3  # how often farther away than at first, and
FAST = 1e6  # how often faster: d log |x| / dt grows without end where x reaches infinity in finite time
EVALUATIONS = 50_000  # of the drift, to follow all paths that may explode once more


@dataclass(frozen=True)
class Explosion:
    """The solution of dx/dt = f(x) from `start` (n,) passes every bound before `time`, in the model's units of time."""

    start: tuple[float, ...]
    time: float

    def __str__(self) -> str:
        start = ", ".join(f"{value:.3g}" for value in self.start)
        return (
            f"the drift alone takes x = ({start}) to infinity within t = {self.time:.2g}: where the noise reaches such states, "
            "paths explode with positive probability, and a simulation or a grid cannot follow them"
        )


@once_for_a_model
def explosion(model: Model) -> Explosion | None:
    """A start from which the drift at the model's first time explodes; None where none was found, which proves nothing.

    dx/dt = f(x) is followed from 24 states at distances of 1, 10 and 100 from the origin, in a time that slows down as x
    speeds up, so that no step moves x by more than a tenth of its size.  It explodes if d log |x| / dt, which is bounded
    where |f| <= C (1 + |x|) (nothing explodes then, by Gronwall), has grown a millionfold when |x| has grown a
    thousandfold, and if it does so with controlled errors too.

        >>> import zakai
        >>> print(explosion(zakai.load_model("gallery:lorenz")))
        None
    """
    if of_dynamics(model).keys() - {STATE_DEPENDENT_DIFFUSION} or affine_parts(model.drift, model.x) is not None:
        return None
    try:
        drift = numpy_function(model.drift, model)
    except InputError:  # an undetermined function
        return None
    directions = np.random.default_rng(0).normal(size=(STARTS, model.n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    starts = directions * np.resize(RADII, (STARTS, 1))
    left = [EVALUATIONS]
    with np.errstate(all="ignore"):
        while len(starts):
            found = _exploding(model, drift, starts)
            if found is None:
                break
            time = _confirmed(model, drift, starts[found], left)
            if time is not None:
                return Explosion(tuple(float(value) for value in starts[found]), time)
            starts = np.delete(starts, found, axis=0)
    return None


def _slowed(model: Model, drift: NumericFunction, path: np.ndarray) -> np.ndarray:
    """The derivative of (x, time), (k, n + 1), in a time in which x moves by less than its size."""
    x = path[:, :-1]
    f = drift(x, model.start, model.theta())
    size = 1.0 + np.linalg.norm(x, axis=-1, keepdims=True)
    speed = np.linalg.norm(f, axis=-1, keepdims=True)
    pace = np.where(np.isinf(speed), np.nan, size / (size + speed))
    return np.hstack([pace * f, pace])


def _outward(model: Model, drift: NumericFunction, x: np.ndarray) -> np.ndarray:
    """d log |x| / dt."""
    return np.sum(x * drift(x, model.start, model.theta()), axis=-1) / np.sum(x * x, axis=-1)


def _fast(model: Model, drift: NumericFunction, starts: np.ndarray) -> np.ndarray:
    """The rate d log |x| / dt of a path that explodes."""
    return FAST * (1.0 + np.linalg.norm(drift(starts, model.start, model.theta()), axis=-1) / np.linalg.norm(starts, axis=-1))


def _exploding(model: Model, drift: NumericFunction, starts: np.ndarray) -> int | None:
    """The first of the starts (k, n) whose path seems to explode, in steps that are not watched."""

    def slowed(path: np.ndarray) -> np.ndarray:
        return _slowed(model, drift, path)

    fast = _fast(model, drift, starts)
    going = np.isfinite(fast)
    path = np.hstack([starts, np.zeros((len(starts), 1))])  # x and the time
    for _ in range(STEPS):
        if not np.any(going):
            break
        one = slowed(path)
        two = slowed(path + 0.5 * MOVE * one)
        three = slowed(path + 0.5 * MOVE * two)
        four = slowed(path + MOVE * three)
        new = path + MOVE / 6 * (one + 2 * two + 2 * three + four)
        finite = np.all(np.isfinite(new), axis=-1)
        path = np.where((going & finite)[:, None], new, path)
        x = path[:, :-1]
        far = np.linalg.norm(x, axis=-1) > FAR * np.linalg.norm(starts, axis=-1)
        exploded = np.flatnonzero(going & (far | ~finite) & (_outward(model, drift, x) > fast))
        if len(exploded):
            return int(exploded[0])
        going &= finite
    return None


def _confirmed(model: Model, drift: NumericFunction, start: np.ndarray, left: list[int]) -> float | None:
    """The time in which the path of one start explodes, its error controlled; None where it does not, or takes too long.

    Steps of a tenth of |x| leap over the places where x^2 (1 + sin x) dt comes to rest.
    """
    from scipy.integrate import LSODA

    def slowed(_: float, path: np.ndarray) -> np.ndarray:
        left[0] -= 1
        return _slowed(model, drift, path[None])[0]

    fast = _fast(model, drift, start[None])[0]
    solver = LSODA(slowed, 0.0, np.append(start, 0.0), STEPS * MOVE, max_step=MOVE, rtol=1e-8, atol=1e-10)
    while solver.status == "running" and left[0] > 0:
        before = solver.y
        solver.step()
        finite = np.all(np.isfinite(solver.y)) and solver.status != "failed"
        path = solver.y if finite else before
        far = np.linalg.norm(path[:-1]) > FAR * np.linalg.norm(start)
        if (far or not finite) and _outward(model, drift, path[None, :-1])[0] > fast:
            return float(path[-1])
        if not finite:
            break
    return None
