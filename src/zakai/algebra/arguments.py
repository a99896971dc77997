"""Arguments of elementary functions over a basis: exp(2 x) and exp(3 x) are powers of one exponential.

Exponentials of polynomials are algebraically independent over the rational functions if and only if no integer combination
of the polynomials is constant (Ax 1971, the theorem of Lindemann and Weierstrass for functions); so are sines, with
imaginary exponents.  A Z-basis of the arguments gives generators that are independent, and each argument as an integer
combination.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import lcm

import sympy as sp
from flint import fmpz_mat

from zakai.algebra.integer_basis import integer_basis


class Unreadable(Exception):
    """What the operator ring cannot hold, as the end of a sentence."""


def argument_basis(arguments: Sequence[sp.Expr], x: Sequence[sp.Symbol], kind: str) -> tuple[list[sp.Expr], list[list[int]]]:
    """(basis, coordinates): polynomials, and each argument as an integer combination of them.

    Raises Unreadable where an argument is no polynomial in x, or arguments differ by a constant.
    """
    if not arguments:
        return [], []
    constants = sorted(set().union(*(a.free_symbols for a in arguments)) - set(x), key=lambda s: s.name)
    try:
        polynomials = [sp.Poly(argument, *x, *constants, domain="QQ") for argument in arguments]
    except sp.PolynomialError:
        raise Unreadable(f"the argument of {kind} is not a polynomial in the state") from None
    monomials = sorted({m for p in polynomials for m in p.monoms()}, reverse=True)
    rows = [[p.coeff_monomial(m) for m in monomials] for p in polynomials]
    scale = lcm(*(int(sp.Rational(c).q) for row in rows for c in row))
    reduced = integer_basis([[int(c * scale) for c in row] for row in rows])
    moving = [j for j, m in enumerate(monomials) if any(m[: len(x)])]
    if fmpz_mat([[row[j] for j in moving] for row in reduced.rows]).rank() < len(reduced.rows):
        raise Unreadable(f"arguments of {kind} differ by a constant, whose function is an irrational factor")
    if reduced.high:
        raise Unreadable(f"the arguments of {kind} are high multiples of each other")
    symbols = (*x, *constants)
    expressions = [
        sp.Add(*[sp.Rational(c, scale) * sp.prod([s**k for s, k in zip(symbols, m)]) for c, m in zip(row, monomials)])
        for row in reduced.rows
    ]
    return _mostly_positive(expressions, reduced.multiples)


def _mostly_positive(basis: list[sp.Expr], coordinates: list[list[int]]) -> tuple[list[sp.Expr], list[list[int]]]:
    """A basis vector of which only negative multiples occur is turned, so that no inverse is needed."""
    for j in range(len(basis)):
        if all(row[j] <= 0 for row in coordinates):
            basis[j] = -basis[j]
            for row in coordinates:
                row[j] = -row[j]
    return basis, coordinates
