"""The log-likelihood of a record as a function of the model's parameters, and its gradient by the complex step."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zakai.engine.batch import filter_all
from zakai.engine.driver import check_noise, check_records, planned
from zakai.engine.loop import Run
from zakai.engine.setting import Setting
from zakai.errors import ConditionError, InputError
from zakai.models._errors import did_you_mean, listing
from zakai.models.checks import check_noise_at
from zakai.models.model import Model
from zakai.models.prior import DensityPrior
from zakai.numerics.complex_step import STEP
from zakai.records import Record

DIFFERENCE = 1e-5  # relative step of the differences of gradients that give second derivatives


def log_likelihood(
    model: Model, record: Record, method: str = "auto", parameters: Sequence[str] | None = None, **options: Any
) -> LogLikelihood:
    """Return the log-likelihood of the record as a function of the parameters.

        l(theta) = sum_k log p(observation k | observations before it, theta)

    The function takes the values (p,) of the parameters and returns l, which `filter` gives as `log_likelihood` at these values;
    `value_and_gradient` returns l and its gradient (p,).  With JAX installed it may be used under `jax.grad`,
    `jax.value_and_grad`, `jax.hessian`, `jax.vmap` and `jax.jit` (set `jax_enable_x64` for double precision).  Where a noise is
    not a covariance, the value is NaN.

    Args:
        model: the system, with a prior and parameters.
        record: K observations.
        method: as of `filter`.
        parameters: p names, by default all of the model's, in its order.
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
    return LogLikelihood(model, record, method, chosen_parameters(model, parameters), options)


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
        check_records(model, record)
        plan = planned(model, None, method, options, by_value=False)
        check_noise([plan], [record])
        for setting in plan.settings:
            if not setting.method.differentiable:
                name = setting.method.name
                raise ConditionError(
                    f"{setting.model.source}: {name} has no gradient with respect to parameters; name another method"
                )
        self.model, self.record, self.names, self._plan = model, record, names, plan
        self._where = [list(model.parameters).index(name) for name in names]
        self._depends = [_parameters_of(setting) for setting in plan.settings]
        self._times = np.concatenate([[model.start], record.times])
        self._traced: Callable[[Any], Any] | None = None

    def __repr__(self) -> str:
        return f"LogLikelihood({', '.join(self.names)}; {len(self.record)} observations of {self.model.source})"

    def __call__(self, values: Any) -> Any:
        """Return l at the values (p,)."""
        if "jax" in sys.modules and isinstance(values, sys.modules["jax"].core.Tracer):
            return self._in_jax()(values)
        return float(self._evaluated(values, [])[0])

    def value_and_gradient(self, values: Any) -> tuple[float, np.ndarray]:
        """Return l and its gradient (p,) at the values (p,)."""
        value, *slopes = self._evaluated(values, range(len(self.names)))
        return float(value), np.array(slopes)

    def _evaluated(self, values: Any, directions: Sequence[int]) -> list[float]:
        """Return l, and its derivatives with respect to some of the parameters."""
        given = np.asarray(values, dtype=float)
        if given.shape != (len(self.names),):
            raise InputError(f"log_likelihood: the values have shape {given.shape}; expected ({len(self.names)},)")
        theta = self.model.theta()
        theta[self._where] = given
        try:
            changed = self.model.with_parameters(**dict(zip(self.names, given.tolist(), strict=True)))
            check_noise_at(changed, self._times)
        except InputError:
            return [np.nan] * (1 + len(directions))
        runs: list[tuple[int, Run]] = []
        for column, direction in enumerate([None, *directions]):
            moved = theta
            if direction is not None:
                moved = theta + 0j
                moved[self._where[direction]] += 1j * STEP
            for run, depends in zip(self._plan.runs(self.record, "moments", theta=moved), self._depends, strict=True):
                if direction is None or self.names[direction] in depends:
                    runs.append((column, run))
        try:
            with np.errstate(all="ignore"):
                filter_all([run for _, run in runs], None)
        except InputError:
            return [np.nan] * (1 + len(directions))
        totals = [0.0] * (1 + len(directions))
        for column, run in runs:
            evidence = sum(part.log_likelihood_increment.sum() for part in run.parts)
            totals[column] += float(evidence.real if column == 0 else evidence.imag / STEP)
        return totals

    def _in_jax(self) -> Callable[[Any], Any]:
        """Return the function for values that JAX traces."""
        if self._traced is None:
            self._traced = _traced(self)
        return self._traced


def _parameters_of(setting: Setting) -> set[str]:
    """Return the names of the parameters on which a part of the likelihood depends."""
    model, prior = setting.model, setting.prior
    parts = [model.drift, model.diffusion, model.process_noise, model.observation, model.observation_noise]
    symbols = set().union(*(part.free_symbols for part in parts))
    if isinstance(prior, DensityPrior):
        symbols |= prior.log_density.free_symbols
    return {symbol.name for symbol in symbols}


def _traced(function: LogLikelihood) -> Callable[[Any], Any]:
    """Return a function with derivatives for JAX: the second ones are central differences of the gradient."""
    import jax
    import jax.numpy as jnp

    p = len(function.names)

    def called(host: Callable[..., Any], shape: tuple[int, ...], values: Any, *rest: Any) -> Any:
        # Single precision, unless jax_enable_x64 is set.
        result = jax.ShapeDtypeStruct(shape, values.dtype)  # type: ignore[no-untyped-call]
        return jax.pure_callback(lambda *v: np.asarray(host(*v), values.dtype), result, values, *rest, vmap_method="sequential")

    @jax.custom_jvp
    def gradient(values: Any) -> Any:
        return called(lambda v: function.value_and_gradient(v)[1], (p,), values)

    def difference(values: Any, direction: Any) -> Any:
        values, direction = np.asarray(values), np.asarray(direction)
        size = np.max(np.abs(direction))
        if size == 0:
            return np.zeros(p)
        step = DIFFERENCE * max(np.max(np.abs(values)), 1e-3) / size
        above = function.value_and_gradient(values + step * direction)[1]
        return (above - function.value_and_gradient(values - step * direction)[1]) / (2 * step)

    @gradient.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        # The Hessian is symmetric; what JAX asks for is linear in the tangent.
        (values,), (tangent,) = primals, tangents
        columns = jnp.stack([called(difference, (p,), values, direction) for direction in jnp.eye(p)])
        return gradient(values), tangent @ columns

    @jax.custom_jvp
    def value(values: Any) -> Any:
        return called(lambda v: function(np.asarray(v)), (), values)

    @value.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        (values,), (tangent,) = primals, tangents
        return value(values), gradient(values) @ tangent

    def traced(values: Any) -> Any:
        return value(jnp.asarray(values, dtype=float))

    return traced
