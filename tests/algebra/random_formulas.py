"""Random formulas of the grammar, true identities between them, and their values in many digits by mpmath."""

from __future__ import annotations

import random

import mpmath
import sympy as sp

from zakai.models.functions import Maximum, Minimum

X, Y, T, A = sp.symbols("x y t a", real=True)
SYMBOLS = (X, Y, T, A)
DIGITS = 60
_MODULES = [{"Maximum": max, "Minimum": min}, "mpmath"]


def formula(rng: random.Random, depth: int = 3) -> sp.Expr:
    """Return a random formula."""
    if depth == 0 or rng.random() < 0.15:
        numbers = [sp.Integer(rng.randint(-3, 3)), sp.Rational(1, rng.randint(2, 7))]
        return rng.choice([X, Y, X + Y, X - 2 * Y, T * X, A * Y, T, X / 3, *numbers])

    def part() -> sp.Expr:
        return formula(rng, depth - 1)

    return rng.choice(
        [
            lambda: part() + part(),
            lambda: part() - part(),
            lambda: part() * part(),
            lambda: part() * part(),
            lambda: part() / (1 + part() ** 2),
            lambda: part() ** rng.randint(2, 3),
            lambda: sp.sin(part()),
            lambda: sp.cos(part()),
            lambda: sp.tanh(part()),
            lambda: sp.exp(part() / 2),
            lambda: sp.cosh(part()),
            lambda: sp.sinh(part()),
            lambda: sp.atan(part()),
            lambda: sp.erf(part()),
            lambda: sp.log(1 + part() ** 2),
            lambda: sp.sqrt(1 + part() ** 2),
            lambda: sp.sqrt(part() ** 2 * (1 + part() ** 2)),
            lambda: sp.Abs(part()),
            lambda: Minimum(part(), part()),
            lambda: sp.asin(sp.sin(part())),
        ]
    )()


def zero(rng: random.Random) -> sp.Expr:
    """Return a formula that is zero wherever it has a value."""
    u, v = formula(rng, 2), formula(rng, 2)
    return rng.choice(
        [
            lambda: sp.sin(u) ** 2 + sp.cos(u) ** 2 - 1,
            lambda: sp.sin(u + v) - sp.sin(u) * sp.cos(v) - sp.cos(u) * sp.sin(v),
            lambda: sp.cos(2 * u) - 2 * sp.cos(u) ** 2 + 1,
            lambda: sp.tanh(u) ** 2 + 1 / sp.cosh(u) ** 2 - 1,
            lambda: sp.cosh(u) + sp.sinh(u) - sp.exp(u),
            lambda: sp.tanh(u + v) * (1 + sp.tanh(u) * sp.tanh(v)) - sp.tanh(u) - sp.tanh(v),
            lambda: sp.exp(u) * sp.exp(-v) - sp.exp(u - v),
            lambda: sp.sqrt(u**2 * (1 + v**2)) - sp.Abs(u) * sp.sqrt(1 + v**2),
            lambda: sp.Abs(u * v) - sp.Abs(u) * sp.Abs(v),
            lambda: sp.log((1 + u**2) * (2 + v**2)) - sp.log(1 + u**2) - sp.log(2 + v**2),
            lambda: Minimum(u, v) + Maximum(u, v) - u - v,
            lambda: sp.sin(2 * sp.atan(u)) - 2 * u / (1 + u**2),
            lambda: sp.diff(sp.log(sp.cosh(u)), X) - sp.tanh(u) * sp.diff(u, X),
            lambda: sp.erf(-u) + sp.erf(u),
            lambda: (u + v) ** 3 - u**3 - 3 * u * v * (u + v) - v**3,
        ]
    )()


def values(e: sp.Expr, count: int = 24, seed: int = 5) -> list[mpmath.mpf]:
    """Return values of a formula, relative to the largest of its terms, at random points where it has some."""
    rng, found = random.Random(seed), []
    terms = sp.Add.make_args(e)
    functions = [sp.lambdify(SYMBOLS, term, _MODULES) for term in terms]
    with mpmath.workdps(DIGITS):
        for _ in range(count):
            point = [mpmath.mpf(rng.randint(-3000, 3000)) / 2003 for _ in SYMBOLS]
            try:
                parts = [mpmath.mpmathify(f(*point)) for f in functions]
            except (ValueError, ZeroDivisionError, OverflowError, TypeError):
                continue
            if all(isinstance(part, mpmath.mpf) and mpmath.isfinite(part) for part in parts):
                size = max(map(abs, parts))
                found.append(abs(mpmath.fsum(parts)) / size if size else mpmath.mpf(0))
    return found
