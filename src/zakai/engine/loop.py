"""The loop over the observations of one record: the only one, whether moments, densities or derivatives are wanted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.engine.along_path import along_path, record_along
from zakai.engine.coarser import Done, distances
from zakai.engine.setting import KEPT, Setting
from zakai.errors import InputError
from zakai.methods._protocol import Infos, Prepared, State, joined, stacked
from zakai.methods._states import Joined
from zakai.methods.system.escape import EscapeError
from zakai.notes.health import warnings_of_run
from zakai.notes.model import (
    notes_on_angles,
    notes_on_inputs,
    notes_on_start,
    notes_on_tables,
    why_not_finite,
)
from zakai.numerics.one_thread import one_thread
from zakai.records import Record
from zakai.records.noise import notes_on_noise
from zakai.records.schedule import ROUNDING, Schedule, schedule_of

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

CHUNK = 1024  # intervals that are prepared together, at most
PIECE = 128  # intervals between two reports of progress, at most
GROWTH = 8  # the first report comes after one interval
AT_ONCE = 64 * 2**20  # bytes of the states of a segment
KEPT_BYTES = 512 * 2**20  # of densities that are kept by default


@one_thread
def advance(
    setting: Setting, prepared: Prepared, rows: slice, state: State, values: np.ndarray, stepped: Callable[[], None] | None = None
) -> tuple[Sequence[State], Infos]:
    """Advance a state over the intervals `rows` of what is prepared; `values` (rows, m) are their observations.

    `stepped` is called after every single step.

    Returns the state after each interval and what the steps report.
    """
    method = setting.method
    found = None if method.segment is None else method.segment(prepared, rows, state, values)
    if found is not None:
        return found
    states, infos = [], []
    for k, value in zip(range(rows.start, rows.stop), values, strict=True):
        state, info = method.step(prepared, k, state, value)
        states.append(state)
        infos.append(info)
        if stepped is not None:
            stepped()
    return states, stacked(infos)


class Segment(NamedTuple):
    """Consecutive intervals of a record, after which the states are `states`.

    `first` is the number of the first interval, `rows` are their places in what is `prepared`, and `before` is the state at
    their start.
    """

    first: int
    prepared: Prepared
    rows: slice
    before: State
    states: Sequence[State]
    infos: Infos


def segments(
    setting: Setting,
    schedule: Schedule,
    state: State | None,
    values: np.ndarray,
    size: int = PIECE,
    stepped: Callable[[], None] | None = None,
) -> Iterator[Segment]:
    """Advance a state over a schedule; None stands for the state at the model's start.

    Args:
        setting: the model and the method.
        schedule: K intervals.
        state: the state at the start of the first.
        values: (K, m).
        size: the number of intervals of the first segment.
        stepped: called after every single step.
    """
    for start in range(0, len(schedule), CHUNK):
        chunk = schedule.part(slice(start, start + CHUNK))
        prepared, begin = setting.prepared(chunk), 0
        state = setting.method.init(prepared, setting.prior) if state is None else state
        while begin < len(chunk):
            rows = slice(begin, min(begin + size, len(chunk)))
            with np.errstate(all="ignore"):  # what is not finite is reported by who receives it
                try:
                    states, infos = advance(
                        setting, prepared, rows, state, values[start + rows.start : start + rows.stop], stepped
                    )
                except EscapeError as error:
                    raise error.moved(float(chunk.starts[error.row])) if setting.autonomous else error from None
            yield Segment(start + begin, prepared, rows, state, states, infos)
            state, begin = states[-1], rows.stop
            size = max(1, min(GROWTH * size, PIECE, AT_ONCE // max(size_of(state), 1)))


def size_of(state: object) -> int:
    """Return the bytes of the arrays of a state, or of several."""
    if isinstance(state, np.ndarray):
        return state.nbytes
    if isinstance(state, tuple | list):
        return sum(map(size_of, state))
    return size_of(state.parts) if isinstance(state, Joined) else 8


class Run:
    """One record on its way through one method."""

    def __init__(self, setting: Setting, record: Record, keep: str | None, most: float = KEPT_BYTES):
        self.setting, self.record, self.most = setting, record, most
        self.schedule, self.values = schedule_of(setting.model, record)
        self.noted = along_path(setting.model, self.schedule, self.values)
        self.keep, self.must_keep = keep != "moments", keep == "densities"
        self.empty, self.state = setting.begin()
        self.first = self.state
        self.states: Joined[State] = Joined([[self.state]])
        self.parts: list[Infos] = []
        self.notes: dict[str, None] = dict.fromkeys(
            [
                *notes_on_start(self.schedule),
                *_after_gaps(self.schedule),
                *notes_on_noise(*self.noted),
                *notes_on_angles(setting.model, record),
                *notes_on_inputs(setting.model, record.inputs, float(record.times[-1])),
                *notes_on_tables(self.noted[0], setting.theta.real, record_along(record, self.noted[1])),
                *self.empty.notes,
            ]
        )
        self.misfit: list[str] = []  # sentences on observations that the filter cannot explain
        self.bytes = 0
        self.done = 0
        self.steps = 0  # of the segment that has begun

    def all(self, report: Callable[[Run, int], None] | None = None, step: Callable[[Run], None] | None = None) -> None:
        """Filter the record; `report` receives the run and how many intervals have been added, `step` every single step."""
        stepped = None if step is None else partial(step, self)
        for segment in segments(self.setting, self.schedule, self.state, self.values, 1, stepped):
            self.notes.update(dict.fromkeys(segment.prepared.notes))
            self._explain(segment.infos)
            self._take(segment.states, segment.infos)
            if report is not None:
                report(self, len(segment.states))

    def prepare(self) -> None:
        """Prepare the chunks of the record that are remembered."""
        for first in range(0, min(len(self.schedule), KEPT * CHUNK), CHUNK):
            self.setting.prepared(self.schedule.part(slice(first, min(first + CHUNK, len(self.schedule)))))

    def _take(self, states: Sequence[State], infos: Infos) -> None:
        self.state = states[-1]
        self.parts.append(infos)
        self.done += len(states)
        if not self.keep:
            return
        reduced = self.setting.method.reduced
        states = states if reduced is None else [reduced(state) for state in states]
        self.states.append(states)
        self.bytes += size_of(states[-1]) * len(states)
        # Densities that will not fit are not kept to begin with.
        if self.bytes / self.done * len(self.schedule) > self.most and not self.must_keep:
            self.keep, self.states = False, Joined([[self.first]])

    def _explain(self, infos: Infos) -> None:
        """Raise InputError where a formula is not finite on a density that was lost."""
        bad = ~np.isfinite(infos.log_likelihood_increment)
        if not bad.any():
            return
        (model, schedule), k = self.noted, int(np.argmax(bad))
        stop = float(self.schedule.stops[self.done + k])
        density = self.setting.method.density(self.empty, self.state)
        with np.errstate(all="ignore"):
            centre, width = density.mean(), np.sqrt(np.maximum(np.diagonal(density.cov()), 0.0))
        if not np.isfinite(centre).all() or not np.isfinite(width).all():
            return
        points = centre + np.linspace(-8.0, 8.0, 257)[:, None, None] * np.diag(width)
        points = points.reshape(-1, model.n)
        for key in ("drift", "observation"):
            reason = why_not_finite(model, key, points, stop, self.setting.theta.real, schedule.inputs)
            if reason:
                raise InputError(f"{model.source}: {reason}, which the density reaches")

    def start_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean (n,) and the covariance (n, n) at the start."""
        first = self.setting.method.density(self.empty, self.first)
        return first.mean(), first.cov()

    @property
    def kept_states(self) -> Sequence[State] | None:
        """The states at the start and after every interval, None where they were not kept with all that a step needs."""
        whole = self.setting.method.reduced is None and len(self.states) == len(self.schedule) + 1
        return self.states if whole else None

    def density(self, index: int) -> Density:
        """Return the density at an index of the result."""
        return self.setting.method.density(self.empty, self.states[index])

    def complete(self, result: FilterResult) -> FilterResult:
        """Return the result of this run with what only this kind of run adds."""
        return result

    def health_warnings(self, result: FilterResult) -> list[str]:
        """Return what the health figures of the result say."""

        def apart() -> np.ndarray | None:
            found = distances(self.setting, result.mean[1:], result.cov[1:], self.again)
            return None if found is None else np.append(found[:1], found)

        # Of one state the error that is promised is not the tolerance for which substeps are chosen.
        asked = getattr(self.empty, "promised", getattr(self.empty, "tolerance", None))
        return warnings_of_run(result, self.setting.method.losses, apart, asked)

    def again(self, setting: Setting, done: Done) -> Infos:
        """Return what another setting of the method reports after each interval; `done` is called with the number of these."""
        parts, count = list[Infos](), 0

        def stepped() -> None:
            nonlocal count
            count += 1
            done(count)

        for one in segments(setting, self.schedule, None, self.values, 1, stepped):
            parts.append(one.infos)
            count = one.first + len(one.states)
            done(count)
        return joined(parts)

    def why_no_density(self) -> str:
        """Return why densities were not kept."""
        if self.bytes and not self.keep:
            return (
                f"the densities of {len(self.schedule)} steps were not kept: they need more than "
                f'{self.most / 2**20:.3g} MiB; keep="densities" keeps them all'
            )
        return 'the densities were not kept; keep="densities" keeps them'


def _after_gaps(schedule: Schedule) -> list[str]:
    """Return a sentence where an increment was gathered over more than its interval."""
    late = np.any(schedule.elapsed > (1 + ROUNDING) * (schedule.stops - schedule.starts)[:, None], axis=1)
    if not late.any():
        return []
    return [
        f"at {int(late.sum())} of {len(late)} times a path is observed after a gap: the increment since the last observation of "
        "that coordinate acts as one factor at its end, which is exact only as the gaps shrink, and omits the noise that it "
        "shares with other coordinates observed in between"
    ]
