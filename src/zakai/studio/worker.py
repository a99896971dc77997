"""The process that computes: requests come as lines of JSON on standard input, answers leave as frames on standard output.

It ends with its server, holds at most the memory that it may have, and can be killed at any time: it writes no files but those in
its folder.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from zakai.errors import ZakaiError
from zakai.studio.frames import ENVELOPE, packed
from zakai.studio.session import Session
from zakai.studio.tasks import carried_out

WATCHED = 0.25  # seconds between checks whether a kernel is compiled
COMPILED = 1.0  # seconds of a compilation after which it is said
COMPILING = "Kernels are being compiled, once for this machine; this takes up to a minute."
FULL = "the computation needs more memory than it may have ({:g} GiB): take a shorter record or a larger tolerance, or start "
FULL += "zakai studio with a larger --memory"


class Output:
    """The way back to the server, for one request after the other."""

    def __init__(self, stream: BinaryIO):
        self.stream, self.lock = stream, threading.Lock()

    def send(self, number: int, frame: bytes, last: bool) -> None:
        """Write a frame; progress may come from several threads."""
        with self.lock:
            self.stream.write(ENVELOPE.pack(len(frame), number, last) + frame)
            self.stream.flush()


def answer(session: Session, request: dict[str, Any], memory: float, report: Callable[[int, int | None], None]) -> bytes:
    """Return the frame that answers a request; whatever fails becomes one line that says what to do."""
    head = {"id": request.get("id"), "do": request.get("do")}
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            header, arrays = carried_out(session, request, report)
        notes = list(dict.fromkeys(str(one.message) for one in caught if one.category is UserWarning))
        return packed({**head, "notes": notes, **header}, arrays)
    except ZakaiError as error:
        return packed({**head, "error": " ".join(str(error).split())})
    except MemoryError:
        session.forget()
        return packed({**head, "error": FULL.format(memory)})
    except RecursionError:
        return packed({**head, "error": "the formulas are nested too deep; write them in a shorter form"})
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        return packed({**head, "error": f"this is a fault of zakai, not of the model ({what}); save the model and report it"})


def limit_memory(memory: float) -> None:
    """Hold the address space of this process to `memory` GiB, where the system can, and write no core files."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    size = int(memory * 2**30)
    for name, value in ((resource.RLIMIT_AS, size), (resource.RLIMIT_CORE, 0)):
        try:
            resource.setrlimit(name, (value, value))
        except (OSError, ValueError):  # macOS refuses the first
            continue


def main() -> None:
    """Answer requests until standard input ends; arguments are the folder and the memory in GiB."""
    folder, memory = Path(sys.argv[1]), float(sys.argv[2])
    limit_memory(memory)
    output = Output(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what a library prints does not get between the frames
    session = Session(folder)
    _load()
    # As in the command: searches for garbage among what is imported take a tenth of the time of a short task.
    gc.set_threshold(500_000, 20, 100)
    gc.freeze()
    for line in sys.stdin.buffer:
        request = json.loads(line)
        number = int(request["number"])
        report = partial(_report, output, number, request.get("id"))
        with saying(partial(_say, output, number, request.get("id"))):
            frame = answer(session, request, memory, report)
        output.send(number, frame, True)
        if request.get("do") in ("run", "smooth", "fit"):
            gc.collect()  # results hold one another


@contextmanager
def saying(say: Callable[[str], None]) -> Iterator[None]:
    """Say what the work inside logs, such as the time that it takes, and for how long kernels are compiled."""
    ended, log = threading.Event(), _Log(say)
    logger = logging.getLogger("zakai")
    logger.addHandler(log)
    threading.Thread(target=_watch, args=(say, ended), daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        logger.removeHandler(log)


class _Log(logging.Handler):
    def __init__(self, say: Callable[[str], None]):
        super().__init__(logging.WARNING)
        self.say = say

    def emit(self, record: logging.LogRecord) -> None:
        self.say(record.getMessage())


def _watch(say: Callable[[str], None], ended: threading.Event) -> None:
    said = False
    while not ended.wait(WATCHED):
        compiled = sys.modules.get("zakai.numerics.compiled")
        since = None if compiled is None else getattr(compiled, "compiles_since", lambda: None)()
        compiles = since is not None and time.monotonic() - since > COMPILED
        if compiles and not said:
            said = True
            say(COMPILING)
        elif said and since is None:
            said = False
            say("")


def _load() -> None:
    """Import what every page needs, while it is still being opened."""
    from zakai.report import equations  # noqa: F401


def _report(output: Output, number: int, given: Any, done: int, total: int | None) -> None:
    output.send(number, packed({"id": given, "do": "progress", "done": done, "total": total}), False)


def _say(output: Output, number: int, given: Any, text: str) -> None:
    output.send(number, packed({"id": given, "do": "said", "text": text}), False)


if __name__ == "__main__":
    main()
