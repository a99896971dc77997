"""The linear span of operators: an echelon form over the rationals, or over quotients of polynomials in the constants."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import sympy as sp
from flint import fmpq_mpoly_ctx

from zakai.algebra.generators import Reader
from zakai.algebra.operators import OperatorRing, Symbol
from zakai.algebra.ratios import Ratio

Vector = dict[Any, Any]  # key -> number that is not zero
Word = tuple[int, ...]


class Numbers:
    """Symbols as vectors: monomials in (xi, u, x), with numbers that are rationals or `Ratio`s of the ring's constants.

    A monomial's key is (xi-degree, generator degree, x-degree, monomial), so that the rows of an echelon form whose pivot has
    xi-degree 0 are a basis of the functions in the span.
    """

    def __init__(self, ring: OperatorRing, symbolic: bool, reader: Reader):
        self._ring, self._reader = ring, reader
        self._count = ring.constants
        self.symbolic = symbolic
        self._context = fmpq_mpoly_ctx.get([f"c{k}" for k in range(ring.constants)], ring.context.ordering())
        denominator = {m[-self._count :]: c for m, c in reader.constant_denominator.to_dict().items()}
        self._denominator = self._context.from_dict(denominator)
        one = self._context.constant(1)
        self.one = Ratio(one, one) if symbolic else ring.one.leading_coefficient()

    def vector(self, p: Symbol) -> Vector:
        """The coefficients of an operator."""
        if not self.symbolic:
            return {self._key(m): c for m, c in p.to_dict().items()}
        groups: dict[Any, dict[tuple[int, ...], Any]] = {}
        for m, c in p.to_dict().items():
            groups.setdefault(self._key(m), {})[m[-self._count :]] = c
        return {key: self._ratio(terms) for key, terms in groups.items()}

    def _ratio(self, terms: dict[tuple[int, ...], Any]) -> Ratio:
        """The last constant stands for 1 / denominator."""
        highest = max(m[-1] for m in terms)
        by_power: dict[int, dict[tuple[int, ...], Any]] = {}
        for m, c in terms.items():
            by_power.setdefault(highest - m[-1], {})[(*m[:-1], 0)] = c
        numerator = self._context.constant(0)
        for power, part in by_power.items():
            numerator = numerator + self._context.from_dict(part) * self._denominator**power
        return Ratio(numerator, self._denominator**highest)

    def expression(self, number: Any) -> sp.Expr:
        """A number of this kind in SymPy."""
        if not self.symbolic:
            return sp.Rational(int(number.p), int(number.q))
        return sp.factor(self._in_constants(number.numerator) / self._in_constants(number.denominator))

    def _in_constants(self, p: Any) -> sp.Expr:
        return self._reader.expression(self._in_ring(p))

    def _in_ring(self, p: Any) -> Symbol:
        padding = (0,) * (self._ring.n + self._ring.generators + self._ring.n)
        return self._ring.context.from_dict({(*padding, *m): c for m, c in p.to_dict().items()})

    def monomial(self, key: Any) -> tuple[tuple[int, ...], sp.Expr]:
        """The exponents of xi and the function in SymPy that a key stands for."""
        n, exponents = self._ring.n, key[3]
        padded = (*[0] * n, *exponents[n:], *[0] * self._count)
        return exponents[:n], self._reader.expression(self._ring.context.from_dict({padded: 1}))

    def combination(self, numbers: Vector, elements: Mapping[Any, Symbol]) -> tuple[Symbol, Any]:
        """(p, d): sum_k numbers[k] elements[k] = p / d with p in the ring."""
        if not self.symbolic:
            return sum((elements[key] * c for key, c in numbers.items()), self._ring.zero), self.one
        common = self._context.constant(1)
        for c in numbers.values():
            common = common * divmod(c.denominator, common.gcd(c.denominator))[0]
        total = self._ring.zero
        for key, c in numbers.items():
            total = total + elements[key] * self._in_ring(c.numerator * divmod(common, c.denominator)[0])
        return total, Ratio(common, self._context.constant(1))

    def support(self, vector: Vector) -> np.ndarray:
        """The exponents of x and then of xi of a vector without generators, a row each."""
        n = self._ring.n
        return np.array([(*key[3][-n:], *key[3][:n]) for key in vector], dtype=int)

    def expression_of(self, vector: Vector) -> sp.Expr:
        """A vector that is a function, in SymPy."""
        return sp.Add(*[self.expression(c) * self.monomial(key)[1] for key, c in vector.items()])

    def _key(self, m: tuple[int, ...]) -> tuple[int, int, int, tuple[int, ...]]:
        xi, u, x, _ = self._ring.split(m)
        return sum(xi), sum(u), sum(x), (*xi, *u, *x)


class Span:
    """A span in fully reduced echelon form; each row knows itself as a combination of the words that were added."""

    def __init__(self, one: Any):
        self._one = one
        self.rows: dict[Any, tuple[Vector, Vector]] = {}  # pivot -> (row, its combination of words)

    def __len__(self) -> int:
        return len(self.rows)

    def reduce(self, vector: Vector) -> tuple[Vector, Vector]:
        """Return (the remainder of a vector modulo the span, the combination of words that was subtracted)."""
        left, subtracted = dict(vector), Vector()
        for pivot in [key for key in vector if key in self.rows]:
            factor = left[pivot]
            row, words = self.rows[pivot]
            _subtract(left, factor, row)
            _subtract(subtracted, -factor, words)
        return left, subtracted

    def add(self, vector: Vector, word: Any) -> bool:
        """Whether the vector is new; then it is in the span from now on."""
        left, subtracted = self.reduce(vector)
        if not left:
            return False
        pivot = max(left)
        scale = self._one / left[pivot]
        combination = {word: self._one}
        _subtract(combination, self._one, subtracted)
        row = {key: scale * c for key, c in left.items()}
        combination = {key: scale * c for key, c in combination.items()}
        for other, words in self.rows.values():
            if pivot in other:
                factor = other[pivot]
                _subtract(other, factor, row)
                _subtract(words, factor, combination)
        self.rows[pivot] = (row, combination)
        return True


def _subtract(target: Vector, factor: Any, row: Vector) -> None:
    for key, c in row.items():
        value = target[key] - factor * c if key in target else -factor * c
        if value:
            target[key] = value
        else:
            target.pop(key, None)


__all__ = ["Numbers", "Span", "Vector", "Word"]
