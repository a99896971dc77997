"""Particles in chunks on threads: each chunk is computed alone, so that the number of threads decides nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

T = TypeVar("T")

CHUNK = 1024  # particles that are moved together: their noise stays in the cache
_ALONE = 8192  # particles up to which threads cost more than they save


@cache
def _cores() -> int:
    return os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="zakai-particles")


def over_chunks(work: Callable[[int, int], T], count: int) -> list[T]:
    """Return what `work(low, high)` returns for parts of `count` particles, on all cores where these are many.

    The parts are multiples of `CHUNK`.
    """
    cores = _cores()
    if count <= _ALONE or cores == 1:
        return [work(0, count)]
    size = -(-count // (cores * CHUNK)) * CHUNK
    parts = [_pool().submit(work, low, min(low + size, count)) for low in range(0, count, size)]
    return [part.result() for part in parts]
