"""Maximum likelihood: the parameters under which a record is most probable, with their standard errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import minimize

from zakai import _display
from zakai._progress import Advance, bar
from zakai.densities import GaussianMixture
from zakai.engine.driver import filter as run_filter
from zakai.engine.likelihood import LogLikelihood, chosen_parameters
from zakai.errors import InputError
from zakai.models._errors import listing
from zakai.models.model import Model
from zakai.records import Record

ITERATIONS = 200
NEAR = 1e-3  # the distance to the maximum, in standard errors, that counts as none
SINGULAR = 1e-6  # the smallest eigenvalue of the information scaled to a unit diagonal; differences leave 1e-8


@dataclass(frozen=True, eq=False)
class Fit:
    """The parameters of largest likelihood.

    `estimates` and `standard_errors` by name, the latter from the observed information (the negative Hessian of the
    log-likelihood), nan where there is none; `log_likelihood` at the estimates; `model` with the estimates as its parameters;
    `converged`, and a `message` that says what happened; `iterations` of the optimiser; `warnings`, in sentences, those of the
    filter at the estimates among them; `covariance` (p, p), the inverse information; `method`, the filter's name.
    """

    estimates: dict[str, float]
    standard_errors: dict[str, float]
    log_likelihood: float
    model: Model
    converged: bool
    message: str
    iterations: int
    covariance: np.ndarray
    method: str
    observations: int
    warnings: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        width = max(map(len, self.estimates))
        lines = [
            f"maximum likelihood by {self.method}, {self.observations} observations: log-likelihood {self.log_likelihood:.8g}",
            *(f"  {name:{width}} = {value:.6g} +- {self.standard_errors[name]:.2g}" for name, value in self.estimates.items()),
            f"  {self.message}",
            *(f"  warning: {line}" for line in self.warnings),
        ]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        rows = [(name, _display.number(value), f"{self.standard_errors[name]:.2g}") for name, value in self.estimates.items()]
        title = f"Fit({self.method}: {_display.counted(self.observations, 'observation')}, {self.message})"
        return _display.html_table(title, ("parameter", "estimate", "standard error"), rows, self.warnings)

    def plot(self, parameters: Sequence[str] | None = None, *, ax: Any = None) -> Any:
        """Draw the Gaussian approximation N(estimates, covariance) of the estimates: one parameter, or regions of two.

        Args:
            parameters: one or two names; needed where more than two are fitted.
            ax: the Matplotlib Axes to draw in; a new figure without it.

        Returns:
            The Matplotlib Axes.

        Raises:
            InputError: an unknown name, no standard errors, or Matplotlib is not installed (extra `plots`).
        """
        from zakai.report.axes import draw_density

        wanted = list(self.estimates) if parameters is None else [parameters] if isinstance(parameters, str) else list(parameters)
        names = tuple(self.estimates)
        for name in wanted:
            if name not in names:
                raise InputError(f"plot: {name!r} is not among the parameters that were fitted ({listing(names)})")
        rows = [names.index(name) for name in wanted]
        covariance = self.covariance[np.ix_(rows, rows)]
        if not np.isfinite(covariance).all():
            raise InputError(f"plot: there are no standard errors of {listing(wanted)}; see the warnings of the fit")
        mean = np.array([self.estimates[name] for name in wanted])
        return draw_density(GaussianMixture.gaussian(mean, covariance, tuple(wanted), (False,) * len(wanted)), ax)


def fit(
    model: Model,
    record: Record,
    parameters: Sequence[str] | None = None,
    method: str = "auto",
    *,
    start: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
    **options: Any,
) -> Fit:
    """Return the parameters of largest likelihood given the record.

        maximise l(theta) = log p(observations | theta);  standard errors: (-Hessian of l)^-1/2, on the diagonal

    The likelihood and its gradient are those of `log_likelihood`, maximised by L-BFGS-B and Newton's steps. Check `converged`
    and `warnings` of the result.

    Args:
        model: the system, with a prior; the search starts from its parameters.
        record: K observations.
        parameters: the names to estimate; by default all.
        method: as for `filter`.
        start: values by name from which the search starts instead.
        bounds: (lowest, highest) by name, None for no bound. A noise covariance that is not positive is never accepted.
        **options: as for `filter`.

    Returns:
        The estimates, their standard errors, and the model with the estimates.

    Raises:
        InputError: an unknown parameter, wrong bounds, or a start at which the likelihood does not exist; and as for `filter`.

    References:
        Byrd, Lu, Nocedal and Zhu 1995, A limited memory algorithm for bound constrained optimization.

    Example:
        fitted = zakai.fit(model, record, parameters=["a"], bounds={"a": (0, None)})
        fitted.estimates["a"], fitted.standard_errors["a"], fitted.converged
    """
    names = chosen_parameters(model, parameters)
    values = _start(model, names, start)
    box = _box(model, names, values, bounds)
    now = model.with_parameters(**dict(zip(names, values.tolist(), strict=True)))
    with bar("fitting") as advance:
        found = _maximum(_Counted(LogLikelihood(now, record, method, names, options), advance), values, box, names, model)
    values = found.values
    now = model.with_parameters(**dict(zip(names, values.tolist(), strict=True)))
    result = run_filter(now, record, method, keep="moments", **options)
    warnings = list(result.warnings)
    if found.problem:
        warnings.insert(0, found.problem)
    if not found.converged:
        warnings.insert(0, "the fit did not converge; these are the best values that were found")
    errors = np.sqrt(np.where(np.diag(found.covariance) > 0, np.diag(found.covariance), np.nan))
    return Fit(
        estimates=dict(zip(names, values.tolist(), strict=True)),
        standard_errors=dict(zip(names, errors.tolist(), strict=True)),
        log_likelihood=result.log_likelihood,
        model=now,
        converged=found.converged,
        message=found.message,
        iterations=found.iterations,
        covariance=found.covariance,
        method=result.method,
        observations=len(record.times),
        warnings=warnings,
    )


class _Counted:
    """The log-likelihood and its gradient; every evaluation is reported."""

    def __init__(self, function: LogLikelihood, advance: Advance | None):
        self._function, self._advance, self._count = function, advance, 0

    def value_and_gradient(self, values: np.ndarray) -> tuple[float, np.ndarray]:
        self._count += 1
        if self._advance is not None:
            self._advance(self._count, None)
        return self._function.value_and_gradient(values)


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or np.isnan(value):
        raise InputError(f"{where}: {value!r} is not a number")
    return float(value)


def _known(given: Any, names: tuple[str, ...], key: str) -> Mapping[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"{key}: expected a dictionary by parameter name, got a {type(given).__name__}")
    for name in given:
        if name not in names:
            raise InputError(f"{key}: {name!r} is not among the parameters that are fitted ({listing(names)})")
    return given


def _start(model: Model, names: tuple[str, ...], start: Any) -> np.ndarray:
    given = _known(start, names, "start")
    return np.array([_number(given.get(name, float(model.parameters[name])), f"start: {name}") for name in names])


def _box(model: Model, names: tuple[str, ...], values: np.ndarray, bounds: Any) -> np.ndarray:
    """The bounds (p, 2), infinite where there is none."""
    box = np.tile([-np.inf, np.inf], (len(names), 1))
    for name, pair in _known(bounds, names, "bounds").items():
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise InputError(f"bounds: {name}: {pair!r} is not a pair (lowest, highest); None stands for no bound")
        for side, value in enumerate(pair):
            if value is not None:
                box[names.index(name), side] = _number(value, f"bounds: {name}")
    for name, value, (low, high) in zip(names, values, box, strict=True):
        if not low < high:
            raise InputError(f"bounds: {name}: {low:g} is not below {high:g}")
        if not low <= value <= high:
            raise InputError(f"start: {name}: {value:g} is outside its bounds {low:g} and {high:g}; give another start")
    return box


@dataclass
class _Found:
    values: np.ndarray
    log_likelihood: float
    covariance: np.ndarray
    converged: bool
    message: str
    problem: str
    iterations: int


class _Objective:
    """The negative log-likelihood of the parameters in units of `scale`, and its gradient; finite everywhere."""

    def __init__(self, function: _Counted, origin: np.ndarray, scale: np.ndarray):
        self._both = function.value_and_gradient
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
        # A wall behind the best point, which rises ten times as fast as the function fell there: the search turns back.
        assert self.best is not None
        self.refused += 1
        best, at, slope = self.best
        rise = -10.0 * slope
        return best + abs(rise @ (u - at)) + 1e-3, rise

    def hessian(self, u: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Central differences of the gradient."""
        columns = []
        for shift in np.diag(steps):
            above, below = self.exact(u + shift)[1], self.exact(u - shift)[1]
            columns.append((above - below) / (2 * shift.sum()))
        matrix = np.array(columns)
        return np.asarray(0.5 * (matrix + matrix.T))


