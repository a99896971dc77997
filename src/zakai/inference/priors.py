"""Priors of parameters: their text, the transform to the whole real line, and their density there."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import betaln, gammaln, log_expit

from zakai.densities.mapped import IntervalMap
from zakai.errors import InputError
from zakai.models._errors import did_you_mean, listing

DIFFERENCE = 1e-5  # of u in derivatives; their relative error is about 1e-10
_TEXT = re.compile(r"\s*([A-Za-z-]+)\s*\(([^()]*)\)\s*")


class _Family(NamedTuple):
    """A family: the names of its arguments, its log density in u, and the interval of the parameter, None for the whole line."""

    arguments: tuple[str, ...]
    log_density: Callable[..., float]
    interval: Callable[..., IntervalMap] | None = None


def _log_normal(u: float, mean: float, deviation: float) -> float:
    return float(-0.5 * ((u - mean) / deviation) ** 2 - np.log(deviation) - 0.5 * np.log(2 * np.pi))


def _positive(*numbers: float) -> IntervalMap:
    return IntervalMap(0.0, np.inf)


_ANY = ("mean", "mean of the logarithm", "low", "high")  # arguments that need not be positive
_FAMILIES: Mapping[str, _Family] = {
    "normal": _Family(("mean", "standard deviation"), _log_normal),
    "lognormal": _Family(("mean of the logarithm", "standard deviation of the logarithm"), _log_normal, _positive),
    "half-normal": _Family(("scale",), lambda u, s: np.log(2) + _log_normal(np.exp(u), 0.0, s) + u, _positive),
    "gamma": _Family(("shape", "rate"), lambda u, a, b: a * (u + np.log(b)) - b * np.exp(u) - gammaln(a), _positive),
    "uniform": _Family(("low", "high"), lambda u, a, b: log_expit(u) + log_expit(-u), IntervalMap),
    "beta": _Family(
        ("a", "b"), lambda u, a, b: a * log_expit(u) + b * log_expit(-u) - betaln(a, b), lambda a, b: IntervalMap(0.0, 1.0)
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
            if argument not in _ANY and number <= 0:
                raise InputError(f"{where}: {text!r}: the {argument} is {number:g}; it must be positive")
        if kind == "uniform" and not numbers[0] < numbers[1]:
            raise InputError(f"{where}: {text!r}: low is not below high")
        self.family, self.numbers = family, numbers
        self.interval = None if family.interval is None else family.interval(*numbers)

    def value(self, u: float) -> float:
        """Return the parameter at u."""
        return u if self.interval is None else float(self.interval.x(np.asarray(u)))

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
            u = float(value if self.interval is None else self.interval.w(np.asarray(float(value))))
        return u if np.isfinite(u) and abs(u) < 50 else 0.0
