"""Gauges e^phi that are sums of exponentials of linear forms, as those of log cosh are."""

from __future__ import annotations

from itertools import product

import sympy as sp

from zakai.algebra.identities import is_zero

MOST_TERMS = 16


def exponential_sum(phi: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[tuple[sp.Expr, list[sp.Expr]]] | None:
    """e^phi = sum_j exp(c_j + q_j.x) as pairs (c_j, q_j) that are free of x, or None if phi has not that form.

    phi is a sum of linear terms and of whole positive multiples of log(E), E a sum of exponentials and hyperbolic cosines.
    """
    terms: list[tuple[sp.Expr, sp.Expr]] = [(sp.Integer(1), sp.Integer(0))]
    for term in sp.Add.make_args(sp.expand(phi)):
        number, function = term.as_independent(*x, as_Add=False)
        if not isinstance(function, sp.log):
            terms = [(coefficient, exponent + term) for coefficient, exponent in terms]
            continue
        if not (number.is_Integer and 0 < number <= 4):
            return None
        for _ in range(int(number)):
            factors = _terms(function.args[0], x)
            if factors is None or len(factors) * len(terms) > MOST_TERMS:
                return None
            terms = [(a * b, p + q) for (a, p), (b, q) in product(terms, factors)]
    found = []
    for coefficient, exponent in terms:
        slopes = [sp.expand(sp.diff(exponent, symbol)) for symbol in x]
        if any(slope.has(*x) for slope in slopes):
            return None
        rest = sp.expand(exponent - sum(slope * symbol for slope, symbol in zip(slopes, x)))
        if rest.has(*x) and is_zero(sum(sp.diff(rest, s) ** 2 for s in x)) is not True:
            return None
        rest = rest.subs({symbol: 0 for symbol in x})
        found.append((sp.log(coefficient) + rest, slopes))
    return found


def _terms(expression: sp.Expr, x: tuple[sp.Symbol, ...]) -> list[tuple[sp.Expr, sp.Expr]] | None:
    """The expression as pairs (positive coefficient, exponent), or None."""

    def exponentials(e: sp.Expr) -> sp.Expr:
        u = e.args[0]
        return (sp.exp(u) + sp.exp(-u)) / 2 if isinstance(e, sp.cosh) else (sp.exp(u) - sp.exp(-u)) / 2

    plain = expression.replace(lambda e: isinstance(e, sp.cosh | sp.sinh) and e.has(*x), exponentials)
    found = []
    for term in sp.Add.make_args(sp.expand(plain, power_exp=False)):
        coefficient, exponent = sp.Integer(1), sp.Integer(0)
        for base, power in ((b, p) for factor in sp.Mul.make_args(term) for b, p in [factor.as_base_exp()]):
            if not sp.Pow(base, power).has(*x):
                coefficient *= sp.Pow(base, power)
            elif base == sp.E:
                exponent += power
            else:
                return None
        if coefficient.is_positive is not True:
            return None
        found.append((coefficient, exponent))
    return found
