"""Known inputs: what acts on a system and is known, at times of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
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
    _extended: bool = field(default=False, repr=False)  # the first row holds from the model's start

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

    @classmethod
    def of_rows(cls, times: Any, values: NDArray[Any], unit: str | None = None, origin: Any = None) -> Inputs:
        """Return the inputs of the rows of a record.

        The first row with inputs holds from the model's start, and a row without inputs (NaN) changes nothing.

        Raises:
            InputError: a row with only some of the inputs, or no row with inputs.
        """
        given = ~np.isnan(values)
        rows = given.all(axis=1)
        partial = given.any(axis=1) & ~rows
        if partial.any():
            row = int(np.argmax(partial))
            raise InputError(f"inputs: row {row}, counted from 0: only some inputs are given; give all or none")
        if not rows.any():
            raise InputError("inputs: no row has inputs; fill their columns")
        return cls(times[rows], values[rows], unit, origin, True)

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
        times = clock.times(self.clock.dates(self.times))
        return Inputs(times, self.values, clock.unit, clock.origin, self._extended)

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

    def since(self, start: float) -> Inputs:
        """Return the inputs with a row at `start`, where their first row holds from there on."""
        if not self._extended or self.times[0] <= start:
            return self
        return Inputs(np.concatenate([[start], self.times]), np.concatenate([self.values[:1], self.values]))

    def followed_by(self, later: Inputs) -> Inputs:
        """Return these inputs up to the first time of `later`, and from there on those of `later`."""
        kept = self.times < later.times[0]
        times, values = (np.concatenate([a[kept], b]) for a, b in ((self.times, later.times), (self.values, later.values)))
        return Inputs(times, values, _extended=self._extended)

    def check(self, model: Model, first: float, last: float, start: float | None = None, name: str = "inputs") -> None:
        """Raise InputError unless the inputs are those of the model for observations from the time `first` to `last`.

        `start` is the time of the state from which the filter begins, by default the model's start.  `name` is what the message
        calls the inputs: their file, where they have one.
        """
        start = model.start if start is None else start
        where = f"the start {start:.12g} of {model.source}"
        if not acts_between_rows(model):
            start, where = first, f"the first observation at {first:.12g}"
        if self.values.shape[1] != len(model.inputs):
            names = ", ".join(model.inputs) or "none"
            raise InputError(f"{name}: {self.values.shape[1]} columns; {model.source} has {len(model.inputs)}: {names}")
        begin = float(self.times[0])
        if begin > start and not self._extended:
            raise InputError(
                f"{name}: the first time {begin:.12g} is after {where}; give {', '.join(model.inputs)} from {start:.12g} on"
            )
        if model.input_hold == "linear" and self.times[-1] < last:
            raise InputError(
                f'{name}: the last time {float(self.times[-1]):.12g} is before {last:.12g}; with input_hold = "linear" give '
                f"{', '.join(model.inputs)} up to {last:g}"
            )


def acts_between_rows(model: Model) -> bool:
    """Return whether an input acts between the observations: not only on what samples say of the state."""
    moving = (model.drift, model.diffusion)
    formulas = moving if model.observation_kind == "samples" else (*moving, model.observation)
    return any(formula.free_symbols & set(model.u) for formula in formulas)


def expected_inputs(given: Any, what: str = "inputs") -> Inputs:
    """Return what is given as inputs; InputError where it is something else."""
    if not isinstance(given, Inputs):
        raise InputError(f"{what}: expected zakai.Inputs(times, values), got a {type(given).__name__}")
    return given


def check_inputs(model: Model, inputs: Any, first: float, last: float) -> None:
    """Raise InputError unless a model and the inputs of a record (or None) go together; it has times from `first` to `last`."""
    inputs = None if inputs is None else expected_inputs(inputs)
    if inputs is None and model.inputs:
        raise InputError(
            f"inputs: {', '.join(model.inputs)} of {model.source} are missing; give inputs=zakai.Inputs(times, values), "
            "--inputs FILE.csv, or columns of the CSV with their names; of a DataFrame, "
            f"zakai.Record.from_pandas(frame, inputs={list(model.inputs)})"
        )
    if inputs is not None:
        inputs.check(model, first, last)


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
    found.check(model, time, time, now)
    return found.since(now)


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
