"""What a request must have before the studio answers it.

The page and its worker can read what the user gave to the studio, so no other page may reach them: not by a guessed address, not
by a name that resolves to this machine (DNS rebinding), not by a form or a WebSocket of another origin.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qs

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Application = Callable[[Scope, Callable[[], Awaitable[Message]], Callable[[Message], Awaitable[None]]], Awaitable[None]]

NAMES = ("127.0.0.1", "localhost")  # under which the page may be opened
REFUSED = 403
INSTRUCTION = "refused: open the address that zakai studio printed, with its token\n"


def new_token() -> str:
    """Return a token that cannot be guessed: 192 random bits, in letters that need no escape in an address."""
    return secrets.token_urlsafe(24)


def headers_of(port: int) -> dict[str, str]:
    """Return the headers of every answer: nothing is loaded from elsewhere, framed or kept; no other page sees the address."""
    sockets = " ".join(f"ws://{name}:{port}" for name in NAMES)
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        f"connect-src 'self' {sockets}; base-uri 'self'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "content-security-policy": policy,
        "cross-origin-opener-policy": "same-origin",
        "cross-origin-resource-policy": "same-origin",
        "referrer-policy": "no-referrer",
        "x-content-type-options": "nosniff",
        "x-frame-options": "DENY",
        "cache-control": "no-store",
    }


class Guard:
    """An application around another one, which it calls for requests of the own page alone.

    A request needs the Host 127.0.0.1 or localhost with the port; no Origin, or the page's own; no word of the browser that it
    comes from another site; and the token, as the first part of its path or, for the page itself, as `?token=`. A WebSocket and
    a request that changes something need the Origin.
    """

    def __init__(self, application: Application, token: str, port: int):
        self.application, self.token = application, token
        self.hosts = {f"{name}:{port}" for name in NAMES}
        self.headers = [(name.encode(), value.encode()) for name, value in headers_of(port).items()]

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.application(scope, receive, send)
        elif not self.allows(scope):
            await self._refuse(scope, receive, send)
        elif scope["type"] == "http":
            await self.application(scope, receive, self._with_headers(send))
        else:
            await self.application(scope, receive, send)

    def allows(self, scope: Scope) -> bool:
        """Return whether a request may be answered."""
        given: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            given.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        if any(len(given.get(name, [])) > 1 for name in ("host", "origin")):
            return False
        host, origin = (given.get(name, [""])[0] for name in ("host", "origin"))
        if host not in self.hosts or (origin and origin != f"http://{host}"):
            return False
        reads = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        if not (reads or origin):
            return False
        page = scope["type"] == "http" and scope["path"] == "/"
        # A link to the page with its token may stand anywhere, such as in a terminal that is a page itself.
        if not page and given.get("sec-fetch-site", ["none"])[0] not in ("same-origin", "none"):
            return False
        return self._has_token(scope, page)

    def _has_token(self, scope: Scope, page: bool) -> bool:
        if page:
            found = parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
            token = found[0] if len(found) == 1 else ""
        else:
            token = scope["path"].split("/")[1]
        return secrets.compare_digest(token.encode("utf-8", "replace"), self.token.encode())

    def _with_headers(self, send: Any) -> Any:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *self.headers]
            await send(message)

        return sending

    async def _refuse(self, scope: Scope, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})  # before it was accepted: the handshake is answered 403
            return
        headers = [(b"content-type", b"text/plain; charset=utf-8"), *self.headers]
        await send({"type": "http.response.start", "status": REFUSED, "headers": headers})
        await send({"type": "http.response.body", "body": INSTRUCTION.encode()})
