"""Compilation of kernels: once for each machine, kept in Numba's cache where one can be written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def kernel(signature: Any) -> Callable[[F], F]:
    """Return a decorator that compiles a function for one signature, without Python's lock and with IEEE division.

    The compiled code is kept beside the source, or in the user's cache folder.  Where neither can be written, the function is
    compiled in every process.
    """

    def decorate(function: F) -> F:
        try:
            compiled = njit(signature, cache=True, nogil=True, error_model="numpy")(function)
        except (RuntimeError, OSError):  # no folder for the cache, or it cannot be written
            compiled = njit(signature, nogil=True, error_model="numpy")(function)
        return cast(F, compiled)

    return decorate
