"""Formulas as one writes them: gamma'(x1 + x2), gamma_13 for d_1 d_3 gamma, and 3 dt for three times dt."""

from __future__ import annotations

import sympy as sp
from sympy.core.function import AppliedUndef


def readable(expression: sp.Basic) -> sp.Basic:
    """The expression with primes, or the numbers of the arguments, for derivatives of undetermined functions.

    >>> x = sp.Symbol("x")
    >>> print(readable(sp.Function("gamma")(2 * x).diff(x)))
    2*gamma'(2*x)
    """
    inside = expression.replace(lambda e: isinstance(e, sp.Subs), lambda e: _named(e.expr, dict(zip(e.variables, e.point))) or e)
    return inside.replace(lambda e: isinstance(e, sp.Derivative), lambda e: _named(e, {}) or e)


def _named(derivative: sp.Expr, values: dict[sp.Symbol, sp.Expr]) -> sp.Expr | None:
    if not isinstance(derivative, sp.Derivative) or not isinstance(derivative.expr, AppliedUndef):
        return None
    function = derivative.expr
    if len(set(function.args)) < len(function.args) or any(z not in function.args for z, _ in derivative.variable_count):
        return None
    orders = [sum(k for z, k in derivative.variable_count if z == argument) for argument in function.args]
    name = function.func.__name__
    if len(orders) == 1:
        name += "'" * orders[0] if orders[0] <= 3 else f"^({orders[0]})"
    else:
        name += "_" + "".join(str(j + 1) * k for j, k in enumerate(orders))
    return sp.Function(name, real=True)(*[argument.xreplace(values) for argument in function.args])


def times(factor: sp.Expr, noise: str) -> str:
    """A factor before dt or the differential of a noise; empty for zero."""
    if factor == 0:
        return ""
    short = factor.is_Symbol or factor.is_Integer or factor.is_Function
    return noise if factor == 1 else f"{factor} {noise}" if short else f"({factor}) {noise}"
