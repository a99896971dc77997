"""The shape that every method has.

A method is one module with one `METHOD`, which names plain functions:

    prepare(model, schedule, theta, **options) -> Prepared     offline: sees no data
    init(prepared, prior) -> State                             the prior at the model's start
    step(prepared, k, state, values) -> (State, Info)          interval k of the schedule, and the observation at its stop
    density(prepared, state) -> Density

Rules:

* A `Prepared` has the attribute `notes`, sentences for the warnings of a result.  `prepare` works for an empty schedule; `init`
  and `density` depend on the model, theta and the options only, never on the schedule.
* What is prepared for an interval depends on that interval alone, to the last bit: a record, a batch and an online filter
  prepare different schedules and must agree.  Where the model does not depend on t, it depends on the length of the interval
  only (`schedule.lengths`), not on where it begins.
* `step` is a pure function of its arguments; many threads call it at once.  It handles intervals of length zero (a sample at the
  start), unobserved coordinates (`schedule.seen`), and increments gathered over more than the interval (`schedule.elapsed`).
  `values` (m,) are zero where nothing is observed.
* A `State` is a NamedTuple of arrays, numbers, booleans, strings and tuples of these: a checkpoint stores its fields.
* With `differentiable`, `theta` (p,) may be complex: the imaginary part of the log-likelihood is then its derivative
  (`numerics/complex_step.py`).  Decisions (grids, substeps) are taken by the real parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from zakai.algebra.conditions import Condition
from zakai.densities import Density
from zakai.models.model import Model
from zakai.records.schedule import Schedule


class Info(NamedTuple):
    """What one step reports: the increment of the log-likelihood, `mean` (n,), `cov` (n, n), and the health figures.

    Methods with random errors report the standard errors of the mean (n,) and of the log-likelihood until now.
    """

    log_likelihood_increment: Any
    mean: np.ndarray
    cov: np.ndarray
    health: Mapping[str, float]
    mean_standard_error: np.ndarray | None = None
    log_likelihood_standard_error: float | None = None


class Infos(NamedTuple):
    """What K steps report: an Info with a leading axis of K."""

    log_likelihood_increment: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    health: Mapping[str, np.ndarray]
    mean_standard_error: np.ndarray | None = None
    log_likelihood_standard_error: np.ndarray | None = None


State = tuple[Any, ...]  # of a method that is not known: a NamedTuple of arrays, numbers, booleans, strings and tuples of these

S = TypeVar("S")


def stacked(infos: Sequence[Info]) -> Infos:
    """Return the reports of single steps as arrays with a leading axis."""
    random = infos[0].mean_standard_error is not None
    return Infos(
        np.array([info.log_likelihood_increment for info in infos]),
        np.array([info.mean for info in infos]),
        np.array([info.cov for info in infos]),
        {name: np.array([info.health[name] for info in infos]) for name in infos[0].health},
        np.array([info.mean_standard_error for info in infos]) if random else None,
        np.array([info.log_likelihood_standard_error for info in infos]) if random else None,
    )


def joined(parts: Sequence[Infos]) -> Infos:
    """Return the reports of consecutive steps as one."""
    health = {name: np.concatenate([part.health[name] for part in parts]) for name in parts[0].health}
    increments, means, covs = (np.concatenate([part[i] for part in parts]) for i in range(3))
    errors = [None if parts[0][i] is None else np.concatenate([part[i] for part in parts]) for i in (4, 5)]
    return Infos(increments, means, covs, health, *errors)


class Tangents(NamedTuple, Generic[S]):
    """The states after K steps, what they report, the derivatives (p,) of the sum of what they gained, and the shifted states."""

    states: Sequence[S]
    infos: Infos
    slopes: np.ndarray
    shifted: Sequence[S]


class Prepared(Protocol):
    """What is known without data."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the warnings of a result."""


P = TypeVar("P", bound=Prepared)
M = TypeVar("M")


