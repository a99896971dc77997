"""Fractions of polynomials over a tower of generators, in which an identity is proved by exact arithmetic.

The variables of the polynomials are the state, other symbols, and a generator for each function of a formula.  A generator g
has a derivative that is an element of the tower, and may have a relation g^k = p, as sin(u)^2 = 1 - cos(u)^2.  Every relation
and every derivative is true wherever the formulas have values, so that an element that reduces to zero is zero there.  An
element that does not reduce to zero refutes nothing: no theorem of independence is used.

The work is bounded by counts of term products and of operations, so that an answer never depends on the load of a machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import sympy as sp
from flint import Ordering, fmpq, fmpq_mpoly, fmpq_mpoly_ctx

# Bounds of the work of one tower.  A log-cosh gauge with a full moving G in six states takes 600,000 products of terms.
MOST_PRODUCTS = 400_000  # of terms in one product of polynomials
MOST_WORK = 3_000_000  # products of terms
MOST_OPERATIONS = 150_000  # on elements
TEXT = 150  # products of terms that take as long as to write a term as a formula
MOST_TERMS = 5_000  # of an operand of a greatest common divisor, which flint does not interrupt

Slope = Callable[[sp.Symbol], "Element"]


class OutOfBounds(Exception):
    """The tower does not hold a formula, or the work of a proof is beyond its bound; says which."""


class Element:
    """A fraction in lowest terms modulo the relations; its denominator has the leading coefficient 1."""

    __slots__ = ("_symbols", "denominator", "numerator", "tower")

    def __init__(self, tower: Tower, numerator: fmpq_mpoly, denominator: fmpq_mpoly, lowest: bool = False):
        if not lowest:
            numerator, denominator = tower.lowest(numerator, denominator)
        self.tower, self.numerator, self.denominator, self._symbols = tower, numerator, denominator, -1

    @property
    def symbols(self) -> int:
        """The base symbols that the element depends on, as bits."""
        if self._symbols < 0:
            places = self.tower.symbols_of_places
            found = 0
            for p in (self.numerator, self.denominator):
                for place, k in enumerate(() if p.is_constant() else p.degrees()):
                    found |= places[place] if k > 0 else 0
            self._symbols = found
        return self._symbols

    def __bool__(self) -> bool:
        return not self.numerator.is_zero()

    def __add__(self, other: Element) -> Element:
        if not other:
            return self
        if not self:
            return other
        tower = self.tower
        if self.denominator == other.denominator:
            return Element(tower, self.numerator + other.numerator, self.denominator)
        common = tower.gcd(self.denominator, other.denominator)
        own, its = self.denominator / common, other.denominator / common
        numerator = tower.times(self.numerator, its) + tower.times(other.numerator, own)
        return Element(tower, numerator, tower.times(self.denominator, its))

    def __neg__(self) -> Element:
        return Element(self.tower, -self.numerator, self.denominator, True)

    def __sub__(self, other: Element) -> Element:
        return self + -other

    def __mul__(self, other: Element | int | fmpq) -> Element:
        tower = self.tower
        if not isinstance(other, Element):
            return Element(tower, self.numerator * other, self.denominator)
        if not self or not other:
            return tower.zero
        return Element(
            tower, tower.times(self.numerator, other.numerator), tower.times(self.denominator, other.denominator)
        )

    def inverse(self) -> Element:
        """Return 1 / self."""
        return Element(self.tower, self.denominator, self.numerator)

    def __pow__(self, k: int) -> Element:
        if k < 0:
            return self.inverse() ** -k
        result, square = self.tower.one, self
        while k:
            result, k = result * square if k & 1 else result, k >> 1
            square = square * square if k else square
        return result

    @property
    def key(self) -> tuple[str, str]:
        """What equal elements have in common."""
        return str(self.numerator), str(self.denominator)


class Tower:
    """The ring of `count` generators over `x` and other symbols; what is made later comes first in the order of monomials.

    `x`: the state; `others`: symbols that do not depend on the state, time and parameters.
    """

    def __init__(self, x: Sequence[sp.Symbol], others: Sequence[sp.Symbol], count: int):
        self.x, self.count, self.base = list(x), count, [*x, *others]
        names = (*(f"g{count - 1 - i}" for i in range(count)), *(f"y{i}" for i in range(len(self.base))))
        self.ring = fmpq_mpoly_ctx.get(names, Ordering.lex)
        self._gens = list(self.ring.gens())
        self.unit, none = self.ring.constant(1), self.ring.constant(0)
        self.zero, self.one = Element(self, none, self.unit, True), Element(self, self.unit, self.unit, True)
        self.symbols = {s: Element(self, g, self.unit, True) for s, g in zip(self.base, self._gens[count:])}
        self.names: list[sp.Expr] = []  # of the generators, as formulas
        self.bit = {s: 1 << i for i, s in enumerate(self.base)}
        self.symbols_of_places = [0] * count + [1 << i for i in range(len(self.base))]
        self._state = (1 << len(self.x)) - 1
        self._slopes: list[tuple[Slope, dict[sp.Symbol, Element]]] = []
        self._relations: list[tuple[int, int, fmpq_mpoly]] = []  # place in the ring, power, g^k - p
        self._work, self._operations, self._share = 0, 0, 1

    def number(self, c: fmpq | int) -> Element:
        """Return a rational number as an element."""
        return Element(self, self.unit * c, self.unit, True)

    def of(self, numerator: Any) -> Element:
        """Return a polynomial, or a dictionary of its terms, as an element."""
        p = self.ring.from_dict(numerator) if isinstance(numerator, dict) else numerator
        return Element(self, p, self.unit)

    def sum(self, elements: Any) -> Element:
        """Return the sum of elements."""
        return reduce(Element.__add__, elements, self.zero)

    # Bounded arithmetic.

    def begin(self, share: int = 1) -> None:
        """Count the work from zero, with the bounds divided by `share`."""
        self._work, self._operations, self._share = 0, 0, share

    def spend(self, products: int) -> None:
        """Count one operation and some products of terms.

        Raises:
            OutOfBounds: it is too much.
        """
        self._operations += 1
        self._work += products
        most = max(products * (MOST_WORK // MOST_PRODUCTS), self._work, self._operations * (MOST_WORK // MOST_OPERATIONS))
        if most * self._share > MOST_WORK:
            raise OutOfBounds("the work of a proof is bounded")

    def times(self, p: fmpq_mpoly, q: fmpq_mpoly) -> fmpq_mpoly:
        """Return the product of two polynomials."""
        self.spend(len(p) * len(q))
        return p * q

    def gcd(self, p: fmpq_mpoly, q: fmpq_mpoly) -> fmpq_mpoly:
        """Return the greatest common divisor of two polynomials."""
        if p.is_constant() or q.is_constant():
            return self.unit
        if max(len(p), len(q)) > MOST_TERMS:
            raise OutOfBounds("a formula has too many terms")
        self.spend(len(p) + len(q))
        return p.gcd(q)

    def lowest(self, p: fmpq_mpoly, q: fmpq_mpoly) -> tuple[fmpq_mpoly, fmpq_mpoly]:
        """Return numerator and denominator in lowest terms."""
        p, q = self.reduced(p), self.reduced(q)
        if q.is_zero():
            raise OutOfBounds("a denominator vanishes")
        if p.is_zero():
            return p, self.unit
        common = self.gcd(p, q)
        if not common.is_constant():
            p, q = p / common, q / common
        leading = q.leading_coefficient()
        return (p, q) if leading == 1 else (p / leading, q / leading)

    def reduced(self, p: fmpq_mpoly) -> fmpq_mpoly:
        """Return the remainder modulo the relations."""
        if p.is_constant() or not self._relations:
            return p
        degrees = p.degrees()
        for place, power, relation in reversed(self._relations):
            if degrees[place] >= power:
                self.spend(len(p) * len(relation))
                p = divmod(p, relation)[1]
                degrees = p.degrees()
        return p

    # Generators and derivatives.

    def generator(
        self, name: sp.Expr, slope: Slope, inner: Sequence[Element], relation: tuple[int, fmpq_mpoly] | None = None
    ) -> Element:
        """Return a new variable.

        Args:
            name: the formula that it stands for.
            slope: returns its derivative in a base symbol.
            inner: what it is a function of.
            relation: (k, p) says that its k-th power is p.
        """
        k = len(self.names)
        if k == self.count:
            raise OutOfBounds("there are too many functions")
        self.names.append(name)
        self._slopes.append((slope, {}))
        place = self.count - 1 - k
        self.symbols_of_places[place] = reduce(int.__or__, [e.symbols for e in inner], 0)
        if relation is not None:
            self._relations.append((place, relation[0], self._gens[place] ** relation[0] - relation[1]))
        return Element(self, self._gens[place], self.unit, True)

    def generated(self, k: int) -> Element:
        """Return the k-th generator."""
        return Element(self, self._gens[self.count - 1 - k], self.unit, True)

    def depends(self, place: int) -> bool:
        """Return whether the variable at a place of the ring depends on the state."""
        return bool(self.symbols_of_places[place] & self._state)

    def moving(self, e: Element) -> bool:
        """Return whether an element depends on the state."""
        return bool(e.symbols & self._state)

    def used(self, p: fmpq_mpoly) -> list[int]:
        """Return the numbers of the generators in a polynomial."""
        degrees = p.degrees()
        return [k for k in range(len(self.names)) if degrees[self.count - 1 - k] > 0]

    def diff(self, e: Element, s: sp.Symbol) -> Element:
        """Return the derivative of an element in a base symbol."""
        if not e.symbols & self.bit[s]:
            return self.zero
        if e.denominator.is_constant():
            return self._diff(e.numerator, s)
        below = self._diff(e.denominator, s)
        above = self._diff(e.numerator, s)
        if not below and not above:
            return self.zero
        return (above - e * below) * Element(self, self.unit, e.denominator)

    def slope(self, k: int, s: sp.Symbol) -> Element:
        """Return the derivative of the k-th generator in a base symbol."""
        rule, known = self._slopes[k]
        if s not in known:
            known[s] = rule(s)
        return known[s]

    def _diff(self, p: fmpq_mpoly, s: sp.Symbol) -> Element:
        total = self.zero
        for place, degree in enumerate(p.degrees()):
            if degree < 1 or not self.symbols_of_places[place] & self.bit[s]:
                continue
            slope = self.one if place >= self.count else self.slope(self.count - 1 - place, s)
            if slope:
                total = total + self.of(p.derivative(place)) * slope
        return total

    def chain(self, u: Element, outer: Callable[[], Element]) -> Slope:
        """Return the derivative of a function of u, whose own derivative is outer()."""

        def slope(s: sp.Symbol) -> Element:
            inner = self.diff(u, s)
            return outer() * inner if inner else inner

        return slope

    def affine_part(self, e: Element) -> tuple[list[Element], Element, Element]:
        """Return a, b and the rest of e = a.x + b + rest, of which no term is affine in the states."""
        n, count, parts = len(self.x), self.count, dict[Any, dict[tuple[int, ...], fmpq]]()
        if not e.denominator.is_constant() and any(k > 0 and self.depends(i) for i, k in enumerate(e.denominator.degrees())):
            return [self.zero] * n, self.zero, e
        for monomial, c in e.numerator.to_dict().items():
            states = monomial[count : count + n]
            part: Any = None
            if sum(states) > 1 or any(k and self.depends(i) for i, k in enumerate(monomial[:count])):
                part = "rest"
            elif any(states):
                part = states.index(1)
                monomial = (*monomial[: count + part], 0, *monomial[count + part + 1 :])
            parts.setdefault(part, {})[monomial] = c

        def element(part: Any) -> Element:
            return Element(self, self.ring.from_dict(parts[part]), e.denominator) if part in parts else self.zero

        return [element(i) for i in range(n)], element(None), element("rest")

    def beyond(self, e: Element, degree: int) -> Element:
        """Return the terms that are no polynomials of this degree in the states; all, where a denominator depends on them."""
        n, count = len(self.x), self.count
        if not e.denominator.is_constant() and any(k > 0 and self.depends(i) for i, k in enumerate(e.denominator.degrees())):
            return e
        kept = {
            m: c
            for m, c in e.numerator.to_dict().items()
            if sum(m[count : count + n]) > degree or any(k and self.depends(i) for i, k in enumerate(m[:count]))
        }
        return Element(self, self.ring.from_dict(kept), e.denominator)

    def solve(self, matrix: Sequence[Sequence[Element]], columns: Sequence[Sequence[Element]]) -> list[list[Element]]:
        """Return the inverse of a matrix times some columns, by elimination."""
        rows = [[*row, *(column[i] for column in columns)] for i, row in enumerate(matrix)]
        n = len(rows)
        for i in range(n):
            choices = [k for k in range(i, n) if rows[k][i]]
            if not choices:
                raise OutOfBounds("a matrix is singular")
            pivot = min(choices, key=lambda k: len(rows[k][i].numerator) + len(rows[k][i].denominator))
            rows[i], rows[pivot] = rows[pivot], rows[i]
            inverse = rows[i][i].inverse()
            rows[i] = [e * inverse if e else e for e in rows[i]]
            for k in range(n):
                if k != i and rows[k][i]:
                    factor = rows[k][i]
                    rows[k] = [a - factor * b if b else a for a, b in zip(rows[k], rows[i])]
        return [[rows[i][n + j] for i in range(n)] for j in range(len(columns))]

    # Back to formulas.

    def expression(self, e: Element) -> sp.Expr:
        """Return an element as a formula; a denominator of one term divides each term, lest exponentials overflow.

        Raises:
            OutOfBounds: there are too many terms.
        """
        self.spend(TEXT * (len(e.numerator) + len(e.denominator)))
        names = [*[sp.Integer(1)] * (self.count - len(self.names)), *self.names[::-1], *self.base]

        def term(monomial: Sequence[int], c: fmpq, below: Sequence[int]) -> sp.Expr:
            powers = [name ** (k - j) for name, k, j in zip(names, monomial, below) if k != j]
            return sp.Mul(sp.Rational(int(c.p), int(c.q)), *powers)

        def formula(p: fmpq_mpoly, below: Sequence[int]) -> sp.Expr:
            return sp.Add(*[term(monomial, c, below) for monomial, c in p.to_dict().items()])

        none = (0,) * len(names)
        if len(e.denominator) == 1:
            return formula(e.numerator, e.denominator.monoms()[0])
        return formula(e.numerator, none) / formula(e.denominator, none)
