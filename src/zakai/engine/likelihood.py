"""The log-likelihood of a record as a function of the model's parameters, and its gradient by the complex step."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from zakai.engine.driver import check_noise, check_records, planned, with_inputs
from zakai.engine.loop import CHUNK, Run, segments
from zakai.engine.setting import Setting
from zakai.errors import ConditionError, InputError
from zakai.methods._protocol import Infos, State
from zakai.models._entries import formula
from zakai.models._errors import did_you_mean, listing
from zakai.models.checks import COEFFICIENTS, depends_on_state, noise_check
from zakai.models.features import formulas_of
from zakai.models.functions import Floor
from zakai.models.model import Model
from zakai.numerics.complex_step import STEP
from zakai.numerics.one_thread import one_thread
from zakai.records import Inputs, Record
from zakai.records.schedule import Schedule

OF_TOLERANCE = 0.1  # nats by which a log-likelihood on grids of several states jumps, in tolerances (measured: 0.01 to 0.1)
SHORT = 0.02  # seconds of one evaluation below which threads do not pay
JUMPS = sp.sign, Floor

Argument = TypeVar("Argument")
Value = TypeVar("Value")


def log_likelihood(
    model: Model,
    record: Record,
    method: str = "auto",
    parameters: Sequence[str] | None = None,
    *,
    inputs: Inputs | None = None,
    **options: Any,
) -> LogLikelihood:
    """Return the log-likelihood of the record as a function of the parameters.

        l(theta) = sum_k log p(observation k | observations before it, theta)

    The function takes the values (p,) of the parameters and returns l, which `filter` gives as `log_likelihood` at these values;
    `value_and_gradient` returns l and its gradient (p,).  With JAX installed it may be used under `jax.grad`,
    `jax.value_and_grad`, `jax.hessian`, `jax.vmap` and `jax.jit` (set `jax_enable_x64` for double precision).  Where a noise is
    not a covariance, the value is NaN.  Where a health figure exceeds its bound, a Python warning names it.

    Args:
        model: the system, with a prior and parameters.
        record: K observations.
        method: as of `filter`.
        parameters: p names, by default all of the model's, in its order.
        inputs: the known inputs of the model, in place of those of the record.
        **options: as of `filter`.

    Raises:
        InputError: an unknown parameter, and as `filter`.
        ConditionError: the method's theorem does not hold, or it has no gradient.

    References:
        Squire and Trapp 1998, Using complex variables to estimate derivatives of real functions.

    Example:
        l = zakai.log_likelihood(model, record, parameters=["a"])
        value, gradient = l.value_and_gradient([0.5])
    """
    return LogLikelihood(model, with_inputs(record, inputs), method, chosen_parameters(model, parameters), options)


def _without_gradient(setting: Setting) -> str:
    """Return why "auto" does not take a method for a gradient, or nothing."""
    return "" if setting.method.differentiable else "has no gradient with respect to parameters"


def _jump_of(model: Model, names: tuple[str, ...]) -> str:
    """Return that the place of a jump depends on one of the parameters, or nothing."""
    chosen = {symbol for symbol in model.parameter_symbols if symbol.name in names}
    for expression in formulas_of(model):
        for call in expression.atoms(*JUMPS):
            for symbol in call.free_symbols & chosen:
                return (
                    f"{model.source}: parameters: the place of a jump, {formula(call)}, depends on {symbol.name}, in which the "
                    "log-likelihood has no derivative that a gradient could give; leave it out of the parameters and compare "
                    "log-likelihoods at several of its values"
                )
    return ""


def chosen_parameters(model: Model, names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of parameters, checked; all of them for None."""
    if not isinstance(model, Model):
        raise InputError(f"expected a Model, got a {type(model).__name__}; zakai.load_model reads one from a file")
    if not model.parameters:
        raise InputError(f"{model.source}: parameters: the model has none, so there is nothing to estimate")
    names = tuple(model.parameters) if names is None else names
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        raise InputError(f"parameters: {names!r} is not a list of names; the model has {listing(model.parameters)}")
    names = tuple(names)
    for name in names:
        if name not in model.parameters:
            hint = did_you_mean(name, model.parameters)
            raise InputError(f'parameters: there is no "{name}"{hint}; the model has {listing(model.parameters)}')
    if not names or len(set(names)) < len(names):
        raise InputError(f"parameters: {list(names)}: name at least one, each once; the model has {listing(model.parameters)}")
    return names


