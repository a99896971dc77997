"""A basis of the integer combinations of rows: the Hermite normal form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from flint import fmpz_mat

MOST_MULTIPLE = 24  # of a row of the basis in a row that is given


class IntegerBasis(NamedTuple):
    """The `rows` of a basis, each as a combination of those that are given, and each of these as a combination of the basis."""

    rows: list[list[int]]
    combinations: list[list[int]]
    multiples: list[list[int]]

    @property
    def high(self) -> bool:
        """Whether a multiple is too high for a power."""
        return any(abs(k) > MOST_MULTIPLE for row in self.multiples for k in row)


def integer_basis(given: Sequence[Sequence[int]]) -> IntegerBasis:
    """Return a Z-basis of rows of integers, of which each pivot is the first entry that is not zero."""
    width = len(given[0])
    marked = fmpz_mat([[*row, *(int(i == j) for j in range(len(given)))] for i, row in enumerate(given)])
    reduced = [[int(c) for c in row] for row in marked.hnf().tolist() if any(row[:width])]
    rows, combinations = [row[:width] for row in reduced], [row[width:] for row in reduced]
    pivots, multiples = [next(j for j, c in enumerate(row) if c) for row in rows], []
    for one in given:
        left, found = list(one), []
        for row, pivot in zip(rows, pivots, strict=True):
            found.append(left[pivot] // row[pivot])
            left = [c - found[-1] * b for c, b in zip(left, row, strict=True)]
        multiples.append(found)
    return IntegerBasis(rows, combinations, multiples)
