"""Who runs the batches: this process, some processes beside it, or a Dask cluster.  The numbers are the same."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from importlib import import_module
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Any

import xarray

from zakai.errors import InputError
from zakai.studies._batch import run_batch
from zakai.studies.specification import Job, Study

MOST_DEATHS = 3  # of the workers of one batch, after which it is the batch's fault
_ANSWER = "10s"  # how long a scheduler may take to answer
_PATIENCE = 0.3  # seconds between checks whether the user has interrupted

Finished = Iterator[tuple[int, xarray.Dataset]]
Advance = Callable[[float], None]  # called with the number of batches that are done, parts of one included


def here(study: Study, indices: list[int], advance: Advance) -> Finished:
    """One batch after the other in this process."""
    for done, index in enumerate(indices):
        yield index, run_batch(study.job(index), lambda share, done=done: advance(done + share))  # type: ignore[misc]
        advance(done + 1)


class _Worker:
    """A process that runs one batch after the other."""

    def __init__(self) -> None:
        # A copy of a process with threads, as fork makes it, may hang.
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(other,), daemon=True)
        self.process.start()
        other.close()
        self.index: int | None = None

    def give(self, study: Study, index: int) -> None:
        self.index = index
        self.connection.send(study.job(index))

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


def _serve(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the process that gives the work
    Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            job: Job = connection.recv()
        except EOFError:
            return
        try:
            answer: Any = run_batch(job)
        except Exception as error:
            answer = error if isinstance(error, InputError) else RuntimeError(f"{type(error).__name__}: {error}")
        connection.send(answer)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def in_processes(study: Study, indices: list[int], count: int, advance: Advance) -> Finished:
    """`count` processes; a batch whose process dies is given to another."""
    todo, deaths, done = list(reversed(indices)), dict.fromkeys(indices, 0), 0
    workers = [_Worker() for _ in range(min(count, len(indices)))]
    try:
        while done < len(indices):
            for worker in workers:
                if worker.index is None and todo:
                    worker.give(study, todo.pop())
            busy = {worker.connection: worker for worker in workers if worker.index is not None}
            for ready in wait(list(busy), timeout=_PATIENCE):
                worker = busy[ready]  # type: ignore[index]
                index, worker.index = worker.index, None
                assert index is not None
                try:
                    answer = worker.connection.recv()
                except (EOFError, OSError):
                    deaths[index] += 1
                    if deaths[index] >= MOST_DEATHS:
                        raise InputError(_given_up(index)) from None
                    worker.stop()
                    workers[workers.index(worker)] = _Worker()
                    todo.append(index)
                    continue
                if isinstance(answer, Exception):
                    raise answer
                yield index, answer
                done += 1
            advance(done)
    finally:
        for worker in workers:
            worker.stop()


def _given_up(index: int) -> str:
    return (
        f"batch {index}: {MOST_DEATHS} workers died of it, perhaps for want of memory; what was done is kept: "
        "start again with more memory, fewer processes or a smaller batch"
    )


def on_cluster(study: Study, indices: list[int], address: str, advance: Advance) -> Finished:
    """The workers of a Dask scheduler; a batch whose worker dies is given to another by the scheduler."""
    try:
        distributed = import_module("distributed")
    except ImportError as error:
        raise InputError('--scheduler: distributed is not installed: pip install "zakai[dask]"') from error
    try:
        client = distributed.Client(address, timeout=_ANSWER, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        said = " ".join(str(error).split())[:120]
        raise InputError(f"--scheduler {address}: no scheduler answers ({said}); start one with `dask scheduler`") from None
    try:
        futures = {client.submit(run_batch, study.job(index), pure=False, retries=MOST_DEATHS): index for index in indices}
        for done, future in enumerate(distributed.as_completed(list(futures), loop=client.loop), 1):
            yield futures[future], _result(future, futures[future], address)
            del futures[future]
            advance(done)
    finally:
        client.close(timeout=5)


def _result(future: Any, index: int, address: str) -> Any:
    try:
        return future.result()
    except CancelledError:
        raise InputError(f"--scheduler {address}: the scheduler is gone; what was done is kept: start again") from None
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            raise InputError(_given_up(index)) from None
        raise
