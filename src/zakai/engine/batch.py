"""Many records: each is filtered by the loop for one record, on the threads of the machine."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

from zakai.engine.loop import Progress, Run


def filter_all(runs: Sequence[Run], progress: Progress | None, blocks: float = 1.0) -> None:
    """Run every run to its end; results do not depend on the order or the number of threads.

    Args:
        runs: what is to be run.
        progress: called with the number of observations done and their total.
        blocks: how many runs share an observation.
    """
    total, done, lock = sum(len(run.schedule) for run in runs), 0, Lock()

    def one(run: Run) -> None:
        last = 0

        def advance(now: int, _: int) -> None:
            nonlocal done, last
            with lock:
                done += now - last
                last = now
                if progress is not None:
                    progress(min(round(done / blocks), round(total / blocks)), round(total / blocks))

        run.all(advance)

    if len(runs) == 1:
        return one(runs[0])
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for finished in [pool.submit(one, run) for run in runs]:
            finished.result()
