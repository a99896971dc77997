"""Known inputs: what acts on a system and is known, at times of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zakai import _display
from zakai.errors import InputError
from zakai.models._errors import echo
from zakai.records.dates import Clock, read_times
from zakai.records.numbers import LARGEST, numbers_in_time, real_numbers

if TYPE_CHECKING:
    from zakai.models.model import Model


@dataclass(frozen=True, eq=False)
class Inputs:
    """Known inputs at strictly increasing times, which need not be those of a record.

    Args:
        times: (k,), in the model's unit of time; or dates, with a `unit`, as for `Record`.
        values: (k, number of inputs), in the order of the model's `inputs`; (k,) is taken as (k, 1).
        unit: the model's unit of time, for dates: "ns", "us", "ms", "s", "min", "h", "d", "week" or "year" (365.25 days).
        origin: the date at which t = 0, by default the first date; with a record of dates its origin counts.

    With `input_hold = "zero"` the value at t_k holds on [t_k, t_(k+1)), the last one for ever; with "linear" it is linear between
    the times.

    Raises:
        InputError: a wrong shape, times that do not increase, or a number that is not finite.

    Example:
        >>> Inputs([0.0, 1.0], [2.0, 3.0]).at(0.5)
        array([2.])
    """

    times: NDArray[Any]
    values: NDArray[Any]
    unit: str | None = None
    origin: Any = None

    def __post_init__(self) -> None:
        given, clock, _ = read_times(self.times, self.unit, self.origin, "inputs")
        times, values = numbers_in_time(given, self.values, "inputs", "(k,)", "number of inputs")
        for name, part in (("times", times[:, None]), ("values", values)):
            wrong = ~(np.abs(part) <= LARGEST).all(axis=1)
            if wrong.any():
                row = int(np.argmax(wrong))
                raise InputError(
                    f"inputs: row {row}, counted from 0: {name} must be finite numbers; an input is known at all times"
                )
        late = np.flatnonzero(np.diff(times) <= 0)
        if len(late):
            row = int(late[0]) + 1
            fault = f"time {times[row]:.12g} does not increase; sort the rows by time"
            raise InputError(f"inputs: row {row}, counted from 0: {fault}")
        times.flags.writeable = values.flags.writeable = False
        found = {"times": times, "values": values, "unit": None, "origin": None}
        for name, value in (found if clock is None else {**found, **clock._asdict()}).items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        return f"Inputs({len(self)} rows x {self.values.shape[1]}, times {float(self.times[0])!r} to {float(self.times[-1])!r})"

    def _repr_html_(self) -> str:
        few = slice(_display.MOST_ROWS)
        rows = [tuple(map(_display.number, (time, *row))) for time, row in zip(self.times[few], self.values[few], strict=True)]
        header = ["time", *(f"u{i + 1}" for i in range(self.values.shape[1]))]
        return _display.html_table(repr(self), header, rows, total=len(self))

    @property
    def clock(self) -> Clock | None:
        """The unit and the date at which t = 0, of inputs with dates."""
        return None if self.unit is None else Clock(self.origin, self.unit)

    def on(self, clock: Clock | None) -> Inputs:
        """Return the inputs with times of a clock; inputs without dates are returned as they are.

        Raises:
            InputError: inputs have dates, and there is no clock.
        """
        if self.clock is None or self.clock == clock:
            return self
        if clock is None:
            raise InputError("inputs: have dates, but the observations have not; give dates, a unit and an origin to both")
        return Inputs(clock.times(self.clock.dates(self.times)), self.values, clock.unit, clock.origin)

    def at(self, t: Any, hold: str = "zero", before: bool = False) -> NDArray[Any]:
        """Return the inputs (..., number of inputs) at times t (...); `before` takes the limit from the left at a jump.

        Before the first time it is the first value, after the last the last one.
        """
        t = np.asarray(t, dtype=float)
        if hold == "linear":
            columns = [np.interp(t, self.times, column) for column in self.values.T]
            return np.stack(columns, axis=-1)
        place = np.searchsorted(self.times, t, side="left" if before else "right") - 1
        return np.asarray(self.values[np.maximum(place, 0)])

    def within(self, start: float, stop: float) -> NDArray[Any]:
        """Return the times of the inputs in (start, stop): where u or its slope jumps inside of an interval."""
        first, last = np.searchsorted(self.times, start, "right"), np.searchsorted(self.times, stop, "left")
        return self.times[first:last]

    def part(self, start: float, stop: float = math.inf) -> Inputs:
        """Return the rows that decide the inputs, their limits and `within` for times from `start` to `stop`."""
        first = max(int(np.searchsorted(self.times, start, "left")) - 1, 0)
        last = int(np.searchsorted(self.times, stop, "left")) + 1
        return self if first == 0 and last >= len(self) else Inputs(self.times[first:last], self.values[first:last])

    def followed_by(self, later: Inputs) -> Inputs:
        """Return these inputs up to the first time of `later`, and from there on those of `later`."""
        kept = self.times < later.times[0]
        return Inputs(np.concatenate([self.times[kept], later.times]), np.concatenate([self.values[kept], later.values]))

    def check(self, model: Model, last: float, start: float | None = None, name: str = "inputs") -> None:
        """Raise InputError unless the inputs are those of the model from `start`, by default its own, to the time `last`.

        `name` is what the message calls the inputs: their file, where they have one.
        """
        start = model.start if start is None else start
        if self.values.shape[1] != len(model.inputs):
            names = ", ".join(model.inputs) or "none"
            raise InputError(f"{name}: {self.values.shape[1]} columns; {model.source} has {len(model.inputs)}: {names}")
        first = float(self.times[0])
        if first > start:
            raise InputError(
                f"{name}: the first time {first:.12g} is after the start {start:.12g} of {model.source}; "
                f"give {', '.join(model.inputs)} from the start on"
            )
        if model.input_hold == "linear" and self.times[-1] < last:
            raise InputError(
                f'{name}: the last time {float(self.times[-1]):.12g} is before {last:.12g}; with input_hold = "linear" give '
                f"{', '.join(model.inputs)} up to {last:g}"
            )


def check_inputs(model: Model, inputs: Any, last: float) -> None:
    """Raise InputError unless a model and the inputs of a record (or None) go together; `last` is its last time."""
    if inputs is not None and not isinstance(inputs, Inputs):
        raise InputError(f"inputs: expected zakai.Inputs(times, values), got a {type(inputs).__name__}")
    if inputs is None and model.inputs:
        raise InputError(
            f"inputs: {', '.join(model.inputs)} of {model.source} are missing; give inputs=zakai.Inputs(times, values), "
            "--inputs FILE.csv, or columns of the record with their names"
        )
    if inputs is not None:
        inputs.check(model, last)


def known_inputs(model: Model, known: Inputs | None, given: Any, now: float, time: float) -> Inputs | None:
    """Return what is known of the inputs after an observation at `time`, None for a model without inputs.

    Args:
        model: its inputs.
        known: what is known at the time `now` of the filter, None at the beginning.
        given: `Inputs`, which replace what is known from their first time on; the values at `time` by their names or in the
            order of the model's `inputs`, the first of which hold from the start of the model; or None.
        now: the time of the last observation.
        time: the time of this one.

    Raises:
        InputError: inputs of another model, or inputs that are missing.
    """
    if not model.inputs:
        if given is None:
            return None
        raise InputError(f"inputs: {model.source} has no inputs; leave them out, or name them in the model")
    if given is not None and not isinstance(given, Inputs):
        row = _row(model, given)
        begin = [now] if known is None and time > now else []
        given = Inputs(np.array([*begin, time]), np.array([*(row for _ in begin), row]))
    if given is not None and known is not None and given.values.shape[1] == known.values.shape[1]:
        given = known.followed_by(given)
    found = known if given is None else given
    if found is None:
        raise InputError(f"inputs: {', '.join(model.inputs)} of {model.source} are missing; give them with the first observation")
    found.check(model, time, now)
    return found


def _row(model: Model, given: Any) -> Any:
    """Return the values of the inputs at one time, in the order of the model."""
    names = ", ".join(model.inputs)
    if isinstance(given, Mapping):
        for name in given:
            if name not in model.inputs:
                raise InputError(f"inputs: {echo(name, 40)} is not an input of {model.source}; its inputs: {names}")
        missing = [name for name in model.inputs if name not in given]
        if missing:
            raise InputError(f"inputs: {', '.join(missing)} of {model.source} are missing; give all inputs, or none")
        given = [given[name] for name in model.inputs]
    row = np.atleast_1d(real_numbers(given, "values", "inputs"))
    if row.shape != (len(model.inputs),):
        raise InputError(f"inputs: {row.size} values; {model.source} has {len(model.inputs)}: {names}")
    return row
