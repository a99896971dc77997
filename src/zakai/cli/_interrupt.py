"""Ctrl-C that is not lost, and that breaks nothing.

Python raises KeyboardInterrupt wherever the program happens to be.  Where that is a callback of a library, of JAX while it
compiles for example, it is dropped there, or the library comes down.  So it is also noted, and asked for at every step of long
work; and while JAX is at work it waits a little.
"""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType

AGAIN = 2.0  # seconds after which an interruption that nobody heard is asked for again
SOON = 0.05  # the same of one that waits for JAX
PATIENCE = 5.0  # seconds that it waits at most

_asked = False
_since = 0.0
_insists = False
_timed = False


def watch() -> None:
    """Note the interruptions of this process, unless somebody else already looks after them."""
    global _asked, _timed
    _asked = False
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)
        if hasattr(signal, "setitimer") and signal.getsignal(signal.SIGALRM) is signal.SIG_DFL:
            signal.signal(signal.SIGALRM, _note)
            _timed = True


def insist() -> None:
    """Ask again and again: for what waits for its input, where no step comes at which `check` is asked."""
    global _insists
    _insists = _timed


def _note(_: int = 0, frame: FrameType | None = None) -> None:
    global _asked, _since
    _since = _since if _asked else time.monotonic()
    _asked = True
    if _timed and _within_jax(frame) and time.monotonic() - _since < PATIENCE:
        signal.setitimer(signal.ITIMER_REAL, SOON)
        return
    if _insists:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    raise KeyboardInterrupt


def _within_jax(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_globals.get("__name__", "").partition(".")[0] in ("jax", "jaxlib"):
            return True
        frame = frame.f_back
    return False


def check() -> None:
    """Raise KeyboardInterrupt if there was one."""
    if _asked:
        raise KeyboardInterrupt
