"""The code in the documents."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(
    r"^```(?:\{code-block\} )?(\w+)\n(?::caption: (\S+)\n)?(.*?)^```$(?:\n+```text\n(.*?)^```$)?", re.DOTALL | re.MULTILINE
)


class Block(NamedTuple):
    """A fenced block: its language, its file or "", its code, and the output that a `text` block after it shows, or None."""

    language: str
    file: str
    code: str
    output: str | None


def blocks(name: str, language: str = "") -> list[Block]:
    """Return the fenced blocks of a document in their order, of one language or of all."""
    found = [
        Block(kind, file or "", code, output)
        for kind, file, code, output in (match.groups() for match in _BLOCK.finditer((ROOT / name).read_text(encoding="utf-8")))
    ]
    return [block for block in found if language in ("", block.language)]


def table(name: str, heading: str) -> list[tuple[str, ...]]:
    """The rows of the table whose first heading is `heading`, each cell without its backquotes."""
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading} |")) + 2
    rows = []
    for line in lines[first:]:
        if not line.startswith("|"):
            break
        rows.append(tuple(cell.strip().strip("`") for cell in line.strip("|").split(" | ")))
    return rows
