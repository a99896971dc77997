"""Formulas of the grammar as elements of a tower: which generators, relations and derivatives a function has.

    exp, sinh, cosh      powers of E, E' = E u'; tanh alone is T, T' = (1 - T^2) u'
    sin, cos             C and S, S^2 = 1 - C^2; sums, multiples and inverse functions inside by the addition theorems
    roots, abs, log      by the irreducible factors f of their argument: R^k = |f|, A^2 = f^2, log |f|
    atan, asin, erf ...  algebraic derivatives; min and max by abs; floor and tables by their derivatives

At first every argument is independent of the others.  `joint` rewrites them over a Z-basis, so that exp(2 x) and exp(3 x) are
powers of one exponential.  A relation holds wherever all formulas of the tower have a value: where the square root of f has one,
|f| = f.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import Any

import sympy as sp
from flint import fmpq
from sympy.core.function import AppliedUndef

from zakai.algebra.balls import QUOTIENTS, rational
from zakai.algebra.factors import FactoredTower
from zakai.algebra.integer_basis import MOST_MULTIPLE
from zakai.algebra.joint import Joint, dependent
from zakai.algebra.tower import Element, OutOfBounds, Slope
from zakai.models.functions import Floor, Maximum, Minimum, Sinc, TableFunction

HYPERBOLIC = (sp.exp, sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch)
CIRCULAR = (sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc)
INVERSE = (sp.asin, sp.acos, sp.atan, sp.atan2)
SPARE = 8  # generators for numbers and for derivatives that no formula names


class Reader(FactoredTower):
    """The tower of some formulas; calling it returns a formula as an element.

    `log_cosh` lists (u, T) for each generator T = tanh u.
    """

    def __init__(self, formulas: Iterable[sp.Expr], x: Sequence[sp.Symbol], joint: Mapping[str, Joint] | None = None):
        self.joint = dict(joint or {})
        functions: dict[sp.Expr, int] = {}
        symbols: set[sp.Symbol] = set()
        for e in (*formulas, *(b for one in self.joint.values() for b in one.basis)):
            symbols |= e.free_symbols
            _gather(e, functions)
        others = sorted(symbols - set(x), key=lambda s: s.name)
        super().__init__(x, others, SPARE + sum(map(_room, functions)))
        self.log_cosh: list[tuple[sp.Expr, Element]] = []
        self.arguments: dict[str, dict[sp.Expr, Element]] = {"hyperbolic": {}, "circular": {}}
        self._known: dict[sp.Expr, Element] = {}
        self._open: set[sp.Expr] = set()
        self._users: dict[tuple[str, str], set[type]] = {}
        self._orientation: dict[tuple[str, str], int] = {}
        self._whole = {kind: _unit(functions, kinds) for kind, kinds in (("e", (sp.exp,)), ("circle", CIRCULAR))}
        self._functions = functions
        self._prepared = False

    def __call__(self, e: sp.Expr) -> Element:
        """Return a formula as an element.

        Raises:
            OutOfBounds: the tower does not hold it.
        """
        if not self._prepared:
            self._prepared = True
            self._prepare()
        try:
            return self._read(e)
        except RecursionError:
            raise OutOfBounds("a formula is too deep") from None

    def _prepare(self) -> None:
        """Note who uses each argument of an exponential, and the signs that roots and logarithms need, from the inside out."""
        for e, _ in sorted(self._functions.items(), key=lambda item: item[1]):
            if isinstance(e, HYPERBOLIC):
                self._note_user(e)
            elif isinstance(e, sp.log) or (e.is_Pow and e.exp.is_Rational):
                self.note_sign(self._read(e.args[0]))

    def _note_user(self, e: sp.Expr) -> None:
        inner = self._read(e.args[0])
        if inner:
            sign = _sign(inner)
            key = (inner * sign).key
            self._users.setdefault(key, set()).add(e.func)
            if isinstance(e, sp.exp):
                self._orientation.setdefault(key, sign)

    def _read(self, e: sp.Expr) -> Element:
        if e not in self._known:
            if e in self._open:  # over a basis of arguments that stand inside of each other
                raise OutOfBounds("arguments contain each other")
            self._open.add(e)
            self._known[e] = self._make(e)
            self._open.discard(e)
        return self._known[e]

    def _make(self, e: sp.Expr) -> Element:
        if e.is_Rational:
            return self.number(rational(e))
        if e in self.symbols:
            return self.symbols[e]
        if e.is_Add or e.is_Mul:
            return reduce(Element.__add__ if e.is_Add else Element.__mul__, map(self._read, e.args))
        if e.is_Pow:
            return self._power(e)
        if e == sp.E:
            return self._exponential(sp.Integer(1), 1)
        if e == sp.pi:
            return self.constant(e)
        if isinstance(e, HYPERBOLIC):
            return self._hyperbolic(e.func, e.args[0])
        if isinstance(e, CIRCULAR):
            return self._circular(e.func, e.args[0])
        if isinstance(e, AppliedUndef):
            return self._undetermined(e, (0,) * len(e.args))
        if isinstance(e, TableFunction):
            return self._table(e)
        return self._other(e)

    def _power(self, e: sp.Expr) -> Element:
        if e.exp.is_Integer:
            return self._read(e.base) ** int(e.exp)
        if not e.exp.is_Rational:
            return self._exponential(sp.expand(e.exp * sp.log(e.base)), 1)
        return self.root(self._read(e.base), rational(e.exp))

    # Exponentials and circular functions.

    def _hyperbolic(self, f: type, u: sp.Expr) -> Element:
        inner = self._read(u)
        sign = _sign(inner)
        key = (inner * sign).key
        if self._users.get(key) == {sp.tanh} and "hyperbolic" not in self.joint and not _inverse_parts(u, (sp.log,))[0]:
            return self._tanh(u * sign, inner * sign) * sign
        up = self._exponential(u, 1)
        down = up.inverse()
        if f is sp.exp:
            return up
        if f in (sp.sinh, sp.csch):
            half = (up - down) * fmpq(1, 2)
            return half if f is sp.sinh else half.inverse()
        if f in (sp.cosh, sp.sech):
            half = (up + down) * fmpq(1, 2)
            return half if f is sp.cosh else half.inverse()
        above, below = up - down, up + down
        return above * below.inverse() if f is sp.tanh else below * above.inverse()

    def _tanh(self, u: sp.Expr, inner: Element) -> Element:
        def make() -> Element:
            held: list[Element] = []
            slope = self.chain(inner, lambda: self.one - held[0] * held[0])
            held.append(self.generator(sp.tanh(u), slope, [inner]))
            self.log_cosh.append((u, held[0]))
            return held[0]

        self.arguments["hyperbolic"][u] = inner
        found: Element = self._once(("tanh", inner.key), make)
        return found

    def _exponential(self, u: sp.Expr, power: int) -> Element:
        """Return exp(u)^power."""
        logs, rest = _inverse_parts(u, (sp.log,))
        result = reduce(Element.__mul__, [self._read(log.args[0]) ** (k * power) for log, k in logs], self.one)
        inner = self._read(rest)
        if not inner:
            return result
        if rest.is_Rational:
            return result * self._power_of_e(rest, power)
        sign = _sign(inner)
        u, inner = rest * sign, inner * sign
        self.arguments["hyperbolic"][u] = inner
        for argument, k in self._over_basis("hyperbolic", u):
            if argument.is_Rational:
                result = result * self._power_of_e(argument, k * sign * power)
            else:
                result = result * self._one_exponential(argument, k * sign * power)
        return result

    def _one_exponential(self, u: sp.Expr, power: int) -> Element:
        inner = self._read(u)
        sign = _sign(inner)
        key = (inner * sign).key
        facing = self._orientation.get(key, sign)

        def make() -> Element:
            held: list[Element] = []
            w = inner * (sign * facing)
            held.append(self.generator(sp.exp(u * (sign * facing)), self.chain(w, lambda: held[0]), [w]))
            self._made["exponent", held[0].key] = w
            return self._positive(held[0])

        found: Element = self._once(("exp", key), make)
        return found ** (sign * facing * power)

    def _power_of_e(self, u: sp.Rational, power: int) -> Element:
        unit = self._whole["e"]
        k = u * power * unit
        if not k.is_Integer or abs(k) > MOST_MULTIPLE:
            return self.constant(sp.exp(u * power))
        root = self._once(("e", unit), lambda: self._positive(self.constant(sp.exp(sp.Rational(1, unit)))))
        self._made["exponent", root.key] = self.number(fmpq(1, unit))
        found: Element = root ** int(k)
        return found

    def _over_basis(self, kind: str, u: sp.Expr) -> list[tuple[sp.Expr, int]]:
        """Return an argument as integer multiples of others."""
        if kind not in self.joint or u not in self.joint[kind].coordinates:
            return [(u, 1)]
        multiples, offset = self.joint[kind].coordinates[u]
        return [(b, k) for b, k in zip(self.joint[kind].basis, multiples) if k] + ([(offset, 1)] if offset != 0 else [])

    def _circular(self, f: type, u: sp.Expr) -> Element:
        angles, rest = _inverse_parts(u, INVERSE)
        turns = [(self._angle(angle), k) for angle, k in angles]
        inner = self._read(rest)
        if inner:
            sign = _sign(inner)
            u, inner = rest * sign, inner * sign
            self.arguments["circular"][u] = inner
            turns += [(self._circle(b), k * sign) for b, k in self._over_basis("circular", u)]
        c, s = self.one, self.zero
        for (cosine, sine), k in turns:
            sine = sine if k > 0 else -sine
            for _ in range(abs(k)):
                c, s = c * cosine - s * sine, s * cosine + c * sine
        if f in (sp.sin, sp.csc):
            return s if f is sp.sin else s.inverse()
        if f in (sp.cos, sp.sec):
            return c if f is sp.cos else c.inverse()
        return s * c.inverse() if f is sp.tan else c * s.inverse()

    def _angle(self, e: sp.Expr) -> tuple[Element, Element]:
        """Return cosine and sine of an inverse function."""
        u = e.args[0]
        if isinstance(e, sp.asin | sp.acos):
            other = self._read(_root_of(u))
            return (other, self._read(u)) if isinstance(e, sp.asin) else (self._read(u), other)
        v = e.args[1] if isinstance(e, sp.atan2) else sp.Integer(1)
        size = self._read(sp.Pow(u**2 + v**2, sp.Rational(-1, 2)))
        return self._read(v) * size, self._read(u) * size

    def _circle(self, u: sp.Expr) -> tuple[Element, Element]:
        """Return C = cos u and S = sin u."""
        unit = self._whole["circle"]
        if u.is_Rational and u * unit != 1 and (u * unit).is_Integer and abs(u * unit) <= MOST_MULTIPLE:
            cosine, sine = self._circle(sp.Rational(1, unit))
            c, s = self.one, self.zero
            for _ in range(int(abs(u * unit))):
                c, s = c * cosine - s * sine, s * cosine + c * sine
            return c, s if u > 0 else -s
        w = self._read(u)

        def make() -> tuple[Element, Element]:
            pair: dict[str, Element] = {}
            pair["c"] = self.generator(sp.cos(u), self.chain(w, lambda: -pair["s"]), [w])
            relation = 2, 1 - pair["c"].numerator ** 2
            pair["s"] = self.generator(sp.sin(u), self.chain(w, lambda: pair["c"]), [w], relation)
            return pair["c"], pair["s"]

        if _sign(w) < 0:
            c, s = self._circle(-u)
            return c, -s
        found: tuple[Element, Element] = self._once(("circle", w.key), make)
        return found

    # The other functions.

    def _other(self, e: sp.Expr) -> Element:
        f = e.func
        if f in QUOTIENTS or not e.args:
            raise OutOfBounds(f"{e} is not in the tower")
        u = self._read(e.args[0])
        if f is sp.erfc:
            return self.one - self._read(sp.erf(e.args[0]))
        if f is sp.Abs:
            return self._abs(u)
        if f is sp.sign:
            return self._signum(u)
        if f is sp.log:
            return self._logarithm(u)
        if f in (Minimum, Maximum):
            v = self._read(e.args[1])
            return (u + v + self._abs(u - v) * (1 if f is Maximum else -1)) * fmpq(1, 2)
        if f is Sinc:
            return self._sinc(e)
        if f is sp.atan2:
            return self._atan2(e)
        if e.is_number and f in (sp.atan, sp.asin, sp.acos, sp.erf):
            return self.constant(e)
        outer = {
            Floor: lambda: self.zero,
            sp.atan: lambda: (self.one + u * u).inverse(),
            sp.asin: lambda: self._read(_root_of(e.args[0])).inverse(),
            sp.acos: lambda: -self._read(_root_of(e.args[0])).inverse(),
            sp.erf: lambda: self._read(sp.exp(-(e.args[0] ** 2))) * self._read(2 / sp.sqrt(sp.pi)),
        }.get(f)
        if outer is None:
            raise OutOfBounds(f"{f.__name__} is not in the tower")
        sign = 1
        if f in (sp.atan, sp.asin, sp.erf):  # odd functions
            sign = _sign(u)
        if sign < 0:
            return -self._read(f(-e.args[0])) if f(-e.args[0]).func is f else self._odd(e, u, outer)
        found: Element = self._once((f, u.key), lambda: self.generator(e, self.chain(u, outer), [u]))
        return found

    def _odd(self, e: sp.Expr, u: Element, outer: Any) -> Element:
        """Return an odd function of an argument whose sign SymPy turns back: f(u) = -f(-u)."""
        found: Element = self._once(
            (e.func, (-u).key), lambda: self.generator(-e, self.chain(-u, outer), [u])
        )
        return -found

    def _atan2(self, e: sp.atan2) -> Element:
        u, v = map(self._read, e.args)

        def slope(s: sp.Symbol) -> Element:
            turned = v * self.diff(u, s) - u * self.diff(v, s)
            return turned * (u * u + v * v).inverse() if turned else turned

        found: Element = self._once(("atan2", u.key, v.key), lambda: self.generator(e, slope, [u, v]))
        return found

    def _sinc(self, e: Sinc) -> Element:
        u = e.args[0]
        down = self._read(u).inverse()
        result = self._read(sp.sin(u)) * down
        for k in range(1, int(e.args[1]) + 1):
            result = (self._read(sp.sin(u + k * sp.pi / 2)) - result * k) * down
        return result

    def _undetermined(self, e: sp.Expr, orders: tuple[int, ...]) -> Element:
        """Return a derivative of an undetermined function: each is a variable."""
        inner = [self._read(a) for a in e.args]
        dummies = sp.symbols(f"_xi1:{len(e.args) + 1}", real=True)
        name = e.func(*dummies).diff(*[(d, k) for d, k in zip(dummies, orders) if k]) if any(orders) else e
        if any(orders):
            name = name.subs(dict(zip(dummies, e.args)), simultaneous=True)
        slope = self._partial_slopes(inner, lambda i: self._undetermined(e, _raised(orders, i)))
        key = ("undetermined", e.func, orders, *(u.key for u in inner))
        found: Element = self._once(key, lambda: self.generator(name, slope, inner))
        return found

    def _table(self, e: TableFunction) -> Element:
        inner = [self._read(a) for a in e.args]

        def partial(i: int) -> Element:
            derivative = e.fdiff(i + 1)
            return self._table(derivative) if isinstance(derivative, TableFunction) else self.zero

        key = ("table", e.func, *(u.key for u in inner))
        slope = self._partial_slopes(inner, partial)
        found: Element = self._once(key, lambda: self.generator(e, slope, inner))
        return found

    def _partial_slopes(self, inner: Sequence[Element], partial: Any) -> Slope:
        def slope(s: sp.Symbol) -> Element:
            slopes = [(i, d) for i, u in enumerate(inner) if (d := self.diff(u, s))]
            return self.sum(partial(i) * d for i, d in slopes)

        return slope

    def joint_arguments(self) -> dict[str, Joint]:
        """Return bases of the arguments that are dependent over Q modulo numbers."""
        found = {}
        for kind, arguments in self.arguments.items():
            joint = dependent(self, {u: e for u, e in arguments.items() if not u.is_Rational})
            if joint is not None:
                found[kind] = joint
        return found

def _sign(e: Element) -> int:
    """Return the sign of the leading coefficient: one of u and -u is the argument of a generator."""
    return -1 if e and e.numerator.leading_coefficient() < 0 else 1


def _root_of(u: sp.Expr) -> sp.Expr:
    return sp.Pow(1 - u**2, sp.Rational(1, 2), evaluate=False)


def _raised(orders: tuple[int, ...], i: int) -> tuple[int, ...]:
    return tuple(k + (i == j) for j, k in enumerate(orders))


def _inverse_parts(u: sp.Expr, kinds: tuple[type, ...]) -> tuple[list[tuple[sp.Expr, int]], sp.Expr]:
    """Return the integer multiples of inverse functions in a sum, and the rest."""
    if not u.has(*kinds):
        return [], u
    parts, rest = [], []
    for term in sp.Add.make_args(sp.expand(u) if u.count_ops() < 60 else u):
        number, function = term.as_coeff_Mul()
        if isinstance(function, kinds) and number.is_Integer and abs(number) <= MOST_MULTIPLE:
            parts.append((function, int(number)))
        else:
            rest.append(term)
    return parts, sp.Add(*rest)


def _gather(e: sp.Expr, functions: dict[sp.Expr, int]) -> int:
    """Collect the functions of a formula and of their derivatives with their depths; return the depth of the formula."""
    if e in functions:
        return functions[e]
    u: Any = e.args[0] if e.args else None
    further: list[sp.Expr] = []
    if isinstance(e, sp.asin | sp.acos):
        further = [_root_of(u)]
    elif isinstance(e, sp.erf | sp.erfc):
        further = [sp.exp(-(u**2)), sp.sqrt(sp.pi)]
    elif isinstance(e, Sinc):
        further = [sp.sin(u)]
    elif e.is_Pow and not e.exp.is_Rational:
        further = [sp.log(e.base)]
    depth = max((_gather(a, functions) for a in (*e.args, *further)), default=0)
    own = e.is_Function or (e.is_Pow and not e.exp.is_Integer) or e in (sp.pi, sp.E)
    if own:
        depth += 1
        functions[e] = depth
    return depth


def _room(e: sp.Expr) -> int:
    """Return how many generators a function may need."""
    if isinstance(e, AppliedUndef | TableFunction):
        return 6
    if isinstance(e, (*CIRCULAR, *INVERSE)):
        return 3
    if e.is_Pow or isinstance(e, sp.log | sp.Abs | sp.sign | Minimum | Maximum):
        return 4
    return 2 if isinstance(e, Sinc) else 1


def _unit(functions: Iterable[sp.Basic], kinds: Any) -> int:
    """Return the least common denominator of the rational numbers among the arguments of some functions."""
    numbers = [e.args[0] for e in functions if isinstance(e, kinds) and e.args[0].is_Rational]
    return math.lcm(*(int(number.q) for number in numbers)) if numbers else 1
