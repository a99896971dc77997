"""The shape that every method has.

A method is one module with one `METHOD`.  Its parts are plain functions; arrays travel in pytrees; what decides the shape of an
array is static.  `prepare` is offline and sees no data, `step` is pure and sees no symbol.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.conditions import Condition
from zakai.densities import Density
from zakai.models.model import Model


class Schedule(NamedTuple):
    """When and which coordinates are observed: `starts` (K,), `stops` (K,), `inside` (K, m).

    `inside` marks the coordinates whose observation is an increment over just this interval, so that it may act inside of it.
    """

    starts: np.ndarray
    stops: np.ndarray
    inside: np.ndarray


class Info(NamedTuple):
    """What one step tells: the increment of the log-likelihood, moments (n,) and (n, n), and its health.

    `need` is for `adapt` alone: by what factor (n,) each axis of a lattice was too coarse, above one.
    """

    log_likelihood_increment: Any
    mean: Any
    cov: Any
    health: dict[str, Any]
    need: Any = None


@dataclass(frozen=True)
class Method:
    """One filter.

    `prepare(model, schedule, **options)` gives a Prepared whose `intervals` are a pytree with a leading axis of K;
    `init(prepared, prior)` the first state; `correct(prepared, prior, observation)` the same with an observation at the start;
    `observations(prepared, data)` what `step` is given, for all intervals at once; `step(interval, state, observation)`
    gives (State, Info); `density(prepared, state)` a Density.  A method whose arrays have a size that the data decides has
    `adapt(prepared, state, intervals, info)`: the state to start (or, after a try with `info`, to start again) a run of intervals
    with, or None where nothing need or can be changed.

    Where a try can cut something away, the state has `tried(begin)`: itself, with the plan of the `begin` that was tried, which
    is what `adapt` is then given with `info`.

    Gradients.  A Prepared has `theta` (p,), the values of the parameters: the model's own, a NumPy array, out of `prepare`.
    `with_parameters(prepared, theta)` gives the same Prepared with another `theta` and the `intervals` that belong to it.  It
    is traced by JAX: what is adaptive (substeps, parts, nodes, sizes) stays as it was decided for the model's own values, which
    `prepared.model` still has.  `init`, `correct` and `observations` read `prepared.theta` and nothing else, and are traced too.
    A method with `adapt` has `resume(prepared, state, rows, begin)` beside it: the traced `state`, laid on the lattice and
    given the static plan of `begin`, the state with which an ordinary run began the intervals `rows` (a slice of those of
    `prepared`).  Only the values depend on theta; the lattice of `begin` is a constant.  None: the method has no gradient.
    Where `correct` cannot be traced, `correct_again(prepared, prior, observation, begin)` can: `begin` is what `correct` gave an
    ordinary run.

    Batches.  `init`, `observations` and `step` serve many records at once as they are.  A method with `adapt` has
    `adapt_many(prepared, states, rows, info)`: `states` and `info` have a leading axis of records, and all records get one
    plan and arrays of one size.  None: records are filtered one by one.  `alone(prepared)` says that this is faster for these
    intervals.  None: it never is.

    One reading at a time.  `rule(prepared, data)` is what `observations` gives but for the values of the readings, a pytree whose
    slices are called with values (m,), zero where there is none: observations(prepared, data) is
    rule(prepared, data)(data.filled).  None: `observations` is asked for every reading.  `fits(state, info)`, traced by JAX, says
    of the step that gave them that `adapt` would find nothing to better.  None: `healthy` says it, or `adapt` is asked.  A class
    of states may name in `LASTING` (a tuple) its fields that no step changes, only `adapt`: they are not copied with every step.
    A state may have `settled(state)`, traced by JAX, which lays it as its next steps had best find it: a live filter asks for it
    at the beginning of a run and now and then within.  One that is `small` takes steps that are over about as soon as begun, and
    that are products and sums of its points: they are compiled as one kernel.
    Where nothing depends on time, `lasting(prepared, interval, rule, length)` makes of the only interval of a Prepared, and
    of its rule, those of a shorter one.  None: that is prepared like any other.

    Runs.  A state that `adapt` gives may have `together(state, intervals, observations, keep, count, strict)`, traced by JAX,
    which gives what a scan of `step` gives: the state after `count` steps, rounded up to whole sixteens; of every step its Info
    and, with `keep`, what is kept of its state, of those that were not taken anything; and how many were taken: if it is `strict`
    those before the first that was not well, which is found out every `look` steps.  `needed(intervals)` is what it asks for of
    them.  Where a Prepared is `at_once` many records are filtered by it one after another.  `bare` is the state with nothing
    static in it but what a step must know.  Where steps are healthy or not, one may have `some(intervals, state, observations)`,
    which gives the states and the Infos of a few steps with a leading axis.  A class of states may name in `PLANNED` its fields
    that no step changes, and whose values are asked for between runs: they stay as `adapt` gave them.

    Early ends.  `healthy(info)` says, traced by JAX, whether steps kept their bounds.  A run then ends before the first that did
    not, and where it took enough steps by then, the next run begins there: no step is taken twice.
    """

    name: str
    source: str
    exactness: str
    theorem: Callable[[Model], tuple[Condition, ...]]
    options: Mapping[str, Any]
    prepare: Callable[..., Any]
    init: Callable[..., Any]
    correct: Callable[..., Any]
    observations: Callable[..., Any]
    step: Callable[..., Any]
    density: Callable[..., Density]
    adapt: Callable[..., Any] | None = None
    with_parameters: Callable[..., Any] | None = None
    resume: Callable[..., Any] | None = None
    correct_again: Callable[..., Any] | None = None
    adapt_many: Callable[..., Any] | None = None
    alone: Callable[[Any], bool] | None = None
    healthy: Callable[[Info], Any] | None = None
    rule: Callable[..., Any] | None = None
    lasting: Callable[..., tuple[Any, Any]] | None = None
    fits: Callable[[Any, Info], Any] | None = None
    bounds: Mapping[str, tuple[float, str]] = field(default_factory=dict)
