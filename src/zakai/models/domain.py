"""Where a state lives: an interval with natural or reflecting ends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.errors import InputError
from zakai.models._entries import kind_of, known_keys, number
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models.prior import DensityPrior, GaussianPrior, MixturePrior

if TYPE_CHECKING:
    from zakai.models.model import Model

BOUNDARIES = ("natural", "reflecting")
NEGLIGIBLE = 1e-6  # probability of a prior outside of the domain


class Interval(NamedTuple):
    """The states between `lower` and `upper`, which may be infinite.

    The process does not reach a natural end, or enters from it; a reflecting end returns it.
    """

    lower: float = -math.inf
    upper: float = math.inf
    boundary: str = "natural"

    def __str__(self) -> str:
        return f"in ({self.lower:g}, {self.upper:g}), {self.boundary}"

    @property
    def reflecting(self) -> bool:
        """Whether the finite ends reflect."""
        return self.boundary == "reflecting"

    @property
    def bounded(self) -> bool:
        """Whether both ends are finite."""
        return math.isfinite(self.upper - self.lower)

    def contains(self, x: Any) -> NDArray[np.bool_]:
        """Return where x is inside; a reflecting end belongs to the domain, a natural one does too, as the limit of paths."""
        return np.asarray((x >= self.lower) & (x <= self.upper))

    def reflected(self, x: Any) -> Any:
        """Return x, mirrored at the ends until it is inside."""
        if self.bounded:
            width = self.upper - self.lower
            place = np.mod(x - self.lower, 2 * width)
            return self.lower + np.minimum(place, 2 * width - place)
        if math.isfinite(self.lower):
            return self.lower + np.abs(x - self.lower)
        return self.upper - np.abs(self.upper - x)

    def from_line(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the states inside that numbers y of the line stand for, by a logarithm at each finite end, and log dx/dy."""
        if self.bounded:
            width, share = self.upper - self.lower, -np.logaddexp(0.0, -y)
            return self.lower + width * np.exp(share), np.log(width) + share - np.logaddexp(0.0, y)
        if math.isfinite(self.lower):
            return self.lower + np.exp(y), y
        return (self.upper - np.exp(y), y) if math.isfinite(self.upper) else (y, np.zeros_like(y))

    def keys(self) -> dict[str, Any]:
        """Return the interval as the keys of a model file."""
        ends = {"lower": self.lower, "upper": self.upper}
        kept: dict[str, Any] = {key: end for key, end in ends.items() if math.isfinite(end)}
        return kept if self.boundary == "natural" else {**kept, "boundary": self.boundary}


def read_domain(keys: Any, state: tuple[str, ...], periodic: tuple[str, ...]) -> dict[str, Interval]:
    """Return the interval of every state that has one.

    Raises:
        InputError: by the name of the state.
    """
    if not isinstance(keys, Mapping):
        raise InputError(f"expected a table such as x = {{ lower = 0.0 }}, got {kind_of(keys)}")
    domain = {}
    for name, given in keys.items():
        if name not in state:
            raise InputError(f"{echo(name, 40)} is not a state{did_you_mean(str(name), state)} (the states are {listing(state)})")
        with named(str(name)):
            domain[name] = _interval(given)
            if name in periodic:
                raise InputError("is periodic, and a circle has no ends; take it out of periodic or of domain")
    return domain


def _interval(given: Any) -> Interval:
    if isinstance(given, Interval):
        given = given.keys()
    if not isinstance(given, Mapping):
        raise InputError(f"expected a table such as {{ lower = 0.0, upper = 1.0 }}, got {kind_of(given)}")
    known_keys(given, ("lower", "upper", "boundary"))
    ends = {}
    for key in ("lower", "upper"):
        if key in given:
            with named(key):
                ends[key] = number(given[key])
    if not ends:
        raise InputError("lower: missing; give lower, upper or both")
    boundary = given.get("boundary", "natural")
    if not isinstance(boundary, str) or boundary not in BOUNDARIES:
        hint = did_you_mean(boundary, BOUNDARIES) if isinstance(boundary, str) else ""
        raise InputError(f"boundary: expected one of {listing(BOUNDARIES)}, got {kind_of(boundary)}{hint}")
    interval = Interval(**ends, boundary=boundary)
    if not interval.lower < interval.upper:
        raise InputError(f"lower: {interval.lower:g} is not less than upper, {interval.upper:g}")
    return interval


def check_prior(model: Model, prior: Any) -> None:
    """Raise InputError where a Gaussian or mixture prior has more than 1e-6 of its mass outside of the domain."""
    if prior is None or isinstance(prior, DensityPrior):
        return
    for name, interval in model.domain.items():
        column = model.state.index(name)
        outside = _mass_outside(prior, column, interval)
        if outside > NEGLIGIBLE:
            raise InputError(
                f"prior: {outside:.2g} of it is outside of the domain of {name!r}, {interval}; "
                'give a prior inside, such as kind = "density", which counts inside of the domain only'
            )


def _mass_outside(prior: GaussianPrior | MixturePrior, column: int, interval: Interval) -> float:
    weights, means, covs = prior.components
    total = 0.0
    for weight, mean, variance in zip(weights, means[:, column], covs[:, column, column], strict=True):
        if variance == 0:
            total += weight * float(not interval.contains(mean))
            continue
        scale = math.sqrt(2 * variance)
        total += weight * 0.5 * (math.erfc((mean - interval.lower) / scale) + math.erfc((interval.upper - mean) / scale))
    return float(total)
