"""Forecasts: the density of the state after the end of a record, by the steps of the filter with nothing observed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.engine.batch import filter_all
from zakai.engine.loop import Run
from zakai.errors import InputError
from zakai.methods._protocol import State
from zakai.methods._states import Joined
from zakai.records import Inputs, Record
from zakai.records.dates import dated
from zakai.records.inputs import check_inputs, expected_inputs

if TYPE_CHECKING:
    from zakai.engine.plan import Plan
    from zakai.engine.results import FilterResult


def origin_of(result: FilterResult, what: str) -> tuple[Plan, tuple[State, ...], Record]:
    """Return how a result was computed, the last states of its runs, and its record.

    Raises:
        InputError: the result was read from a file.
    """
    if result.origin is None and result._again is not None:
        computed = result._again()
        result.origin, result.record, result._states = computed.origin, computed.record, computed._states
    if result.origin is None or result.record is None:
        raise InputError(
            f"{what}: a result that was read from a file does not hold its filter; filter the record again, or save it with "
            "densities=True"
        )
    return result.origin[0], result.origin[1], result.record


def future_of(result: FilterResult, times: Any, inputs: Inputs | None, what: str) -> Record:
    """Return a record without observations at times after that of a result; `what` begins the errors."""
    record = origin_of(result, what)[2]
    times = [times] if np.ndim(times) == 0 else times
    if not np.size(times):
        raise InputError(f"{what}: no times; give at least one time after the end of the record")
    values = np.full((np.size(times), record.values.shape[1]), np.nan)
    known = record.inputs
    if inputs is not None:
        later = expected_inputs(inputs, f"{what}: inputs").on(record.clock)
        known = later if known is None else known.followed_by(later)
    future = Record(times, values, record.kind, known, record.unit, record.origin)
    last = float(record.times[-1])
    if future.times[0] <= last:
        when = f"the time {future.times[0]:.12g} is not after the end of the record, {last:.12g}"
        raise InputError(f"{what}: {when}; give later times")
    if result.model is not None:
        check_inputs(result.model, future.inputs, float(record.times[0]), float(future.times[-1]))
    return future


def forecast(result: FilterResult, times: Any, inputs: Inputs | None = None) -> FilterResult:
    """Return the density of the state at times after a record; see `FilterResult.forecast`."""
    plan, states, record = origin_of(result, "forecast")
    future, last = future_of(result, times, inputs, "forecast"), float(record.times[-1])
    runs = [ForecastRun(run, state, last) for run, state in zip(plan.runs(future, None), states, strict=True)]
    filter_all(runs, None, len(runs))
    found = plan.result(runs)
    found.record, found.warnings = future, dated(found.warnings, future.clock)
    found.times[0], found.mean[0] = last, result.mean[-1]
    found.attributes["kind"] = "forecast"
    return found


class ForecastRun(Run):
    """A run that continues another one from its last state."""

    def __init__(self, run: Run, state: State, last: float):
        super().__init__(run.setting, run.record, None, run.most)
        self.state = self.first = state
        self.states = Joined([[state]])
        self.schedule.starts[0] = last
