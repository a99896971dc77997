"""Ctrl-C that is neither ignored nor breaks a library.

Python raises KeyboardInterrupt wherever the program is.  In a callback of a library, for example in a compiler, it is dropped or
makes the library fail.  Therefore it is also recorded, and checked at every step of long work; while a compiler runs it waits.
"""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType

COMPILERS = ("jax", "jaxlib", "numba", "llvmlite")
AGAIN = 2.0  # seconds after which an interruption without effect is raised again
SOON = 0.05  # the same for one that waits for a compiler
PATIENCE = 5.0  # the longest wait in seconds

_asked = False
_since = 0.0
_insists = False
_timed = False


def watch() -> None:
    """Record the interruptions of this process, unless another handler is installed."""
    global _asked, _timed
    _asked = False
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)
        if hasattr(signal, "setitimer") and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL:
            signal.signal(signal.SIGALRM, _note)
            _timed = True


def insist() -> None:
    """Raise repeatedly: for a program that waits for input and calls `check` too rarely."""
    global _insists
    _insists = _timed


def end() -> None:
    """Stop raising: the interruption has had its effect, and Python no longer handles an alarm while it shuts down."""
    global _insists
    _insists = False
    if _timed:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _note(_: int = 0, frame: FrameType | None = None) -> None:
    global _asked, _since
    _since = _since if _asked else time.monotonic()
    _asked = True
    if _timed and _within_compiler(frame) and time.monotonic() - _since < PATIENCE:
        signal.setitimer(signal.ITIMER_REAL, SOON)
        return
    if _insists:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    raise KeyboardInterrupt


def _within_compiler(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in COMPILERS:
            return True
        frame = frame.f_back
    return False


def check() -> None:
    """Raise KeyboardInterrupt if there was one."""
    if _asked:
        raise KeyboardInterrupt
