"""Many records: each is filtered by the loop for one record, on the threads of the machine."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

from zakai.engine.loop import Run

LONG = 10.0  # seconds of work that are announced
SURE = 1.0  # seconds after which the rest can be estimated

_LOG = logging.getLogger("zakai")
Progress = Callable[[int, int], None]


def filter_all(runs: Sequence[Run], progress: Progress | None, blocks: float = 1.0) -> None:
    """Run every run to its end; results do not depend on the order or the number of threads.

    Args:
        runs: what is to be run.
        progress: called with the number of observations done and their total.
        blocks: how many runs share an observation.
    """
    threads = min(os.cpu_count() or 1, len(runs))
    watch = _Watch(sum(len(run.schedule) for run in runs), threads, progress, blocks)
    if threads == 1:
        for run in runs:
            run.all(watch.report)
        return
    with ThreadPoolExecutor(threads) as pool:
        for finished in [pool.submit(run.all, watch.report) for run in runs]:
            finished.result()


class _Watch:
    """How much of all runs is done, and whether the rest takes long."""

    def __init__(self, total: int, threads: int, progress: Progress | None, blocks: float):
        self.total, self.progress, self.blocks = total, progress, blocks
        self.lock = Lock()
        self.done = self.counted = 0
        self.began, self.waiting = 0.0, threads
        self.announced = False

    def report(self, run: Run, count: int) -> None:
        """Add intervals that a run has done; say once that the rest takes long, and what would shorten it."""
        with self.lock:
            self.done += count
            done, total = round(self.done / self.blocks), round(self.total / self.blocks)
            if self.progress is not None:
                self.progress(min(done, total), total)
            now = time.monotonic()
            if self.waiting:  # the first interval of a thread waits for what it compiles: it says nothing of the others
                self.began, self.counted, self.waiting = now, self.done, self.waiting - 1
            spent = now - self.began
            if self.announced or spent <= SURE:
                return
            self.announced = True
            left = spent / (self.done - self.counted) * (self.total - self.done)
            if left > LONG:
                name, shorter = run.setting.method.name, run.setting.method.shorter
                _LOG.warning("%s: %d more observations take about %.0f s; to shorten it, %s", name, total - done, left, shorter)
