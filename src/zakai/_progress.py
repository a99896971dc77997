"""A progress bar for long work, on a terminal or in a notebook, and a line in the log elsewhere."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from importlib.util import find_spec
from threading import Lock, Timer
from typing import Any, TypeVar

T = TypeVar("T")

PATIENCE = 1.0  # seconds of work before a bar appears
FIRST = 5.0  # seconds after which long work is announced

Advance = Callable[[int, int | None], None]
Progress = Callable[[int, int], None]
_LOG = logging.getLogger("zakai")
_WITHIN: ContextVar[bool] = ContextVar("within", default=False)
_LOCK = Lock()  # one bar at a time: work inside of other work has none of its own


def shown() -> bool:
    """Return whether a bar can be drawn: standard error is a terminal, or this is a notebook that can show it."""
    if "ipykernel" in sys.modules:
        return find_spec("ipywidgets") is not None
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def announced(what: str) -> Iterator[Callable[[float, float, float], None]]:
    """Log that work takes more than `FIRST` seconds, if the rest does, too, and how long that takes, as soon as it is known.

    Yields a function of the parts of the work that are done, and of the fewest and the most that there usually are in all; the
    rest is estimated from the time between its calls.
    """
    work, before = _Announced(what), _WITHIN.set(True)
    try:
        yield work.advance
    finally:
        _WITHIN.reset(before)
        work.end()


def within_announced() -> bool:
    """Return whether this work is a part of other work that is announced as a whole."""
    return _WITHIN.get()


def _clock() -> float:
    """Return a time in seconds that does not count the compilation of kernels, where that is imported."""
    compiled = sys.modules.get("zakai.numerics.compiled")
    return float(getattr(compiled, "working_time", time.monotonic)())


class _Announced:
    def __init__(self, what: str):
        self.what, self.known, self.lock, self.said, self.ended = what, "", Lock(), False, False
        self.began, self.first, self.most = _clock(), (0.0, 0.0), math.inf
        self._wait(FIRST)

    def _wait(self, seconds: float) -> None:
        self.timer = Timer(seconds, self._announce)
        self.timer.daemon = True
        self.timer.start()

    def end(self) -> None:
        with self.lock:
            self.ended = True
            self.timer.cancel()

    def _announce(self) -> None:
        with self.lock:
            rest = FIRST - (_clock() - self.began)  # kernels were compiled meanwhile
            if self.ended:
                return
            if rest > 0.01:
                self._wait(rest)
            elif self.most > FIRST:
                self.said = bool(self.known)
                _LOG.warning("%s takes %s", self.what, self.known or f"more than {FIRST:.0f} s")

    def advance(self, done: float, fewest: float, most: float) -> None:
        """Note how much is done; log how long the rest takes, where only the beginning was announced."""
        now = _clock()
        if not self.first[1]:
            self.first = now, done
        # The first part waits for what is prepared and compiled.
        alone = done <= self.first[1]
        rate = (now - self.began) / done if alone else (now - self.first[0]) / (done - self.first[1])
        about = "at most about" if alone else "about"
        low, high = (rate * max(count - done, 0) for count in (fewest, most))
        with self.lock:
            self.most = high
            self.known = f"{about} {high:.0f} s more" if fewest == most else f"{about} {low:.0f} to {high:.0f} s more"
            if now - self.began > FIRST and not self.said and high > FIRST and not alone:
                self.said = True
                _LOG.warning("%s takes %s", self.what, self.known)


@contextmanager
def bar(what: str, patience: float = PATIENCE) -> Iterator[Advance | None]:
    """Yield a function of (done, total) to call at every step, which draws a bar; None where nothing is drawn.

    The bar appears in the middle of a long step, too.

    Args:
        what: the words before the bar.
        patience: seconds of work before the bar appears; total is None where it is not known.
    """
    if not shown() or not _LOCK.acquire(blocking=False):
        yield None
        return
    drawn = _Bar(what, patience)
    try:
        yield drawn.advance
    finally:
        drawn.close()
        _LOCK.release()


@contextmanager
def counting(what: str, total: int, progress: Progress | None) -> Iterator[Callable[[Iterable[T]], Iterator[T]]]:
    """Yield a function that passes the items of an iterable on and counts them, in all iterables that it is given.

    Args:
        what: the words before the bar, and of the announcement where it takes long.
        total: the number of all items.
        progress: called with the number of items done and `total`; without it long work has a bar on a terminal.
    """
    with bar(what) if progress is None else nullcontext(progress) as advance, announced(what) as announce:
        done = 0

        def counted(items: Iterable[T]) -> Iterator[T]:
            nonlocal done
            for item in items:
                yield item
                done += 1
                announce(done, total, total)
                if advance is not None:
                    advance(done, total)

        yield counted


class _Bar:
    def __init__(self, what: str, patience: float):
        self.what, self.begins = what, time.monotonic() + patience
        self.latest: tuple[int, int | None] | None = None
        self.display: Any = None
        self.task: Any = None
        self.lock, self.timer = Lock(), Timer(patience, self._draw)
        self.timer.daemon = True
        self.timer.start()

    def advance(self, done: int, total: int | None) -> None:
        """Draw how much is done; nothing before its time, or if all is done by then."""
        self.latest = done, total
        self._draw()

    def _draw(self) -> None:
        with self.lock:
            if self.latest is None:
                return
            done, total = self.latest
            if self.display is None:
                if time.monotonic() < self.begins or done == total:
                    return
                self._open(total)
            self.display.update(self.task, completed=done, total=total)

    def _open(self, total: int | None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        last = TimeElapsedColumn() if total is None else TimeRemainingColumn()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), last)
        self.display = Progress(*columns, console=Console(stderr=True), transient=True)
        self.task = self.display.add_task(self.what, total=total)
        self.display.start()

    def close(self) -> None:
        """Remove the bar."""
        self.timer.cancel()
        with self.lock:
            self.latest = None
            if self.display is not None:
                self.display.stop()
