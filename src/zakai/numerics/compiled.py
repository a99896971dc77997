"""Compilation of kernels: once for each machine, kept in the user's cache folder where one can be written."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from threading import Timer
from typing import Any, TypeVar, cast

from numba import njit, types, version_info
from numba.core.compiler_lock import global_compiler_lock
from numba.core.sigutils import normalize_signature

from zakai._progress import shown
from zakai.numerics.kernel_cache import caching, folder

F = TypeVar("F", bound=Callable[..., Any])
R = TypeVar("R")

# Without Python's lock, with IEEE division, and without the entry for C, which nothing calls.
_compiler: Any = partial(njit, nogil=True, error_model="numpy", no_cfunc_wrapper=True)

_INLINED = (0, 68)  # the version of Numba, of which `numerics/inlined.py` replaces a part


# Sums may be taken in any order, so that several terms are added at once.
_REORDERED: Any = frozenset({"reassoc", "nsz", "contract"})


LONG = 0.3  # seconds in which a kernel is not read from the cache but compiled


class _Compilation:
    """The seconds that this process has spent compiling, with the garbage collection off, which takes a tenth of them.

    The first time that it takes long a line on the terminal says so.
    """

    def __init__(self) -> None:
        self.depth, self.collects = 0, False
        # The seconds of earlier compilations, and when the present one began: one object, which other threads read as a whole.
        self.clock: tuple[float, float | None] = (0.0, None)
        self.announced, self.timer = False, Timer(0.0, _announce)

    def __enter__(self) -> None:
        if self.depth == 0:
            self.clock, self.collects = (self.clock[0], time.monotonic()), gc.isenabled()
            gc.disable()
            if not self.announced and shown():
                self.timer = Timer(LONG, self._announce)
                self.timer.daemon = True
                self.timer.start()
        self.depth += 1

    def _announce(self) -> None:
        self.announced = True
        _announce()

    def __exit__(self, *error: object) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.timer.cancel()
            if self.collects:
                gc.enable()
                gc.collect(0)  # what was put off, which the next allocation would do: seconds after the first compilation
            self.clock = (self.seconds(), None)

    def seconds(self) -> float:
        """Return the seconds until now."""
        before, since = self.clock
        return before if since is None else before + (time.monotonic() - since)


def _announce() -> None:
    """Write that kernels are compiled."""
    kept = "once for this machine" if folder() is not None else "in this process: no cache folder can be written"
    print(f"zakai: compiling, {kept} (about 10 s; zakai warm-up does it beforehand)", file=sys.stderr, flush=True)


_compilation = _Compilation()
_declared: list[Callable[[], None]] = []


def compile_declared() -> Iterator[tuple[int, int]]:
    """Compile all kernels of the modules that are imported, for all of their types; yield how many are done, and their number."""
    _compilation.announced = True
    for count, compile_kernel in enumerate(_declared, 1):
        compile_kernel()
        yield count, len(_declared)


def compilation_time() -> float:
    """Return the seconds that this process has spent with the compilation of kernels."""
    return _compilation.seconds()


def compiling() -> bool:
    """Return whether this thread compiles a kernel. Numba must not be interrupted there: it would keep what is half done."""
    return bool(global_compiler_lock.is_locked())


def compiles_since() -> float | None:
    """Return when the compilation began, by `time.monotonic`, with which any thread is busy now; None where none is."""
    return _compilation.clock[1]


def working_time() -> float:
    """Return a clock in seconds that does not count the compilation of kernels."""
    return time.monotonic() - _compilation.seconds()


def kernel(signature: Any, derivative: Any = None, *, reordered: bool = False) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Return a decorator that compiles a function for one signature when it is first called, by Python or by another kernel.

    The compiled code is kept in `kernel_cache.folder_of` its module; without one, the function is compiled in every process.

    Args:
        signature: the types of the arguments and of the result.
        derivative: those of complex arguments, for which the function is compiled when it first receives one.
        reordered: whether its sums may be taken in any order.  The order depends on how the kernel was compiled, so that only one
            compilation, that of the cache, may serve all who need equal bits: a `helper` must not have such sums.
    """
    fastmath = set(_REORDERED) if reordered else False

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        with caching(function.__module__ or "") as kept:
            try:
                dispatcher = _compiler(cache=kept, fastmath=fastmath)(function)
            except RuntimeError:  # a function without a file
                dispatcher = _compiler(fastmath=fastmath)(function)
        compiled = dispatcher.compile

        def compile_for(arguments: Any) -> Any:
            """Compile for the declared types, to which these arguments are converted."""
            complex_ = derivative is not None and any(getattr(t, "dtype", t) == types.complex128 for t in arguments)
            declared = derivative if complex_ else signature
            expected, _ = normalize_signature(declared)
            pairs = zip(arguments, expected, strict=True)
            if any(dispatcher.typingctx.can_convert(given, wanted) is None for given, wanted in pairs):
                raise TypeError(f"{function.__name__}{arguments}: the kernel takes {expected}")
            with global_compiler_lock, _compilation:  # threads of a batch come here together
                known = dispatcher.overloads.get(tuple(expected))
                if known is not None:
                    return known.entry_point
                try:
                    entry = compiled(declared)
                except OSError:  # the cache cannot be written
                    entry = compiled(declared)
                if len(dispatcher.overloads) == (1 if derivative is None else 2):
                    # From now on arguments of other types, such as int for float64, are converted without asking here first.
                    dispatcher.disable_compile()
                return entry

        def compile_all() -> None:
            for one in (signature, derivative):
                if one is not None and tuple(normalize_signature(one)[0]) not in dispatcher.overloads:
                    compile_for(tuple(normalize_signature(one)[0]))

        dispatcher.compile = compile_for
        _declared.append(compile_all)
        return cast("Callable[..., R]", dispatcher)

    return decorate


def helper(function: F) -> F:
    """Compile a function that only kernels call, as a part of each of them; it has no entry for Python.

    It is compiled once for all literal integers, and once for each literal boolean, which selects code.  With a version of Numba
    that is not known it is compiled as any function, which takes longer.
    """
    keys = {}
    if version_info.short == _INLINED:
        from zakai.numerics.inlined import InlinedCompiler

        keys["pipeline_class"] = InlinedCompiler
    # Without an own value it would take that of the kernel that is compiled first, and hand it on to all others.
    dispatcher = _compiler(fastmath=False, **keys)(function)
    compiled = dispatcher.compile

    def compile_common(arguments: Any) -> Any:
        return compiled(tuple(types.unliteral(t) if isinstance(t, types.IntegerLiteral) else t for t in arguments))

    dispatcher.compile = compile_common
    return cast(F, dispatcher)
