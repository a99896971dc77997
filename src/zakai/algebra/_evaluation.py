"""Expressions in 120 digits at random points, with concrete functions in the place of undetermined ones."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence

import sympy as sp
from sympy.core.function import AppliedUndef

DIGITS = 120
TINY = sp.Float(10) ** (-DIGITS // 2)


def differences_vanish(e: sp.Expr, x: Sequence[sp.Symbol], order: int) -> bool:
    """Whether the differences of this order along random lines are zero, as those of polynomials of lower degree are."""
    e, rng = _concrete(e), random.Random(1730)
    # Short steps are for formulas that exist on a small domain only.
    for length in (sp.Rational(1), sp.Rational(1), sp.Rational(1, 20), sp.Rational(1, 100), sp.Rational(1, 100)):
        start = [sp.Rational(rng.randint(-2000, 3000), 1009) for _ in x]
        step = [length * sp.Rational(rng.randint(700, 2000), 1009) for _ in x]
        points = [{s: a + k * b for s, a, b in zip(x, start, step)} for k in range(order + 1)]
        values = [_value(e, point) for point in points]
        if any(value is None for value in values):
            continue
        terms = [(-1) ** k * math.comb(order, k) * value for k, value in enumerate(values)]
        if abs(sum(terms)) > TINY * (1 + sum(map(abs, terms))):
            return False
    return True


def values_at_random_points(e: sp.Expr, x: Sequence[sp.Symbol], count: int = 4) -> list[sp.Expr]:
    """The expression in many digits at random points where it has a value; constants such as pi are what they are."""
    e = _concrete(e)
    rng = random.Random(1730)
    found: list[sp.Expr] = []
    for _ in range(20 * count):
        point = {symbol: sp.Rational(rng.randint(-2000, 3000), 1009) for symbol in x}
        value = _value(e, point)
        if value is not None:
            found.append(value)
        if len(found) == count:
            break
    return found


def _value(e: sp.Expr, point: Mapping[sp.Symbol, sp.Rational]) -> sp.Expr | None:
    value = e.xreplace(point).doit().evalf(DIGITS, maxn=4 * DIGITS)
    return value if value.is_Float or value.is_Rational else None


def _concrete(e: sp.Expr) -> sp.Expr:
    """Every undetermined function replaced by one that satisfies no equation of low order."""
    names = sorted({part.func.__name__ for part in e.atoms(AppliedUndef)})
    for k, name in enumerate(names, 2):
        e = e.replace(
            lambda part, name=name: isinstance(part, AppliedUndef) and part.func.__name__ == name,
            lambda part, k=k: sp.exp(sp.sin(sum((j + k) * argument for j, argument in enumerate(part.args)) / k)),
        )
    return e.doit()