class LogLikelihood:
    """A function of the parameters' values (p,); see `log_likelihood`."""

    def __init__(self, model: Model, record: Record, method: str, names: tuple[str, ...], options: dict[str, Any]):
        (record,) = check_records(model, record)
        plan = planned(model, None, method, options, by_value=False, unfit=_without_gradient)
        check_noise([plan], [record])
        for setting in plan.settings:
            if not setting.method.differentiable:
                name = setting.method.name
                raise ConditionError(
                    f"{setting.model.source}: {name} has no gradient with respect to parameters; name another method"
                )
        self.model, self.record, self.names, self._plan = model, record, names, plan
        self._where = [list(model.parameters).index(name) for name in names]
        self._parts = [_Part.of(run) for run in plan.runs(record, "moments")]
        self._times = np.concatenate([[model.start], record.times])
        keys = [key for key in COEFFICIENTS if not depends_on_state(getattr(model, key), model)]
        self._jump = _jump_of(model, names)
        self._checks = [check for key in keys if (check := noise_check(model, key)) is not None]

    def __repr__(self) -> str:
        return f"LogLikelihood({', '.join(self.names)}; {len(self.record)} observations of {self.model.source})"

    def __call__(self, values: Any) -> Any:
        """Return l at the values (p,)."""
        if "jax" in sys.modules and isinstance(values, sys.modules["jax"].core.Tracer):
            return self._in_jax(values)
        value, _, exceeded = self._evaluated(values, False)
        _warn(exceeded)
        return value

    def value_and_gradient(self, values: ArrayLike) -> tuple[float, np.ndarray]:
        """Return l and its gradient (p,) at the values (p,).

        Raises:
            InputError: sign, heaviside or floor of an expression with one of the parameters.
        """
        value, gradient, exceeded = self._evaluated(values, True)
        _warn(exceeded)
        return value, gradient

    def unwarned(self, values: ArrayLike) -> tuple[float, np.ndarray]:
        """Return what `value_and_gradient` returns, for searches that report the health of their end alone."""
        return self._evaluated(values, True)[:2]

    def consistent_pair(self, values: ArrayLike) -> tuple[float, np.ndarray]:
        """Return l and its gradient (p,), both by complex steps, which takes less time; on a grid l differs by its accuracy."""
        return self._evaluated(values, True, own=False)[:2]

    def _evaluated(self, values: ArrayLike, derivatives: bool, own: bool = True) -> tuple[float, np.ndarray, set[str]]:
        """Return l, its gradient, zero unless `derivatives` are wanted, and the health figures beyond their bounds.

        Where l does not exist it is NaN.

        With derivatives a density may have another grid; `own`: l is the filter's.
        """
        given = np.asarray(values, dtype=float)
        if given.shape != (len(self.names),):
            raise InputError(f"log_likelihood: the values have shape {given.shape}; expected ({len(self.names)},)")
        if derivatives and self._jump:
            raise InputError(self._jump)
        missing: tuple[float, np.ndarray, set[str]] = np.nan, np.full(len(given), np.nan), set()
        theta = self._theta(given)
        if theta is None:
            return missing

        def shifted(direction: int) -> np.ndarray:
            found = theta.astype(complex)
            found[self._where[direction]] += 1j * STEP
            return found

        value, gradient, exceeded = 0.0, np.zeros(len(given)), set()
        try:
            for part in self._parts:
                directions = [i for i, name in enumerate(self.names) if derivatives and name in part.depends]
                gained, slopes, over = part.derivatives(theta, [shifted(i) for i in directions], own)
                value, gradient[directions] = value + gained, gradient[directions] + slopes
                exceeded |= over
        except InputError:
            return missing
        return value, gradient, exceeded

    @property
    def jumps(self) -> float:
        """The nats by which log-likelihoods of values close by may differ because grids of several states differ."""
        settings = [part.setting for part in self._parts]
        grids = [one for one in settings if one.model.n > 1 and "tolerance_ratio" in one.method.bounds]
        return OF_TOLERANCE * max((float(getattr(one.begin()[0], "tolerance", 0.0)) for one in grids), default=0.0)

    def exists(self, values: np.ndarray) -> bool:
        """Return whether the model holds at the values (p,), by preparing its first interval, which takes little time."""
        theta = self._theta(values)
        if theta is None:
            return False
        try:
            for part in self._parts:
                part.setting._replace(theta=theta).prepared(part.schedule.part(slice(0, 1)))
        except InputError:
            return False
        return True

    def _theta(self, values: np.ndarray) -> np.ndarray | None:
        """Return all parameters of the model, None where a noise is not a covariance."""
        theta = self.model.theta()
        theta[self._where] = values
        with np.errstate(all="ignore"):
            return theta if np.isfinite(values).all() and not any(check(self._times, theta) for check in self._checks) else None

    @cached_property
    def _in_jax(self) -> Callable[[Any], Any]:
        """The function for values that JAX traces."""
        from zakai.engine.likelihood_in_jax import traced

        return traced(self)


