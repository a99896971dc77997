"""Lines as they arrive: of a file that grows, or of standard input."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from collections.abc import AsyncIterator
from pathlib import Path

AT_ONCE = 1 << 17  # bytes
MOST_KEPT = 1 << 24  # bytes of standard input that a page which is loaded again receives again
PAUSE = 0.2  # seconds until a file is read again


class Source:
    """A file, or standard input where there is no path."""

    def __init__(self, path: Path | None):
        self.path = path
        self.name = "standard input" if path is None else path.name
        self.kept = self.rest = b""  # of standard input, which can be read once
        self.blocks: asyncio.Queue[bytes] | None = None

    async def batches(self) -> AsyncIterator[str]:
        """Yield whole lines, as many as are there, from the first on; of a file for as long as it is followed."""
        async for block in self._file() if self.path is not None else self._input():
            yield block.decode("utf-8", "replace")

    async def _file(self) -> AsyncIterator[bytes]:
        assert self.path is not None
        with self.path.open("rb") as file:
            rest = b""
            while True:
                block = await asyncio.to_thread(file.read, AT_ONCE)
                lines, newline, rest = (rest + block).rpartition(b"\n")
                if newline:
                    yield lines + newline
                if not block:
                    await asyncio.sleep(PAUSE)

    async def _input(self) -> AsyncIterator[bytes]:
        if self.blocks is None:
            self.blocks = asyncio.Queue(1)
            # A thread that waits for a line must not keep the server from ending.
            threading.Thread(target=_read, args=(self.blocks, asyncio.get_running_loop()), daemon=True).start()
        if self.kept:
            yield self.kept
        while block := await self.blocks.get():
            lines, newline, self.rest = (self.rest + block).rpartition(b"\n")
            if newline:
                self.kept = self.kept + lines + newline if len(self.kept) < MOST_KEPT else self.kept
                yield lines + newline
        if self.rest:
            yield self.rest + b"\n"


def _read(blocks: asyncio.Queue[bytes], loop: asyncio.AbstractEventLoop) -> None:
    while True:
        # Python's own reader would be locked by this thread when the interpreter ends.
        block = os.read(sys.stdin.fileno(), AT_ONCE)
        try:
            asyncio.run_coroutine_threadsafe(blocks.put(block), loop).result()
        except RuntimeError:  # the server has ended
            return
        if not block:
            return
