"""The basis L_0, D_..., x_..., 1 of a closed estimation algebra, and its table of brackets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import sympy as sp

from zakai.algebra.closure import Closure
from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.linear_span import Span, Vector, Word
from zakai.algebra.operators import Symbol
from zakai.models.model import Model


def operator_symbols(model: Model) -> tuple[sp.Symbol, tuple[sp.Symbol, ...]]:
    """L_0 and the D_i = d/dx_i - g_i: L0, D1, D2, ...; with a letter twice, or more, where the model has such a name."""
    used_names = {*model.state, *model.parameters, *model.functions}
    first, letter = "L", "D"
    while f"{first}0" in used_names:
        first += "L"
    while any(f"{letter}{i + 1}" in used_names for i in range(model.n)):
        letter += "D"
    D = tuple(sp.Symbol(f"{letter}{i + 1}", commutative=False) for i in range(model.n))
    return sp.Symbol(f"{first}0", commutative=False), D


@dataclass(frozen=True)
class Basis:
    """`elements` E_k in L0, D_i and the state; each as a combination of `words`; [E_i, E_j] = sum_k constants[i, j][k] E_k.

    (S^-1 h)_j = sum_k observation[j][k] E_k.
    """

    elements: tuple[sp.Expr, ...]
    words: tuple[Mapping[Word, sp.Expr], ...]
    constants: Mapping[tuple[int, int], tuple[sp.Expr, ...]]
    observation: tuple[tuple[sp.Expr, ...], ...]

    def brackets(self) -> dict[tuple[int, int], sp.Expr]:
        """[E_i, E_j] for i < j, in the terms of the basis."""
        return {pair: sp.Add(*[c * element for c, element in zip(row, self.elements)]) for pair, row in self.constants.items()}


def basis_of(operators: DmzOperators, closure: Closure) -> Basis:
    """The reduced echelon basis in D and x, highest order first, with L_0 itself in the place of its leading row."""
    numbers = operators.numbers
    if not closure.words:  # L_0 = 0 and h = 0
        return Basis((), (), {}, ((),) * len(operators.driven))
    span = Span(numbers.one)
    for word, symbol in closure.words.items():
        span.add(numbers.vector(operators.in_D(symbol)), word)
    leading = max(numbers.vector(operators.in_D(operators.L0)))
    combinations: list[Vector] = [{(0,): numbers.one}]
    elements: list[sp.Expr] = [operator_symbols(operators.model)[0]]
    for pivot, (row, words) in sorted(span.rows.items(), key=_place):
        if pivot != leading:
            combinations.append(words)
            elements.append(_expression(row, operators))
    constants, observation = _coordinates(combinations, operators, closure)
    in_words = tuple({word: numbers.expression(c) for word, c in combination.items()} for combination in combinations)
    return Basis(tuple(elements), in_words, constants, observation)


def _place(item: tuple[Any, Any]) -> tuple:
    """Highest order first, then functions from high degree to low; the first coordinate first."""
    order, generators, degree, monomial = item[0]
    return -order, -generators, -degree, tuple(-k for k in monomial)


def _coordinates(
    combinations: list[Vector], operators: DmzOperators, closure: Closure
) -> tuple[dict[tuple[int, int], tuple[sp.Expr, ...]], tuple[tuple[sp.Expr, ...], ...]]:
    """The coordinates of the brackets and of S^-1 h; every element is multiplied by a common denominator to be in the ring."""
    numbers = operators.numbers
    span = Span(numbers.one)
    multiples = []
    for k, combination in enumerate(combinations):
        symbol, denominator = numbers.combination(combination, closure.words)
        multiples.append((symbol, denominator))
        span.add({key: c / denominator for key, c in numbers.vector(symbol).items()}, k)

    def coordinates(symbol: Symbol, scale: Any) -> tuple[sp.Expr, ...]:
        rest, found = span.reduce(numbers.vector(symbol))
        assert not rest, "the span is closed"
        return tuple(numbers.expression(scale * found[k]) if k in found else sp.Integer(0) for k in range(len(multiples)))

    constants = {}
    for i, (left, p) in enumerate(multiples):
        for j, (right, q) in enumerate(multiples[i + 1 :], i + 1):
            constants[i, j] = coordinates(operators.ring.bracket(left, right), numbers.one / (p * q))
    return constants, tuple(coordinates(symbol, numbers.one) for symbol in operators.driven)


def _expression(row: Vector, operators: DmzOperators) -> sp.Expr:
    terms = []
    D = operator_symbols(operators.model)[1]
    for key, number in sorted(row.items(), reverse=True):
        exponents, function = operators.numbers.monomial(key)
        powers = [D_i**k for D_i, k in zip(D, exponents, strict=True) if k]
        terms.append(sp.Mul(operators.numbers.expression(number), function, *powers))
    return sp.Add(*terms)
