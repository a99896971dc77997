"""The maximum of a log-likelihood in a box, and the information there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from zakai.errors import InputError
from zakai.models._errors import listing
from zakai.models.model import Model

ITERATIONS = 200
FIRST = 0.1  # length of the first step of L-BFGS-B, relative to the parameters
GAIN = 1e-6  # nats, by which an iteration of L-BFGS-B must raise the log-likelihood; Newton's steps do the rest
NEAR = 1e-3  # the distance to the maximum, in standard errors, that counts as none
SINGULAR = 1e-6  # the smallest eigenvalue of the information scaled to a unit diagonal; differences leave 1e-8


Function = Callable[[np.ndarray], tuple[float, np.ndarray]]  # a value and its gradient (p,)


@dataclass
class Found:
    """The best values, the log-likelihood and the covariance there, and what is wrong with them."""

    values: np.ndarray
    log_likelihood: float
    covariance: np.ndarray
    converged: bool
    message: str
    problem: str
    iterations: int


class _Objective:
    """The negative log-likelihood of the parameters in units of `scale`, and its gradient; finite everywhere."""

    def __init__(self, function: Function, origin: np.ndarray, scale: np.ndarray):
        self._both = function
        self.origin, self.scale = origin, scale
        self.best: tuple[float, np.ndarray, np.ndarray] | None = None
        self.refused = 0

    def exact(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = self._both(self.origin + self.scale * u)
        return -float(value), -self.scale * np.asarray(gradient, float)

    def __call__(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = self.exact(u)
        if np.isfinite(value) and np.isfinite(gradient).all():
            if self.best is None or value < self.best[0]:
                self.best = value, np.array(u), gradient
            return value, gradient
        # Beyond the domain the function rises ten times as fast as it fell at the best point, so that the search turns back.
        assert self.best is not None
        self.refused += 1
        best, at, slope = self.best
        rise = -10.0 * slope
        return best + abs(rise @ (u - at)) + 1e-3, rise


def hessian(gradient: Callable[[np.ndarray], np.ndarray], u: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the central differences (p, p) of a gradient, by steps (p,)."""
    matrix = np.array([(gradient(u + shift) - gradient(u - shift)) / (2 * shift.sum()) for shift in np.diag(steps)])
    return np.asarray(0.5 * (matrix + matrix.T))


def maximum(function: Function, values: np.ndarray, box: np.ndarray, names: tuple[str, ...], model: Model) -> Found:
    """Return the maximum of the likelihood from `values`: L-BFGS-B, and then Newton's steps in the free parameters."""
    scale = FIRST * np.where(values != 0, np.abs(values), 1.0)
    objective = _Objective(function, values, scale)
    value, gradient = objective.exact(np.zeros(len(values)))
    if not (np.isfinite(value) and np.isfinite(gradient).all()):
        at = ", ".join(f"{name} = {float(number):g}" for name, number in zip(names, values, strict=True))
        raise InputError(f"{model.source}: start: the log-likelihood does not exist at {at}; give another start")
    limits = (box - values[:, None]) / scale[:, None]
    gtol = 1e-7 * max(FIRST, np.abs(gradient).max() * 1e-3)
    settings = {"maxiter": ITERATIONS, "ftol": GAIN / max(1.0, abs(value)), "gtol": gtol}
    search = minimize(objective, np.zeros(len(values)), jac=True, method="L-BFGS-B", bounds=limits, options=settings)
    assert objective.best is not None
    # The search may have moved far: the best point gives the new units.
    values, old = np.clip(values + scale * objective.best[1], box[:, 0], box[:, 1]), scale
    scale = np.where(values != 0, np.abs(values), scale / FIRST)
    limits = (box - values[:, None]) / scale[:, None]
    objective, u = _Objective(function, values, scale), np.zeros(len(values))
    value, gradient = objective.exact(u)
    iterations = int(search.nit)
    deviations = np.sqrt(np.abs(np.diag(search.hess_inv.todense()))) * old / scale
    information, place = np.zeros((0, 0)), u
    for _ in range(8):
        held = ((u <= limits[:, 0]) & (gradient > 0)) | ((u >= limits[:, 1]) & (gradient < 0))
        free = ~held
        if not information.size:
            information, place = _information(objective, u, deviations, free), u
        cov, distance, problem = _inverse(information, gradient, free, names)
        if not np.isfinite(distance) or distance < 1e-2 * NEAR:
            if not np.any(np.abs(u - place)[free] > NEAR * np.sqrt(np.diag(cov)[free])):
                break
            information, deviations = np.zeros((0, 0)), np.sqrt(np.diag(cov))  # of the place where the search has ended
            continue
        # Newton's step, in the box; where it gains nothing, rounding has been reached.
        trial = np.clip(u - np.nan_to_num(cov) @ np.where(free, gradient, 0.0), limits[:, 0], limits[:, 1])
        new, slope = objective.exact(trial)
        if not (new <= value + 1e-13 * abs(value)) or not np.isfinite(slope).all():
            break
        value, u, gradient, iterations = new, trial, slope, iterations + 1
    converged = bool(distance < NEAR) if np.isfinite(distance) else bool(search.success and not problem.startswith("the log"))
    if held.any():
        at = ", ".join(f"{name} = {values[i] + scale[i] * u[i]:g}" for i, name in enumerate(names) if held[i])
        problem = "; ".join(filter(None, [f"at a bound ({at}), where there is no standard error", problem]))
    covariance = np.where(np.outer(free, free), cov * np.outer(scale, scale), np.nan)
    message = f"converged after {iterations} iterations" if converged else f"not converged after {iterations} iterations"
    if not converged:
        said = search.message if isinstance(search.message, str) else search.message.decode()
        message += f" ({said.strip().lower()})"
    values = np.clip(values + scale * u, box[:, 0], box[:, 1])
    return Found(values, -value, covariance, converged, message, problem, iterations)


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
