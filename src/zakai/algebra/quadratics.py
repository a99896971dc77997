"""Whether a function is quadratic in the state, and its coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.grouping import MANY_TERMS, grouped, normal_form, terms_of, tidy
from zakai.algebra.identities import is_quadratic


@dataclass(frozen=True)
class Quadratic:
    """x'`matrix` x + `linear`.x + `constant`: what -q/2 is when q is quadratic in x."""

    matrix: sp.ImmutableMatrix
    linear: sp.ImmutableMatrix
    constant: sp.Expr


def as_quadratic(q: sp.Expr, x: tuple[sp.Symbol, ...]) -> tuple[Quadratic | None, bool | None, str]:
    """-q/2 as a quadratic in x, whether q is one, and the expression that decided it."""
    n = len(x)
    # To refute is soon done, and to expand may take long.
    if terms_of(q) > MANY_TERMS // 10 and is_quadratic(q, x) is False:
        return None, False, f"q contains {not_quadratic_part(q, x)}"
    quadratic = _read_off(q, x)
    if quadratic is None and terms_of(q) <= 12:
        quadratic = _read_off(sp.cancel(q), x)  # quotients of one function, such as D''/D of phi = log D
    if quadratic is not None:
        return quadratic, True, f"q = {short(str(quadratic_expression(quadratic, x)))}"
    answer = is_quadratic(q, x)
    if answer is False:
        return None, False, f"q contains {not_quadratic_part(q, x)}"
    if answer is None:
        return None, None, f"it is not decided whether {short(str(q))} is quadratic in {', '.join(map(str, x))}"
    # q is quadratic, so its derivatives at any one point give its coefficients; the origin reads best where q is defined there.
    for value in (sp.Integer(0), sp.Rational(1, 2), sp.Rational(7, 5)):
        point = {symbol: value for symbol in x}
        hessian = sp.hessian(q, x).subs(point)
        slope = sp.Matrix([q]).jacobian(x).T.subs(point)
        level = q.subs(point)
        if all(e.is_finite is not False and not e.has(sp.nan, sp.zoo) for e in [*hessian, *slope, level]):
            break
    at = sp.ones(n, 1) * value
    matrix = (-hessian / 4).applyfunc(tidy)
    linear = (-slope / 2 - 2 * matrix * at).applyfunc(tidy)
    constant = tidy(-level / 2 - (at.T * matrix * at)[0, 0] - (linear.T * at)[0, 0])
    quadratic = Quadratic(sp.ImmutableMatrix(matrix), sp.ImmutableMatrix(linear), constant)
    return quadratic, True, f"q = {short(str(quadratic_expression(quadratic, x)))}"


def _read_off(q: sp.Expr, x: tuple[sp.Symbol, ...]) -> Quadratic | None:
    """-q/2 if nothing but monomials of degree two at most is left in the normal form of q."""
    n = len(x)
    matrix, linear, constant = sp.zeros(n, n), sp.zeros(n, 1), sp.Integer(0)
    for function, coefficient in grouped(normal_form(q, x), x).items():
        powers = function.as_powers_dict()
        if any(base not in x and base != 1 or not k.is_Integer or k < 0 for base, k in powers.items()):
            return None
        which = [x.index(base) for base, k in powers.items() if base in x for _ in range(int(k))]
        if len(which) > 2:
            return None
        share = -coefficient / 2
        if len(which) == 2:
            matrix[which[0], which[1]] += share / 2
            matrix[which[1], which[0]] += share / 2
        elif which:
            linear[which[0]] += share
        else:
            constant += share
    return Quadratic(sp.ImmutableMatrix(matrix), sp.ImmutableMatrix(linear), constant)


def quadratic_expression(quadratic: Quadratic, x: tuple[sp.Symbol, ...]) -> sp.Expr:
    """q itself."""
    state = sp.Matrix(x)
    value = (state.T * quadratic.matrix * state)[0, 0] + (quadratic.linear.T * state)[0, 0] + quadratic.constant
    return sp.collect(sp.expand(-2 * value), list(x)) if value.count_ops() < 200 else -2 * value


def not_quadratic_part(q: sp.Expr, x: tuple[sp.Symbol, ...]) -> str:
    """The terms of q that are not quadratic in x, for a sentence."""
    terms = []
    for function, coefficient in grouped(q, x).items() if terms_of(q) <= MANY_TERMS // 10 else [(q, sp.Integer(1))]:
        if is_quadratic(function, x) is not True:
            terms.append(coefficient * function)
    return f"{short(str(sp.Add(*terms)))}, which is not quadratic in {', '.join(map(str, x))}"
