"""The folder in which compiled kernels are kept: the user's, never that of the package.

Numba compiles a kernel again where its own file has changed, and not where a function or a constant has that it imports.  Kernels
are therefore kept in a folder for the text of their module and of all modules of this package that it imports.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numba

_CONFIG: Any = numba.config  # of which CACHE_DIR is the environment variable NUMBA_CACHE_DIR
_IMPORT = re.compile(r"^(?:from|import) (zakai[\w.]*)(?: import ([^\n(]*))?", re.MULTILINE)
OLD = 30 * 86400.0  # seconds after which kernels of another text are deleted


@cache
def folder() -> Path | None:
    """Return the folder of the compiled kernels, None where none can be written.

    It is `NUMBA_CACHE_DIR` where that is set, else a folder of this version of zakai in the user's cache folder, else one in the
    folder of temporary files that belongs to this user alone.  The first that can be written is taken.
    """
    if _CONFIG.CACHE_DIR:
        return Path(_CONFIG.CACHE_DIR) if _is_writable(Path(_CONFIG.CACHE_DIR)) else None
    try:
        name = version("zakai")
    except PackageNotFoundError:
        name = "unknown"
    own = _of_user()
    if own is not None and _is_writable(own / "zakai" / name):
        return own / "zakai" / name
    try:
        temporary = Path(tempfile.gettempdir()) / f"zakai-{_user()}"
    except OSError:
        return None
    # Compiled code is executed: in a folder that all may write to, it must be of this user.
    return temporary / name if _is_writable(temporary) and _is_private(temporary) and _is_writable(temporary / name) else None


@cache
def folder_of(module: str) -> Path | None:
    """Return the folder of the kernels of a module, None where none can be written."""
    parent = folder()
    if parent is None:
        return None
    texts = sorted(_text(name) for name in _imported(module))
    own = parent / module.rpartition(".")[2] / hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]
    for other in own.parent.glob("*") if not own.exists() else ():
        if time.time() - other.stat().st_mtime > OLD:
            shutil.rmtree(other, ignore_errors=True)
    return own if _is_writable(own) else None


def _imported(module: str) -> set[str]:
    """Return a module and all modules of this package that it imports, or that these import."""
    found, left = set[str](), [module]
    while left:
        name = left.pop()
        if name in found or name not in sys.modules:
            continue
        found.add(name)
        for source, names in _IMPORT.findall(_text(name)):
            left += [source, *(f"{source}.{part.split()[0]}" for part in names.split(",") if part.split())]
    return found


@cache
def _text(module: str) -> str:
    """Return the text of a module, nothing where there is none."""
    try:
        return Path(sys.modules[module].__file__ or "").read_text(encoding="utf-8")
    except (OSError, TypeError, AttributeError):
        return ""


@contextmanager
def caching(module: str) -> Iterator[bool]:
    """Let Numba keep the kernels of a module that are declared inside in their folder; yield whether there is one."""
    where, before = folder_of(module), _CONFIG.CACHE_DIR
    if where is not None:
        _CONFIG.CACHE_DIR = str(where)
    try:
        yield where is not None
    finally:
        _CONFIG.CACHE_DIR = before


def _of_user() -> Path | None:
    """Return the cache folder of the user on this platform, None without a home."""
    if sys.platform == "win32":
        named = os.environ.get("LOCALAPPDATA", "")
    elif sys.platform == "darwin":
        named = os.path.expanduser("~/Library/Caches")
    else:
        named = os.environ.get("XDG_CACHE_HOME", "")
        named = named if os.path.isabs(named) else os.path.expanduser("~/.cache")
    return Path(named) if os.path.isabs(named) else None


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")


def _is_writable(path: Path) -> bool:
    """Return whether a folder is there, or can be made, and files can be written to it."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return True
    except OSError:
        return False


def _is_private(path: Path) -> bool:
    """Return whether a folder belongs to this user, and no other one can write to it."""
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return False
    return not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o022)
