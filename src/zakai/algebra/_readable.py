"""Formulas as one writes them: gamma'(x1 + x2), gamma_13 for d_1 d_3 gamma, and 3 dt for three times dt."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

import sympy as sp
from sympy.core.function import AppliedUndef

_LONG = 400  # parts of a formula that is not printed whole

def readable(expression: sp.Basic) -> sp.Basic:
    """The expression with primes, or the numbers of the arguments, for derivatives of undetermined functions.

    >>> x = sp.Symbol("x")
    >>> print(readable(sp.Function("gamma")(2 * x).diff(x)))
    2*gamma'(2*x)
    """
    return _replaced(expression, _in_text)


def for_latex(expression: sp.Basic) -> sp.Basic:
    """The same with names that are LaTeX."""
    return _replaced(expression, _in_latex)


def _replaced(expression: sp.Basic, named: Callable[[str, list[int]], str]) -> sp.Basic:
    def at(e: sp.Subs) -> sp.Expr:
        return _one(e.expr, dict(zip(e.variables, e.point)), named) or e

    inside = expression.replace(lambda e: isinstance(e, sp.Subs), at)
    return inside.replace(lambda e: isinstance(e, sp.Derivative), lambda e: _one(e, {}, named) or e)


def _one(derivative: sp.Expr, values: dict[sp.Symbol, sp.Expr], named: Callable[[str, list[int]], str]) -> sp.Expr | None:
    if not isinstance(derivative, sp.Derivative) or not isinstance(derivative.expr, AppliedUndef):
        return None
    function = derivative.expr
    if len(set(function.args)) < len(function.args) or any(z not in function.args for z, _ in derivative.variable_count):
        return None
    orders = [sum(k for z, k in derivative.variable_count if z == argument) for argument in function.args]
    name = named(function.func.__name__, orders)
    return sp.Function(name, real=True)(*[argument.xreplace(values) for argument in function.args])


def _in_text(name: str, orders: list[int]) -> str:
    if len(orders) > 1:
        return f"{name}_" + "".join(str(j + 1) * k for j, k in enumerate(orders))
    return name + ("'" * orders[0] if orders[0] <= 3 else f"^({orders[0]})")


def _in_latex(name: str, orders: list[int]) -> str:
    base = sp.latex(sp.Symbol(name))
    base = rf"\mathrm{{{name}}}" if base == name and name[1:] else base
    if len(orders) > 1:
        return rf"\mathop{{\partial_{{{''.join(str(j + 1) * k for j, k in enumerate(orders))}}} {base}}}"
    return rf"\mathop{{{base}{chr(39) * orders[0]}}}" if orders[0] <= 3 else rf"\mathop{{{base}^{{({orders[0]})}}}}"


def times(factor: sp.Expr, noise: str) -> str:
    """A factor before dt or the differential of a noise; empty for zero."""
    if factor == 0:
        return ""
    short = factor.is_Symbol or factor.is_Integer or factor.is_Function
    return noise if factor == 1 else f"{factor} {noise}" if short else f"({factor}) {noise}"


def tidy(expression: sp.Expr) -> sp.Expr:
    """Return a shorter form of a coefficient that depends on time and parameters only."""
    if expression.is_number or expression.is_Symbol or expression.count_ops() > 80:
        return expression
    return min((expression, sp.cancel(sp.together(expression))), key=sp.count_ops)


def brief(expression: sp.Basic) -> str:
    """Return a formula as text, and of a long one, which takes long to print, its first terms."""
    if is_short(expression):
        return str(expression)
    terms = sp.Add.make_args(expression)
    if len(terms) > 1 and all(map(is_short, terms[:2])):
        return f"{terms[0]} + {terms[1]} + ... ({len(terms)} terms)"
    return "a formula of many terms"


def is_short(expression: sp.Basic) -> bool:
    """Return whether a formula has few parts."""
    return sum(1 for _ in islice(sp.preorder_traversal(expression), _LONG)) < _LONG


def short(text: str) -> str:
    """A formula for a sentence: cut where it would fill the screen."""
    return text if len(text) <= 240 else f"{text[:240]} ..."
