"""Priors of parameters: their text, the transform to the whole real line, and their density there."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import betaln, expit, gammaln, log_expit, logit

from zakai.errors import InputError
from zakai.models._errors import did_you_mean, listing

DIFFERENCE = 1e-5  # of u in derivatives; their relative error is about 1e-10
_TEXT = re.compile(r"\s*([A-Za-z-]+)\s*\(([^()]*)\)\s*")


class _Family(NamedTuple):
    """A family: the names of its arguments, which of them must be positive, and three functions of u and the arguments.

    `value` is the parameter at u, `place` its inverse, `log_density` that of u (with the Jacobian of the transform).
    """

    arguments: tuple[str, ...]
    positive: tuple[str, ...]
    value: Callable[..., float]
    place: Callable[..., float]
    log_density: Callable[..., float]


def _log_normal(u: float, mean: float, deviation: float) -> float:
    return float(-0.5 * ((u - mean) / deviation) ** 2 - np.log(deviation) - 0.5 * np.log(2 * np.pi))


_FAMILIES: Mapping[str, _Family] = {
    "normal": _Family(("mean", "standard deviation"), ("standard deviation",), lambda u, m, s: u, lambda x, m, s: x, _log_normal),
    "lognormal": _Family(
        ("mean of the logarithm", "standard deviation of the logarithm"),
        ("standard deviation of the logarithm",),
        lambda u, m, s: np.exp(u),
        lambda x, m, s: np.log(x),
        _log_normal,
    ),
    "half-normal": _Family(
        ("scale",),
        ("scale",),
        lambda u, s: np.exp(u),
        lambda x, s: np.log(x),
        lambda u, s: np.log(2) + _log_normal(np.exp(u), 0.0, s) + u,
    ),
    "gamma": _Family(
        ("shape", "rate"),
        ("shape", "rate"),
        lambda u, a, b: np.exp(u),
        lambda x, a, b: np.log(x),
        lambda u, a, b: a * (u + np.log(b)) - b * np.exp(u) - gammaln(a),
    ),
    "uniform": _Family(
        ("low", "high"),
        (),
        lambda u, a, b: a + (b - a) * expit(u),
        lambda x, a, b: logit((x - a) / (b - a)),
        lambda u, a, b: log_expit(u) + log_expit(-u),
    ),
    "beta": _Family(
        ("a", "b"),
        ("a", "b"),
        lambda u, a, b: expit(u),
        lambda x, a, b: logit(x),
        lambda u, a, b: a * log_expit(u) + b * log_expit(-u) - betaln(a, b),
    ),
}


class Prior:
    """The prior of one parameter, by a number u on the whole real line."""

    def __init__(self, name: str, text: object):
        where = f"priors: {name}"
        match = _TEXT.fullmatch(text) if isinstance(text, str) else None
        if match is None:
            raise InputError(f'{where}: {text!r} is not a prior; give a text such as "normal(0, 1)"')
        kind = match[1].lower()
        if kind not in _FAMILIES:
            hint = did_you_mean(kind, tuple(_FAMILIES))
            raise InputError(f'{where}: there is no prior "{kind}"{hint}; the priors are {listing(_FAMILIES)}')
        family = _FAMILIES[kind]
        try:
            numbers = tuple(float(word) for word in match[2].split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != len(family.arguments) or not np.isfinite(numbers).all():
            raise InputError(f"{where}: {text!r}: expected {kind}({', '.join(family.arguments)}) with finite numbers")
        for argument, number in zip(family.arguments, numbers, strict=True):
            if argument in family.positive and number <= 0:
                raise InputError(f"{where}: {text!r}: the {argument} is {number:g}; it must be positive")
        if kind == "uniform" and not numbers[0] < numbers[1]:
            raise InputError(f"{where}: {text!r}: low is not below high")
        self.family, self.numbers = family, numbers

    def value(self, u: float) -> float:
        """Return the parameter at u."""
        return float(self.family.value(u, *self.numbers))

    def log_density(self, u: float) -> float:
        """Return the log density of u."""
        return float(self.family.log_density(u, *self.numbers))

    def slopes(self, u: float) -> tuple[float, float]:
        """Return the derivatives of the parameter and of the log density by u, by central differences."""
        above, below = u + DIFFERENCE, u - DIFFERENCE
        value = self.value(above) - self.value(below)
        return value / (above - below), (self.log_density(above) - self.log_density(below)) / (above - below)

    def place(self, value: float) -> float:
        """Return u for a value of the parameter; where the prior excludes it, u = 0."""
        with np.errstate(all="ignore"):
            u = float(self.family.place(float(value), *self.numbers))
        return u if np.isfinite(u) and abs(u) < 50 else 0.0
