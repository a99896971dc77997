"""The versions of what computed a result, which are stored with it."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version
from typing import Any


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return the versions of what computed a result."""
    return {f"version_{name}": version(name) for name in ("zakai", "numba", "numpy", "scipy", "sympy")}


def other_versions(stored: Any) -> str:
    """Return the names of the packages of which a file has not the versions in use, joined by commas."""
    stored = stored if isinstance(stored, dict) else {}
    return ", ".join(name.removeprefix("version_") for name, own in versions().items() if stored.get(name) != own)
