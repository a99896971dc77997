"""Values of formulas in ball arithmetic: a ball that excludes zero proves that a formula is not identically zero.

A formula is evaluated along a line x0 + s d as a truncated power series in s, with derivatives in independent infinitesimals
where they are asked for.  Coefficients are balls of 256 bits (Johansson 2017): rounding is inside of them, so that a
refutation is rigorous and the point is its witness.  A series of balls that contain zero proves nothing.

    F. Johansson, Arb: efficient arbitrary-precision midpoint-radius interval arithmetic, IEEE Trans. Comput. 66 (2017).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from threading import RLock

import sympy as sp
from flint import arb, arb_series, ctx, fmpq
from sympy.core.function import AppliedUndef

from zakai.models.functions import Floor, Maximum, Minimum, Sinc, TableFunction

BITS = 256
TERMS = 5  # of a power series: four derivatives along a line
LINES = 2  # that refute most of what is false
POINTS = 12  # that count as evidence where there is no proof
PRECISE = 1e-40  # radius of a ball up to which it is evidence for zero
LARGEST_ARGUMENT = 10**6  # of an exponential and its like: more has no digits
SATURATED = 80  # argument of an exponential and its like from which a sum may lose it in so many bits
SEED = 20170111
TIME = -1  # the infinitesimal of time
QUOTIENTS = {
    sp.cot: (sp.cos, sp.sin),
    sp.sec: (None, sp.cos),
    sp.csc: (None, sp.sin),
    sp.coth: (None, sp.tanh),
    sp.sech: (None, sp.cosh),
    sp.csch: (None, sp.sinh),
}

Point = Mapping[sp.Symbol, arb]
_LOCK = RLock()  # the precision of flint belongs to the process


class NoValue(Exception):
    """A formula has no value at a point, or no known series."""


class NoRealValue(NoValue):
    """A root or logarithm that depends on the state has no real value at a point."""


class Jet:
    """A series in s, and its derivatives {k: series} in independent infinitesimals."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: arb_series, slopes: Mapping[int, arb_series] | None = None):
        self.value, self.slopes = value, dict(slopes or {})

    def __add__(self, other: Jet) -> Jet:
        return Jet(self.value + other.value, _sum(self.slopes, other.slopes))

    def __mul__(self, other: Jet) -> Jet:
        own = {k: slope * other.value for k, slope in self.slopes.items()}
        return Jet(self.value * other.value, _sum(own, {k: slope * self.value for k, slope in other.slopes.items()}))

    def chain(self, value: arb_series, slope: arb_series) -> Jet:
        """Return a function of this, from its value and its derivative."""
        return Jet(value, {k: own * slope for k, own in self.slopes.items()})


def _sum(a: Mapping[int, arb_series], b: Mapping[int, arb_series]) -> dict[int, arb_series]:
    return {**a, **{k: a[k] + slope if k in a else slope for k, slope in b.items()}}


def constant(c: arb | int) -> arb_series:
    """Return a number as a series."""
    return arb_series([c])


