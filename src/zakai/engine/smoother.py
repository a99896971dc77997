"""Smoothing: p(x(t_k) | all observations), by the filter forward and a message backward.

The forward pass keeps the state at the start of every segment, and those within while there is memory.  The backward pass takes
the message p(later observations | x) through a segment, whose states it filters again where they were not kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai import _registry
from zakai._progress import Progress, announced
from zakai.algebra.conditions import all_hold
from zakai.algebra.theorems import conditions_of
from zakai.densities import Density
from zakai.engine.batch import filter_all, smooth_all
from zakai.engine.coarser import Done
from zakai.engine.driver import check_noise, check_records, with_inputs
from zakai.engine.first_intervals import any_fault, first_intervals
from zakai.engine.loop import CHUNK, KEPT_BYTES, Run, advance, size_of
from zakai.engine.paths import sample_paths
from zakai.engine.plan import plan_of
from zakai.engine.results import FilterResult
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Info, Infos, Prepared, State, joined, stacked
from zakai.methods._states import Joined
from zakai.models.model import Model
from zakai.numerics.one_thread import one_thread
from zakai.records import Inputs, Record
from zakai.records.dates import dated

_EVIDENCE = "the evidence of the backward pass differs from the filter's, in nats"


@dataclass(eq=False, repr=False)
class SmoothingResult(FilterResult):
    """The density of the state at every time of a record given all of its observations.

    Index 0 is the model's start, index k the time of observation k.  `filtered` is the result of the filter; the
    log-likelihood is the filter's.  All else is as for a `FilterResult`.
    """

    filtered: FilterResult | None = None
    _runs: tuple[SmoothingRun, ...] = ()

    def sample_paths(self, count: int, seed: int = 0) -> np.ndarray:
        """Return draws from the joint law of the state at all times given all observations.

            x_K ~ p(x_K | all observations),      x_k ~ p(x_k | x_(k+1), observations until k + 1)

        Args:
            count: number of paths.
            seed: the same seed gives the same paths.

        Returns:
            (count, K+1, n); index 0 is the model's start.  Angles are in (-pi, pi].

        Raises:
            InputError: a wrong count, more paths than the memory holds, a method that does not draw paths, or a result that was
                read from a file.

        References:
            Godsill, Doucet and West 2004, Monte Carlo smoothing for nonlinear time series.

        Example:
            model = zakai.load_model("gallery:benes")
            truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
            smoothed = zakai.smooth(model, record)
            paths = smoothed.sample_paths(1000)
            highest = paths[:, :, 0].max(axis=1)  # draws of the largest value that the state has taken
        """
        if not self._runs and self._again is not None:
            computed = self._again()
            if isinstance(computed, SmoothingResult):
                return computed.sample_paths(count, seed)
        if not self._runs:
            raise InputError(
                "sample_paths: a result that was read from a file does not hold its filter; smooth the record again, or save it "
                "with densities=True"
            )
        place = {name: i for i, name in enumerate(self.state)}
        names = [block.state for block in self.blocks] or [self.state]
        return sample_paths(self._runs, [[place[name] for name in own] for own in names], len(self.state), count, seed)

    def __repr__(self) -> str:
        return super().__repr__().replace("FilterResult", "SmoothingResult", 1)


def smooth(
    model: Model,
    record: Record,
    method: str = "auto",
    *,
    inputs: Inputs | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> SmoothingResult:
    """Return the conditional density of the state given all observations, at every time of the record.

    Args:
        model: the system, with a prior.
        record: K observations of the model's kind.
        method: a method's name, or "auto": the first method that holds and has a backward pass for this system.
        inputs: the known inputs of the model, in place of those of the record.
        progress: called with the number of observations filtered and K.
        **options: options of the method.

    Raises:
        InputError: a wrong record or option, or a method without a backward pass.
        ConditionError: the method's theorem does not hold.

    Example:
        model = zakai.load_model("gallery:benes")
        truth, record = zakai.simulate(model, np.arange(0.01, 1.0, 0.01))
        smoothed = zakai.smooth(model, record)
        smoothed.mean[0], smoothed.density(0).quantile([0.025, 0.975])
    """
    (record,) = check_records(model, with_inputs(record, inputs))
    with announced(f"{model.source}: deciding which method holds"):
        plan = plan_of(model, model.prior, method, options, unfit=any_fault(_unfit, first_intervals(model, record).fault))
    check_noise([plan], [record])
    runs = [SmoothingRun(run.setting, run.record) for run in plan.runs(record, "moments")]
    filter_all(runs, progress, len(runs))
    filtered = plan.result(runs)
    filtered.record = record
    smooth_all(runs)
    result = plan.result(runs)
    result.record, result.increment_law_error = record, filtered.increment_law_error
    for one in (filtered, result):
        one.warnings = dated([*([record._note] if record._note else []), *one.warnings], record.clock)
    result.attributes["kind"] = "smoothed"
    shared = {field.name: getattr(result, field.name) for field in fields(result)}
    return SmoothingResult(**shared, filtered=filtered, _runs=tuple(runs))


def _unfit(setting: Setting) -> str:
    """Return why a method cannot smooth a system, or nothing."""
    if setting.method.backward is None:
        return "has no backward pass"
    try:
        setting.method.backward.message(*setting.begin())
    except InputError as refused:
        return str(refused)
    return ""


def _refusal(setting: Setting) -> str:
    """Return that a method has no backward pass, and the first method that holds for its system and smooths it."""
    model, prior = setting.model, setting.prior
    said = f"{model.source}: smooth: the method {setting.method.name} has no backward pass"
    for name in _registry.METHODS:  # the most exact first
        other = _registry.load(name)
        if other.backward is None or all_hold(conditions_of(name, model)) is not True:
            continue
        if not _unfit(Setting.of(model, prior, other, other.options)):
            return f"{said}; take {name}, which holds for this system and smooths it"
    return f"{said}, and no method that has one holds for this system"


class _Opened(NamedTuple):
    """A segment as `_segment` returns it, and those of its messages that were needed, backward in time from its end."""

    rows: range
    prepared: Prepared
    begin: int
    states: Sequence[State]
    messages: list[Any]


class SmoothingRun(Run):
    """One record on its way through one method, and back."""

    def __init__(self, setting: Setting, record: Record):
        backward = setting.method.backward
        if backward is None:
            raise InputError(_refusal(setting))
        super().__init__(setting._replace(options={**setting.options, **backward.options}), record, "moments")
        self.backward = backward
        backward.message(self.empty, self.state)  # a model without a smoother is refused before it is filtered
        self.segments: list[tuple[int, State]] = []  # the first interval of each, and the state at its start
        self.after: list[Sequence[State] | None] = []  # the states after each interval of a segment, while there is memory
        self.messages: list[Any] = []  # at the end of each segment
        self.held = 0
        self.opened: dict[int, _Opened] = {}  # the segments of which densities were asked, while there is memory
        self.start: Info | None = None  # what is smoothed at the start

    def _take(self, states: Sequence[State], infos: Infos) -> None:
        self.segments.append((self.done, _alone(self.state)))
        self.held += size_of(states)
        self.after.append(states if self.held < KEPT_BYTES / 4 else None)
        super()._take(states, infos)

    def _segment(self, number: int) -> tuple[range, Prepared, int, Sequence[State]]:
        """Return the intervals of a segment, what is prepared for them and from which interval on, and the states around them."""
        first, state = self.segments[number]
        last = self.segments[number + 1][0] if number + 1 < len(self.segments) else len(self.schedule)
        begin = first // CHUNK * CHUNK
        prepared = self.setting.prepared(self.schedule.part(slice(begin, min(begin + CHUNK, len(self.schedule)))))
        states = self.after[number]
        if states is None:
            with np.errstate(all="ignore"):
                states, _ = advance(self.setting, prepared, slice(first - begin, last - begin), state, self.values[first:last])
        return range(first, last), prepared, begin, Joined([[state], states])

    def smooth(self, report: Callable[[Run, int], None], step: Callable[[Run], None]) -> None:
        """Replace the filter's moments by the smoothed ones; `report` and `step` are called as by `all`."""
        filtered = joined(self.parts)
        forward = filtered.log_likelihood_increment
        message = self.backward.message(self.empty, self.state)
        expected, self.parts, self.messages = 0.0, [], [None] * len(self.segments)
        for number in reversed(range(len(self.segments))):
            rows, prepared, begin, states = self._segment(number)
            self.messages[number] = message
            here = slice(rows.start - begin, rows.stop - begin)
            message, infos = self._backward(prepared, here, states, message, rows, partial(step, self))
            health = dict(infos.health)
            if self.backward.paths is None:  # draws know no evidence
                own = np.append(forward[rows.start + 1 : rows.stop], expected)
                health["evidence_error"] = np.abs(infos.log_likelihood_increment - own)
            here = slice(rows.start, rows.stop)
            known = filtered.log_likelihood_standard_error
            self.parts.append(
                infos._replace(
                    log_likelihood_increment=forward[here], health=health,
                    log_likelihood_standard_error=None if known is None else known[here],
                )
            )  # fmt: skip
            expected = float(forward[rows.start])
            report(self, len(rows))
        self.parts.reverse()
        _, info = self.backward.smoothed(self.empty, self.first, message)
        if self.backward.paths is None:
            error = abs(float(info.log_likelihood_increment) - expected)
            info = info._replace(health={**info.health, "evidence_error": error})
        self.start = info

    @one_thread
    def _backward(
        self,
        prepared: Prepared,
        rows: slice,
        states: Sequence[State],
        message: Any,
        observed: range,
        stepped: Callable[[], None] | None = None,
    ) -> tuple[Any, Infos]:
        """Return the message at the start of the intervals `rows` of what is prepared, and the smoothed moments after each."""
        values = self.values[observed.start : observed.stop]
        found = None
        if self.backward.segment is not None:
            found = self.backward.segment(prepared, rows, states, message, values)
        if found is not None:
            return found
        infos = []
        for i in reversed(range(len(values))):
            message, info = self.backward.smoothed(self.empty, states[i + 1], message)
            infos.append(info)
            message = self.backward.step(prepared, rows.start + i, message, values[i], states[i])
            if stepped is not None:
                stepped()
        return message, stacked(infos[::-1])

    def density(self, index: int) -> Density:
        """Return the smoothed density at an index of the result, made from the nearest checkpoints."""
        number = max(i for i, (first, _) in enumerate(self.segments) if first < max(index, 1))
        if number not in self.opened:
            while sum(map(size_of, self.opened.values())) > KEPT_BYTES / 4:
                self.opened.pop(next(iter(self.opened)))
            self.opened[number] = _Opened(*self._segment(number), [self.messages[number]])
        rows, prepared, begin, states, messages = self.opened[number]
        for k in range(rows.stop - len(messages), index - 1, -1):
            place = k - rows.start
            here = slice(k - begin, k - begin + 1)
            messages.append(self._backward(prepared, here, states[place : place + 2], messages[-1], range(k, k + 1))[0])
        return self.backward.density(self.empty, states[index - rows.start], messages[rows.stop - index])

    def start_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the covariance at the start, smoothed once the record is."""
        return super().start_moments() if self.start is None else (self.start.mean, self.start.cov)

    def health_warnings(self, result: FilterResult) -> list[str]:
        """Return what the figures of the filter say, nothing while they stand beside those of the smoother."""
        return [] if self.start is not None else super().health_warnings(result)

    def again(self, setting: Setting, done: Done) -> Infos:
        """Return what another setting of the method reports after each interval, of the smoother once the record is smoothed."""
        if self.start is None:
            return super().again(setting, done)
        other, count = SmoothingRun(setting, self.record), 0

        def reported(run: Run, more: int) -> None:
            nonlocal count
            count += more
            done(0.5 * count)  # the pass through the record is half of the work, and the way back the other half

        other.all(reported)
        other.smooth(reported, lambda run: None)
        return joined(other.parts)

    def complete(self, result: FilterResult) -> FilterResult:
        """Return the result, of the filter until the record is smoothed."""
        if self.start is None:
            return result
        result._density = self.density
        for name, figures in result.health.items():
            figures[0] = self.start.health[name]
        if "evidence_error" in result.health:
            result.bounds = {**result.bounds, "evidence_error": (self.backward.accuracy(self.empty), _EVIDENCE)}
        if result.mean_standard_error is not None and self.start.mean_standard_error is not None:
            result.mean_standard_error[0] = self.start.mean_standard_error
        result.warnings = [*self.notes, *self.misfit, *super().health_warnings(result)]
        result.increment_law_error = None  # `smooth` gives that of the filter
        return result


def _alone(state: Any) -> Any:
    """Return a state with arrays of its own: a view would keep those of all states of its segment."""
    if isinstance(state, np.ndarray):
        return state.copy()
    return type(state)(*map(_alone, state)) if isinstance(state, tuple) and hasattr(state, "_fields") else state
