"""Models that come with the package, by name: `zakai.gallery.names()`, `describe(name)`, `load(name)`."""

from __future__ import annotations

from zakai.models._gallery_texts import names, text
from zakai.models.files import read_model
from zakai.models.model import Model

__all__ = ["describe", "load", "names", "text"]


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
