"""Models that come with the package, by name: `zakai.gallery.names()`, `describe(name)`, `load(name)`."""

from __future__ import annotations

from importlib.resources import files

from zakai.errors import InputError
from zakai.models._errors import did_you_mean, echo, listing
from zakai.models.files import read_model
from zakai.models.model import Model

_FOLDER = files("zakai.models") / "gallery"


def names() -> tuple[str, ...]:
    """The names of all models of the gallery, in alphabetical order.

    >>> "benes" in names()
    True
    """
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _FOLDER.iterdir() if entry.name.endswith(".toml")))


def text(name: str) -> str:
    """The model file of this name. Raises InputError for an unknown name."""
    if name not in names():
        raise InputError(
            f"gallery:{echo(name, 40)[1:-1]}: there is no such model{did_you_mean(name, names())} "
            f"(the gallery holds {listing(names())})"
        )
    return (_FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def describe(name: str) -> str:
    """What this model is, in one line: the first line of its file. Raises InputError for an unknown name.

    >>> describe("benes")
    'Benes: drift tanh(x), observed directly; the classical nonlinear system with an exact filter.'
    """
    return text(name).splitlines()[0].removeprefix("#").strip()


def load(name: str) -> Model:
    """The model of this name. Raises InputError for an unknown name.

    >>> load("kalman-bucy-2d").n
    2
    """
    return read_model(text(name), f"gallery:{name}")
