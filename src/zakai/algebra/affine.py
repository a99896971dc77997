"""Whether formulas are affine in the state, and their coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sp

from zakai.algebra.balls import concrete, differences
from zakai.algebra.identities import Answer, answer, is_affine, is_in_one_piece
from zakai.algebra.reading import Reader


@dataclass(frozen=True)
class Affine:
    """field = `slope` x + `intercept`: (m, n) and (m, 1), where the answer holds; else None."""

    answer: Answer
    slope: sp.ImmutableMatrix | None
    intercept: sp.ImmutableMatrix | None


def affine(field: sp.MatrixBase, x: tuple[sp.Symbol, ...]) -> Affine:
    """Return whether a field is affine in x for all x, and its coefficients."""
    formulas = [e for e in field if not e.is_Rational]
    one_piece = all(is_in_one_piece(e, x) for e in formulas)

    def proof(reader: Reader) -> bool:
        return all(is_affine(reader, reader(e), one_piece) for e in formulas)

    plain = _read_off(field, x)
    if plain is not None:
        return Affine(Answer(True, "proof", ""), *plain)
    found = answer(differences(list(map(concrete, formulas)), 2), formulas, x, proof, everywhere=True)
    if found.holds is not True:
        return Affine(found, None, None)
    origin = _point(field, x)
    slope = sp.Matrix([[sp.diff(e, s).xreplace(origin) for s in x] for e in field])
    intercept = field.xreplace(origin) - slope * sp.Matrix([origin[s] for s in x])
    return Affine(found, sp.ImmutableMatrix(slope), sp.ImmutableMatrix(intercept))


def _read_off(field: sp.MatrixBase, x: tuple[sp.Symbol, ...]) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """Return the coefficients of a field that is written as a sum of multiples of the states, else None."""
    own = set(x)
    slope, intercept = sp.zeros(len(field), len(x)), sp.zeros(len(field), 1)
    for i, entry in enumerate(field):
        rest: list[sp.Expr] = []
        parts: dict[sp.Symbol, list[sp.Expr]] = {}
        for term in sp.Add.make_args(entry):
            factors = sp.Mul.make_args(term)
            moving = [factor for factor in factors if not own.isdisjoint(factor.free_symbols)]
            if not moving:
                rest.append(term)
            elif len(moving) == 1 and moving[0] in own:
                parts.setdefault(moving[0], []).append(sp.Mul(*[factor for factor in factors if factor is not moving[0]]))
            else:
                return None
        intercept[i] = sp.Add(*rest)
        for symbol, coefficients in parts.items():
            slope[i, x.index(symbol)] = sp.Add(*coefficients)
    return sp.ImmutableMatrix(slope), sp.ImmutableMatrix(intercept)


def _point(field: sp.MatrixBase, x: Sequence[sp.Symbol]) -> dict[sp.Symbol, sp.Expr]:
    """Return a point where the field and its derivatives have values; the origin reads best."""
    for value in (sp.Integer(0), sp.Rational(1, 2), sp.Rational(7, 5)):
        point = {s: value for s in x}
        values = [e.xreplace(point) for entry in field for e in (entry, *(sp.diff(entry, s) for s in x))]
        if not any(e.has(sp.nan, sp.zoo, sp.oo) for e in values):
            break
    return point