class Line:
    """Formulas along `point` + s `direction`, with an infinitesimal k for each symbol of `marked` {symbol: k}."""

    def __init__(self, point: Point, direction: Mapping[sp.Symbol, arb], marked: Mapping[sp.Symbol, int]):
        self._known: dict[sp.Expr, Jet] = {}
        self.saturated = False  # whether a sum may have lost an exponential, or the distance of its like from their limit
        for symbol, value in point.items():
            slopes = {marked[symbol]: constant(1)} if symbol in marked else {}
            series = arb_series([value, direction[symbol]]) if symbol in direction else constant(value)
            self._known[symbol] = Jet(series, slopes)

    def __call__(self, e: sp.Expr) -> Jet:
        """Return the jet of a formula."""
        if e not in self._known:
            self._known[e] = self._make(e)
        return self._known[e]

    def value(self, e: sp.Expr) -> arb:
        """Return the value of a formula at the point."""
        return self(e).value[0]

    def _make(self, e: sp.Expr) -> Jet:
        # A number without an error bound would refute falsely, so that each is made from its structure.
        if e.is_Rational:
            return Jet(constant(arb(rational(e))))
        if e in (sp.pi, sp.E):
            return Jet(constant(arb.pi() if e == sp.pi else arb(1).exp()))
        if e.is_Add or e.is_Mul:
            return reduce(Jet.__add__ if e.is_Add else Jet.__mul__, map(self, e.args))
        if e.is_Pow and e.exp.is_Rational:
            return self._power(self(e.base), rational(e.exp))
        if e.is_Pow:
            return self(sp.exp(e.exp * sp.log(e.base), evaluate=False))
        if isinstance(e, sp.erfc):
            return self(1 - sp.erf(e.args[0]))
        if e.func in QUOTIENTS:
            above, below = QUOTIENTS[e.func]
            return self((above(e.args[0]) if above else 1) / below(e.args[0]))
        if isinstance(e, sp.atan2 | Minimum | Maximum | Floor):
            return self._piece(e, *map(self, e.args))
        if isinstance(e, TableFunction):
            return self._table(e)
        if isinstance(e, Sinc):
            return self._sinc(e)
        if e.is_Function and len(e.args) == 1:
            u = self(e.args[0])
            if e.func in _GROWING and not abs(u.value[0]) < SATURATED:
                self.saturated = True
            return _function(e.func, u)
        raise NoValue(f"{e} has no series")

    def _power(self, u: Jet, r: fmpq) -> Jet:
        k = int(r.p)
        if r.q == 1:
            low = u.value ** (k - 1) if k > 0 else u.value.inv() ** (1 - k)
            return u.chain(low * u.value, low * k)
        _check_positive(u, "a root")
        if r.q == 2:
            value = u.value.sqrt() ** k if k > 0 else u.value.rsqrt() ** -k
        else:
            value = (u.value.log() * arb(r)).exp()
        return u.chain(value, value / u.value * arb(r))

    def _piece(self, e: sp.Expr, u: Jet, v: Jet | None = None) -> Jet:
        """Return a function of pieces, whose ends have no value."""
        if v is None:
            floor = u.value[0].floor()
            if not floor.is_exact() or u.value[0].contains(floor):
                raise NoValue("at a jump")
            return Jet(constant(floor))
        if isinstance(e, sp.atan2):
            if v.value[0].contains(0):
                raise NoValue("at an end of a formula of atan2")
            at = self(sp.atan(e.args[0] / e.args[1]))
            return at + Jet(constant(arb.atan2(u.value[0], v.value[0]) - at.value[0]))
        difference = u.value[0] - v.value[0]
        if difference.contains(0):
            raise NoValue("at a kink")
        return u if (difference < 0) == isinstance(e, Minimum) else v

    def _table(self, e: TableFunction) -> Jet:
        """Return a table of one argument, where its numbers are taken as exact."""
        if len(e.args) > 1:
            raise NoValue("a table of several arguments has no series")
        inner, order = self(e.args[0]), e.orders[0]
        at = float(inner.value[0].mid())
        if inner.value.length() > 1:
            raise NoValue("a table of the state has no series")
        value, slope = (constant(arb(float(e.table(at, orders=(order + k,))))) for k in (0, 1))
        return inner.chain(value, slope)

    def _sinc(self, e: Sinc) -> Jet:
        """Return S_k with u S_k = sin(u + k pi/2) - k S_(k-1)."""
        u, order = e.args[0], int(e.args[1])
        result = self(sp.sin(u) / u)
        for k in range(1, order + 1):
            shifted = self(sp.sin(u + k * sp.pi / 2))
            result = (shifted + result * Jet(constant(-k))) * self(1 / u)
        return result


def _check_positive(u: Jet, what: str) -> None:
    if u.value[0] < 0 and (u.value.length() > 1 or u.slopes):
        raise NoRealValue(f"{what} has no value")
    if not u.value[0] > 0:
        raise NoValue(f"{what} has no value")


def _function(f: type, u: Jet) -> Jet:
    a, one = u.value, constant(1)
    if f is sp.log:
        _check_positive(u, "a logarithm")
    if f in _GROWING and not abs(a[0]) < LARGEST_ARGUMENT:
        raise NoValue("an exponential without digits")
    if f in (sp.sinh, sp.cosh, sp.tanh):
        e = a.exp()
        s, c = (e - e.inv()) / 2, (e + e.inv()) / 2
        return u.chain(s, c) if f is sp.sinh else u.chain(c, s) if f is sp.cosh else u.chain(s / c, (c * c).inv())
    if f in (sp.Abs, sp.sign):
        if a[0].contains(0):
            raise NoValue("at a kink")
        sign = 1 if a[0] > 0 else -1
        return u.chain(a * sign, constant(sign)) if f is sp.Abs else Jet(constant(sign))
    rules: dict[type, Callable[[], tuple[arb_series, arb_series]]] = {
        sp.exp: lambda: (a.exp(), a.exp()),
        sp.log: lambda: (a.log(), a.inv()),
        sp.sin: lambda: (a.sin(), a.cos()),
        sp.cos: lambda: (a.cos(), -a.sin()),
        sp.tan: lambda: (a.tan(), one + a.tan() ** 2),
        sp.atan: lambda: (a.atan(), (one + a * a).inv()),
        sp.asin: lambda: (a.asin(), (one - a * a).rsqrt()),
        sp.acos: lambda: (a.acos(), -((one - a * a).rsqrt())),
        sp.erf: lambda: (a.erf(), (-(a * a)).exp() * (2 / arb.pi().sqrt())),
    }
    if f not in rules:
        raise NoValue(f"{f} has no series")
    return u.chain(*rules[f]())


_GROWING = (sp.exp, sp.erf, sp.sinh, sp.cosh, sp.tanh)


def rational(e: sp.Rational) -> fmpq:
    """Return a SymPy rational as a flint one."""
    return fmpq(int(e.p), int(e.q))


