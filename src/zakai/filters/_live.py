"""One method on its way through readings that come one by one."""

from __future__ import annotations

from struct import Struct
from typing import Any, NamedTuple

import jax
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities import Density
from zakai.errors import InputError
from zakai.filters._ahead import Ahead, Block, Clock, data_at
from zakai.filters._compiled_step import Laid, Layout, Step, Told, compiled, packed, settled
from zakai.filters._protocol import Info
from zakai.filters._run import RUN, SETTLED, TRIES, Setting

AFTER_GAP = (
    "a path is read after a gap: the increment since the last reading of that coordinate acts as one factor at its end, which is "
    "exact only as the gaps shrink"
)
STEADY = 8  # how many times longer all runs are but the first

_number = Struct("d").unpack_from


def run_of(state: Any) -> int:
    """After how many steps, taken one by one, the lattice is looked at again for the first time."""
    return min(getattr(state, "run_length", RUN), RUN)


class Moment(NamedTuple):
    """Everything that decides what a filter says next; it never changes, the next reading makes another.

    `laid` holds the state, and behind it what the step `by` told of it, where `by` is not itself what was told; of the run of
    steps since the lattice was looked at `left` are left, in `block`, whose interval now ended began and ended at `ends`.  `read`
    and `read_at` (m,) are the last values of a path and their times.  `first` are samples at the start itself: what they make of
    the prior waits for the first interval.
    """

    time: float
    laid: Laid | None
    by: Step | Told | None
    left: int
    block: Block | None
    ends: tuple[float, float]
    clock: Clock
    read: tuple[float, ...]
    read_at: tuple[float, ...]
    first: tuple[float, ...] | None
    notes: tuple[str, ...]

    @property
    def told(self) -> Told | None:
        """What was told of the state."""
        if not isinstance(self.by, Step):
            return self.by
        assert self.laid is not None
        return self.by.told(self.laid)