@dataclass(frozen=True)
class Backward(Generic[P, S, M]):
    """The backward pass of a smoother.  A message is p(observations after t | x at t), up to a constant factor.

    `message(prepared, state)` returns the message at the last time, constant one; it raises InputError where this model has no
    smoother, and is asked for that before the record is filtered.  `step(prepared, k, message, values, state)` returns the
    message at the start of interval k from that at its end; `state` is the filtered one at the start.
    `smoothed(prepared, state, message)` returns the message normalised, so that its product with the filtered state at the same
    time has mass one, and the Info of that product, whose `log_likelihood_increment` is the logarithm of the mass before: what
    the step over interval k has gained must be the increment of the filter over interval k.  `density(prepared, state, message)`
    returns the smoothed density.

    Optional: `segment(prepared, rows, states, message, values)` takes the message from the end of a slice of intervals to its
    start; `states` are the filtered ones at the start and after each interval.  It returns the message and what `smoothed`
    reports after each interval; or None, where the single steps are to be taken.

    Optional: `draw(prepared, k, later, values, state, rng)` returns draws (P, n) of the state at the start of interval k given
    the draws `later` (P, n) at its end, and how far their law is from what is drawn: zero where it is exact, else a figure that
    falls with the length of the interval, which is divided above a bound.

    Optional: `paths(prepared, state, count, seed)` returns the message at the last time of so many draws, where a message is
    draws, its `draws` (n, P): those of consecutive messages are paths.  Only one of `draw` and `paths` is needed.

    Optional: `accuracy(prepared)` is the error of the evidence of one interval, in nats, beyond which a result warns.

    Optional: `options` are those of the method with which a record is filtered before the backward pass.

    `message`, `smoothed` and `density` use of `prepared` only what does not depend on the schedule.
    """

    message: Callable[[P, S], M]
    step: Callable[[P, int, M, np.ndarray, S], M]
    smoothed: Callable[[P, S, M], tuple[M, Info]]
    density: Callable[[P, S, M], Density]
    segment: Callable[[P, slice, Sequence[S], M, np.ndarray], tuple[M, Infos] | None] | None = None
    draw: Callable[[P, int, np.ndarray, np.ndarray, S, np.random.Generator], tuple[np.ndarray, float]] | None = None
    accuracy: Callable[[P], float] = lambda prepared: 1e-6
    paths: Callable[[P, S, int, int], M] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


def through(
    of: Callable[[Any], tuple[Backward[Any, Any, Any], Any]],
    state_of: Callable[[Any, Any], Any],
    reported: Callable[[Any, Any, Mapping[str, Any]], Mapping[str, Any]],
    accuracy: Callable[[Any], float] = lambda prepared: 0.0,
) -> Backward[Any, Any, Any]:
    """Return the backward pass of a method by that of another one.

    Args:
        of: what is prepared to the other backward pass and what is prepared for it.
        state_of: what is prepared and a state to the other method's state.
        reported: what is prepared, a state and the health figures of the other one to those that are reported.
        accuracy: the error of the evidence that an interval of the method itself may leave.
    """

    def message(prepared: Any, state: Any) -> Any:
        other, own = of(prepared)
        return other.message(own, state_of(prepared, state))

    def step(prepared: Any, k: int, later: Any, values: np.ndarray, state: Any) -> Any:
        other, own = of(prepared)
        return other.step(own, k, later, values, state_of(prepared, state))

    def smoothed(prepared: Any, state: Any, later: Any) -> tuple[Any, Info]:
        other, own = of(prepared)
        later, info = other.smoothed(own, state_of(prepared, state), later)
        return later, info._replace(health=reported(prepared, state, info.health))

    def density(prepared: Any, state: Any, later: Any) -> Density:
        other, own = of(prepared)
        return other.density(own, state_of(prepared, state), later)

    def draw(
        prepared: Any, k: int, later: np.ndarray, values: np.ndarray, state: Any, rng: np.random.Generator
    ) -> tuple[np.ndarray, float]:
        other, own = of(prepared)
        assert other.draw is not None
        return other.draw(own, k, later, values, state_of(prepared, state), rng)

    def allowed(prepared: Any) -> float:
        other, own = of(prepared)
        return max(accuracy(prepared), other.accuracy(own))

    return Backward(message, step, smoothed, density, None, draw, allowed)


