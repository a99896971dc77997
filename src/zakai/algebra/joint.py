"""Arguments of functions over a Z-basis: exp(2 x) and exp(3 x) are powers of one exponential.

The basis is the Hermite normal form of the coefficients of the arguments; numbers are left apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import sympy as sp
from flint import fmpz_mat

from zakai.algebra.tower import Element, OutOfBounds, Tower

MOST_MULTIPLE = 24  # of an argument


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
    marked = fmpz_mat([[*row, *(int(i == j) for j in range(len(A)))] for i, row in enumerate(A)])
    H = [[int(c) for c in row] for row in marked.hnf().tolist() if any(row[:width])]
    values = [tower.sum(e * c for c, e in zip(row[width:], elements) if c) for row in H]
    coordinates = {}
    for name, element, left in zip(names, elements, A):
        multiples = []
        for row in H:
            pivot = next(j for j in range(width) if row[j])
            k = left[pivot] // row[pivot]
            left = [a - k * b for a, b in zip(left, row)]
            multiples.append(k)
        if max(map(abs, multiples)) > MOST_MULTIPLE:
            raise OutOfBounds("arguments are high multiples of each other")
        rest = element - tower.sum(value * k for k, value in zip(multiples, values) if k)
        coordinates[name] = multiples, tower.expression(rest)
    basis = [sp.Add(*[c * u for c, u in zip(row[width:], names)]) for row in H]
    return Joint(basis, coordinates)