class _Part(NamedTuple):
    """One run of the filter: its setting, its schedule and observations, and the names of the parameters that it depends on."""

    setting: Setting
    schedule: Schedule
    values: np.ndarray
    depends: set[str]

    @classmethod
    def of(cls, run: Run) -> _Part:
        return cls(run.setting, run.schedule, run.values, run.setting.parameters)

    def evidence(self, theta: np.ndarray) -> tuple[Any, set[str]]:
        """Return the log-likelihood at the parameters, complex where they are, and the figures beyond their bounds."""
        infos = [one.infos for one in segments(self.setting._replace(theta=theta), self.schedule, None, self.values)]
        return _total([part.log_likelihood_increment for part in infos]), self._exceeded(infos)

    def _exceeded(self, infos: Sequence[Infos]) -> set[str]:
        """Return the names of the health figures that exceed their bounds."""
        bounds = self.setting.method.bounds
        figures = [(name, part.health[name]) for part in infos for name in bounds if name in part.health]
        return {name for name, values in figures if (np.real(values) > bounds[name][0]).any()}

    @one_thread
    def derivatives(self, theta: np.ndarray, shifted: Sequence[np.ndarray], own: bool) -> tuple[float, np.ndarray, set[str]]:
        """Return the log-likelihood, its derivatives (p,) in complex directions, and the figures beyond their bounds.

        `own`: the log-likelihood is the filter's.
        """
        carried = self._carried(theta, shifted) if shifted else None
        if carried is not None:
            return carried
        found = _each(self.evidence, [theta, *shifted] if own or not shifted else shifted)
        totals, exceeded = [total for total, _ in found], set().union(*(over for _, over in found))
        return float(totals[0].real), np.array([total.imag / STEP for total in totals[len(totals) - len(shifted) :]]), exceeded

    def _carried(self, theta: np.ndarray, shifted: Sequence[np.ndarray]) -> tuple[float, np.ndarray, set[str]] | None:
        """Return the same where the method carries all derivatives in one pass, else None."""
        method, prior = self.setting.method, self.setting.prior
        if method.tangents is None:
            return None
        states: list[State] = []
        parts, slopes = [], np.zeros(len(shifted))
        for start in range(0, len(self.schedule), CHUNK):
            rows = slice(start, min(start + CHUNK, len(self.schedule)))
            chunk = self.schedule.part(rows)
            prepared = [self.setting._replace(theta=one).prepared(chunk) for one in (theta, *shifted)]
            states = states or [method.init(one, prior) for one in prepared]
            with np.errstate(all="ignore"):
                found = method.tangents(prepared[0], prepared[1:], slice(0, len(chunk)), states[0], states[1:], self.values[rows])
            if found is None:
                return None
            parts.append(found.infos)
            slopes, states = slopes + found.slopes, [found.states[-1], *found.shifted]
        return float(_total([part.log_likelihood_increment for part in parts])), slopes, self._exceeded(parts)


def _warn(exceeded: set[str]) -> None:
    """Warn, three calls up, where figures exceed their bounds."""
    if exceeded:
        warnings.warn(
            f"log_likelihood: health figures exceed their bounds at these values ({', '.join(sorted(exceeded))}), so that the "
            "value and its gradient may be wrong; zakai.filter at these values says where, and what to change",
            stacklevel=3,
        )


def _total(increments: list[np.ndarray]) -> Any:
    """Return the sum of what consecutive steps gained, to the bit as in a result, whose first entry is zero."""
    return np.sum(np.concatenate([[0.0], *increments]))


def _each(function: Callable[[Argument], Value], arguments: Sequence[Argument]) -> list[Value]:
    """Return the values of a function, computed on the threads of the machine unless the first one took no time."""
    began = time.monotonic()
    found, rest = [function(argument) for argument in arguments[:1]], arguments[1:]
    if len(rest) < 2 or time.monotonic() - began < SHORT:
        return found + [function(argument) for argument in rest]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(rest))) as pool:
        return found + list(pool.map(function, rest))
