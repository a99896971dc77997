"""Maximum likelihood: the parameters under which a record is most probable, with their standard errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zakai import _display
from zakai._progress import announced, bar
from zakai.densities import GaussianMixture
from zakai.engine.driver import filter as run_filter
from zakai.engine.driver import planned, with_inputs
from zakai.engine.likelihood import LogLikelihood, chosen_parameters
from zakai.errors import InputError
from zakai.inference.maximum import Likelihood, maximum, with_signs_of
from zakai.inference.profile import Profile, Quadratic
from zakai.inference.random_maximum import random_maximum, sentence, usual_values
from zakai.models._errors import listing
from zakai.models.model import Model
from zakai.records import Inputs, Record

USUAL = 5, 10  # evaluations for each parameter, and as many more, that a search with gradients usually takes
SMALL = 0.1  # of a standard error, by which random errors or jumps of a log-likelihood may move its maximum without a warning
COARSER = 4.0  # times the tolerance for the search, where the log-likelihood has small jumps; not for the maximum at its end


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
    _profile: Profile | Quadratic | None = None

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return confidence intervals of the parameters by their profile likelihood.

            {x : 2 (l(estimates) - max l(theta | theta_i = x)) <= chi^2_1(level)}

        Where the likelihood does not fall enough, an end is the bound of the parameter, or infinite.  They need not be symmetric,
        and need no standard errors.  By a method with random errors, such as particles, the likelihood is the quadratic that was
        fitted: the interval is the estimate and a multiple of its standard error, to which the random error of the maximum is
        added.

        Args:
            level: the probability with which an interval covers the true value, for long records.

        Returns:
            (low, high) by name.

        Raises:
            InputError: a wrong level; a larger log-likelihood than at the estimates was found.

        References:
            Venzon and Moolgavkar 1988, A method for computing profile-likelihood-based confidence intervals.

        Example:
            fitted = zakai.fit(model, record, parameters=["a"])
            fitted.intervals(0.9)["a"]
        """
        if isinstance(level, bool) or not isinstance(level, int | float | np.number) or not 0.0 < level < 1.0:
            raise InputError(f"intervals: level is {level!r}; give a probability between 0 and 1")
        if self._profile is None:
            raise InputError("intervals: this Fit does not hold its record; fit again")
        return self._profile.intervals(float(level))

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
    inputs: Inputs | None = None,
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
        inputs: the known inputs of the model, in place of those of the record.
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
    record = with_inputs(record, inputs)
    names = chosen_parameters(model, parameters)
    values = _start(model, names, start)
    box = _box(model, names, values, bounds)
    now = model.with_parameters(**dict(zip(names, values.tolist(), strict=True)))
    plan = planned(now, None, method, options, by_value=False)
    methods = [setting.method for setting in plan.settings]
    if plan.division is None:
        method = plan.method  # the choice of "auto" may depend on the parameters
    if any(one.random or one.by_values for one in methods):
        random = any(one.random for one in methods)
        maker = next((one.by_values for one in methods if one.by_values is not None), None)
        given = options if random else {**options, "seed": None}
        return _fit_by_values(now, record, (names, values, box), method, given, maker)
    function, known = LogLikelihood(now, record, method, names, options), dict[bytes, tuple[float, np.ndarray]]()
    what = f"{model.source}: fit: the search for the largest log-likelihood by {listing(names)}"
    with bar("fitting: log-likelihood and gradient") as advance, announced(what) as announce:

        def counted(theta: np.ndarray) -> tuple[float, np.ndarray]:
            key = theta.tobytes()
            if key not in known:
                if advance is not None:
                    advance(len(known) + 1, None)
                known[key] = function.consistent_pair(theta)
                announce(len(known), *(count * (1 + len(names)) for count in USUAL))
            return known[key]

        found = maximum(Likelihood(counted, box, names, model, function.exists, function.jumps), values)
        found = with_signs_of(values, found, counted, box)
    values = found.values
    now = model.with_parameters(**dict(zip(names, values.tolist(), strict=True)))
    result = run_filter(now, record, method, keep="moments", **options)
    warnings = list(result.warnings)
    if found.problem:
        warnings.insert(0, found.problem)
    if found.beyond is not None:
        beyond = dict(zip(names, found.beyond.tolist(), strict=True))
        warnings.insert(0, _limit(now, beyond, record, method, options))
    elif not found.converged:
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
        _profile=Profile(function.unwarned, values, found.covariance, box, names),
    )