@dataclass(frozen=True)
class Method(Generic[P, S]):
    """One filter: its functions, and what is said of it.

    `options` are the keyword arguments of `prepare` with their defaults.  `bounds` gives for a health figure the bound above
    which a result warns, and the words of the warning; `losses` gives for some the value above which the step has lost the
    density, so that later rows mean nothing.  `state` is the class of the states.  `shorter` says what shortens a long
    run, as in "this takes about 40 s; to shorten it, raise the tolerance".

    `handles` names the features of a model (`models/features.py`) that the method handles; a model with another one is refused
    before `theorem` is asked.

    `random` says that the numbers have random errors, which the standard errors of an Info report.

    `reflects` says that states of a system with several are mirrored at reflecting ends.

    `by_values` says that a fit takes quadratics through values of the log-likelihood, which has no derivative but small jumps; it
    makes the option `choices` that the values of one quadratic have in common, so that the jumps are smaller, for a tolerance
    that is as many times larger as its argument says.

    `cautious` says that `error_estimate` is a bound that may be far above the error: where it warns, a run at a coarser tolerance
    is compared with it.

    `absolute` says that what is prepared for an interval depends on where it begins, although the model does not depend on t.

    Optional: `variant(model, options)` returns the method with the functions for this model and these options, where those above
    are not for all of them.

    Optional: `valid(prepared, state)` says whether the arrays of a state fit together; it is asked of a state that was read from
    a file, before any kernel receives it.

    Optional: `segment(prepared, rows, state, values)` advances the intervals of a slice in one compiled loop that calls the same
    kernel as `step`, and returns the states after each step and their Infos; or None, where the single steps are to be taken.

    Optional: `tangents(prepared, shifted, rows, state, shifted_states, values)` advances the intervals of a slice and carries the
    derivatives with respect to p parameters; `shifted` and `shifted_states` (p) are what is prepared and the states at parameters
    of which one has an infinitesimal imaginary part.  It returns the states after each step, their Infos, the derivatives (p,) of
    the sum of what they gained, and the last shifted states; or None, where `step` is to carry them.

    Optional: `for_interval(prepared, schedule)` returns what `prepare` returns for one interval without inputs, from what is
    prepared for another one, in which the same coordinates are seen and the same of them are increments over just the interval.

    Optional: `backward` is the backward pass of `zakai.smooth`.

    Optional: `bounded(prepared, points)` returns what is prepared with a bound on the work in an interval, in grid points; a
    step that needs more raises ExhaustedError.  "auto" tries the first intervals with it.

    Optional: `reduced(state)` returns a state of which only the density and the backward pass are asked, without what the next
    step needs: those are the states that a result keeps.
    """

    name: str
    source: str
    exactness: str
    theorem: Callable[[Model], tuple[Condition, ...]]
    options: Mapping[str, Any]
    prepare: Callable[..., P]
    init: Callable[[P, Any], S]
    step: Callable[[P, int, S, np.ndarray], tuple[S, Info]]
    density: Callable[[P, S], Density]
    state: type[S]
    bounds: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    losses: Mapping[str, float] = field(default_factory=dict)
    differentiable: bool = True
    handles: frozenset[str] = frozenset()
    shorter: str = "give fewer observations"
    absolute: bool = False
    cautious: bool = True
    random: bool = False
    reflects: bool = False
    by_values: Callable[[float], Any] | None = None
    variant: Callable[[Model, Mapping[str, Any]], Method[Any, Any]] | None = None
    valid: Callable[[P, S], bool] | None = None
    segment: Callable[[P, slice, S, np.ndarray], tuple[Sequence[S], Infos] | None] | None = None
    tangents: Callable[[P, Sequence[P], slice, S, Sequence[S], np.ndarray], Tangents[S] | None] | None = None
    for_interval: Callable[[P, Schedule], P] | None = None
    backward: Backward[P, S, Any] | None = None
    reduced: Callable[[S], S] | None = None
    bounded: Callable[[P, float], P] | None = None

    @property
    def all_options(self) -> dict[str, Any]:
        """The options with their defaults, and `choices`, which a fit alone gives."""
        return {**self.options, **({} if self.by_values is None else {"choices": None})}
