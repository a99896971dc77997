"""Draws of whole paths of the state given all observations, from the last time to the first.

    x_K ~ p(x_K | y_1..y_K),      x_k ~ p(x_k | x_(k+1), y_1..y_(k+1)),      k = K - 1, ..., 0

This is the joint law: given x_(k+1), the state before it does not depend on later observations.

References:
    Godsill, Doucet and West 2004, Monte Carlo smoothing for nonlinear time series.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai._progress import bar
from zakai.engine.loop import advance
from zakai.errors import InputError
from zakai.methods._protocol import Prepared, State
from zakai.records.schedule import Schedule

if TYPE_CHECKING:
    from zakai.engine.smoother import SmoothingRun

_LOG = logging.getLogger("zakai")
LARGEST_BYTES = 16 * 2**30  # of paths that are returned together
NORMAL = 0.25  # skewness and kurtosis of a conditional law up to which its expansion is accurate
MOST_PARTS = 256  # of an interval


def sample_paths(runs: Sequence[SmoothingRun], places: Sequence[Sequence[int]], n: int, count: Any, seed: Any) -> np.ndarray:
    """Return draws (count, K+1, n) of the joint law of the states of independent runs, whose states have these places.

    Raises:
        InputError: a wrong count, more paths than the memory holds, or a method that does not draw paths.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"sample_paths: count is {count!r}; expected a whole number of at least 1")
    size, times = 8.0 * count * n, len(runs[0].schedule) + 1
    if size * times > LARGEST_BYTES:
        raise InputError(
            f"sample_paths: {count} paths of {n} states at {times} times take {size * times / 2**30:.3g} GiB; draw at most "
            f"{max(1, int(LARGEST_BYTES / (8.0 * n * times)))} paths at once"
        )
    for run in runs:
        if run.backward.draw is None and run.backward.paths is None:
            raise InputError(
                f"sample_paths: the method {run.setting.method.name} does not draw paths; take yau-yau for up to four "
                "states, or kalman-bucy, benes, hu-yau or general-direct, where one holds"
            )
    found = np.empty((count, times, n))
    generators = np.random.default_rng(seed).spawn(len(runs))
    with bar("sampling paths") as advance_bar:
        total, done = len(runs) * (times - 1), 0
        for run, place, rng in zip(runs, places, generators, strict=True):
            for index, states in _Paths(run, int(count), rng):
                found[:, index, list(place)] = states
                done += index < times - 1
                if advance_bar is not None:
                    advance_bar(done, total)
    return found


class _Paths:
    """The draws of one run, from its last time to its first: an iterator of indices and states (count, n)."""

    def __init__(self, run: SmoothingRun, count: int, rng: np.random.Generator):
        self.run, self.count, self.rng = run, count, rng
        self.parts = 1  # into which the next interval is divided
        self.inaccurate = 0  # intervals whose laws are not near to normal in the smallest parts

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        return self._by_messages() if self.run.backward.paths is not None else self._by_draws()

    def _by_messages(self) -> Iterator[tuple[int, np.ndarray]]:
        run = self.run
        assert run.backward.paths is not None
        message = run.backward.paths(run.empty, run.state, self.count, int(self.rng.integers(1, 2**32)))
        yield len(run.schedule), message.draws.T
        for number in reversed(range(len(run.segments))):
            rows, prepared, begin, states = run._segment(number)
            for k in reversed(rows):
                message = run.backward.step(prepared, k - begin, message, run.values[k], states[k - rows.start])
                yield k, message.draws.T

    def _by_draws(self) -> Iterator[tuple[int, np.ndarray]]:
        run = self.run
        paths = run.setting.method.density(run.empty, run.state).sample(self.rng, self.count)
        yield len(run.schedule), paths
        for number in reversed(range(len(run.segments))):
            rows, prepared, begin, states = run._segment(number)
            for k in reversed(rows):
                paths = self._before(prepared, k - begin, k, paths, states[k - rows.start])
                yield k, paths
        if self.inaccurate:
            _LOG.warning(
                "sample_paths: the law of the state given the next one is not near to normal in %d of %d intervals: the paths "
                "are inaccurate there; give more frequent observations", self.inaccurate, len(run.schedule),
            )  # fmt: skip

    def _before(self, prepared: Prepared, number: int, k: int, later: np.ndarray, state: State) -> np.ndarray:
        """Return the draws at the start of interval k, which has this number in what is prepared."""
        draw = self.run.backward.draw
        assert draw is not None
        if self.parts == 1:
            paths, departure = draw(prepared, number, later, self.run.values[k], state, self.rng)
            if departure <= NORMAL:
                return paths
            self.parts = 2
        while True:
            paths, departure = self._in_parts(k, later, state)
            if departure <= NORMAL or self.parts >= MOST_PARTS:
                break
            self.parts *= 2
        self.inaccurate += departure > NORMAL
        if departure <= 0.5 * NORMAL:
            self.parts //= 2
        return paths

    def _in_parts(self, k: int, later: np.ndarray, state: State) -> tuple[np.ndarray, float]:
        """Return the draws at the start of interval k by equal parts of it, and the largest departure."""
        run, draw = self.run, self.run.backward.draw
        assert draw is not None
        schedule, values = _divided(run.schedule.part(slice(k, k + 1)), run.values[k], self.parts)
        prepared = run.setting.prepared(schedule)
        with np.errstate(all="ignore"):
            states, _ = advance(run.setting, prepared, slice(0, self.parts), state, values)
        paths, worst = later, 0.0
        for part, start in reversed(list(enumerate([state, *states[:-1]]))):
            paths, departure = draw(prepared, part, paths, values[part], start, self.rng)
            worst = max(worst, departure)
            if worst > NORMAL and self.parts < MOST_PARTS:
                break
        return paths, worst


def _divided(interval: Schedule, values: np.ndarray, count: int) -> tuple[Schedule, np.ndarray]:
    """Return an interval in equal parts: an increment over just the interval is divided, all else is observed at its end."""
    inside, last = interval.inside[0], np.arange(count) == count - 1
    times = np.linspace(interval.starts[0], interval.stops[0], count + 1)
    seen = np.where(inside, True, last[:, None] & interval.seen[0])
    elapsed = np.where(inside, np.diff(times)[:, None], np.where(seen, interval.elapsed[0], 0.0))
    schedule = Schedule(times[:-1], times[1:], seen, elapsed, interval.inputs)
    return schedule, np.where(inside, values / count, np.where(last[:, None], values, 0.0))
