"""The server of the studio: the page, the files that are given to it, and a WebSocket to the workers."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import shutil
import socket
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from zakai.errors import InputError
from zakai.studio.follow import Source
from zakai.studio.frames import packed
from zakai.studio.process import Worker, requested
from zakai.studio.security import Guard, new_token

LARGEST_FILE = 64 << 20  # bytes of a record that is dropped
MOST_ROWS = 1_000_000
MOST_FILES = 20  # that are kept; of more the oldest goes
LARGEST_MESSAGE = 4 << 20
RELOAD = 10.0  # seconds in which a page that is gone may come back, before what it asked for ends
HOST = "127.0.0.1"
QUICK = {"check", "write", "gallery", "columns", "describe", "shell"}  # answered while one types
LONGER = {"methods", "algebra"}  # answered beside a run, until the model is another one
KINDS = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
STATIC = files("zakai.studio").joinpath("static")
SHARED = files("zakai.report").joinpath("static")  # the picture of a density, which the report shows too


@dataclass
class Settings:
    """What the command gives: the first model and record, the stream to follow, and the memory of a computation in GiB."""

    model: str = ""
    record: Path | None = None
    follow: Source | None = None
    tables: Path | None = None
    memory: float = 4.0
    version: str = ""
    port: int = 0
    token: str = field(default_factory=new_token)


class Studio:
    """The state of the server: a folder, three workers, and the page that is connected."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self.folder = Path(mkdtemp(prefix="zakai-studio-"))
        self.page: WebSocket | None = None
        self.sending = asyncio.Lock()
        self.quick = Worker(self.folder, settings.memory, self.send, impatient=True)
        self.thinker = Worker(self.folder, settings.memory, self.send, impatient=True)
        self.runner = Worker(self.folder, settings.memory, self.send)
        self.following: asyncio.Task[None] | None = None
        self.leaving: asyncio.Task[None] | None = None
        self.back = asyncio.Event()  # whether a page is there again
        self.first: dict[str, Any] | None = None
        if settings.tables is not None:
            (self.folder / "tables-are-in").write_text(str(settings.tables), encoding="utf-8")
        if settings.record is not None:
            number = hashlib.sha256(str(settings.record).encode()).hexdigest()[:32]
            shutil.copyfile(settings.record, self.folder / f"{number}.csv")
            self.first = {"file": number, "name": settings.record.name}

    @property
    def workers(self) -> tuple[Worker, ...]:
        """The processes: for what must be quick, for what is about the model alone, and for what is about a record."""
        return self.quick, self.thinker, self.runner

    def application(self) -> Guard:
        """Return the application, which answers nobody but the own page."""

        @contextlib.asynccontextmanager
        async def lifespan(_: Starlette) -> AsyncIterator[None]:
            await asyncio.gather(self.quick.start(), self.runner.start())
            yield
            await self._stay()
            await self.stop_following()
            await asyncio.gather(*(one.close() for one in self.workers))
            shutil.rmtree(self.folder, ignore_errors=True)

        base = "/{token}"
        routes = [
            Route("/", self.index),
            Route(base + "/record", self.upload, methods=["POST"]),
            WebSocketRoute(base + "/socket", self.socket),
            Route(base + "/{name}", self.static),
        ]
        return Guard(Starlette(routes=routes, lifespan=lifespan), self.settings.token, self.settings.port)

    async def index(self, request: Request) -> Response:
        """Return the page."""
        text = STATIC.joinpath("index.html").read_text(encoding="utf-8")
        return HTMLResponse(text.replace("{{base}}", f"/{self.settings.token}/"))

    async def static(self, request: Request) -> Response:
        """Return one of the page's own files."""
        name = request.path_params["name"]
        suffix = Path(name).suffix
        for folder in (STATIC, SHARED):
            if suffix in KINDS and name in {one.name for one in folder.iterdir()}:
                return Response(folder.joinpath(name).read_bytes(), media_type=KINDS[suffix])
        return PlainTextResponse("there is no such file\n", 404)

    async def upload(self, request: Request) -> Response:
        """Keep a record of at most a bounded size and number of rows, and return its number."""
        number = hashlib.sha256()
        rows = size = 0
        temporary = self.folder / f"part-{id(request)}"
        try:
            with temporary.open("wb") as file:
                async for chunk in request.stream():
                    size += len(chunk)
                    rows += chunk.count(b"\n")
                    if size > LARGEST_FILE:
                        return _refused(f"the file is larger than {LARGEST_FILE >> 20} MiB; drop a part of it")
                    if rows > MOST_ROWS:
                        return _refused(f"the file has more than {MOST_ROWS:,} rows; drop a part of it")
                    number.update(chunk)
                    file.write(chunk)
            if not size:
                return _refused("the file is empty; drop a CSV file with a header")
            name = number.hexdigest()[:32]
            temporary.replace(self.folder / f"{name}.csv")
        except ClientDisconnect:
            return _refused("the file did not arrive; drop it again")
        finally:
            temporary.unlink(missing_ok=True)
        kept = sorted(self.folder.glob("*.csv"), key=lambda path: path.stat().st_mtime)
        for old in kept[:-MOST_FILES]:
            old.unlink(missing_ok=True)
        return JSONResponse({"file": name, "bytes": size, "rows": rows})

    async def socket(self, socket: WebSocket) -> None:
        """Pass requests of the page to the workers, and their answers back; a newer page takes the place of an older one."""
        await socket.accept()
        await self._stay()
        older, self.page = self.page, socket
        if older is not None:
            with contextlib.suppress(RuntimeError, WebSocketDisconnect):
                await older.send_text(json.dumps({"do": "replaced"}))
                await older.close(4001)
        await self.stop_following()
        await self._abandon()
        await socket.send_text(json.dumps(self._hello()))
        try:
            while True:
                text = await socket.receive_text()
                request = requested(text) if len(text) <= LARGEST_MESSAGE else None
                if request is None:
                    await self.send(packed({"do": "error", "error": "the page sent something that is no request; reload it"}))
                else:
                    await self._take(dict(request))
        except (WebSocketDisconnect, RuntimeError, KeyError):
            pass
        if self.page is socket:
            self.page = None
            self.back.clear()
            self.leaving = asyncio.create_task(self._leave())
            await self.stop_following()

    async def _leave(self) -> None:
        """End what a page has asked for that is gone and does not come back."""
        try:
            await asyncio.wait_for(self.back.wait(), RELOAD)
        except TimeoutError:
            await self._abandon()

    async def _stay(self) -> None:
        """Forget that the page was gone; wait until what has begun to end has ended."""
        self.back.set()
        if self.leaving is not None:
            await self.leaving
            self.leaving = None

    async def _abandon(self) -> None:
        await asyncio.gather(*(one.abandon() for one in self.workers))

    def _hello(self) -> dict[str, Any]:
        source = self.settings.follow
        return {
            "do": "hello",
            "version": self.settings.version,
            "model": self.settings.model,
            "record": self.first,
            "follow": None if source is None else source.name,
            "memory": self.settings.memory,
        }

    async def _take(self, request: dict[str, Any]) -> None:
        what = request["do"]
        if what == "cancel":
            await self.stop_following()
            await self.runner.cancel()
        elif what == "follow":
            await self.stop_following()
            self.following = asyncio.create_task(self._follow(request))
        elif what == "unfollow":
            await self.stop_following()
        else:
            worker = self.quick if what in QUICK else self.thinker if what in LONGER else self.runner
            await worker.ask(request)

    async def send(self, frame: bytes) -> None:
        """Send a frame to the page, if there is one."""
        page = self.page
        if page is not None:
            async with self.sending:
                with contextlib.suppress(RuntimeError, WebSocketDisconnect, ConnectionError):
                    await page.send_bytes(frame)

    async def _follow(self, request: dict[str, Any]) -> None:
        """Give the lines of the stream to the runner, as many at once as have arrived while it computed."""
        source = self.settings.follow
        if source is None:
            why = "stream: start zakai studio MODEL RECORD.csv to follow a file, or zakai studio MODEL - for standard input"
            await self.send(packed({**_names(request), "error": why}))
            return
        await self.runner.ask({**request, "do": "stream-begin", "channel": "stream"})
        await self.runner.idle.wait()
        try:
            async for lines in source.batches():
                await self.runner.ask({**_names(request), "do": "stream-lines", "channel": "stream", "lines": lines})
                await self.runner.idle.wait()
        except OSError as error:
            await self.send(packed({**_names(request), "error": f"stream: {source.name}: cannot be read: {error.strerror}"}))

    async def stop_following(self) -> None:
        """End the stream, if one is followed."""
        if self.following is not None:
            self.following.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self.following
            self.following = None


def _names(request: dict[str, Any]) -> dict[str, Any]:
    return {"id": request.get("id"), "do": request.get("do")}


def _refused(message: str) -> Response:
    return JSONResponse({"error": message}, 413)


def bound(port: int) -> socket.socket:
    """Return a socket on this machine alone.

    Raises:
        InputError: the port is taken, or may not be used.
    """
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if sys.platform != "win32":
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((HOST, port))
        found.listen()  # so that the address can be opened as soon as it is printed
    except (OSError, OverflowError) as error:
        found.close()
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--port {port}: cannot be used: {reason}; choose another one, or leave it out") from None
    return found