def _fit_by_values(
    model: Model,
    record: Record,
    where: tuple[tuple[str, ...], np.ndarray, np.ndarray],
    method: str,
    options: dict[str, Any],
    maker: Callable[[float], Any] | None,
) -> Fit:
    """Return the fit by values of a log-likelihood, with common random numbers or choices.

    Args:
        model: the system.
        record: the observations.
        where: the names of the parameters, their values at the start, and their bounds.
        method: the name of the method.
        options: its options; a seed of None is for a method without.
        maker: what makes the choices, None for a method without.
    """
    names, values, box = where
    known: dict[tuple[bytes, int], float] = {}
    options, choices = dict(options), dict[int, Any]()
    first = options.pop("seed", 0)
    final = 1.0 if maker is None else COARSER  # how much longer a value at the end takes, as the tolerance is smaller

    def result_at(theta: np.ndarray, seed: int, common: Any = None) -> Any:
        at = model.with_parameters(**dict(zip(names, theta.tolist(), strict=True)))
        own = options if first is None else {**options, "seed": int(first) + seed}
        own = own if common is None else {**own, "choices": common}
        return run_filter(at, record, method, keep="moments", **own)

    what = f"{model.source}: fit: the search for the largest log-likelihood by {listing(names)}"
    with bar("fitting: log-likelihood") as advance, announced(what) as announce:

        def value(theta: np.ndarray, seed: int) -> float:
            key = theta.tobytes(), seed
            if key not in known:
                if advance is not None:
                    advance(len(known) + 1, None)
                if maker is not None and seed not in choices:
                    choices[seed] = maker(COARSER if seed < 0 else 1.0)
                try:
                    known[key] = result_at(theta, seed, choices.get(seed)).log_likelihood
                except InputError:
                    known[key] = -np.inf
                done = len(known) + (final - 1.0) * sum(of >= 0 for _, of in known)
                announce(done, *usual_values(len(names), first is not None, final))
            return known[key]

        found = random_maximum(value, values, box, first is not None)
        result = result_at(found.values, 0)
    errors = np.sqrt(np.diag(found.covariance))
    # Random errors and jumps of a log-likelihood matter where they move the maximum by a part of a standard error.
    matters = not (found.errors <= SMALL * errors).all()
    warnings = [*([sentence(names, found, first is not None)] if matters else []), *result.warnings]
    if not found.converged:
        warnings.insert(0, "the fit did not converge; these are the best values that were found")
    estimates = dict(zip(names, found.values.tolist(), strict=True))
    return Fit(
        estimates=estimates,
        standard_errors=dict(zip(names, errors.tolist(), strict=True)),
        log_likelihood=result.log_likelihood,
        model=model.with_parameters(**estimates),
        converged=found.converged,
        message=f"{'converged' if found.converged else 'not converged'}: quadratics through values"
        + (" with common random numbers" if first is not None else "")
        + ("" if matters else f"; {sentence(names, found, first is not None)}"),
        iterations=found.iterations,
        covariance=found.covariance,
        method=result.method,
        observations=len(record.times),
        warnings=warnings,
        _profile=Quadratic(found.values, found.covariance, found.errors, box, names),
    )


def _limit(model: Model, beyond: dict[str, float], record: Record, method: str, options: dict[str, Any]) -> str:
    """Return which limit of the parameters the fit has reached, from values beyond it."""
    at = ", ".join(f"{name} = {value:.6g}" for name, value in beyond.items())
    try:
        run_filter(model.with_parameters(**beyond), record, method, keep="moments", **options)
        reason = "the log-likelihood is not finite"
    except InputError as error:
        reason = str(error)
    return (
        f"the fit ended at a limit of the parameters, towards which the log-likelihood rises: at {at} it does not exist, because "
        f"{reason}; change the model, or fix a parameter inside the limit"
    )


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
    """Return the bounds (p, 2), infinite where there is none."""
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
