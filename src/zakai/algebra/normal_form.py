"""The basis L_0, D_..., x_..., 1 of a closed estimation algebra, and its table of brackets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sympy as sp

from zakai.algebra.closure import Closure
from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.linear_span import Span, Vector, Word

L0 = sp.Symbol("L0", commutative=False)


def D(i: int) -> sp.Symbol:
    """D_i = d/dx_i - g_i, i from 1."""
    return sp.Symbol(f"D{i}", commutative=False)


@dataclass(frozen=True)
class Basis:
    """`elements` in L0, D_i and the state; each as a combination of `words`; [E_i, E_j] = sum_k constants[i, j][k] E_k."""

    elements: tuple[sp.Expr, ...]
    words: tuple[Mapping[Word, sp.Expr], ...]
    constants: Mapping[tuple[int, int], tuple[sp.Expr, ...]]

    def brackets(self) -> dict[tuple[int, int], sp.Expr]:
        """[E_i, E_j] for i < j, in the terms of the basis."""
        return {pair: sp.Add(*[c * element for c, element in zip(row, self.elements)]) for pair, row in self.constants.items()}


def basis_of(operators: DmzOperators, closure: Closure) -> Basis:
    """The reduced echelon basis in D and x, highest order first, with L_0 itself in the place of its leading row."""
    numbers, one = operators.numbers, operators.numbers.one
    span = Span(one)
    for word, symbol in closure.words.items():
        span.add(numbers.vector(operators.in_D(symbol)), word)
    leading = max(numbers.vector(operators.in_D(operators.L0)))
    combinations: list[Vector] = [{(0,): one}]
    elements: list[sp.Expr] = [L0]
    for pivot, (row, words) in sorted(span.rows.items(), key=_place):
        if pivot != leading:
            combinations.append(words)
            elements.append(_expression(row, operators))
    coordinates = Span(one)
    for k, combination in enumerate(combinations):
        coordinates.add(combination, k)
    table = _word_brackets(operators, closure)
    constants = {}
    for i, left in enumerate(combinations):
        for j, right in enumerate(combinations[i + 1 :], i + 1):
            found = coordinates.reduce(_bilinear(left, right, table))[1]
            constants[i, j] = tuple(
                numbers.expression(found[k]) if k in found else sp.Integer(0) for k in range(len(combinations))
            )
    in_words = tuple({word: numbers.expression(c) for word, c in combination.items()} for combination in combinations)
    return Basis(tuple(elements), in_words, constants)


def _place(item: tuple[Any, Any]) -> tuple:
    """Highest order first, then functions from high degree to low; the first coordinate first."""
    order, generators, degree, monomial = item[0]
    return -order, -generators, -degree, tuple(-k for k in monomial)


def _word_brackets(operators: DmzOperators, closure: Closure) -> dict[tuple[Word, Word], Vector]:
    words = list(closure.words)
    table = {}
    for i, left in enumerate(words):
        for right in words[i + 1 :]:
            bracket = operators.ring.bracket(closure.words[left], closure.words[right])
            rest, taken = closure.span.reduce(operators.numbers.vector(bracket))
            assert not rest, "the span is closed"
            table[left, right] = taken
    return table


def _bilinear(left: Vector, right: Vector, table: Mapping[tuple[Word, Word], Vector]) -> Vector:
    total: Vector = {}
    for a, x in left.items():
        for b, y in right.items():
            known, factor = (table[a, b], x * y) if (a, b) in table else (table.get((b, a), {}), -(x * y))
            for word, c in known.items():
                value = total[word] + factor * c if word in total else factor * c
                if value:
                    total[word] = value
                else:
                    total.pop(word)
    return total


def _expression(row: Vector, operators: DmzOperators) -> sp.Expr:
    terms = []
    for key, number in sorted(row.items(), reverse=True):
        exponents, function = operators.numbers.monomial(key)
        powers = [D(i + 1) ** k for i, k in enumerate(exponents) if k]
        terms.append(sp.Mul(operators.numbers.expression(number), function, *powers))
    return sp.Add(*terms)
