"""Offer every tutorial as a Jupyter notebook: the text of its page, and its blocks with the outputs of this build.

`executed_blocks` runs the blocks of a page and sends them with their outputs. This extension writes the notebook and links it
from the page. The page is the only source of the text.
"""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any

from docutils import nodes

FOLDER = "tutorials/"
_FENCE = re.compile(r"^```(?:\{code-block\} )?(\w+)\n(?::caption: (\S+)\n)?(.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\.md(?:#[^)]*)?\)")


def notebook(source: str, outputs: list[tuple[str, list[bytes]]]) -> dict[str, Any]:
    """Return a page as a notebook.

    Args:
        source: The MyST text of the page.
        outputs: What each block of the page printed, and the PNG files of its figures, in the order of the blocks.

    Returns:
        The notebook, as JSON. A shell block is a cell `%%bash`, and a block with a caption a cell `%%writefile`.
    """
    cells: list[dict[str, Any]] = []
    remaining, end = iter(outputs), 0

    def markdown(text: str) -> None:
        if text.strip():
            cells.append({"cell_type": "markdown", "metadata": {}, "source": _LINK.sub(r"\1", text.strip())})

    def code(text: str, printed: str, figures: list[bytes]) -> None:
        shown: list[dict[str, Any]] = [{"output_type": "stream", "name": "stdout", "text": printed}] if printed else []
        for figure in figures:
            data = {"image/png": base64.b64encode(figure).decode()}
            shown.append({"output_type": "display_data", "data": data, "metadata": {}})
        cell = {"cell_type": "code", "execution_count": None, "metadata": {}, "outputs": shown}
        cells.append({**cell, "source": text.rstrip("\n")})

    for block in _FENCE.finditer(source):
        language, file, text = block.groups()
        printed, figures = next(remaining)
        first = {"python": "", "sh": "%%bash\n"}.get(language, f"%%writefile {file}\n" if file else None)
        if first is None:
            continue  # text that nobody runs: part of the next markdown cell
        markdown(source[end : block.start()])
        code(first + text, printed, figures)
        end = block.end()
    markdown(source[end:])
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def write(app: Any, page: str, doctree: nodes.document, outputs: list[tuple[str, list[bytes]]]) -> None:
    """Write the notebook of a tutorial, and link it below the title of the page."""
    if not page.startswith(FOLDER):
        return
    path = Path(app.srcdir) / "_generated" / f"{page}.ipynb"
    path.parent.mkdir(parents=True, exist_ok=True)
    content = notebook(Path(app.env.doc2path(page)).read_text(encoding="utf-8"), outputs)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    link = nodes.reference("", "Download this page as a notebook", refuri=path.name, internal=False)
    doctree.next_node(nodes.title).parent.insert(1, nodes.paragraph("", "", link, classes=["notebook"]))


def copy(app: Any, error: Exception | None) -> None:
    """Copy the notebooks beside their pages."""
    for path in [] if error else sorted((Path(app.srcdir) / "_generated" / FOLDER).glob("*.ipynb")):
        shutil.copy(path, Path(app.outdir) / FOLDER / path.name)


def setup(app: Any) -> dict[str, Any]:
    """Register the extension; `executed_blocks` is loaded before."""
    app.connect("blocks-executed", write)
    app.connect("build-finished", copy)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
