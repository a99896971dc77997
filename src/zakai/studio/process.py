"""The server's side of a worker: one request at a time, of each kind the newest, and an end at any moment."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from zakai.studio.frames import ENVELOPE, packed

LARGEST_FRAME = 1 << 30
SUPERSEDED_AFTER = 1.0  # seconds after which a request ends when a newer one of its kind arrives
ENOUGH = 1.0  # seconds in which a request of a page that is gone may end by itself
SWITCHES = {"OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
Send = Callable[[bytes], Awaitable[None]]


class Worker:
    """A process that answers requests.

    Requests of one kind replace one another while they wait; the one that runs is never interrupted but by `cancel`, by the end
    of the process, or, where it is `impatient`, by a newer one of its kind once it has taken a second. Each frame goes to `send`.
    """

    def __init__(self, folder: Path, memory: float, send: Send, impatient: bool = False):
        self.folder, self.memory, self.send, self.impatient = folder, memory, send, impatient
        self.waiting: dict[str, dict[str, Any]] = {}
        self.running: dict[str, Any] | None = None
        self.began, self.number = 0.0, 0
        self.process: asyncio.subprocess.Process | None = None
        self.reader: asyncio.Task[None] | None = None
        self.lock, self.idle = asyncio.Lock(), asyncio.Event()
        self.idle.set()
        self.deaf = False  # whether answers are for a page that is gone

    async def start(self) -> None:
        """Begin a process, unless there is one."""
        async with self.lock:
            if self.process is not None and self.process.returncode is None:
                return
            self.process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "zakai.studio.worker", str(self.folder), repr(self.memory),
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
                env={**os.environ, **SWITCHES}, start_new_session=True, limit=1 << 20,
            )  # fmt: skip
            self.reader = asyncio.create_task(self._read(self.process))

    async def ask(self, request: dict[str, Any]) -> None:
        """Take a request; its answer goes to `send` in its time, unless a newer one of its kind replaces it."""
        kind = str(request.get("channel") or request.get("do"))
        self.waiting.pop(kind, None)
        self.waiting[kind] = request
        running = self.running
        if self.impatient and running is not None and time.monotonic() - self.began > SUPERSEDED_AFTER:
            if kind == str(running.get("channel") or running.get("do")):
                await self._end()
                return
        await self._next()

    async def cancel(self) -> None:
        """End what runs and what waits, and answer that it is cancelled."""
        ended, running = list(self.waiting.values()), self.running
        self.waiting.clear()
        if running is not None:
            await self._end()
            ended.insert(0, running)
        for one in ended:
            await self.send(packed({"id": one.get("id"), "do": one.get("do"), "error": "cancelled", "cancelled": True}))

    async def abandon(self) -> None:
        """Forget what waits, and what runs unless it is nearly done, since a new process takes seconds; its answer is dropped."""
        self.waiting.clear()
        running = self.running
        try:
            self.deaf = True
            await asyncio.wait_for(self.idle.wait(), ENOUGH)
        except TimeoutError:
            if self.running is running and running is not None:
                await self._end()
        finally:
            self.deaf = False

    async def close(self) -> None:
        """End the process for good."""
        self.waiting.clear()
        await self._kill()

    async def _end(self) -> None:
        self.running = None
        await self._kill()
        await self.start()
        await self._next()

    async def _kill(self) -> None:
        process, reader = self.process, self.reader
        self.process = self.reader = None
        if reader is not None:
            reader.cancel()
        if process is not None:
            if process.returncode is None:
                process.kill()
            await process.wait()

    async def _next(self) -> None:
        if self.running is not None:
            return
        if not self.waiting:
            self.idle.set()
            return
        await self.start()
        if self.running is not None or not self.waiting or self.process is None or self.process.stdin is None:
            return
        kind = next(iter(self.waiting))
        request = self.waiting.pop(kind)
        self.running, self.began, self.number = request, time.monotonic(), self.number + 1
        self.idle.clear()
        line = json.dumps({**request, "number": self.number}).encode() + b"\n"
        try:
            self.process.stdin.write(line)
            await self.process.stdin.drain()
        except (ConnectionError, OSError):
            pass  # its end is reported where its output ends

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        try:
            while True:
                size, number, last = ENVELOPE.unpack(await process.stdout.readexactly(ENVELOPE.size))
                if size > LARGEST_FRAME:
                    break
                frame = await process.stdout.readexactly(size)
                current = self.running is not None and number == self.number
                if last and current:
                    self.running = None
                if current and not self.deaf:
                    await self.send(frame)
                if last:
                    await self._next()
        except asyncio.IncompleteReadError:
            pass
        if process is not self.process:
            return
        try:
            code = await asyncio.wait_for(process.wait(), ENOUGH)  # to kill one that has just ended would lose its code
        except TimeoutError:
            process.kill()
            code = await process.wait()
        running, self.running, self.process = self.running, None, None
        if running is not None:
            await self.send(packed({"id": running.get("id"), "do": running.get("do"), "error": self._why(code)}))
        await self._next()  # another process begins with the next request: a process that fails at its start is not begun again

    def _why(self, code: int) -> str:
        if code in (-9, -11, -6):
            return (
                f"the computation ended; it needed more memory than it may have ({self.memory:g} GiB): take a shorter record or "
                "a larger tolerance, or start zakai studio with a larger --memory"
            )
        return f"the computation ended unexpectedly (code {code}); press Run again, and if that does not help save the model file"


def requested(text: str) -> Mapping[str, Any] | None:
    """Return the request in a message of the page; None where it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("do"), str) else None
