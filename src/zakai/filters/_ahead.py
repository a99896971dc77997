"""What a live filter knows of the intervals before their readings come.

Where nothing depends on time an interval is known by its length, and prepared once; lengths that never repeat are cheap for
methods that have `lasting`.  Where something does, intervals are prepared
many at once as soon as their steps repeat, and one by one where they do not.  What is prepared depends on nothing but its key, so
that a filter that is started again from a checkpoint finds the same numbers.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any, NamedTuple

import jax
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.errors import InputError
from zakai.filters._compiled_step import Layout, packed, packed_rows
from zakai.filters._run import Setting
from zakai.filters.observations import Data
from zakai.models.checks import check_noise_at, check_noise_within

CHUNK = 2048  # intervals that are prepared at once, at most
CHUNK_BYTES = 64 * 2**20  # what is prepared for them, at most
KEPT = 64  # prepared intervals of different lengths or gaps, and
KEPT_BYTES = 64 * 2**20  # what they take, at most


class Key(NamedTuple):
    """Some intervals, each beginning where the last one ends: which coordinates are read, over what time each if not over just
    the interval."""

    start: float
    step: float
    number: int
    seen: tuple[bool, ...]
    elapsed: tuple[float, ...] | None = None

    @property
    def edges(self) -> np.ndarray:
        """Where they begin and end (number + 1,)."""
        return self.start + self.step * np.arange(self.number + 1)


class Block(NamedTuple):
    """What was prepared for the intervals of a key: for each a row, which `layout` describes behind room for a reading (m,)."""

    key: Key
    prepared: Any
    rows: np.ndarray
    layout: Layout
    notes: tuple[str, ...]


class Clock(NamedTuple):
    """How regularly readings came: `steps` equal ones since the time `since`; and the key of what was prepared for them.  With no
    steps they came as the key says, from its start on."""

    since: float
    steps: int
    seen: tuple[bool, ...]
    ahead: Key | None
    begun: bool


class Given(NamedTuple):
    """A rule that gives an observation that was made for just one reading."""

    observation: Any

    def __call__(self, values: Any) -> Any:
        return self.observation


def _slack(time: float, step: float) -> float:
    """By how much times that are the same may differ through rounding."""
    return 1e-9 * step + 4 * math.ulp(time)


def _close(time: float, expected: float, step: float) -> bool:
    """Whether two times are the same but for rounding."""
    return abs(time - expected) <= _slack(time, step)


class Ahead:
    """The intervals of one setting."""

    def __init__(self, setting: Setting):
        self.setting, self.ruled = setting, setting.method.rule is not None
        model = setting.model
        matrices = (model.drift, model.diffusion, model.process_noise, model.observation, model.observation_noise)
        self.varying = any(matrix.has(model.t) for matrix in matrices)
        self.noise_varies = any(matrix.has(model.t) for matrix in (matrices[1], matrices[2], matrices[4]))
        self.kept: OrderedDict[Key, Block] = OrderedDict()
        self.bytes = 0
        self.chunk: Block | None = None

    def at(
        self,
        clock: Clock,
        start: float,
        stop: float,
        values: Any,
        seen: tuple[bool, ...],
        elapsed: tuple[float, ...] | None,
    ) -> tuple[Block, int, Clock]:
        """The block and the row of an interval, and the clock after it."""
        if not self.ruled:
            return self._made(Key(start, stop - start, 1, seen, elapsed), (start, stop), values), 0, clock
        if not self.varying:
            # Lengths that differ by rounding alone are one.
            last = clock.ahead
            same = last is not None and last.seen == seen and last.elapsed == elapsed
            if last is None or not same or not _close(stop, start + last.step, last.step):
                last = Key(0.0, stop - start, 1, seen, elapsed)
                clock = clock._replace(ahead=last)
            chunk = self.chunk
            return chunk if chunk is not None and chunk.key is last else self._remembered(last), 0, clock
        since, steps, before, ahead, begun = clock
        if elapsed is None:
            row = self._row(ahead, start, stop, seen)
            if row is not None and ahead is not None:
                return self._ahead(ahead), row, clock if steps == 0 else Clock(ahead.start, 0, seen, ahead, True)
        if steps == 0 and ahead is not None:
            steps = round((start - since) / ahead.step)
        step = (start - since) / steps if steps else stop - start
        repeats = bool(steps) and seen == before and _close(stop, start + step, step)
        since, steps = (since, steps + 1) if repeats else (start, 1)
        # Of the first interval it is supposed that others like it follow.
        if elapsed is None and (repeats or not begun):
            ahead = self._many(Key(start, (stop - since) / steps, CHUNK, seen))
            return self._ahead(ahead), 0, Clock(ahead.start, 0, seen, ahead, True)
        return self._made(Key(start, stop - start, 1, seen, elapsed), (start, stop)), 0, Clock(since, steps, seen, ahead, True)

    def again(self, key: Key, ends: tuple[float, float]) -> Block:
        """The block of a key once more, for an interval with these ends."""
        if not self.varying:
            return self._remembered(key)
        return self._ahead(key) if key.number > 1 else self._made(key, ends)

    def row(self, key: Key, ends: tuple[float, float]) -> int | None:
        """The row in the block of a key of the interval with these ends; None where it is none of them."""
        if self.varying:
            return self._row(key, *ends, key.seen)
        return 0 if _close(ends[1], ends[0] + key.step, key.step) else None

    def _row(self, key: Key | None, start: float, stop: float, seen: tuple[bool, ...]) -> int | None:
        if key is None or key.seen != seen:
            return None
        row = round((start - key.start) / key.step)
        if not 0 <= row < key.number:
            return None
        slack = _slack(stop, key.step)
        first, last = key.start + row * key.step, key.start + (row + 1) * key.step
        return row if abs(start - first) <= slack and abs(stop - last) <= slack else None

    def _many(self, key: Key) -> Key:
        """The same key with as many intervals as can be prepared ahead: some time the coefficients may end to exist."""
        size = self._made(key._replace(number=1)).rows.nbytes
        key = key._replace(number=max(1, min(key.number, CHUNK_BYTES // max(size, 1))))
        while True:
            try:
                self.chunk = self._made(key)
                return key
            except InputError:
                if key.number == 1:
                    raise
                key = key._replace(number=max(1, key.number // 8))

    def _ahead(self, key: Key) -> Block:
        if self.chunk is None or (self.chunk.key is not key and self.chunk.key != key):
            self.chunk = self._made(key)
        return self.chunk

    def _remembered(self, key: Key) -> Block:
        block = self.kept.get(key)
        if block is None:
            block = self.kept[key] = self._shortened(key)
            self.bytes += block.rows.nbytes
            while len(self.kept) > KEPT or (len(self.kept) > 1 and self.bytes > KEPT_BYTES):
                self.bytes -= self.kept.popitem(last=False)[1].rows.nbytes
        else:
            self.kept.move_to_end(key)
        self.chunk = block
        return block

    def _shortened(self, key: Key) -> Block:
        """The block of a length, out of that of the next power of two: all lengths up to it have as many parts and steps."""
        lasting = self.setting.method.lasting
        share, exponent = math.frexp(key.step)
        # What is read over another time than the interval would be longer or shorter with it.
        if lasting is None or key.elapsed is not None or share == 0.5:
            return self._made(key)
        like = self._remembered(key._replace(step=math.ldexp(1.0, exponent)))
        interval, rule = like.layout.unpacked(like.rows[0, self.setting.model.m :])
        row = packed(lasting(like.prepared, interval, rule, key.step))
        return like._replace(key=key, rows=np.append(np.zeros(self.setting.model.m), row)[None])

    def _made(self, key: Key, ends: tuple[float, float] | None = None, values: Any = None) -> Block:
        """What is prepared for a key, with the very ends of a single interval where they matter."""
        method, model = self.setting.method, self.setting.model
        edges = key.edges if ends is None else np.array(ends)
        data = data_at(model.observation_kind, edges, key.seen, key.elapsed, values)
        if self.noise_varies:
            check_noise_at(model, edges)
            check_noise_within(model, edges)
        prepared = self.setting.prepared(data)
        rule = Given(method.observations(prepared, data)) if method.rule is None else method.rule(prepared, data)
        tree = (prepared.intervals, rule)
        layout = Layout.of_rows(jax.tree.map(np.asarray, tree))
        return Block(key, prepared, packed_rows(tree, key.number, model.m), layout, tuple(getattr(prepared, "notes", ())))


def data_at(
    kind: str, edges: np.ndarray, seen: tuple[bool, ...], elapsed: tuple[float, ...] | None, values: Any = None
) -> Data:
    """Readings at the ends of intervals of the coordinates that are `seen`; zero where no `values` (m,) are given."""
    starts, stops, shape = edges[:-1], edges[1:], (len(edges) - 1, len(seen))
    read = np.where(seen, np.zeros(len(seen)) if values is None else values, np.nan)
    spans = np.broadcast_to((stops - starts)[:, None] if elapsed is None else np.array(elapsed), shape)
    spans = np.zeros(shape) if kind == "samples" else np.where(seen, spans, np.nan)
    return Data(starts, stops, np.broadcast_to(read, shape), spans)