def _maximum(function: _Counted, values: np.ndarray, box: np.ndarray, names: tuple[str, ...], model: Model) -> _Found:
    """The maximum of the replayed likelihood from `values`: L-BFGS-B, and then Newton's steps in the free parameters."""
    scale = np.where(values != 0, np.abs(values), 1.0)
    objective = _Objective(function, values, scale)
    value, gradient = objective.exact(np.zeros(len(values)))
    if not (np.isfinite(value) and np.isfinite(gradient).all()):
        at = ", ".join(f"{name} = {float(number):g}" for name, number in zip(names, values, strict=True))
        raise InputError(f"{model.source}: start: the log-likelihood does not exist at {at}; give another start")
    limits = (box - values[:, None]) / scale[:, None]
    settings = {"maxiter": ITERATIONS, "ftol": 1e-13, "gtol": 1e-7 * max(1.0, np.abs(gradient).max() * 1e-3)}
    search = minimize(objective, np.zeros(len(values)), jac=True, method="L-BFGS-B", bounds=limits, options=settings)
    assert objective.best is not None
    # From here on the unit is where the search came to: it may have come a long way.
    values = np.clip(values + scale * objective.best[1], box[:, 0], box[:, 1])
    scale = np.where(values != 0, np.abs(values), scale)
    limits = (box - values[:, None]) / scale[:, None]
    objective, u = _Objective(function, values, scale), np.zeros(len(values))
    value, gradient = objective.exact(u)
    iterations = int(search.nit)
    for _ in range(8):
        held = ((u <= limits[:, 0]) & (gradient > 0)) | ((u >= limits[:, 1]) & (gradient < 0))
        free = ~held
        information = _information(objective, u, free)
        cov, distance, problem = _inverse(information, gradient, free, names)
        if not np.isfinite(distance) or distance < 1e-2 * NEAR:
            break
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
    return _Found(values, -value, covariance, converged, message, problem, iterations)


def _information(objective: _Objective, u: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The Hessian of the negative log-likelihood, by steps of a thousandth of a standard error, once that is known."""
    for size in (1e-4, 1e-6, 1e-8):
        steps = np.full(len(u), size)
        first = np.diag(objective.hessian(u, steps))
        if np.isfinite(first[free]).all():
            break
    with np.errstate(invalid="ignore", divide="ignore"):
        better = np.where(free & (first > 0), 1e-3 / np.sqrt(first), steps)
    return objective.hessian(u, np.clip(np.where(np.isfinite(better), better, steps), 1e-7, 1e-1))


def _inverse(
    information: np.ndarray, gradient: np.ndarray, free: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, float, str]:
    """The inverse information of the free parameters, the distance to the maximum in standard errors, and what is wrong."""
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
