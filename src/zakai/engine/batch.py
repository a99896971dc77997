"""Many records: each is filtered by the loop for one record, on the threads of the machine."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from threading import Event, Lock, Thread
from typing import Any

from zakai._progress import FIRST, bar
from zakai.engine.loop import Run
from zakai.numerics.compiled import working_time

LONG = 10.0  # seconds of work that are announced
EARLY, FEW = 1.5, 4  # seconds, and observations, after which work that takes twice as long is announced already
OFF = 3.0  # times the announced seconds after which the rest is announced again
SURE = 0.5  # seconds after which the rest can be estimated

_LOG = logging.getLogger("zakai")
Progress = Callable[[int, int], None]


def filter_all(runs: Sequence[Run], progress: Progress | None, blocks: float = 1.0) -> None:
    """Run every run to its end; results do not depend on the order or the number of threads.

    Args:
        runs: what is to be run.
        progress: called with the number of observations done and their total; without it long work has a bar on a terminal.
        blocks: how many runs share an observation.
    """
    with bar("filtering") if progress is None else nullcontext(progress) as advance:
        _watched(runs, lambda run, watch: run.all(watch.report, watch.step), advance, blocks, os.cpu_count() or 1)


def smooth_all(runs: Sequence[Any]) -> None:
    """Smooth every run that has filtered its record, one after the other."""
    _watched(runs, lambda run, watch: run.smooth(watch.report, watch.step), None, len(runs), 1)


def _watched(
    runs: Sequence[Any], work: Callable[[Any, _Watch], None], progress: Progress | None, blocks: float, most_threads: int
) -> None:
    """Do the work of all runs on threads, and announce it where it takes long."""
    threads = min(most_threads, len(runs))
    watch = _Watch(sum(len(run.schedule) for run in runs), threads, progress, blocks)
    finished = Event()
    Thread(target=watch.report_early, args=(runs[:1], finished), daemon=True).start()
    try:
        if threads == 1:
            for run in runs:
                work(run, watch)
            return
        with ThreadPoolExecutor(threads) as pool:
            for one in [pool.submit(work, run, watch) for run in runs]:
                one.result()
    finally:
        finished.set()


class _Watch:
    """How much of all runs is done, and whether the rest takes long.

    The estimates decide what is logged and nothing else. `done` are the observations of finished segments, `steps` the others.
    """

    def __init__(self, total: int, threads: int, progress: Progress | None, blocks: float):
        self.total, self.progress, self.blocks = total, progress, blocks
        self.lock = Lock()
        self.done = self.counted = self.steps = 0
        self.began, self.waiting = 0.0, threads
        self.first = 0.0  # when the first observation was done, by the clock of `report_early`
        self.slow = 0  # successive measurements by which the rest takes long
        self.late = float("inf")  # when the rest has taken so much longer than was announced that it is announced again

    def step(self, run: Run) -> None:
        """Add one observation within a segment that a run has begun."""
        with self.lock:
            run.steps += 1
            self.steps += 1

    def report_early(self, runs: Sequence[Run], finished: Event) -> None:
        """Log after `FIRST` seconds how long runs take at least or about, if it is long and they were not announced before."""
        began = working_time()
        while runs and working_time() - began < FIRST:
            if self.done + self.steps > 0 and not self.first:
                self.first = working_time()
            if working_time() - began > EARLY and self.done + self.steps > FEW:
                self._announce(runs[0], began, 2.0 * LONG, finished)
            if self.slow == 2 or finished.wait(0.1):
                return
        if runs:
            self._announce(runs[0], began, LONG, finished)

    def _announce(self, run: Run, began: float, long: float, finished: Event) -> None:
        """Log that runs take longer than `long` seconds, if they seem to."""
        with self.lock:
            if self.slow == 2 or finished.is_set():
                return
            name, shorter, now = run.setting.method.name, run.setting.method.shorter, working_time()
            count = self.done + self.steps
            if count == 0:
                _LOG.warning("%s: the first observation takes more than %.0f s; to shorten it, %s", name, FIRST, shorter)
                return
            # The first observation waits for what is prepared.
            rate = (now - (self.first or began)) / max(count - 1, 1)
            left, more = rate * (self.total - count), round((self.total - count) / self.blocks)
            if now - began + left > long:
                self.slow, self.late = 2, now + OFF * left
                about = "about" if count > 1 else "at least about"
                _LOG.warning("%s: %d more observations take %s %.0f s; to shorten it, %s", name, more, about, left, shorter)

    def report(self, run: Run, count: int) -> None:
        """Add intervals that a run has done; log once that the rest takes long, with what shortens it."""
        with self.lock:
            self.done, self.steps, run.steps = self.done + count, self.steps - run.steps, 0
            done, total = round(self.done / self.blocks), round(self.total / self.blocks)
            if self.progress is not None:
                self.progress(min(done, total), total)
            now = working_time()
            if self.slow == 2 and now > self.late:
                self.slow, self.began, self.counted = 0, now, self.done
            if self.waiting:  # the first interval of a thread waits for what it prepares: it says nothing of the others
                self.began, self.counted, self.waiting = now, self.done, self.waiting - 1
            spent = now - self.began
            if spent <= SURE or self.slow == 2:
                return
            left = spent / (self.done - self.counted) * (self.total - self.done)
            # Two successive measurements: other grids may be prepared during the first.
            self.began, self.counted, self.slow = now, self.done, self.slow + 1 if left > LONG else 0
            if self.slow == 2:
                self.late = now + OFF * left
                name, shorter = run.setting.method.name, run.setting.method.shorter
                _LOG.warning("%s: %d more observations take about %.0f s; to shorten it, %s", name, total - done, left, shorter)
