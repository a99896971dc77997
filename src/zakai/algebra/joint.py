"""Arguments of functions over a Z-basis: exp(2 x) and exp(3 x) are powers of one exponential.

The basis is the Hermite normal form of the coefficients of the arguments; numbers are left apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import sympy as sp
from flint import fmpz_mat

from zakai.algebra.integer_basis import integer_basis
from zakai.algebra.tower import Element, OutOfBounds, Tower


class Joint(NamedTuple):
    """Arguments over a Z-basis: of each its integer multiples of the basis, and a number that is left."""

    basis: list[sp.Expr]
    coordinates: Mapping[sp.Expr, tuple[list[int], sp.Expr]]


def dependent(tower: Tower, arguments: Mapping[sp.Expr, Element]) -> Joint | None:
    """Return a Z-basis of arguments that are dependent over Q modulo numbers, or None where they are independent.

    Raises:
        OutOfBounds: a multiple is too high.
    """
    names, elements, below = list(arguments), list(arguments.values()), tower.unit
    for e in elements:
        below = tower.times(below, e.denominator / tower.gcd(below, e.denominator))
    rows = [tower.times(e.numerator, below / e.denominator).to_dict() for e in elements]
    number = below.monoms()[0] if below.is_constant() else None  # the monomial of numbers
    monomials = sorted({m for row in rows for m in row if m != number})
    scale = math.lcm(*(int(c.q) for row in rows for c in row.values()))
    A = [[int(row[m] * scale) if m in row else 0 for m in monomials] for row in rows]
    width = len(monomials)
    if len(A) < 2 or width == 0 or fmpz_mat(A).rank() == len(A):
        return None
    reduced = integer_basis(A)
    if reduced.high:
        raise OutOfBounds("arguments are high multiples of each other")
    values = [tower.sum(e * c for c, e in zip(row, elements) if c) for row in reduced.combinations]
    coordinates = {}
    for name, element, multiples in zip(names, elements, reduced.multiples):
        rest = element - tower.sum(value * k for k, value in zip(multiples, values) if k)
        coordinates[name] = multiples, tower.expression(rest)
    basis = [sp.Add(*[c * u for c, u in zip(row, names)]) for row in reduced.combinations]
    return Joint(basis, coordinates)
