"""Formulas as fractions of elements of the ring, and one inverse, v = 1/Q, for all denominators."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import sympy as sp
from flint import fmpq

from zakai.algebra.arguments import Unreadable
from zakai.algebra.operators import OperatorRing, Symbol

Fraction = tuple[Symbol, Symbol]


class Fractions:
    """The way from formulas to elements.

    `symbols` and `values` give the elements of symbols and the fractions of functions; `inverse` is the number of the
    generator v.  Q is the product of the different factors of the denominators, P of those that are constant; 1/P is the last
    constant of the ring.
    """

    def __init__(
        self,
        ring: OperatorRing,
        symbols: Mapping[sp.Expr, Symbol],
        values: Mapping[sp.Expr, Callable[[], Fraction]],
        inverse: int,
    ):
        self._ring, self._symbols, self._values, self._inverse = ring, symbols, values, inverse
        self._known: dict[sp.Expr, Fraction] = {}
        self.Q = self.P = ring.one

    def of(self, e: sp.Expr) -> Fraction:
        """(numerator, denominator) of a formula in lowest terms; raises Unreadable."""
        if e not in self._known:
            self._known[e] = self._convert(e)
        return self._known[e]

    def _convert(self, e: sp.Expr) -> Fraction:
        ring = self._ring
        if e.is_Rational:
            return ring.number(fmpq(int(e.p), int(e.q))), ring.one
        if e in self._symbols:
            return self._symbols[e], ring.one
        if isinstance(e, sp.Add):
            return self._sum([self.of(a) for a in e.args])
        if isinstance(e, sp.Mul):
            parts = [self.of(a) for a in e.args]
            numerator = sp.prod([p for p, _ in parts], start=ring.one)
            denominator = sp.prod([q for _, q in parts], start=ring.one)
            return self._lowest(numerator, denominator)
        if isinstance(e, sp.Pow) and e.exp.is_Integer:
            numerator, denominator = self.of(e.base)
            k = int(e.exp)
            if k < 0:
                numerator, denominator = denominator, numerator
                if denominator.is_zero():
                    raise Unreadable(f"{e} divides by zero")
            return self._lowest(numerator ** abs(k), denominator ** abs(k))
        if e in self._values:
            return self._values[e]()
        raise Unreadable(f"{e} is not in the operator ring")

    def _sum(self, parts: list[Fraction]) -> Fraction:
        numerator, denominator = self._ring.zero, self._ring.one
        for p, q in parts:
            if q == denominator:
                numerator = numerator + p
            else:
                numerator, denominator = numerator * q + p * denominator, denominator * q
        return self._lowest(numerator, denominator)

    def _lowest(self, numerator: Symbol, denominator: Symbol) -> Fraction:
        ring = self._ring
        numerator, denominator = ring.normal(numerator), ring.normal(denominator)
        if denominator.is_constant():
            return numerator / denominator.leading_coefficient(), ring.one
        common = numerator.gcd(denominator)
        return divmod(numerator, common)[0], divmod(denominator, common)[0]

    def polynomial(self, fraction: Fraction) -> Symbol:
        """The fraction as an element, with the inverses of Q and P for its denominator."""
        ring = self._ring
        numerator, denominator = fraction
        if denominator.is_constant():
            return ring.normal(numerator / denominator.leading_coefficient())
        every, inverse = self.Q * self.P, ring.one
        if not self.Q.is_constant():
            inverse = inverse * ring.u[self._inverse]
        if not self.P.is_constant():
            inverse = inverse * ring.c[-1]
        power = every
        for k in range(1, sum(denominator.degrees()) + 1):
            quotient, remainder = divmod(power, denominator)
            if remainder.is_zero():
                return ring.normal(numerator * quotient * inverse**k)
            power = power * every
        raise Unreadable("a denominator is not a product of those of the formulas")

    def relate(self, denominators: list[Symbol]) -> None:
        """Find Q and P, and add v Q = 1 to the relations of the ring."""
        ring, constants = self._ring, len(self._ring.c)
        factors: dict[str, Symbol] = {}
        for denominator in denominators:
            for factor, _ in denominator.factor()[1]:
                factors.setdefault(str(factor), factor)
        moving = {name for name, factor in factors.items() if any(k > 0 for k in factor.degrees()[:-constants])}
        self.Q = sp.prod([factor for name, factor in factors.items() if name in moving], start=ring.one)
        self.P = sp.prod([factor for name, factor in factors.items() if name not in moving], start=ring.one)
        if not self.P.is_constant():
            ring.relations.append(ring.c[-1] * self.P - 1)
        if not moving:
            return
        if any(self.Q.monoms()[0][-constants:]):
            raise Unreadable("the leading coefficient of a denominator depends on a parameter")
        rewritten = [relation.degrees() for relation in ring.relations]
        ring.relations.append(ring.u[self._inverse] * self.Q - 1)
        first, last = ring.n, ring.n + ring.generators
        if any(k > 0 and q > 0 for degrees in rewritten for k, q in zip(degrees[first:last], self.Q.degrees()[first:last])):
            self._complete()

    def _complete(self) -> None:
        """A Groebner basis, where the leading monomials of the relations have common factors."""
        ring = self._ring
        names = [sp.Symbol(name) for name in ring.context.names()]
        relations = [sp.Poly(str(r).replace("^", "**"), *names) for r in ring.relations]
        basis = sp.groebner(relations, *names, order="lex")
        ring.relations = [ring.context.from_dict({m: _flint(c) for m, c in p.terms()}) for p in basis.polys]

    def declare(self) -> None:
        """d_i v = -v^2 d_i Q, once the derivatives of all other generators are known."""
        ring = self._ring
        if not self.Q.is_constant():
            v = ring.u[self._inverse]
            slopes = [ring.total_derivative(self.Q, i) for i in range(ring.n)]
            ring.derivatives[self._inverse] = [ring.normal(-(v**2) * slope) for slope in slopes]


def _flint(number: Any) -> fmpq:
    return fmpq(int(number.p), int(number.q))
