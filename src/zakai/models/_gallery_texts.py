"""The model files that come with the package."""

from __future__ import annotations

import re
from importlib.resources import files

from zakai.errors import InputError
from zakai.models._errors import did_you_mean, echo, listing

_FOLDER = files("zakai.models") / "gallery"
# Example 3.6 of Dong, Chen and Yau (2021) is a family: its file is that of k = 1, and "-k6" after its name means k = 6.
_FAMILY = re.compile(r"dong-chen-yau-3-6-k([1-9][0-9]?)")


def names() -> tuple[str, ...]:
    """The names of all models of the gallery, in alphabetical order.

    >>> "benes" in names()
    True
    """
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _FOLDER.iterdir() if entry.name.endswith(".toml")))


def text(name: str) -> str:
    """The model file of this name. Raises InputError for an unknown name."""
    member = _FAMILY.fullmatch(name)
    if member:
        return _dong_chen_yau_3_6(int(member[1]))
    if name not in names():
        raise InputError(
            f"gallery:{echo(name, 40)[1:-1]}: there is no such model{did_you_mean(name, names())} "
            f"(the gallery holds {listing(names())})"
        )
    return (_FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def _dong_chen_yau_3_6(k: int) -> str:
    """The file of the example with another k."""
    drift = f"""drift = [
    "x1 + x2 + x3 + x4",
    "x1 - x2 - x3**{k} + x4**{k} + x2**{k + 1}*x3**{k + 3}",
    "x1 - x3 - x2**{k + 2} - x4**{k} + x3**{k + 5}*x4**{k} - x2**{k + 1}*x3**{k + 3}",
    "x1 - x4 + x2**{k + 2} + x3**{k} - x3**{k + 5}*x4**{k}",
]"""
    first = text("dong-chen-yau-3-6").replace("k = 1", f"k = {k}")
    return re.sub(r"(?m)^# For another k.*\n", "", re.sub(r"drift = \[[^\]]*\]", lambda _: drift, first))