class Live:
    """One method, its setting and the moment that it has come to."""

    def __init__(self, setting: Setting):
        self.setting, self.ahead = setting, Ahead(setting)
        self.kind, self.m = setting.model.observation_kind, setting.model.m
        method = setting.method
        self.whole = (True,) * self.m  # what is seen where nothing is missing
        self.step: Step | None = None
        self.inputs: Layout | None = None
        self.adapts, self.path = method.adapt is not None, self.kind == "path"
        # On a CPU an array's memory can be read, in a third of the time.
        self.near = jax.default_backend() == "cpu"
        start = float(setting.model.start)
        clock = Clock(start, 0, (), None, False)
        nothing = (0.0,) * self.m
        self.now = Moment(start, None, None, 0, None, (start, start), clock, nothing, (start,) * self.m, None, ())

    def moved(self, time: float, values: list[float], look_only: bool = False) -> Moment:
        """The moment after a reading (m,), nan where there is none; this one stays as it is.

        With `look_only` nothing is prepared for what may follow.
        """
        now = self.now
        # Of what is there the sum is a number.
        total = sum(values)
        seen = self.whole if total == total else tuple([value == value for value in values])
        elapsed, read, read_at = None, now.read, now.read_at
        if self.path:
            elapsed, values, read, read_at = self._increments(time, values, seen)
        elif self.kind == "rates":
            values = [value * (time - now.time) for value in values]
        if seen is not self.whole:
            values = [value if there else 0.0 for value, there in zip(values, seen, strict=True)]
        if time == now.time:
            return self._at_start(np.array(values), seen)
        clock = now.clock._replace(begun=True) if look_only else now.clock
        block, row, clock = self.ahead.at(clock, now.time, time, values, seen, elapsed)
        laid, left = now.laid, now.left
        if laid is None or now.first is not None:
            laid, left = self._begun(block), 0
        given = block.rows[row]
        given[: self.m] = values
        own = laid
        looks = self.adapts and (left == 0 or block is not now.block)
        if looks:
            laid, left = self._looked(block, row, laid)
        elif self.adapts and left % SETTLED == 0:
            laid = self._settled(laid, block)
        after, verdict = self._step(laid, block, given)
        if self.adapts and verdict != 1.0:
            if not looks:
                laid, left = self._looked(block, row, laid)
                after, verdict = self._step(laid, block, given)
            if verdict != 1.0:
                after, verdict, left = self._tried(block, row, own.state, laid, given, (after, verdict, left))
        if verdict != verdict:
            raise InputError(
                f"{self.setting.model.source}: at t = {time:g} the reading leaves nothing of the density, or takes it "
                "beyond what numbers can hold; it is not used. Where it ends a gap of many times the system's own time, say that "
                "nothing was observed at that time, and go on from there"
            )
        ends = (now.time, time)
        left -= self.adapts
        return Moment(time, after, self.step, left, block, ends, clock, read, read_at, None, self.notes_of(block))

    def notes_of(self, block: Block) -> tuple[str, ...]:
        """What is to be said of what was read over an interval of a block."""
        return ((AFTER_GAP,) if block.key.elapsed is not None else ()) + block.notes

    def density(self, moment: Moment) -> Density:
        """The density at a moment."""
        method = self.setting.method
        if moment.laid is None or moment.block is None:
            prepared = self._stand_in().prepared
            return method.density(prepared, method.init(prepared, self.setting.prior))
        return method.density(moment.block.prepared, moment.laid.state)

    def _increments(self, time: float, values: list[float], seen: tuple[bool, ...]) -> tuple[Any, ...]:
        """What a path's readings add to the last ones, and over what time where that is not just the interval."""
        now = self.now
        increments = [value - last for value, last in zip(values, now.read, strict=True)]
        spans = tuple(time - last if there else 0.0 for last, there in zip(now.read_at, seen, strict=True))
        plain = all(last == now.time for last, there in zip(now.read_at, seen, strict=True) if there)
        read = tuple(value if there else last for value, last, there in zip(values, now.read, seen, strict=True))
        read_at = tuple(time if there else last for last, there in zip(now.read_at, seen, strict=True))
        return None if plain else spans, increments, read, read_at

    def _at_start(self, reading: np.ndarray, seen: tuple[bool, ...]) -> Moment:
        """The moment after samples at the start itself."""
        now, block = self.now, self._stand_in()
        state, info = self._corrected(block, reading, seen)
        info = jax.tree.map(np.asarray, info._replace(need=None))
        told = Told(np.append(packed(info), 1.0), 0, Layout.of(info))
        if not np.isfinite(told.vector[: 1 + len(info.mean)]).all():
            raise InputError(f"{self.setting.model.source}: the reading at the start leaves nothing of the prior; it is not used")
        first = tuple(np.where(seen, reading, np.nan).tolist())
        notes = block.notes
        ends = (now.time, now.time + 1.0)
        return now._replace(laid=Laid.of(state), by=told, block=block, ends=ends, first=first, notes=notes)

    def _corrected(self, block: Block, reading: np.ndarray, seen: tuple[bool, ...]) -> tuple[Any, Info]:
        method, start = self.setting.method, self.now.time
        data = data_at(self.kind, np.array([start, start]), seen, None, reading)
        prepared = self.setting.prepared(data) if block.prepared is None else block.prepared
        return method.correct(prepared, self.setting.prior, method.observations(prepared, data))

    def _stand_in(self) -> Block:
        """An interval after the start, where none is known yet."""
        start = float(self.setting.model.start)
        clock = self.now.clock._replace(begun=True)
        return self.ahead.at(clock, start, start + 1.0, np.zeros(self.m), (False,) * self.m, None)[0]

    def _begun(self, block: Block) -> Laid:
        """The state at the start of the first interval."""
        now, method = self.now, self.setting.method
        if now.first is None:
            state = method.init(block.prepared, self.setting.prior)
        else:
            first = np.array(now.first)
            state, _ = self._corrected(block, np.nan_to_num(first), tuple((first == first).tolist()))
        # No step may be taken before the lattice was looked at.
        return Laid.of(state) if self.adapts else self._laid(state, block)

    def _laid(self, state: Any, block: Block) -> Laid:
        return self._settled(Laid.of(state), block)

    def _settled(self, laid: Laid, block: Block) -> Laid:
        laid = settled(laid)
        return compiled(self.setting.method, laid.layout, block.layout, self.m).begun(laid)

    def _looked(self, block: Block, row: int, laid: Laid) -> tuple[Laid, int]:
        """The state on a lattice that was looked at, and how many steps may be taken on it."""
        state = laid.state
        run = run_of(state)
        rows = slice(row, min(row + STEADY * run, block.key.number))
        adapt = self.setting.method.adapt
        assert adapt is not None
        state = adapt(block.prepared, state, rows, None)
        run = run_of(state)
        # Every step tells whether it was well; a look is there to find that less would do, which is mostly so after the prior.
        begins = self.now.laid is None or self.now.first is not None
        return self._laid(state, block), run if begins else STEADY * run

    def _tried(self, block: Block, row: int, own: Any, laid: Laid, given: np.ndarray, found: Any) -> Any:
        """One step from better lattices, until it is well or nothing better can be had; health then says so.

        `own` is the state before any lattice was laid for the step.
        """
        adapt = self.setting.method.adapt
        assert adapt is not None
        for _ in range(TRIES):
            assert self.step is not None
            info = jax.tree.map(lambda a: np.asarray(a)[None], self.step.told(found[0]).info)
            begin = laid.state
            state = adapt(block.prepared, own.tried(begin) if hasattr(own, "tried") else begin, slice(row, row + 1), info)
            if state is None:
                break
            laid = self._laid(state, block)
            found = (*self._step(laid, block, given), run_of(state))
            if found[1] == 1.0:
                break
        return found

    def _step(self, laid: Laid, block: Block, given: np.ndarray) -> tuple[Laid, float]:
        """The state after a step, and the verdict on it."""
        step = self.step
        if step is None or laid.layout is not step.state or block.layout is not self.inputs:
            self.step = step = compiled(self.setting.method, laid.layout, block.layout, self.m)
            self.inputs = block.layout
        after = step.call(laid.vector, given, laid.lasting)
        verdict = _number(after, step.last)[0] if self.near else float(after[-1])
        return Laid(after, step.new, laid.lasting), verdict
