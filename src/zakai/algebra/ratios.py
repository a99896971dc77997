"""Quotients of polynomials in the constants of a model: the numbers of a closure whose parameters stay symbols."""

from __future__ import annotations

from typing import Any

MOST_TERMS = 200


class TooLarge(Exception):
    """A numerator or denominator has more than MOST_TERMS terms: symbols for the constants are not feasible."""


class Ratio:
    """`numerator` / `denominator` in lowest terms, two flint polynomials of one context; the denominator is monic."""

    __slots__ = ("numerator", "denominator")

    def __init__(self, numerator: Any, denominator: Any):
        if not denominator.is_constant():
            common = numerator.gcd(denominator)
            if not common.is_constant():
                numerator, denominator = divmod(numerator, common)[0], divmod(denominator, common)[0]
        if max(len(numerator), len(denominator)) > MOST_TERMS:
            raise TooLarge("polynomials in the constants grow too large")
        leading = denominator.leading_coefficient()
        self.numerator, self.denominator = numerator / leading, denominator / leading

    def __add__(self, other: Ratio) -> Ratio:
        if self.denominator == other.denominator:
            return Ratio(self.numerator + other.numerator, self.denominator)
        return Ratio(
            self.numerator * other.denominator + other.numerator * self.denominator, self.denominator * other.denominator
        )

    def __neg__(self) -> Ratio:
        return Ratio(-self.numerator, self.denominator)

    def __sub__(self, other: Ratio) -> Ratio:
        return self + -other

    def __mul__(self, other: Ratio) -> Ratio:
        return Ratio(self.numerator * other.numerator, self.denominator * other.denominator)

    def __truediv__(self, other: Ratio) -> Ratio:
        return Ratio(self.numerator * other.denominator, self.denominator * other.numerator)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Ratio):
            return bool(self.numerator == other.numerator and self.denominator == other.denominator)
        return bool(self.numerator == other * self.denominator)

    __hash__ = None  # type: ignore[assignment]

    def __bool__(self) -> bool:
        return not self.numerator.is_zero()
