"""An expression as a sum of functions of the state, each with a coefficient that is free of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy as sp

from zakai.algebra.identities import CIRCULAR, HYPERBOLIC, is_zero

MANY_TERMS = 5000  # of an expansion: one with more is not expanded


def normal_form(expression: sp.Expr, variables: Sequence[sp.Symbol]) -> sp.Expr:
    """Expanded, with tanh and cosh for hyperbolic and sin and cos for circular functions of the variables, sin at most once.

    In this form most identities between them are gone: 1/cosh^2 is 1 - tanh^2, sin^2 is 1 - cos^2.  What would have too many
    terms stays as it is.
    """
    if terms_of(expression) >= MANY_TERMS:
        return expression

    def of_variables(e: sp.Expr) -> bool:
        return isinstance(e, (*CIRCULAR, *HYPERBOLIC)) and e.has(*variables)

    def basic(e: sp.Expr) -> sp.Expr:
        u = e.args[0]
        return {
            sp.sinh: lambda: sp.tanh(u) * sp.cosh(u),
            sp.coth: lambda: 1 / sp.tanh(u),
            sp.sech: lambda: 1 / sp.cosh(u),
            sp.csch: lambda: 1 / (sp.tanh(u) * sp.cosh(u)),
            sp.tan: lambda: sp.sin(u) / sp.cos(u),
            sp.cot: lambda: sp.cos(u) / sp.sin(u),
            sp.sec: lambda: 1 / sp.cos(u),
            sp.csc: lambda: 1 / sp.sin(u),
        }.get(e.func, lambda: e)()

    def power(e: sp.Expr) -> bool:
        return e.is_Pow and e.exp.is_Integer and of_variables(e.base) and isinstance(e.base, sp.sin | sp.cosh)

    def reduced(e: sp.Expr) -> sp.Expr:
        u, k = e.base.args[0], int(e.exp)
        if isinstance(e.base, sp.sin) and k >= 2:
            return (1 - sp.cos(u) ** 2) ** (k // 2) * sp.sin(u) ** (k % 2)
        if isinstance(e.base, sp.cosh) and k <= -2:
            return (1 - sp.tanh(u) ** 2) ** (-k // 2) * sp.cosh(u) ** (-(-k % 2))
        return e

    basics = expression.replace(of_variables, basic)
    return sp.expand(sp.expand(basics).replace(power, reduced))


def terms_of(expression: sp.Expr) -> int:
    """Return an upper bound, at most `MANY_TERMS`, of the number of terms of the expanded expression."""
    if isinstance(expression, sp.Add):
        return min(MANY_TERMS, sum(terms_of(part) for part in expression.args))
    if isinstance(expression, sp.Mul):
        count = 1
        for part in expression.args:
            count = min(MANY_TERMS, count * terms_of(part))
        return count
    if isinstance(expression, sp.Pow) and expression.exp.is_Integer and expression.exp > 0:
        terms, power = terms_of(expression.base), int(expression.exp)
        return MANY_TERMS if terms >= MANY_TERMS else min(MANY_TERMS, math.comb(terms + power - 1, power))
    return 1


def grouped(expression: sp.Expr, variables: Sequence[sp.Symbol]) -> dict[sp.Expr, sp.Expr]:
    """The expanded expression as {function of the variables: coefficient that is free of them}.

    One that would have too many terms is a single function.
    """
    if terms_of(expression) >= MANY_TERMS:
        return {expression: sp.Integer(1)}
    groups: dict[sp.Expr, list[sp.Expr]] = {}
    for term in sp.Add.make_args(sp.expand(expression)):
        coefficient, function = term.as_independent(*variables, as_Add=False)
        groups.setdefault(function, []).append(coefficient)
    sums = {function: sp.Add(*coefficients) for function, coefficients in groups.items()}
    return {function: tidy(c) for function, c in sums.items() if is_zero(c) is not True}


def tidy(expression: sp.Expr) -> sp.Expr:
    """A shorter form of a coefficient that depends on time and parameters only."""
    if expression.is_number or expression.is_Symbol or expression.count_ops() > 80:
        return expression
    return min((expression, sp.cancel(sp.together(expression))), key=sp.count_ops)
