"""The Lie algebra that L_0 and h_1, ..., h_m generate: closed under brackets, or explored within a budget.

Left-normed brackets [g_1, [g_2, ... [g_k-1, g_k]]] of generators span the algebra, so that only new elements are bracketed,
and only with the generators; such a bracket is named by its word (1, ..., k), L_0 being 0.  The words of one length are all
explored before anything is concluded, so that what is found depends neither on coordinates nor on the order of the h_i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from zakai.algebra.linear_span import Numbers, Span, Vector, Word
from zakai.algebra.operators import JetTowerEnds, OperatorRing, Symbol

NO_JETS = "higher derivatives of an undetermined function are needed than are kept"


@dataclass(frozen=True)
class Budget:
    """How far to explore: counts, so that a verdict does not depend on the machine."""

    elements: int
    order: int = 8
    terms: int = 5_000

    @classmethod
    def of(cls, states: int) -> Budget:
        """6 n + 20 elements, for an estimation algebra of maximal rank has 2 n + 2; and 50 at most."""
        return cls(elements=min(6 * states + 20, 50))


class Row(NamedTuple):
    """An element as a vector, and as a combination of words."""

    vector: Vector
    words: Vector

    @property
    def order(self) -> int:
        """The order of the operator; 0 for a function."""
        return max(key[0] for key in self.vector)

    @property
    def degree(self) -> int:
        """The degree in x."""
        return max(key[2] for key in self.vector)

    def is_polynomial(self, degree: int | None = None) -> bool:
        """Whether all coefficients are polynomials, of at most a degree."""
        return not any(key[1] for key in self.vector) and (degree is None or self.degree <= degree)

    def principal_is_polynomial(self) -> bool:
        """Whether the coefficients of highest order are polynomials."""
        order = self.order
        return not any(key[1] for key in self.vector if key[0] == order)


@dataclass
class Closure:
    """The span of the words found, in echelon form; `closed` if it is the whole algebra, `limit` says what else ended it."""

    ring: OperatorRing
    numbers: Numbers
    generators: Sequence[Symbol]
    span: Span
    words: dict[Word, Symbol] = field(default_factory=dict)
    length: int = 1
    closed: bool = False
    limit: str = ""

    @property
    def longest(self) -> int:
        """The number of generators in the longest word."""
        return max(map(len, self.words), default=0)

    @property
    def highest_order(self) -> int:
        """The order of the words of highest order."""
        return max((pivot[0] for pivot in self.span.rows), default=-1)

    def rows(self) -> list[Row]:
        """The rows of the echelon form, highest pivot first."""
        return [Row(row, words) for _, (row, words) in sorted(self.span.rows.items(), reverse=True)]


def close(
    ring: OperatorRing,
    numbers: Numbers,
    generators: Sequence[Symbol],
    budget: Budget,
    conclude: Callable[[Closure], bool],
) -> Closure:
    """Explore length by length until nothing is new, `conclude` has seen enough, or the budget is spent."""
    found = Closure(ring, numbers, generators, Span(numbers.one))
    fresh: list[Word] = []
    for k, generator in enumerate(generators):
        if not generator.is_zero() and found.span.add(numbers.vector(generator), (k,)):
            found.words[(k,)] = generator
            fresh.append((k,))
    while not conclude(found):
        if not fresh:
            found.closed = True
            break
        try:
            fresh = _longer(found, fresh, budget)
        except JetTowerEnds:
            found.limit = NO_JETS
        if found.limit:
            conclude(found)
            break
        found.length += 1
    return found


def _longer(found: Closure, fresh: list[Word], budget: Budget) -> list[Word]:
    new: list[Word] = []
    for word in fresh:
        for k, generator in enumerate(found.generators):
            if word == (k,):
                continue
            bracket = found.ring.bracket(generator, found.words[word])
            if bracket.is_zero():
                continue
            if len(bracket) > budget.terms:
                found.limit = f"a bracket has more than {budget.terms} terms"
                return new
            if not found.span.add(found.numbers.vector(bracket), (k, *word)):
                continue
            found.words[(k, *word)] = bracket
            new.append((k, *word))
    if len(found.span) > budget.elements:
        found.limit = f"more than {budget.elements} independent elements"
    elif found.highest_order > budget.order:
        found.limit = f"an element has an order above {budget.order}"
    return new
