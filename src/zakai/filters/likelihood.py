"""The log-likelihood of a record as a function of the model's parameters, to be differentiated.

What is adaptive (substeps, nodes, lattices) is decided by an ordinary run at the model's own values; the same steps are then
taken again as a pure function of the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.errors import ConditionError, InputError
from zakai.filters._run import SETTLED, Piece, Run, Setting, scanned
from zakai.filters.driver import check_noise, check_records, planned
from zakai.filters.results import FilterResult
from zakai.models._definite import ROUNDING
from zakai.models._errors import did_you_mean, listing
from zakai.models.compile import jax_function
from zakai.models.model import Model
from zakai.records import Record


def log_likelihood(
    model: Model, record: Record, method: str = "auto", parameters: Sequence[str] | None = None, **options: Any
) -> Callable[[Any], jax.Array]:
    """The log-likelihood of the record as a pure JAX function of the parameters.

        l(theta) = sum_k log p(observation k | observations before it, theta)

    model: what the system is, with a prior and parameters. record: K observations. method, options: as of `filter`.
    parameters: p names, by default all of the model's, in its order.  The function takes their values (p,) and gives l, which
    `filter` gives as `log_likelihood` at the model's own values.  It may be used under `jax.grad`, `jax.value_and_grad`,
    `jax.hessian`, `jax.vmap` and `jax.jit`; without an outer `jit` each part of it is compiled once and by itself, which takes
    less time.  What is adaptive is decided at the model's own values: far from them, begin again from
    `model.with_parameters`.  Where a covariance of the noise is none, the value is nan.

    Raises InputError for an unknown parameter and as `filter` does, ConditionError if the method's theorem does not hold or it
    has no gradient.

    Example:

        l = zakai.log_likelihood(model, record, parameters=["a"])
        jax.value_and_grad(l)(jnp.array([0.5]))
    """
    return replayed(model, record, method, chosen_parameters(model, parameters), options)[0]


def chosen_parameters(model: Model, names: Sequence[str] | None) -> tuple[str, ...]:
    """The names of parameters, checked; all of them for None."""
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


def replayed(
    model: Model, record: Record, method: str, names: tuple[str, ...], options: dict[str, Any]
) -> tuple[Callable[[Any], jax.Array], FilterResult]:
    """The function of `log_likelihood`, and the result of the ordinary run that it repeats."""
    check_records(model, record)
    plan = planned(model, None, method, options, by_value=False)
    check_noise([plan], [record])
    for setting in plan.settings:
        chosen = setting.method
        if chosen.with_parameters is None or (chosen.adapt and chosen.resume is None):
            source = setting.model.source
            raise ConditionError(f"{source}: {chosen.name} has no gradient with respect to parameters; name another method")
    runs = plan.runs(record, "moments", recorded=True)
    for run in runs:
        run.all(None)
    replays = [_Replay(run.setting, run) for run in runs]
    compiled: dict[Hashable, Callable[[jax.Array], Any]] = {}
    where = np.array([list(model.parameters).index(name) for name in names])
    own, noise = model.theta(), _noise_is_noise(model, names, np.concatenate([[model.start], record.times]))

    def function(values: Any) -> jax.Array:
        theta = jnp.asarray(own).at[where].set(jnp.asarray(values, dtype=jnp.float64))
        at = _At(theta, compiled)
        # Of independent blocks the evidence is the product.
        total = sum((replay(at) for replay in replays), start=jnp.zeros(()))
        return jnp.where(noise(jax.lax.stop_gradient(theta)), total, jnp.nan)

    result = plan.result(runs)
    result.record = record
    return function, result


class _At:
    """Functions of one value of the parameters: each is compiled once, and computed once for all blocks that share it."""

    def __init__(self, theta: jax.Array, compiled: dict[Hashable, Callable[[jax.Array], Any]]):
        self.theta, self.compiled, self.known = theta, compiled, {}  # type: ignore[var-annotated]

    def __call__(self, key: Hashable, function: Callable[[jax.Array], Any]) -> Any:
        if key not in self.known:
            self.known[key] = self.compiled.setdefault(key, jax.jit(function))(self.theta)
        return self.known[key]


class _Replay:
    """An ordinary run, taken again for other values of the parameters."""

    def __init__(self, setting: Setting, run: Run):
        self.setting, self.run, self.pieces = setting, run, run.pieces or []
        # Without a reading at the start the first state is that of every block with the same prior.
        self.same_start = ("start", id(run.first), id(setting.prior), id(run) if run.at_start else None)

    def __call__(self, at: _At) -> jax.Array:
        state, total = at(self.same_start, self._start(self.run))
        for piece in self.pieces:
            intervals = at(("intervals", id(piece.prepared)), partial(self._intervals, piece))
            observations = at(("observations", id(piece)), partial(self._observations, piece))
            for rows, begin in _merged(piece):
                if begin is not None:
                    assert self.setting.method.resume is not None
                    state = self.setting.method.resume(_with(piece.prepared, at.theta, intervals), state, rows, begin)
                count = rows.stop - rows.start
                # Runs that end where their lattice no longer holds have any length: few shapes, few compilations.
                length = count if self.setting.method.healthy is None else 2 ** int(np.ceil(np.log2(count)))
                which = np.minimum(np.arange(rows.start, rows.start + length), rows.stop - 1)
                part = jax.tree.map(lambda a: a[which], (intervals, observations))  # noqa: B023
                state, more = _advance(self.setting.method.step, state, *part, None if length == count else count)
                total = total + more
        return total

    def _start(self, run: Run) -> Callable[[jax.Array], Any]:
        method, prior = self.setting.method, self.setting.prior
        reading = run.data.part(slice(0, 1))

        def start(theta):
            prepared = _with(run.first, theta, run.first.intervals)
            if not run.at_start:
                return method.init(prepared, prior), jnp.zeros(())
            observation = method.observations(prepared, reading)
            if method.correct_again is None:
                state, info = method.correct(prepared, prior, observation)
            else:
                state, info = method.correct_again(prepared, prior, observation, run.corrected)
            return state, info.log_likelihood_increment

        return start

    def _intervals(self, piece: Piece, theta: jax.Array) -> Any:
        assert self.setting.method.with_parameters is not None
        return self.setting.method.with_parameters(piece.prepared, theta).intervals

    def _observations(self, piece: Piece, theta: jax.Array) -> Any:
        # Of what was prepared, only the parameters are read.
        return self.setting.method.observations(_with(piece.prepared, theta, piece.prepared.intervals), piece.data)


def _merged(piece: Piece) -> list[tuple[slice, Any]]:
    """The runs of a piece; where no lattice is laid between them, they are one."""
    if any(begin is not None for _, begin in piece.runs):
        return piece.runs
    return [(slice(0, len(piece.data.stops)), None)]


@partial(jax.jit, static_argnums=0)
def _advance(step, state, intervals, observations, count):
    """The last state of a run and its log-likelihood; to differentiate, a step is computed again and only states are kept.

    With `count` only so many of the steps are taken.  A state that has `settled` is settled every few steps.
    """
    again = jax.checkpoint(step, prevent_cse=False)

    def one(carry, slices):
        new, info = again(slices[0], carry, slices[1])
        return new, info.log_likelihood_increment

    def one_of_some(carry, slices):
        k, *rest = slices
        return jax.lax.cond(k < count, one, lambda carry, _: (carry, jnp.zeros(())), carry, rest)

    def one_now_and_then_settled(carry, slices):
        k, *rest = slices
        return one(jax.lax.cond(k % SETTLED == 0, settle, lambda state: state, carry), rest)

    settle = getattr(state, "settled", None)
    if settle is not None:
        steps = jnp.arange(len(jax.tree.leaves(intervals)[0]))
        state, increments = jax.lax.scan(one_now_and_then_settled, settle(state), (steps, intervals, observations))
    elif count is None:
        state, increments = scanned(one, state, (intervals, observations))
    else:
        length = len(jax.tree.leaves(intervals)[0])
        state, increments = jax.lax.scan(one_of_some, state, (jnp.arange(length), intervals, observations))
    return state, jnp.sum(increments)


def _with(prepared: Any, theta: Any, intervals: Any) -> Any:
    changed = {"theta": theta, "intervals": intervals}
    return prepared._replace(**changed) if hasattr(prepared, "_replace") else replace(prepared, **changed)


def _noise_is_noise(model: Model, names: Sequence[str], times: np.ndarray) -> Callable[[jax.Array], jax.Array]:
    """Whether S is positive definite and Q positive semidefinite at the times, where they depend on the named parameters."""
    free = {symbol for symbol in model.parameter_symbols if symbol.name in names}
    checks = []
    for key, least in (("observation_noise", ROUNDING * model.m), ("process_noise", -ROUNDING * model.process_noise.shape[0])):
        matrix = getattr(model, key)
        if free & matrix.free_symbols:
            function = jax.vmap(jax_function(matrix, model, matrix.shape), (None, 0, None))
            checks.append((function, times if matrix.has(model.t) else times[:1], least))

    def holds(theta: jax.Array) -> jax.Array:
        good = jnp.asarray(True)
        for function, at, least in checks:
            values = function(jnp.zeros(model.n), jnp.asarray(at), theta)
            scale = jnp.sqrt(jnp.abs(jnp.diagonal(values, axis1=1, axis2=2)))
            scale = jnp.where(scale > 0, scale, 1.0)
            smallest = jnp.linalg.eigvalsh(values / (scale[:, :, None] * scale[:, None, :]))[:, 0]
            good = good & jnp.all(smallest > least)
        return good

    return holds
