"""Linear algebra on one thread while the package computes.

The matrices of a filter are so small that threads of BLAS wait for each other more than they work, and the records of a batch
have threads of their own.  The number of threads also decides the last bits of a product: an online filter has those of a record.
"""

from __future__ import annotations

import importlib
import threading
from contextlib import ContextDecorator
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> list[Any]:
    """Return the libraries of linear algebra, those of NumPy and SciPy."""
    importlib.import_module("scipy.linalg")  # which loads them
    return list(ThreadpoolController().select(user_api="blas").lib_controllers)


class _OneThread(ContextDecorator):
    """A context in which BLAS has one thread; the last of all threads that leaves it restores the numbers before."""

    def __init__(self) -> None:
        self.lock, self.inside = threading.Lock(), 0
        self.before: list[tuple[Any, int]] = []

    def __enter__(self) -> None:
        with self.lock:
            self.inside += 1
            if self.inside == 1:
                self.before = [(library, number) for library in _libraries() if (number := library.get_num_threads()) != 1]
                for library, _ in self.before:
                    library.set_num_threads(1)

    def __exit__(self, *error: object) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0:
                for library, number in self.before:
                    library.set_num_threads(number)


one_thread = _OneThread()
