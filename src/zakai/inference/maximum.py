"""The maximum of a log-likelihood in a box, and the information there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from zakai.errors import InputError
from zakai.inference.limit import Exists, Limit
from zakai.models._errors import listing
from zakai.models.model import Model

ITERATIONS = 200
FIRST = 0.1  # length of the first step of L-BFGS-B, relative to the parameters
GAIN = 1e-6  # nats, by which an iteration of L-BFGS-B must raise the log-likelihood; Newton's steps do the rest
NEAR = 1e-3  # the distance to the maximum, in standard errors, that counts as none
LIMIT = 0.1  # nats: the most that can be gained before values without a log-likelihood, at which the search ends
ROUNDS = 4  # of a search in all parameters and one along a limit
FAR = 10.0  # factor by which a parameter may change before a search in logarithms is tried, too
MOST_FACTORS = 6  # of this size, one after another
DECADES = 2  # by which each parameter is varied where a search has ended on a plateau
MOST_TRIALS = 50  # of parameters so varied, drawn at random where there are more
HALVINGS = 20  # of a step that leads to such values
EVEN = 1e-9  # relative difference of log-likelihoods that are the same
SINGULAR = 1e-6  # the smallest eigenvalue of the information scaled to a unit diagonal; differences leave 1e-8


Function = Callable[[np.ndarray], tuple[float, np.ndarray]]  # a value and its gradient (p,)


class Likelihood(NamedTuple):
    """The log-likelihood of the parameters `names` (p,) of a model, with its gradient, in a `box` (p, 2).

    `exists` returns whether it exists at some values; at values close by it may differ by `jumps`.
    """

    function: Function
    box: np.ndarray
    names: tuple[str, ...]
    model: Model
    exists: Exists
    jumps: float = 0.0


@dataclass
class Found:
    """The best values, the log-likelihood and the covariance there, and what is wrong with them.

    `beyond`: values close by without a log-likelihood, where the search ended at such a limit.
    """

    values: np.ndarray
    log_likelihood: float
    covariance: np.ndarray
    converged: bool
    message: str
    problem: str
    iterations: int
    beyond: np.ndarray | None
    upwards: np.ndarray | None = None  # a direction in which the log-likelihood curves upwards at the values (p,)


class _LimitReached(Exception):  # noqa: N818  # ends the search
    pass


class _Objective:
    """The negative log-likelihood of the parameters in units of `scale`, and its gradient.

    `beyond`: the last values without a log-likelihood; `jumps`: nats by which values close by differ by chance.
    """

    def __init__(self, function: Function, origin: np.ndarray, scale: np.ndarray, jumps: float = 0.0):
        self._both, self.jumps = function, jumps
        self.origin, self.scale = origin, scale
        self.best: tuple[float, np.ndarray, np.ndarray] | None = None
        self.beyond: np.ndarray | None = None

    def values(self, u: np.ndarray) -> np.ndarray:
        """Return the parameters."""
        return np.asarray(self.origin + self.scale * u)

    def exact(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the function and its gradient, NaN where they do not exist."""
        value, gradient = self._both(self.values(u))
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            self.beyond = self.values(u)
            return np.nan, np.full(len(u), np.nan)
        return -float(value), -self.scale * np.asarray(gradient, float)

    def __call__(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the same, finite everywhere.

        Raises:
            _LimitReached: the values have no log-likelihood, and there is nothing to be gained before them.
        """
        value, gradient = self.exact(u)
        if np.isfinite(value):
            if self.best is None or value < self.best[0]:
                self.best = value, np.array(u), gradient
            return value, gradient
        assert self.best is not None
        best, at, slope = self.best
        if self.at_limit(at, slope):
            raise _LimitReached
        # The gradient of the best point in reverse and about its value, by which the line search halves its step.
        return best + LIMIT * abs(slope @ (u - at)), -slope

    def at_limit(self, u: np.ndarray, gradient: np.ndarray) -> bool:
        """Return whether the log-likelihood rises from u towards values where it does not exist, but by next to nothing."""
        return self.beyond is not None and bool(0.0 < gradient @ (u - (self.beyond - self.origin) / self.scale) < LIMIT)


def hessian(gradient: Callable[[np.ndarray], np.ndarray], u: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the central differences (p, p) of a gradient, by steps (p,)."""
    matrix = np.array([(gradient(u + shift) - gradient(u - shift)) / (2 * shift.sum()) for shift in np.diag(steps)])
    return np.asarray(0.5 * (matrix + matrix.T))


def _search(
    function: Function, start: np.ndarray, value: float, gradient: np.ndarray, limits: np.ndarray, gain: float
) -> OptimizeResult:
    """Return what L-BFGS-B finds from a start with this value and gradient, without success where it reaches a limit."""
    gtol = 1e-7 * max(FIRST, np.abs(gradient).max() * 1e-3)
    settings = {"maxiter": ITERATIONS, "ftol": gain / max(1.0, abs(value)), "gtol": gtol}
    path: list[np.ndarray] = []
    try:
        return minimize(function, start, jac=True, method="L-BFGS-B", bounds=limits, options=settings, callback=path.append)
    except _LimitReached:
        return OptimizeResult(success=False, nit=len(path), hess_inv=None, message="at a limit of the parameters")


def _along(objective: _Objective, limit: Limit, gap: float, limits: np.ndarray) -> int:
    """Search by the parameters but one, which is held at a distance from its limit; return the number of iterations."""
    assert objective.best is not None
    others = np.arange(len(limits)) != limit.axis

    def held(z: np.ndarray) -> tuple[float, np.ndarray]:
        u = np.zeros(len(limits))
        u[others] = z
        end = limit.at(u)
        u[limit.axis] = np.clip((limit.last if end is None else end) - limit.side * gap, *limits[limit.axis])
        value, gradient = objective(u)
        return value, (gradient + gradient[limit.axis] * limit.slope(u))[others]

    value, u, gradient = objective.best
    return int(_search(held, u[others], value, gradient, limits[others], max(GAIN, objective.jumps)).nit)


class _Searched(NamedTuple):
    """The last search in all parameters, the number of iterations of all, and values beyond the limit where it ended."""

    last: OptimizeResult
    iterations: int
    beyond: np.ndarray | None


def _searched(objective: _Objective, exists: Exists, limits: np.ndarray) -> _Searched:
    """Search in all parameters, and along a limit that is in the way, until there is none or the maximum lies at it."""
    iterations, end = 0, None
    for _ in range(ROUNDS):
        assert objective.best is not None
        value, u, gradient = objective.best
        search = _search(objective, u, value, gradient, limits, max(GAIN, objective.jumps))
        iterations += int(search.nit)
        if search.hess_inv is not None:
            return _Searched(search, iterations, None)
        value, u, gradient = objective.best
        limit, end = Limit(lambda v: exists(objective.values(v)), u, gradient, 2.0 * LIMIT), None
        if not limit.found:  # each parameter alone may still change, so that another direction may lead on
            continue
        if len(u) > 1:
            iterations += _along(objective, limit, 0.5 * LIMIT / abs(gradient[limit.axis]), limits)
            value, u, gradient = objective.best
        if gradient[limit.axis] * limit.side <= 0.0:  # the log-likelihood still rises towards the limit
            end = limit.at(u)
            break
    beyond = objective.beyond if end is None else objective.values(np.where(np.arange(len(u)) == limit.axis, end, u))
    return _Searched(search, iterations, beyond)


def maximum(likelihood: Likelihood, values: np.ndarray) -> Found:
    """Return the maximum of the likelihood from `values`.

    Where a parameter has changed its sign or its size by far, which may lead across a pole, a second search keeps the signs, in
    the logarithms of the sizes, and the higher end counts.  Where the search ends at values from which the log-likelihood curves
    upwards, it goes on from the best ones in that direction; where it ends on a plateau, from the best of the values that are
    larger and smaller than the first ones by up to two decades.
    """
    function, box = likelihood.function, likelihood.box
    found = _maximum(likelihood, values)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.where(values == 0, 1.0, found.values / values)
    if ((moved < 1.0 / FAR) | (moved > FAR)).any():
        later = _maximum(likelihood, _by_size(function, values, box))
        known = later.converged or not found.converged  # a plateau far away does not replace a maximum
        if known and later.log_likelihood > found.log_likelihood + LIMIT:
            found = replace(later, iterations=found.iterations + later.iterations)
    for _ in range(ROUNDS):
        start = _uphill(function, found, box)
        if start is None:
            break
        later = _maximum(likelihood, start)
        if not later.log_likelihood > found.log_likelihood:
            break
        found = replace(later, iterations=found.iterations + later.iterations)
    start = _beside_plateau(function, found, values, box)
    if start is not None:
        later = _maximum(likelihood, start)
        if later.log_likelihood > found.log_likelihood + LIMIT:
            found = replace(later, iterations=found.iterations + later.iterations)
    return found


def _beside_plateau(function: Function, found: Found, values: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Return the best values within two decades of the first ones, where a search has found no information.

    None where there was some, or no better values.
    """
    if np.isfinite(np.diag(found.covariance)).any() or found.beyond is not None:
        return None
    decades = np.arange(-DECADES, DECADES + 1)
    if len(decades) ** len(values) <= MOST_TRIALS:
        factors = np.stack(np.meshgrid(*[decades] * len(values)), axis=-1).reshape(-1, len(values))
    else:
        factors = np.random.default_rng(0).integers(-DECADES, DECADES + 1, (MOST_TRIALS, len(values)))
    best, start = found.log_likelihood + LIMIT, None
    for trial in np.clip(values * 10.0**factors, box[:, 0], box[:, 1]):
        value = function(trial)[0]
        if np.isfinite(value) and value > best:
            best, start = value, trial
    return start


def _by_size(function: Function, values: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the parameters where a search in the logarithms of their sizes ends, with the signs of `values`.

    It goes by factors of at most `FAR`, and on from there.
    """
    log, centre = values != 0, values

    def at(v: np.ndarray) -> np.ndarray:
        return np.clip(np.where(log, centre * np.exp(np.where(log, v, 0.0)), centre + v), box[:, 0], box[:, 1])

    def objective(v: np.ndarray) -> tuple[float, np.ndarray]:
        theta = at(v)
        value, gradient = function(theta)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return 1e300, np.zeros(len(v))
        return -float(value), -gradient * np.where(log, theta, 1.0)

    reach = float(np.log(FAR))
    bounds = [(-reach, reach) if one else (None, None) for one in log]
    options = {"maxiter": ITERATIONS, "ftol": 1e-9}
    for _ in range(MOST_FACTORS):
        v = minimize(objective, np.zeros(len(values)), jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
        centre = at(v)
        if not np.any(log & (np.abs(v) >= reach)):
            break
    return centre


def _uphill(function: Function, found: Found, box: np.ndarray) -> np.ndarray | None:
    """Return the best values in a direction in which the log-likelihood curves upwards, None where there are no better ones."""
    if found.converged or found.upwards is None:
        return None
    best, start = found.log_likelihood + LIMIT, None
    for length in np.concatenate([side * 2.0 ** np.arange(-6, 8) for side in (-1.0, 1.0)]):
        trial = np.clip(found.values + length * found.upwards, box[:, 0], box[:, 1])
        value = function(trial)[0]
        if np.isfinite(value) and value > best:
            best, start = value, trial
    return start


def _maximum(likelihood: Likelihood, values: np.ndarray) -> Found:
    """Return the maximum by L-BFGS-B, and then Newton's steps in the free parameters."""
    function, box, names, model, exists, jumps = likelihood
    scale = FIRST * np.where(values != 0, np.abs(values), 1.0)
    objective, u = _Objective(function, values, scale, jumps), np.zeros(len(values))
    value, gradient = objective.exact(u)
    if not np.isfinite(value):
        at = ", ".join(f"{name} = {float(number):g}" for name, number in zip(names, values, strict=True))
        raise InputError(f"{model.source}: start: the log-likelihood does not exist at {at}; give another start")
    objective.best = value, u, gradient
    search, iterations, beyond = _searched(objective, exists, (box - values[:, None]) / scale[:, None])
    deviations = np.zeros(len(values)) if search.hess_inv is None else np.sqrt(np.abs(np.diag(search.hess_inv.todense())))
    # The search may have moved far: the best point gives the new units.
    values, old = np.clip(objective.values(objective.best[1]), box[:, 0], box[:, 1]), scale
    scale = np.where(values != 0, np.abs(values), scale / FIRST)
    limits = (box - values[:, None]) / scale[:, None]
    objective.origin, objective.scale = values, scale
    value, gradient = objective.exact(u)
    deviations = deviations * old / scale
    information, place = np.zeros((0, 0)), u
    for _ in range(8):
        held = ((u <= limits[:, 0]) & (gradient > 0)) | ((u >= limits[:, 1]) & (gradient < 0))
        free = ~held
        if not information.size:
            information, place = _information(objective, u, deviations, free), u
        cov, distance, problem = _inverse(information, gradient, free, names)
        if not np.isfinite(distance) or distance < 1e-2 * NEAR:
            if not np.any(np.abs(u - place)[free] > max(NEAR, np.sqrt(2.0 * jumps)) * np.sqrt(np.diag(cov)[free])):
                break
            information, deviations = np.zeros((0, 0)), np.sqrt(np.diag(cov))  # of the place where the search has ended
            continue
        # Newton's step, in the box; where it gains nothing, rounding or the jumps have been reached.
        step = np.nan_to_num(cov) @ np.where(free, gradient, 0.0)
        for halvings in range(HALVINGS):
            trial = np.clip(u - 0.5**halvings * step, limits[:, 0], limits[:, 1])
            new, slope = objective.exact(trial)
            if np.isfinite(new) or objective.at_limit(u, gradient):
                break
        if not new <= value + max(1e-13 * abs(value), jumps):
            break
        value, u, gradient, iterations = new, trial, slope, iterations + 1
    near = max(NEAR, float(np.sqrt(2.0 * jumps)))
    converged = bool(distance < near) if np.isfinite(distance) else bool(search.success and not problem.startswith("the log"))
    if converged or u.any():  # Newton's steps have left the limit
        beyond = objective.beyond if not converged and objective.at_limit(u, gradient) else None
    problem = problem if beyond is None else ""
    if held.any():
        at = ", ".join(f"{name} = {objective.values(u)[i]:g}" for i, name in enumerate(names) if held[i])
        problem = "; ".join(filter(None, [f"at a bound ({at}), where there is no standard error", problem]))
    covariance = np.where(np.outer(free, free), cov * np.outer(scale, scale), np.nan)
    message = f"converged after {iterations} iterations" if converged else f"not converged after {iterations} iterations"
    if not converged:
        message += f" ({search.message.strip().lower() if beyond is None else 'at a limit of the parameters'})"
    values = np.clip(objective.values(u), box[:, 0], box[:, 1])
    return Found(values, -value, covariance, converged, message, problem, iterations, beyond, _upwards(information, free, scale))


def _upwards(information: np.ndarray, free: np.ndarray, scale: np.ndarray) -> np.ndarray | None:
    """Return the direction (p,) of the smallest negative curvature in the free parameters, about as long as they are, or None."""
    block = information[np.ix_(free, free)]
    if not block.size or not np.isfinite(block).all():
        return None
    size = np.sqrt(np.abs(np.diag(block)))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(block / np.outer(size, size))
    if values[0] >= -SINGULAR:
        return None
    found = np.zeros(len(free))
    found[free] = vectors[:, 0] / size
    return np.asarray(found / np.max(np.abs(found)) * scale)


def with_signs_of(start: np.ndarray, found: Found, function: Function, box: np.ndarray) -> Found:
    """Return what was found with the signs of the start (p,), where other signs have the same log-likelihood.

    A standard deviation r that enters as r^2 is found at r and at -r. Each parameter is tried alone, then all that are left.
    """
    value = function(found.values)[0]

    def same(values: np.ndarray) -> bool:
        inside = bool(np.all((box[:, 0] <= values) & (values <= box[:, 1])))
        return inside and bool(abs(function(values)[0] - value) <= EVEN * max(1.0, abs(value)))

    signs = np.ones(len(start))
    others = np.flatnonzero(start * found.values < 0)
    for group in [*others[:, None], others]:
        trial = signs.copy()
        trial[group] = np.where(start[group] * found.values[group] < 0, -1.0, 1.0)
        if not np.array_equal(trial, signs) and same(trial * found.values):
            signs = trial
    if (signs > 0).all():
        return found
    return replace(found, values=signs * found.values, covariance=np.outer(signs, signs) * found.covariance)


def _information(objective: _Objective, u: np.ndarray, deviations: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the Hessian of the negative log-likelihood, by steps of about a thousandth of the standard deviations (p,)."""
    steps = np.clip(np.where(np.isfinite(deviations) & (deviations > 0), 1e-3 * deviations, 1e-4), 1e-7, 1e-2)
    for size in (1.0, 1e-2, 1e-4):
        found = hessian(lambda v: objective.exact(v)[1], u, size * steps)
        if np.isfinite(found[np.ix_(free, free)]).all():
            break
    return found


def _inverse(
    information: np.ndarray, gradient: np.ndarray, free: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, float, str]:
    """Return the inverse information of the free parameters, the distance to the maximum in standard errors, and the fault."""
    count = len(names)
    cov, index = np.full((count, count), np.nan), np.flatnonzero(free)
    if not len(index):
        return cov, 0.0, ""
    block = information[np.ix_(index, index)]
    if not np.isfinite(block).all():
        return cov, np.nan, "the information does not exist at the estimates, which are at the edge of what is possible"
    size = np.sqrt(np.abs(np.diag(block)))
    values, vectors = np.linalg.eigh(block / np.outer(np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0)))
    if values[0] <= SINGULAR:
        which = listing(names[i] for i, share in zip(index, vectors[:, 0], strict=True) if abs(share) > 0.1)
        if values[0] < -1e-6:
            return cov, np.nan, f"the log-likelihood curves upwards in {which}: this is no maximum"
        return cov, np.nan, f"the information is singular: the record does not determine {which}; no standard errors"
    inverse = (vectors / values) @ vectors.T / np.outer(size, size)
    cov[np.ix_(index, index)] = inverse
    distance = float(np.sqrt(gradient[index] @ inverse @ gradient[index]))
    return cov, distance, ""
