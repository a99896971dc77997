"""Run the code blocks of a page, and show what they print and draw.

The blocks of a page run in their order, in one namespace and one empty folder. `python` blocks are executed, `sh` blocks go to
bash, and a `toml` or `csv` block with a caption is written to the file that the caption names. Other blocks are shown only.
Figures that a `python` block leaves open are drawn below it; the title of a figure is its alternative text.

The Sphinx extension inserts the output into the page; the tests call `run` on the same blocks.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from docutils import nodes


class Output(NamedTuple):
    """What a block prints, and the Matplotlib figures that it leaves open."""

    text: str
    figures: list[Any]


class Session:
    """The namespace and the folder in which the blocks of one page run."""

    def __init__(self, folder: str | os.PathLike[str], name: str) -> None:
        self.folder, self.name = Path(folder), name
        self.names: dict[str, Any] = {"__name__": "__main__"}

    def run(self, language: str, code: str, file: str = "") -> Output:
        """Run one block.

        Args:
            language: The language of the block.
            code: Its text.
            file: Its caption: the name of a file, for `toml` and `csv`.

        Returns:
            What it printed, and the figures that it left open.

        Raises:
            RuntimeError: A command failed.
            Exception: Whatever the block raises.
        """
        if language == "python":
            return self._python(code)
        if language == "sh":
            return Output(self._shell(code), [])
        if file:
            (self.folder / file).write_text(code + "\n", encoding="utf-8")
        return Output("", [])

    def _python(self, code: str) -> Output:
        printed = io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(printed):
            exec(compile(code, self.name, "exec"), self.names)
        pyplot = sys.modules.get("matplotlib.pyplot")
        figures = [pyplot.figure(number) for number in pyplot.get_fignums()] if pyplot else []
        if pyplot:
            pyplot.close("all")
        return Output(printed.getvalue(), figures)

    def _shell(self, code: str) -> str:
        path = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])
        done = subprocess.run(
            ["bash", "-e", "-o", "pipefail", "-c", code],
            cwd=self.folder,
            env={**os.environ, "PATH": path, "COLUMNS": "110"},
            capture_output=True,
            encoding="utf-8",
        )
        if done.returncode:
            raise RuntimeError(f"{self.name}: the command failed with exit code {done.returncode}:\n{code}\n{done.stderr}")
        return done.stdout


def _blocks(doctree: nodes.document) -> Iterator[tuple[nodes.Element, str, str, str]]:
    """Yield node to insert after, language, text and caption of every literal block."""
    for block in list(doctree.findall(nodes.literal_block)):
        around, caption = block.parent, ""
        if isinstance(around, nodes.container) and around.get("literal_block"):
            caption = around.next_node(nodes.caption).astext()
            yield around, block.get("language", ""), block.astext(), caption
        else:
            yield block, block.get("language", ""), block.astext(), caption


def _title(figure: Any) -> str:
    titles = (axes.get_title(loc=at) for axes in figure.axes for at in ("center", "left"))
    title = figure.get_suptitle() or next((text for text in titles if text), "")
    if not title:
        raise ValueError("a figure needs a title, which is its alternative text")
    return str(title)


def insert_outputs(app: Any, doctree: nodes.document) -> None:
    """Run the blocks of a page that Sphinx has read, and put their outputs behind them."""
    page = app.env.docname
    if "/generated/" in page:  # docstrings: tests run their examples
        return
    blocks = list(_blocks(doctree))
    if not any(language in ("python", "sh") for _, language, _, _ in blocks):
        return
    pictures = Path(app.srcdir) / "_generated"
    pictures.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        session, count = Session(folder, page), 0
        outputs: list[tuple[str, list[bytes]]] = []
        for node, language, code, caption in blocks:
            text, figures = session.run(language, code, caption)
            shown: list[nodes.Node] = []
            if text.strip():
                shown.append(nodes.literal_block(text, text.rstrip("\n"), language="text", classes=["output"]))
            outputs.append((text, []))
            for figure in figures:
                count += 1
                name = f"{page.replace('/', '-')}-{count}.png"
                figure.savefig(pictures / name, dpi=144, metadata={"Software": None})
                outputs[-1][1].append((pictures / name).read_bytes())
                shown.append(nodes.image(uri=f"/_generated/{name}", alt=_title(figure), classes=["output"]))
            place = node.parent.index(node) + 1
            node.parent[place:place] = shown
    app.emit("blocks-executed", page, doctree, outputs)


def setup(app: Any) -> dict[str, Any]:
    """Register the extension: before images are collected, which happens at priority 500."""
    app.add_event("blocks-executed")
    app.connect("doctree-read", insert_outputs, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
