"""Show the formulas and the example of a docstring as they are typed.

An indented block before the first section is a formula, and what follows `Example:` is code; both become literal blocks. Tests
run the examples.
"""

from __future__ import annotations

import re
from typing import Any

_SECTION = re.compile(r"^(Args|Arguments|Returns|Yields|Raises|References|Example):$")


def as_typed(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite the lines of a docstring in place; examples with prompts are shown as they are."""
    shown: list[str] = []
    language, before, listed = "text", "", False
    for line in lines:
        text = line.strip()
        section = _SECTION.match(line)
        if section:
            language = "python" if section.group(1) == "Example" else ""
        elif text and not line.startswith(" "):
            listed = text.startswith("*")
        starts = bool(text) and line.startswith("    ") and not before.startswith("    ")
        if starts and language and not listed and not text.startswith(">>>") and (language == "python" or not before.strip()):
            shown += ["    .. code-block:: " + language if language == "python" else ".. code-block:: text", ""]
            if language == "python":
                language = "code"
        shown.append("    " + line if language == "code" and text and not section else line)
        before = line
    lines[:] = shown


def setup(app: Any) -> dict[str, Any]:
    """Connect before napoleon reads the sections."""
    app.connect("autodoc-process-docstring", as_typed, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
