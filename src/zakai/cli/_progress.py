"""The progress of a command: a bar on a terminal, and a place where an interruption is noticed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from zakai._progress import bar
from zakai.cli import _interrupt


@contextmanager
def progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function of (done, total) to call at every step of long work; on a terminal it draws on stderr."""
    with bar(what, patience=0.0) as draw:

        def advance(done: int, total: int) -> None:
            _interrupt.check()
            if draw is not None:
                draw(done, total)

        yield advance
