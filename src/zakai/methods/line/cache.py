"""What is derived of a model on grids: a cache with typed keys and a bound on its memory."""

from __future__ import annotations

from collections.abc import Hashable
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zakai.models.model import Model

CACHE_BYTES = 96 * 2**20  # of tables and decompositions of grids, which are stored for a model


class Derived(Enum):
    """What is derived of a model on a grid, and held in the cache."""

    __hash__ = object.__hash__  # that of an enumeration hashes the name each time

    TABLES = "f, h and G at the points of a grid"
    MODES = "the decomposition of the operator on a grid"
    MESSAGE_MODES = "the decomposition of the operator of messages on a grid"
    EXPONENTIAL = "the exponential of the operator on a grid, for one length"
    COARSE_GRIDS = "grids and their modes as the compiled loop reads them"
    PROFILE = "f, f' and G around an origin"
    TERMS = "the terms of f and h in a table that is longer than a grid"
    FINE = "an h with kinks or jumps at nodes between the points"
    HIDDEN_DRIFT = "the error of f between the points of a grid"
    PRECISION = "the inverse of S for some coordinates"
    SAMPLE_NOISE = "the inverse of S of a sample, and the constant of its density"
    KINKS = "the states between two at which coefficients have kinks"


class CacheKey(NamedTuple):
    """The key of a derived quantity: which, and of what."""

    quantity: Derived
    at: Hashable


class GridCache(dict[CacheKey, tuple[Any, int]]):
    """Values and their bytes, in the order of their last use; `bytes` is about their sum, which threads may miscount."""

    bytes = 0

    def insert(self, key: CacheKey, value: Any) -> None:
        """Store a value, and drop those that were used long ago where all are large."""
        self[key] = value, (size := _bytes_of(value))
        self.bytes += size
        if self.bytes > CACHE_BYTES:
            self.bytes = sum(size for _, size in list(self.values()))
            while self.bytes > 0.75 * CACHE_BYTES and len(self) > 1:
                try:
                    self.bytes -= self.pop(next(iter(self)), (None, 0))[1]
                except (StopIteration, RuntimeError):  # another thread was faster
                    break


@lru_cache(maxsize=8)
def grid_cache_of(model: Model, theta: bytes, kind: str, setting: Any) -> GridCache:
    """Return the cache of a model with these parameters and this setting, which all of its schedules share."""
    return GridCache()


def _bytes_of(value: Any) -> int:
    """Return the bytes of the arrays in a value and in the attributes of its objects."""
    if isinstance(value, tuple | list):
        return sum(map(_bytes_of, value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    return 64 + sum(map(_bytes_of, getattr(value, "__dict__", {}).values()))
