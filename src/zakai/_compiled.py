"""What is compiled is kept on disk, so that the second run of a model starts at once.

In the user's cache folder (`XDG_CACHE_HOME`, or `~/.cache`; `LOCALAPPDATA` on Windows), under `zakai/compiled`, or in that which
`ZAKAI_CACHE` names; where it is empty nothing is kept.  A folder that JAX's own `JAX_COMPILATION_CACHE_DIR` names comes first.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

MOST_BYTES = 512 * 2**20
WORTH_KEEPING = "0.05"  # seconds of compilation; to read one takes some milliseconds


def keep() -> None:
    """Name the folder to JAX, imported or not; nothing happens where it cannot be written."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or os.environ.get("ZAKAI_CACHE") == "":
        return
    try:
        folder = _folder()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return
        _forget_oldest(folder)
    except (OSError, RuntimeError):  # there may be no home
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    if "jax" in sys.modules:
        config = sys.modules["jax"].config
        if config.jax_compilation_cache_dir is None:
            config.update("jax_compilation_cache_dir", str(folder))
            config.update("jax_persistent_cache_min_compile_time_secs", float(WORTH_KEEPING))
            config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _folder() -> Path:
    base = os.environ.get("ZAKAI_CACHE")
    if base:
        return Path(base)
    local = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else None)
    return (Path(local) if local else Path.home() / ".cache") / "zakai" / "compiled"


def _forget_oldest(folder: Path) -> None:
    """Delete what was not used for longest, down to half of what may be kept."""
    files = [(entry.stat(), entry.path) for entry in os.scandir(folder) if entry.is_file(follow_symlinks=False)]
    total = sum(state.st_size for state, _ in files)
    if total <= MOST_BYTES:
        return
    for state, path in sorted(files, key=lambda file: max(file[0].st_atime, file[0].st_mtime)):
        if total <= MOST_BYTES / 2:
            return
        Path(path).unlink(missing_ok=True)
        total -= state.st_size
