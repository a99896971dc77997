"""Compilation beforehand of what the usual methods need."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import NamedTuple

from zakai import numerics
from zakai._progress import bar
from zakai.numerics import compiled, kernel_cache
from zakai.numerics.line.loop import declare_usual


class WarmUp(NamedTuple):
    """The number of kernels, the seconds that they took, and the folder in which they are kept, None without one."""

    kernels: int
    seconds: float
    folder: Path | None


def warm_up() -> WarmUp:
    """Compile the kernels of all methods, so that no later process has to.

    Kernels that are in the folder already are read.  What only rare models need is left out: samples of an h with kinks.
    """
    for module in pkgutil.walk_packages(numerics.__path__, "zakai.numerics."):
        importlib.import_module(module.name)
    declare_usual()
    before = compiled.compilation_time()
    with bar("compiling") as advance:
        count = 0
        for count, total in compiled.compile_declared():
            if advance is not None:
                advance(count, total)
    return WarmUp(count, compiled.compilation_time() - before, kernel_cache.folder())
