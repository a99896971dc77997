"""The scripts of the pictures, as one text that a page or a notebook holds."""

from __future__ import annotations

import base64
import hashlib
import re
import zlib
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

_COLUMNS, _ROWS = 600, 128  # of the picture of a notebook
_MODULES = ("axes", "panel", "density", "plane", "chart")
_IMPORT = re.compile(r'^import \{([^}]*)\} from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:class|function|const) (\w+))", re.MULTILINE)
_COMMENT = re.compile(r"^ *(?://[^\n]*|/\*\*.*?\*/)\n|^ +", re.MULTILINE | re.DOTALL)  # on lines of their own, and indentation
# Nothing is fetched, whatever a file that was put into the page says, and no script runs but ours.
_POLICY = "default-src 'none'; script-src '{script}'; style-src 'unsafe-inline'"


@cache
def bundle(last: str) -> str:
    """Return the modules of the pictures and the module `last` as one script without imports.

    A module becomes a function that returns what it exports, so that names within it stay its own.
    """
    parts = []
    for name in (*_MODULES, last):
        text = _COMMENT.sub("", files("zakai.report").joinpath("static", f"{name}.js").read_text(encoding="utf-8"))
        exported = _EXPORT.findall(text)
        text = _EXPORT.sub("", _IMPORT.sub(r"const {\1} = $\2;", text))
        parts.append(f"const ${name} = (() => {{\n{text}return {{ {', '.join(exported)} }};\n}})();\n")
    return '"use strict";\n' + "".join(parts)


def script() -> str:
    """Return the element that draws the pictures of a page; it stands after them."""
    return f"<script>{bundle('page')}</script>"


def policy() -> str:
    """Return the element that forbids a page to fetch anything and to run any script but that of `script`."""
    digest = base64.b64encode(hashlib.sha256(bundle("page").encode()).digest()).decode()
    return f'<meta http-equiv="Content-Security-Policy" content="{_POLICY.format(script=f"sha256-{digest}")}">'


def picture(kind: str, frame: bytes, identifier: str, height: int = 0) -> str:
    """Return the element of a picture: its kind ("density", "plane" or "chart") and its frame."""
    packed = base64.b64encode(zlib.compress(frame, 9)).decode()
    size = f' data-height="{height}"' if height else ""
    return (
        f'<div data-zakai="{kind}" data-frame="{escape(identifier)}"{size}></div>'
        f'<script type="application/octet-stream" id="{escape(identifier)}">{packed}</script>'
    )


def framed(kind: str, frame: bytes, identifier: str, note: str = "", height: int = 0) -> str:
    """Return a picture with its caption."""
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    return f"<figure>{picture(kind, frame, identifier, height)}{caption}</figure>"


def embedded(kind: str, frame: bytes, label: str, height: int = 360) -> str:
    """Return a picture for a notebook: a document of its own, so that nothing of it reaches the notebook, nor the reverse."""
    page = (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">{policy()}<title>{escape(label)}</title></head>'
        f'<body style="margin:4px">{picture(kind, frame, "picture", height)}{script()}</body></html>'
    )
    return (
        f'<iframe title="{escape(label)}" sandbox="allow-scripts" srcdoc="{escape(page)}" loading="lazy" '
        f'style="width:100%;height:{height + 56}px;border:0"></iframe>'
    )


def notebook_picture(result: Any) -> str:
    """Return the density over time of the first state of a result, for a notebook."""
    from zakai.report.heatmap import state_names
    from zakai.report.picture import picture_bytes

    return embedded("density", picture_bytes(result, 0, None, _COLUMNS, _ROWS), f"Density of {state_names(result)[0]} over time")
