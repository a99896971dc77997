"""Is an expression identically zero?

A point where it is clearly not zero, found in 50-digit arithmetic, refutes; the proof is algebra.  Trigonometric and
hyperbolic functions become exponentials, exponentials of rationally independent arguments are independent
variables, and what is left is a rational function whose numerator is expanded.  This knows sin^2 + cos^2,
1 - tanh^2 - sech^2, double angles and the like.  What neither refutes nor proves is undecided, and said so.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from functools import reduce
from math import lcm

import mpmath
import sympy as sp

DIGITS = 50
POINTS = 4
MOST_OPERATIONS = 6000

_TO_EXP = (sp.sin, sp.cos, sp.tan, sp.sinh, sp.cosh, sp.tanh, sp.cot, sp.coth, sp.sech, sp.csch, sp.sec, sp.csc)


def is_zero(expression: sp.Expr) -> bool | None:
    """True if the expression is identically zero, False if it is not, None if neither could be shown."""
    expression = sp.sympify(expression)
    if expression.is_zero or expression == 0:
        return True
    if not expression.free_symbols:
        expression_value = expression.evalf(DIGITS)
        if expression_value.is_number and abs(expression_value) > sp.Float(10) ** (-DIGITS // 2):
            return False
    if witness(expression) is not None:
        return False
    return True if _provably_zero(expression) else None


def witness(expression: sp.Expr) -> dict[sp.Symbol, sp.Rational] | None:
    """A point at which the expression is not zero, or None if none was found."""
    symbols = sorted(expression.free_symbols, key=lambda s: s.name)
    rng = random.Random(20170111)
    try:
        function = sp.lambdify(symbols, expression, modules="mpmath", cse=True)
        size = sp.lambdify(symbols, list(sp.Add.make_args(expression)), modules="mpmath", cse=True)
    except Exception:  # an undetermined function: SymPy's printers reject it in several ways
        return None
    for _ in range(POINTS * 3):
        point = [sp.Rational(rng.randint(-4000, 4000), 3001) for _ in symbols]
        with mpmath.workdps(DIGITS):
            try:
                arguments = [mpmath.mpf(p.p) / p.q for p in point]
                value = abs(function(*arguments))
                scale = 1 + sum(abs(term) for term in size(*arguments))
                # A cancellation inside a term is not seen in `scale`, so a wide margin is left.
                if mpmath.isfinite(value) and value > scale * mpmath.mpf(10) ** (-DIGITS // 2 + 2):
                    return dict(zip(symbols, point, strict=True))
            except (ZeroDivisionError, ValueError, OverflowError, TypeError, NameError):
                continue
    return None


def _provably_zero(expression: sp.Expr) -> bool:
    if sp.expand(expression) == 0:
        return True
    if expression.count_ops() > MOST_OPERATIONS:
        return False
    rational = _as_rational(expression)
    if rational is None:
        return False
    numerator = sp.expand(sp.fraction(sp.together(rational))[0])
    return bool(_reduce_roots(numerator) == 0)


def _as_rational(expression: sp.Expr) -> sp.Expr | None:
    """The expression as a rational function of symbols that stand for independent exponentials and other functions."""
    exponential = expression.replace(lambda e: isinstance(e, _TO_EXP), lambda e: e.rewrite(sp.exp))
    exponential = exponential.rewrite(sp.exp) if exponential.has(*_TO_EXP) else exponential
    arguments = {sp.expand(e.exp) for e in exponential.atoms(sp.exp)}
    rates: dict[sp.Expr, list[int]] = {}
    for argument in arguments:
        for term in sp.Add.make_args(argument):
            number, monomial = term.as_coeff_Mul(rational=True)
            if not number.is_Rational:
                return None
            rates.setdefault(monomial, []).append(number.q)
    generators = {
        monomial: (sp.Dummy(f"e{k}", positive=True), reduce(lcm, denominators))
        for k, (monomial, denominators) in enumerate(rates.items())
    }

    def power(e: sp.Expr) -> sp.Expr:
        result = sp.Integer(1)
        for term in sp.Add.make_args(sp.expand(e.exp)):
            number, monomial = term.as_coeff_Mul(rational=True)
            symbol, denominator = generators[monomial]
            result *= symbol ** (number * denominator)
        return result

    return exponential.replace(lambda e: isinstance(e, sp.exp), power)


def _reduce_roots(numerator: sp.Expr) -> sp.Expr:
    """Even powers of square roots are what stands under the root."""
    return sp.expand(sp.powdenest(sp.expand(numerator)))


def all_zero(expressions: Sequence[sp.Expr]) -> bool | None:
    """`is_zero` for several expressions at once: False wins over None, None over True."""
    undecided = False
    for expression in expressions:
        answer = is_zero(expression)
        if answer is False:
            return False
        undecided = undecided or answer is None
    return None if undecided else True


def grouped(expression: sp.Expr, variables: Sequence[sp.Symbol]) -> dict[sp.Expr, sp.Expr]:
    """The expanded expression as {function of the variables: coefficient that is free of them}."""
    groups: dict[sp.Expr, sp.Expr] = {}
    for term in sp.Add.make_args(sp.expand(expression)):
        coefficient, function = term.as_independent(*variables, as_Add=False)
        groups[function] = groups.get(function, sp.Integer(0)) + coefficient
    return {function: tidy(c) for function, c in groups.items() if is_zero(c) is not True}


def tidy(expression: sp.Expr) -> sp.Expr:
    """A shorter form of a coefficient that depends on time and parameters only."""
    expression = sp.sympify(expression)
    if expression.is_number or expression.is_Symbol:
        return expression
    short = sp.cancel(sp.together(expression)) if expression.count_ops() < 400 else expression
    return min((expression, short), key=sp.count_ops)
