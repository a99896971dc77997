"""Roots, absolute values, signs and logarithms in a tower, by the irreducible factors f of their argument.

    u = c prod f^k:    |u|^(p/q) = |c|^(p/q) prod |f|^(k p/q),   |u| = |c| prod |f|^k,   log |u| = log |c| + sum k log |f|

with generators R^q = |f|, A^2 = f^2 for A = |f|, and log |f|.  Each holds wherever all formulas of the tower have a value: where
the square root or the logarithm of f has one, |f| = f.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import sympy as sp
from flint import fmpq

from zakai.algebra.tower import Element, OutOfBounds, Tower

MOST_POWER = 24  # of a root
MOST_FACTORED = 64  # terms of a polynomial that is factored


class FactoredTower(Tower):
    """A tower with the functions of factors; `_made` holds what was made once, `_signs` the signs of factors that are known."""

    def __init__(self, x: Sequence[sp.Symbol], others: Sequence[sp.Symbol], count: int):
        super().__init__(x, others, count)
        self._made: dict[Any, Any] = {}
        self._signs: dict[tuple[str, str], int] = {}

    def _once(self, key: Any, make: Any) -> Any:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def constant(self, e: sp.Expr) -> Element:
        """Return a number of which nothing is known but its value."""
        found: Element = self._once(("number", e), lambda: self.generator(e, lambda s: self.zero, ()))
        return found

    def is_exponential(self, p: Any) -> bool:
        """Return whether a polynomial of one term is a product of exponentials."""
        return not any(p.degrees()[self.count :]) and all(
            ("exponent", self.generated(k).key) in self._made for k in self.used(p)
        )

    def note_sign(self, e: Element) -> None:
        """Note that an argument is not negative, which fixes the sign of its factors of odd power together."""
        c, factors = self._factors(e)
        odd, known = self._unsigned(factors)
        if odd:
            self._signs[odd.key] = known * (1 if c > 0 else -1)

    def _unsigned(self, factors: Sequence[tuple[Element, int]]) -> tuple[Element, int]:
        """Return the product of the factors of odd power whose signs are not known, or zero, and the sign of the others."""
        signs = [self._sign_of(f) if k % 2 else 1 for f, k in factors]
        unknown = [f for (f, _), sign in zip(factors, signs) if not sign]
        product = reduce(Element.__mul__, unknown) if unknown else self.zero
        return product, math.prod(sign for sign in signs if sign)

    def root(self, e: Element, power: fmpq) -> Element:
        """Return e^power, which has a value where e is not negative: factors of even power and known signs leave the root."""
        if not e:
            return e
        c, factors = self._factors(e)
        result = self.one
        for prime, k in sp.factorrat(sp.Rational(abs(int(c.p)), int(c.q))).items():
            result = result * self._root(self.number(prime), power * int(k))
        odd, _ = self._unsigned(factors)
        for f, k in factors:
            even = k - (k % 2 if not self._sign_of(f) else 0)
            result = result * self._root(f, power * even) if even else result
        return result * self._root(odd, power) if odd else result

    def _root(self, f: Element, power: fmpq) -> Element:
        """Return |f|^power for an irreducible f."""
        if ("power", f.key) in self._made:
            base, share = self._made["power", f.key]
            return self._root(base, power * share)
        k, size = int(power.q), self._absolute(f)
        if k == 1:
            return size ** int(power.p)
        if max(k, abs(int(power.p))) > MOST_POWER:
            raise OutOfBounds("a root has a high power")

        def make() -> Element:
            held: list[Element] = []
            name = sp.Pow(self.expression(size), sp.Rational(1, k))
            slope = self.chain(f, lambda: held[0] * f.inverse() * fmpq(1, k))
            held.append(self.generator(name, slope, [f], (k, size.numerator)))
            self._made["power", held[0].key] = f, fmpq(1, k)
            return self._positive(held[0])

        root: Element = self._once(("root", k, f.key), make)
        return root ** int(power.p)

    def _factors(self, e: Element) -> tuple[fmpq, list[tuple[Element, int]]]:
        """Return c and irreducible polynomials with leading coefficient 1: e = c prod f^k."""
        if not e:
            return fmpq(1), [(self.zero, 1)]
        c, found = fmpq(1), []
        for p, sign in ((e.numerator, 1), (e.denominator, -1)):
            few = len(p) <= MOST_FACTORED and p.total_degree() <= MOST_POWER
            number, factors = p.factor() if few else (fmpq(1), [(p, 1)])
            self.spend(len(p))
            for f, k in factors:
                leading = f.leading_coefficient()
                number = number * leading ** int(k)
                if not f.is_constant():
                    found.append((Element(self, f / leading, self.unit, True), sign * int(k)))
            c = c * number if sign > 0 else c / number
        return c, found

    def _sign_of(self, f: Element) -> int:
        """Return 1 or -1 where f is shown to be not negative or not positive, else 0."""
        if f.key in self._signs:
            return self._signs[f.key]
        terms = f.numerator.to_dict()
        sure = all(c > 0 for c in terms.values()) and all(
            k % 2 == 0 or self._made.get(("positive", place)) for monomial in terms for place, k in enumerate(monomial)
        )
        return int(sure)

    def _positive(self, g: Element) -> Element:
        """Note that a generator is not negative."""
        place = next(i for i, k in enumerate(g.numerator.degrees()) if k)
        self._made["positive", place] = True
        return g

    def _absolute(self, f: Element) -> Element:
        """Return |f| for an irreducible f."""
        sign = self._sign_of(f)
        if sign:
            return f * sign

        def make() -> Element:
            held: list[Element] = []
            slope = self.chain(f, lambda: held[0] * f.inverse())
            held.append(self.generator(sp.Abs(self.expression(f)), slope, [f], (2, f.numerator**2)))
            self._made["power", held[0].key] = f, fmpq(1)
            return self._positive(held[0])

        size: Element = self._once(("abs", f.key), make)
        return size

    def _abs(self, e: Element) -> Element:
        c, factors = self._factors(e)
        return reduce(Element.__mul__, [self._absolute(f) ** k for f, k in factors], self.number(abs(c)))

    def _signum(self, e: Element) -> Element:
        c, factors = self._factors(e)
        parts = [self._absolute(f) * f.inverse() for f, k in factors if k % 2]
        return reduce(Element.__mul__, parts, self.number(1 if c > 0 else -1))

    def _logarithm(self, e: Element) -> Element:
        c, factors = self._factors(e)
        primes = sp.factorrat(sp.Rational(abs(int(c.p)), int(c.q))).items()
        total = self.sum(self.constant(sp.log(prime)) * int(k) for prime, k in primes)
        for f, k in factors:
            total = total + self._log_of(f) * k
        return total

    def _log_of(self, f: Element) -> Element:
        """Return log |f| for an irreducible f."""
        if ("power", f.key) in self._made:
            base, share = self._made["power", f.key]
            return self._log_of(base) * share
        exponent = self._made.get(("exponent", f.key))
        if exponent is not None:
            found: Element = exponent
            return found

        def make() -> Element:
            formula, sign = self.expression(f), self._sign_of(f)
            name = sp.log(formula * sign if sign else sp.Abs(formula))
            return self.generator(name, self.chain(f, f.inverse), [f])

        log: Element = self._once(("log", f.key), make)
        return log
