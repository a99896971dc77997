"""Differential operators with exact coefficients, as symbols in one ring of polynomials.

The operator sum_a c_a(x) d^a is the polynomial sum_a c_a xi^a in the variables (xi, generators, x, constants).  With d_i the
total derivative, in which each generator has a declared derivative,

    A o B = sum_alpha  (1 / alpha!) d^alpha A / d xi^alpha  *  d_x^alpha B,          [A, B] = A o B - B o A.

Generators are functions such as t = tanh(x1), with d_1 t = 1 - t^2; relations such as s^2 + c^2 = 1 are rewritten away.
Different normal forms are different operators as long as the generators are algebraically independent over the rational
functions of x but for the relations; `generators.py` sees to that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from flint import Ordering, fmpq_mpoly_ctx

Symbol = Any  # a flint.fmpq_mpoly: the symbol of an operator, or a function (a symbol without xi)


class JetTowerEnds(Exception):
    """A derivative was needed of an undetermined function beyond the highest one that the ring holds."""


class OperatorRing:
    """Q[xi, u, x, c]: `states` n variables xi and x, generators u, constants c.

    `derivatives[k]` holds the n derivatives of generator k, or None where they are not in the ring; `relations` are the
    polynomials that are zero, monic in what they rewrite.  Both are filled by whoever makes the ring.

        >>> ring = OperatorRing(states=1)
        >>> ring.bracket(ring.xi[0], ring.x[0])
        1
    """

    def __init__(self, states: int, generators: int = 0, constants: int = 0):
        names = [f"xi{i}" for i in range(states)] + [f"u{k}" for k in range(generators)]
        names += [f"x{i}" for i in range(states)] + [f"c{k}" for k in range(constants)]
        self.context = fmpq_mpoly_ctx.get(names, Ordering.lex)
        variables = self.context.gens()
        self.n, self.generators, self.constants = states, generators, constants
        self._first_x = states + generators
        self.xi = variables[:states]
        self.u = variables[states : self._first_x]
        self.x = variables[self._first_x : self._first_x + states]
        self.c = variables[self._first_x + states :]
        self.zero, self.one = self.context.constant(0), self.context.constant(1)
        self.derivatives: list[Sequence[Symbol] | None] = [None] * generators
        self.relations: list[Symbol] = []

    def number(self, value: Any) -> Symbol:
        """A rational number as an element."""
        return self.context.constant(value)

    def normal(self, p: Symbol) -> Symbol:
        """The normal form modulo the relations."""
        while self.relations:
            before = p
            for relation in self.relations:
                p = divmod(p, relation)[1]
            if p == before:
                break
        return p

    def total_derivative(self, p: Symbol, i: int) -> Symbol:
        """d_i p; raises JetTowerEnds where the derivative of a generator is not in the ring."""
        result = p.derivative(self._first_x + i)
        degrees = p.degrees()
        for k in range(self.generators):
            if degrees[self.n + k] > 0:
                derivatives = self.derivatives[k]
                if derivatives is None:
                    raise JetTowerEnds
                if not derivatives[i].is_zero():
                    result = result + p.derivative(self.n + k) * derivatives[i]
        return self.normal(result)

    def compose(self, a: Symbol, b: Symbol) -> Symbol:
        """The symbol of A o B."""
        return self.normal(sum(self._leibniz(a, b, 0), self.zero))

    def bracket(self, a: Symbol, b: Symbol) -> Symbol:
        """The symbol of [A, B]; the terms a * b and b * a cancel and are never formed."""
        return self.normal(sum(self._leibniz(a, b, 1), self.zero) - sum(self._leibniz(b, a, 1), self.zero))

    def _leibniz(self, a: Symbol, b: Symbol, lowest: int) -> Iterator[Symbol]:
        """The products of Leibniz' rule with |alpha| >= lowest, coordinate by coordinate."""
        stack = [(a, b, 0, 0)]
        while stack:
            left, right, i, order = stack.pop()
            if i == self.n:
                if order >= lowest:
                    yield left * right
                continue
            k = 0
            while True:
                stack.append((left, right, i + 1, order + k))
                k += 1
                left = left.derivative(i) / k
                if left.is_zero():
                    break
                right = self.total_derivative(right, i)
                if right.is_zero():
                    break

    def order(self, p: Symbol) -> int:
        """The order of the operator, -1 for zero."""
        return max((sum(m[: self.n]) for m in p.monoms()), default=-1)

    def principal(self, p: Symbol) -> Symbol:
        """The principal symbol: the terms of highest order."""
        order = self.order(p)
        return self.context.from_dict({m: c for m, c in p.to_dict().items() if sum(m[: self.n]) == order})

    def has_generators(self, p: Symbol) -> bool:
        """Whether a normal form is not polynomial in x."""
        return any(k > 0 for k in p.degrees()[self.n : self._first_x])

    def degree(self, p: Symbol) -> int:
        """The degree in x, -1 for zero."""
        return max((sum(m[self._first_x : self._first_x + self.n]) for m in p.monoms()), default=-1)

    def split(self, monomial: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
        """The exponents of xi, of the generators, of x and of the constants."""
        first, last = self._first_x, self._first_x + self.n
        return monomial[: self.n], monomial[self.n : first], monomial[first:last], monomial[last:]
