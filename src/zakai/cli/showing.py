"""Run zakai studio."""

from __future__ import annotations

import sys
import threading
import webbrowser
from pathlib import Path

import zakai
from zakai.errors import InputError


def studio(model: str | None, record: str | None, port: int, browser: bool, memory: float) -> None:
    """Serve the page until it is interrupted."""
    try:
        import uvicorn

        from zakai.studio.follow import Source
        from zakai.studio.server import LARGEST_FILE, LARGEST_MESSAGE, Settings, Studio, bound
    except ModuleNotFoundError as error:
        missing = (error.name or "a library").partition(".")[0]
        if missing == "zakai":
            raise
        raise InputError(f"studio: {missing} is not installed; pip install 'zakai[studio]'") from error

    settings = Settings(memory=memory, version=zakai.__version__)
    if model is not None:
        settings.model, settings.tables = _text(model)
    if record == "-":
        settings.follow = Source(None)
    elif record is not None:
        path = Path(record)
        if not path.is_file():
            raise InputError(f"{record}: there is no such file; give a CSV file, or - for standard input")
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{record}: is larger than {LARGEST_FILE >> 20} MiB; give a part of it")
        settings.record, settings.follow = path, Source(path)
    listening = bound(port)
    settings.port = listening.getsockname()[1]
    address = f"http://127.0.0.1:{settings.port}/?token={settings.token}"
    config = uvicorn.Config(
        Studio(settings).application(), log_level="critical", access_log=False, lifespan="on", ws="websockets-sansio",
        ws_max_size=LARGEST_MESSAGE, proxy_headers=False, server_header=False, timeout_graceful_shutdown=1,
        ws_per_message_deflate=False,  # between two processes of one machine it takes more time than it saves
    )  # fmt: skip
    print(f"zakai studio  {address}\nOpen this address in a browser on this machine; Ctrl-C ends the studio.", flush=True)
    if browser:
        threading.Thread(target=_open, args=(address,), daemon=True).start()
    try:
        uvicorn.Server(config).run(sockets=[listening])
    except KeyboardInterrupt:
        pass
    print("\nthe studio has ended", file=sys.stderr)


def _text(source: str) -> tuple[str, Path | None]:
    """Return the text of a model and the folder of its file; one that has an error is shown on the page with it."""
    from zakai.models import gallery
    from zakai.models._text import read_text

    if source.startswith("gallery:"):
        return gallery.text(source.removeprefix("gallery:")), None
    path = Path(source)
    return read_text(path, source), path.parent.resolve()


def _open(address: str) -> None:
    try:
        webbrowser.open(address)
    except Exception:  # there is none; the address is printed
        return
