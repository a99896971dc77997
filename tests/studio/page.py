"""A page of the studio without a browser: requests as JSON, answers as frames."""

from __future__ import annotations

import json
from typing import Any

from starlette.testclient import TestClient

from report.frames import read
from zakai.studio.server import Settings, Studio

PORT = 8123
HOST = f"127.0.0.1:{PORT}"
ORIGIN = f"http://{HOST}"


def unpacked(frame: bytes) -> dict[str, Any]:
    """The header of a frame, with its arrays in it."""
    header, arrays = read(frame)
    return {**header, **arrays}


class Page:
    """A page that is connected to a studio."""

    def __init__(self, client: TestClient, token: str, socket: Any):
        self.client, self.token, self.socket, self.number = client, token, socket, 0
        self.hello = json.loads(socket.receive_text())

    def send(self, do: str, **rest: Any) -> int:
        self.number += 1
        self.socket.send_text(json.dumps({"do": do, "id": self.number, **rest}))
        return self.number

    def ask(self, do: str, **rest: Any) -> dict[str, Any]:
        """The last answer to a request."""
        number = self.send(do, **rest)
        while True:
            header = self.receive()
            if header.get("id") == number and header["do"] != "progress":
                return header

    def receive(self) -> dict[str, Any]:
        return unpacked(self.socket.receive_bytes())

    def upload(self, body: bytes, **headers: str) -> Any:
        return self.client.post(f"/{self.token}/record", content=body, headers={"host": HOST, "origin": ORIGIN, **headers})


def studio(**settings: Any) -> tuple[TestClient, str]:
    """A client of a studio, and its token."""
    made = Studio(Settings(port=PORT, **settings))
    client = TestClient(made.application(), base_url=ORIGIN, headers={"origin": ORIGIN})
    client.studio = made
    return client, made.settings.token
