"""Ctrl-C that is not lost.

Python raises KeyboardInterrupt wherever the program happens to be. Where that is a callback of a library, of JAX while it
compiles for example, it is dropped there. So it is also noted, and asked for at every step of long work.
"""

from __future__ import annotations

import signal
import threading

_asked = False


def watch() -> None:
    """Note the interruptions of this process, unless somebody else already looks after them."""
    global _asked
    _asked = False
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _note)


def _note(*_: object) -> None:
    global _asked
    _asked = True
    raise KeyboardInterrupt


def check() -> None:
    """Raise KeyboardInterrupt if there was one."""
    if _asked:
        raise KeyboardInterrupt
