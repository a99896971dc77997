"""Refuse an interval in which the density reaches infinity, or holds a pole of the drift: no grid holds such a density.

A path reaches infinity in a finite time only where the drift away from the density grows faster than the distance; it reaches a
pole c or not by the test of Feller, kappa = 2 f d / G < 1 at the distance d -> 0, where f is the drift away from c. Intervals in
which no path of the density comes far are not examined further.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.errors import InputError
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function, program_of
from zakai.numerics.escape import Ends, escape

Array = Any
Coefficients = Callable[[Array, Any], tuple[Array, Array]]

RARE = 1e-3  # share of paths that may escape: the error of a density without them is about that, and is reported
FAR = 10.0 ** np.arange(1, 10)  # distances at which the growth of the drift is seen
FASTER = 2.0  # ratio of d log |x| / dt there and nearby from which it may grow without limit
REACH = 8.0  # standard deviations, of the density and of the noise, that no path leaves
CHECKED = 1025  # points of the density among which poles are sought
MOST_POLES = 16
CLOSEST = 1e-5  # distance from a pole, in standard deviations of the density, that counts as the pole
NEAR = 0.3  # the same of a pole that is not reached, in those of the prediction: nearer, the density falls as a power of it
RARELY_NEAR = 1e-4  # share of paths that may come so near
UNTIL = "between t = START and STOP"
REFLECTING = ', boundary = "reflecting"'
STEEP = 300.0  # growth of |f| or G over a thousandth of the distance from a pole, which separates 1 / d from d^(-2/3)
EXACT = 1e-5  # by which kappa may miss its limit


class EscapeError(InputError):
    """A density escapes in an interval: `words` says so, with START and STOP for its times."""

    def __init__(self, words: str, row: int, start: float, length: float):
        super().__init__(words.replace("START", f"{start:.12g}").replace("STOP", f"{start + length:.12g}"))
        self.words, self.row, self.start, self.length = words, row, start, length

    def moved(self, start: float) -> EscapeError:
        """Return the error of an interval that is prepared as if it began at zero, with its own time."""
        return EscapeError(self.words, self.row, start, self.length)


@once_for_a_model
def divisors_of(model: Model) -> NumericFunction | None:
    """Return the function of the formulas of the state by which the drift and the noise are divided, None without any."""
    program, found = program_of([*model.drift, *model.covariance], model), []
    for instruction in program.instructions:
        if instruction.operation == "divide":
            found.append(program.instructions[instruction.operands[1]].expr)
        elif instruction.operation == "tan":
            found.append(sp.cos(instruction.expr.args[0]))
        elif instruction.operation == "general_power" and instruction.expr.args[1].could_extract_minus_sign():
            found.append(instruction.expr.args[0])
    divisors = tuple(dict.fromkeys(part for part in found if part.has(*model.x)))
    return numpy_function(list(divisors), model) if divisors else None


class Density(NamedTuple):
    """A density of one state at the start of an interval: points (N,), probabilities (N,)."""

    points: Array
    values: Array

    @property
    def moments(self) -> tuple[float, float]:
        """The mean and the standard deviation."""
        mean = float(self.values @ self.points)
        return mean, float(np.sqrt(max(self.values @ (self.points - mean) ** 2, 0.0)))


class Motion(NamedTuple):
    """The motion of one state in an interval.

    `model` has the formulas of the user, and `shown` returns a state of the user; `divisors` is None or a function of points
    (N,); `lower` and `upper` are ends that a path does not leave, or infinite; `row` is the number of the interval.
    """

    model: Model
    shown: Callable[[float], float]
    coefficients: Coefficients
    divisors: Callable[[Array], Array] | None
    lower: float
    upper: float
    row: int
    start: float
    length: float
    steady: bool

    def error(self, words: str) -> EscapeError:
        """Return the error of this interval."""
        return EscapeError(f"{self.model.source}: {words}", self.row, self.start, self.length)


def check_one_state(motion: Motion, density: Density) -> None:
    """Raise InputError where more than a thousandth of the paths escape, or a pole that no path crosses divides the density."""
    (mean, deviation), length = density.moments, motion.length
    if not (np.isfinite(mean) and deviation > 0):
        return

    def at(points: Array) -> tuple[Array, Array]:
        f, noise = motion.coefficients(points, 0.5 * length)
        return f, np.maximum(np.nan_to_num(noise), 0.0)

    divided = motion.divisors is not None
    growing = (np.isinf(motion.lower) and _grows(at, mean, deviation, -1.0)) or (
        np.isinf(motion.upper) and _grows(at, mean, deviation, 1.0)
    )
    if not (growing or divided):
        return
    counts = np.flatnonzero(density.values > 1e-12 * density.values.max())
    low, high = density.points[counts[[0, -1]]]
    width = high - low
    f, noise = at(np.linspace(low - width, high + width, 65))
    quiet = bool(np.max(np.abs(f)) * length + REACH * np.sqrt(np.max(noise) * length) < width)  # False for a NaN
    spread = np.sqrt(deviation**2 + float(density.values @ np.minimum(at(density.points)[1], 1e300)) * length)
    poles = _poles(motion, low - REACH * spread, high + REACH * spread, mean, deviation) if divided else []
    if not poles and (quiet or not growing):
        return
    margins = np.array([np.where(pole.reached, CLOSEST * deviation, NEAR * spread) for pole in poles]).reshape(-1, 2)
    ends = Ends(motion.lower, motion.upper, np.array([pole.place for pole in poles]), margins)
    starts, probabilities = escape(motion.coefficients, ends, mean, deviation, length, motion.steady)
    infinity, *escaped = (float(density.values @ np.interp(density.points, starts, column)) for column in probabilities.T)
    name = motion.model.state[0]
    if infinity > RARE:
        raise motion.error(infinite_text(motion.model, 0, name, infinity))
    below = [float(density.values[density.points < pole.place].sum()) for pole in poles]
    for pole, probability, share in sorted(zip(poles, escaped, below, strict=True), key=lambda one: -one[1]):
        infinite = f"{formula_text(pole.key, 0, motion.model)} is infinite at {name} = {motion.shown(pole.place):.6g}"
        sides = pole.reached[0] and share > RARE, pole.reached[1] and 1.0 - share > RARE
        if any(sides) and probability > RARE:
            raise motion.error(
                f"{infinite}, which paths reach {UNTIL} with probability {probability:.2g}, and it does not say what follows; "
                f"give {_domain(motion, poles, mean, REFLECTING)} if {name} is reflected there, or another formula"
            )
        divides = min(share, 1.0 - share) > RARE
        # A grid that holds the tails of the density holds the pole, and no number of steps is enough beside it.
        held = low <= pole.place <= high
        if divides or ((held or probability > RARELY_NEAR) and not any(sides)):
            what = f"has {share:.2g} of its mass below" if divides else f"comes close to it {UNTIL}"
            raise motion.error(
                f"{infinite}; no path crosses it, and the density {what}; give {_domain(motion, poles, mean)} and a prior "
                "inside, or another formula"
            )


def _domain(motion: Motion, poles: list[Pole], mean: float, boundary: str = "") -> str:
    """Return the domain between the poles on both sides of a mean as in a model file."""
    lower, upper = [p.place for p in poles if p.place <= mean], [p.place for p in poles if p.place > mean]
    ends = [f"lower = {motion.shown(lower[-1]):.6g}"] if lower else []
    ends += [f"upper = {motion.shown(upper[0]):.6g}"] if upper else []
    return f"[domain] {motion.model.state[0]} = {{ {', '.join(ends)}{boundary} }}"


def _grows(at: Callable[[Array], tuple[Array, Array]], mean: float, deviation: float, side: float) -> bool:
    """Return whether the drift away from the density grows faster than the distance."""
    unit = max(abs(mean) + deviation, 1.0)
    distance = FAR * unit
    rates = side * at(side * distance)[0] / distance
    rates = np.where(np.isnan(rates), -np.inf, rates)
    return bool(np.max(rates) > FASTER * max(rates[0], 0.0) and np.max(rates) > 0)


class Pole(NamedTuple):
    """A place where a formula is infinite, whether paths reach it from below and above, and the key of that formula."""

    place: float
    reached: tuple[bool, bool]
    key: str


def _poles(motion: Motion, low: float, high: float, mean: float, deviation: float) -> list[Pole]:
    """Return the poles of the drift and the noise in a range, at most the sixteen next to the mean, sorted."""
    if motion.divisors is None:
        return []
    places = _zeros(motion.divisors, np.linspace(max(low, motion.lower), min(high, motion.upper), CHECKED))
    found: list[Pole] = []
    for place in sorted(places, key=lambda place: abs(place - mean))[: 4 * MOST_POLES]:
        pole = _pole_at(motion, place, deviation)
        if pole is not None and len(found) < MOST_POLES:
            found.append(pole)
    return sorted(found)


def _pole_at(motion: Motion, place: float, scale: float) -> Pole | None:
    distances = scale * np.array([1e-3, 1e-6])
    reached, key = [], ""
    for side in (-1.0, 1.0):
        f, noise = motion.coefficients(place + side * distances, 0.5 * motion.length)
        steep = [bool(np.abs(a[1]) > STEEP * np.abs(a[0])) for a in (f, noise)]
        key = key or ("drift" if steep[0] else "diffusion" if steep[1] else "")
        away, G = float(side * f[1]), float(noise[1])
        reached.append(any(steep) and (2.0 * away * distances[1] < (1.0 - EXACT) * G if G > 0 else away < 0))
    return Pole(place, (reached[0], reached[1]), key) if key else None


def _zeros(function: Callable[[Array], Array], points: Array) -> list[float]:
    """Return the zeros of functions (N, D) of points (N,), sorted: changes of sign, and minima of the absolute value."""
    values = function(points)
    size = np.abs(values)
    rows, columns = np.nonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    low, high = points[rows], points[rows + 1]
    sign = np.sign(values[rows, columns])
    for _ in range(80):
        middle = 0.5 * (low + high)
        same = np.sign(function(middle)[np.arange(len(middle)), columns]) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    found = [*(0.5 * (low + high)).tolist(), *points[(size == 0).any(axis=1)].tolist()]
    middle, others = size[1:-1], (size[:-2], size[2:])
    # A parabola that touches zero is nine times as large at one of the two points next to its smallest value, or more.
    touching = (middle > 0) & (middle < np.minimum(*others)) & (4.0 * middle < np.maximum(*others))
    rows, columns = np.nonzero(touching)
    low, high, bound = points[rows], points[rows + 2], size[rows + 1, columns]
    for _ in range(80):
        inner = low + (high - low) * np.array([[0.382], [0.618]])
        first, second = (np.abs(function(x)[np.arange(len(x)), columns]) for x in inner)
        low, high = np.where(first > second, inner[0], low), np.where(first > second, high, inner[1])
    middle = 0.5 * (low + high)
    least = np.abs(function(middle)[np.arange(len(middle)), columns])
    found += middle[least < 1e-9 * bound].tolist()
    least_apart = 1e-9 * (points[-1] - points[0])
    found = sorted(0.0 if abs(place) < least_apart else place for place in found)
    return [place for place, before in zip(found, [-np.inf, *found], strict=False) if place - before > least_apart]


def infinite_text(model: Model, row: int, names: str, share: float) -> str:
    """Return the message about states that reach infinity; `row` is that of the drift which takes them there."""
    return (
        f"{formula_text('drift', row, model)} takes {names} to infinity {UNTIL} with probability {share:.2g}, so that there is "
        "no density to filter; give shorter intervals, a narrower prior, or a drift that grows no faster than the state"
    )


def formula_text(key: str, row: int, model: Model) -> str:
    """Return the first formula of a row of a key with its name."""
    formulas = getattr(model, key)
    text = str(formulas[row, 0])
    return f"{key}[{row}] = {text if len(text) <= 80 else text[:77] + '...'}"
