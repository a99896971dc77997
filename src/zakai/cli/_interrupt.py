"""Ctrl-C that is not lost.

Python raises KeyboardInterrupt wherever the program happens to be. Where that is a callback of a library, of JAX while it
compiles for example, it is dropped there. So it is also noted, and asked for at every step of long work.
"""

from __future__ import annotations

import signal
import threading

AGAIN = 2.0  # seconds after which an interruption that nobody heard is asked for again

_asked = False
_insists = False


def watch() -> None:
    """Note the interruptions of this process, unless somebody else already looks after them."""
    global _asked
    _asked = False
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)


def insist() -> None:
    """Ask again and again: for what waits for its input, where no step comes at which `check` is asked."""
    global _insists
    if signal.getsignal(signal.SIGINT) is _note and hasattr(signal, "setitimer"):
        _insists = True
        signal.signal(signal.SIGALRM, _note)


def _note(*_: object) -> None:
    global _asked
    _asked = True
    if _insists:
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
    raise KeyboardInterrupt


def check() -> None:
    """Raise KeyboardInterrupt if there was one."""
    if _asked:
        raise KeyboardInterrupt