def concrete(e: sp.Expr) -> sp.Expr:
    """Return the formula with one smooth function for each undetermined one: what differs for these is no identity."""
    for k, name in enumerate(sorted({part.func.__name__ for part in e.atoms(AppliedUndef)}), 2):

        def named(part: sp.Basic, name: str = name) -> bool:
            return isinstance(part, AppliedUndef) and part.func.__name__ == name

        def chosen(part: sp.Expr, k: int = k) -> sp.Expr:
            return sp.sin(sp.Add(*[(j + k) * z for j, z in enumerate(part.args)])) * sp.exp(part.args[0] / k)

        e = e.replace(named, chosen).doit()
    return e


@dataclass(frozen=True)
class Sampled:
    """`holds` is False if a ball excludes zero, True if `count` precise balls contain it, None if there were none.

    `witness` says where a ball excludes zero.
    """

    holds: bool | None
    count: int
    witness: str = ""


@contextmanager
def precision() -> Iterator[None]:
    """Use balls of `BITS` bits and series of `TERMS` terms; one thread at a time."""
    with _LOCK:
        bits, terms = ctx.prec, ctx.cap
        ctx.prec, ctx.cap = BITS, TERMS
        try:
            yield
        finally:
            ctx.prec, ctx.cap = bits, terms


class Trial:
    """A random point, the directions that a test draws there, and the lines along which it evaluates formulas."""

    def __init__(self, rng: random.Random, symbols: Sequence[sp.Symbol], x: Sequence[sp.Symbol]):
        self._rng, self._x, self._lines = rng, x, list[Line]()
        self.numbers = {symbol: fmpq(rng.randint(-4000, 4000), 3001) for symbol in symbols}
        self.point: Point = {symbol: arb(number) for symbol, number in self.numbers.items()}

    def draw(self) -> list[arb]:
        """Return a random direction of the state."""
        return self.numbers_of(len(self._x))

    def numbers_of(self, count: int) -> list[arb]:
        """Return random numbers between a third and four thirds, of either sign."""
        return [arb(fmpq(self._rng.randint(500, 2000), 1511)) * self._rng.choice((-1, 1)) for _ in range(count)]

    def line(
        self, direction: Sequence[arb], steps: tuple[Sequence[arb], int] | None = None, time: sp.Symbol | None = None
    ) -> Line:
        """Return the line in a direction, from the point or after some steps of another direction.

        With `time`: with an infinitesimal i for each state and `TIME` for that symbol.
        """
        start = self.point
        if steps is not None:
            start = {**start, **{s: start[s] + steps[1] * step for s, step in zip(self._x, steps[0], strict=True)}}
        marks = {} if time is None else {**{s: i for i, s in enumerate(self._x)}, time: TIME}
        line = Line(start, dict(zip(self._x, direction)), marks)
        self._lines.append(line)
        return line

    @property
    def saturated(self) -> bool:
        """Whether a ball that contains zero says nothing here."""
        return any(line.saturated for line in self._lines)

    def __str__(self) -> str:
        return ", ".join(f"{s} = {int(c.p) / int(c.q):.4g}" for s, c in self.numbers.items())


Test = Callable[[Trial], arb]


def sampled(
    test: Test, symbols: Sequence[sp.Symbol], x: Sequence[sp.Symbol], count: int, everywhere: bool = False
) -> Sampled:
    """Return whether the value of a test is zero at random points.

    Args:
        test: returns a ball for a trial.
        symbols: what has a value in a point.
        x: the state, in which directions are drawn.
        count: number of precise values that are wanted; at most four times as many points are tried.
        everywhere: whether a state without a real value refutes, as it does for what must be a polynomial.
    """
    rng, seen = random.Random(SEED), 0
    with precision():
        for _ in range(4 * count):
            trial = Trial(rng, symbols, x)
            try:
                value = test(trial)
            except NoRealValue as reason:
                if everywhere:
                    return Sampled(False, seen, f"{reason} at {trial}")
                continue
            except (NoValue, ZeroDivisionError, ValueError, OverflowError):
                continue
            if value.is_finite() and not value.contains(0):
                return Sampled(False, seen, f"{value.str(5, radius=False)} at {trial}")
            seen += bool(value.is_finite() and value.rad() < PRECISE) and not trial.saturated
            if seen == count:
                break
    return Sampled(True if seen else None, seen)


def differences(formulas: Sequence[sp.Expr], order: int) -> Test:
    """Return a test: differences of this order along a line, which vanish for polynomials of lower degree in x.

    Values see pieces that derivatives do not, as those of asin(sin x).
    """
    signs = [(-1) ** k * math.comb(order, k) for k in range(order + 1)]

    def test(trial: Trial) -> arb:
        direction = trial.draw()
        lines = [trial.line(direction, (direction, k)) for k in range(order + 1)]
        weights = trial.numbers_of(len(formulas))  # lest the differences of several formulas cancel
        return sum((c * w * line.value(e) for w, e in zip(weights, formulas) for c, line in zip(signs, lines)), arb(0))

    return test
