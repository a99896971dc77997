"""Many records: each is filtered by the loop for one record, on the threads of the machine."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from threading import Event, Lock, Thread
from typing import Any

from zakai import _registry
from zakai._progress import FIRST, Progress, bar, within_announced
from zakai.algebra.choice import faster
from zakai.engine.loop import Run
from zakai.notes.model import notes_on_start
from zakai.numerics.compiled import working_time

LONG = 10.0  # seconds of work that are announced
EARLY, FEW = 1.5, 4  # seconds, and observations, after which work that takes twice as long is announced already
OFF = 3.0  # times the announced seconds after which the rest is announced again
MINUTE = 60.0  # seconds from which a method that is expected to be faster is named
WATCHED = 1.0  # seconds between checks whether a run takes longer than was announced
SURE = 0.5  # seconds after which the rest can be estimated
AS_THIS = "take, if each is as long as the present one,"  # which has not ended

_LOG = logging.getLogger("zakai")


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
    if within_announced():
        watch.slow = 2
    else:
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


def _advice(run: Run, each: float, left: float) -> str:
    """Return what shortens a run of which an observation takes `each` seconds and the rest `left`; a forgotten start does."""
    forgotten = notes_on_start(run.schedule)
    if forgotten:
        return forgotten[0]
    method, model = run.setting.method, run.setting.model
    other = faster(model, method.name, each) if left > MINUTE else None
    if other is None or other in method.shorter:
        return f"to shorten it, {method.shorter}"
    errors = ", with random errors" if _registry.load(other).random and not method.random else ""
    return f"to shorten it, {method.shorter}, or take {other}, which holds too and is expected to be faster{errors}"


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
        self.seen = 0.0, 0  # when the last observation was seen to be done within a segment, and how many were

    def step(self, run: Run) -> None:
        """Add one observation within a segment that a run has begun."""
        with self.lock:
            run.steps += 1
            self.steps += 1

    def report_early(self, runs: Sequence[Run], finished: Event) -> None:
        """Log after `FIRST` seconds how long runs take, if it is long and they were not announced before; and again if longer."""
        began = working_time()
        while runs and working_time() - began < FIRST:
            if self.done + self.steps > 0 and not self.first:
                self.first = working_time()
            if working_time() - began > EARLY and self.done + self.steps > FEW:
                self._announce(runs[0], began, 2.0 * LONG, finished)
            if finished.wait(0.1):
                return
            if self.slow == 2:
                break
        if runs:
            self._announce(runs[0], began, LONG, finished)
        self.seen = working_time(), self.done + self.steps
        while runs and not finished.wait(WATCHED):
            self._announce_again(runs[0])

    def _announce_again(self, run: Run) -> None:
        """Log that the observations within a segment take longer than was announced, if they do."""
        with self.lock:
            now, count, (since, before) = working_time(), self.done + self.steps, self.seen
            spent, left = now - since, self.total - count
            if left <= 0 or spent <= LONG or (self.slow == 2 and now <= self.late):
                self.seen = (now, count) if self.slow < 2 and count > before else self.seen
                return
            if count == before and run.setting.method.segment is not None:
                return  # how many of a compiled segment are done is not known
            rate = spent / max(count - before, 1)
            self.slow, self.seen, self.late = 2, (now, count), now + max(OFF * rate * left, OFF * spent)
            take, name = "take about" if count > before else AS_THIS, run.setting.method.name
            advice = _advice(run, rate, rate * left)
            _LOG.warning("%s: %d more observations %s %.0f s; %s", name, round(left / self.blocks), take, rate * left, advice)

    def _announce(self, run: Run, began: float, long: float, finished: Event) -> None:
        """Log that runs take longer than `long` seconds, if they seem to."""
        with self.lock:
            if self.slow == 2 or finished.is_set():
                return
            name, now = run.setting.method.name, working_time()
            count = self.done + self.steps
            if count == 0:
                advice = _advice(run, FIRST, FIRST * self.total)
                of_all = f"the first of {self.total / self.blocks:.0f} observations takes more than {FIRST:.0f} s"
                _LOG.warning("%s: %s; %s", name, of_all, advice)
                return
            # The first observation waits for what is prepared.
            rate = (now - (self.first or began)) / max(count - 1, 1)
            left, more = rate * (self.total - count), round((self.total - count) / self.blocks)
            if now - began + left > long:
                self.slow, self.late = 2, now + OFF * left
                take = "take about" if count > 1 else AS_THIS
                _LOG.warning("%s: %d more observations %s %.0f s; %s", name, more, take, left, _advice(run, rate, left))

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
                name, advice = run.setting.method.name, _advice(run, left / max(self.total - self.done, 1), left)
                _LOG.warning("%s: %d more observations take about %.0f s; %s", name, total - done, left, advice)
