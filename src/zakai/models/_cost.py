"""What working with a formula can cost, bounded while it is read and before anything is computed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from zakai.models.expressions import MAX_DEPTH, ExpressionError

MAX_EXPONENT = 64
MAX_ROOT = 12
MAX_DEGREE = 256
MAX_BITS = 65_536
SMALL_SIZE = 100
SMALL_EXPANSION = 100
TINY_SIZE = 20
_MANY = 10**6  # expansions larger than this need not be told apart


@dataclass(frozen=True, slots=True)
class Cost:
    """The cost of one formula.

    Its degree as a polynomial in names and functions, the bits of all its exact numbers together, the height and the size of
    its tree, and the number of terms of its expansion.
    """

    degree: Fraction = Fraction(0)
    bits: int = 0
    height: int = 1
    size: int = 1
    terms: int = 1

    @property
    def small(self) -> bool:
        """Whether SymPy may look for simpler forms: its searches expand, and an untrusted formula can be large."""
        return self.size <= SMALL_SIZE and self.terms <= SMALL_EXPANSION

    @property
    def tiny(self) -> bool:
        """Whether SymPy may ask for its sign or its zeros, as functions and powers of it do: slower yet."""
        return self.small and self.size <= TINY_SIZE

    def checked(self, position: int) -> Cost:
        """The cost itself, if the formula at this position may be computed; raises ExpressionError if not."""
        if self.height > MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels", position)
        if self.degree > MAX_DEGREE:
            raise ExpressionError(f"its powers multiply to a degree above {MAX_DEGREE}", position)
        if self.bits > MAX_BITS:
            raise ExpressionError("its exact numbers grow too large", position)
        return self

    def power(self, exponent: Fraction) -> Cost:
        """The cost of a power; multinomials count the terms of its expansion."""
        repeats = max(1, math.ceil(abs(exponent)))
        terms = _MANY if self.terms >= _MANY else min(_MANY, math.comb(self.terms + repeats - 1, repeats))
        degree = self.degree * max(Fraction(1), abs(exponent))
        return Cost(degree, self.bits * repeats, self.height + 1, self.size + 2, terms)


def cost_of_sum(costs: Sequence[Cost]) -> Cost:
    """The cost of a sum, and of the arguments of a function."""
    return _together(costs, max(c.degree for c in costs), min(_MANY, sum(c.terms for c in costs)))


def cost_of_product(costs: Sequence[Cost]) -> Cost:
    """The cost of a product or quotient."""
    terms = 1
    for cost in costs:
        terms = min(_MANY, terms * cost.terms)
    return _together(costs, sum((c.degree for c in costs), Fraction(0)), terms)


def cost_of_call(costs: Sequence[Cost]) -> Cost:
    """The cost of a function: a polynomial sees it as one more name, but its argument still has its terms."""
    return _together(costs, Fraction(1), min(_MANY, sum(c.terms for c in costs)))


def _together(costs: Sequence[Cost], degree: Fraction, terms: int) -> Cost:
    height = 1 + max(cost.height for cost in costs)
    return Cost(degree, sum(cost.bits for cost in costs), height, 1 + sum(cost.size for cost in costs), terms)
