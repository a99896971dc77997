"""Certificates checked again, by a plain path that shares no code with the engine that found them.

Operators are tables {alpha: coefficient} of SymPy expressions, multiplied by Leibniz' rule with SymPy's derivatives; there is
no ring of symbols, no generator, no echelon form.  Polynomials and their quotients are compared exactly.  Other expressions are
compared in 120 digits at random points, with concrete functions in the place of undetermined ones; that refutes exactly, and
what a certificate of infinite dimension needs most is a refutation: a derivative that is not zero.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import sympy as sp
from sympy.polys.rings import PolyRing

from zakai.algebra._evaluation import TINY, differences_vanish, values_at_random_points
from zakai.algebra.certificates import CLOSED, GROWTH, OCONE, OMEGA, QUADRATIC, RANK, SYMBOL, Certificate
from zakai.models.model import Model

Operator = Mapping[tuple[int, ...], Any]


def verify(certificate: Certificate) -> bool:
    """Return whether the witness of a certificate meets the assumption of its statement, computed from the model again."""
    check: dict[str, Callable[[_Plain, Certificate], bool]] = {
        CLOSED: _is_closed,
        QUADRATIC: lambda plain, c: (
            plain.omega_is_constant()
            and all(plain.is_polynomial(entry, 1) for entry in plain.h)
            and plain.is_polynomial(plain.eta(), 2)
        ),
        OCONE: lambda plain, c: plain.order(c.elements[0]) == 0 and not plain.is_polynomial(plain.function(c.elements[0]), 2),
        OMEGA: lambda plain, c: (
            plain.is_smooth() and plain.omega_is_constant() and not plain.is_polynomial(plain.function(c.elements[0]), 1)
        ),
        RANK: _has_maximal_rank,
        SYMBOL: _has_a_symbol_that_is_not_polynomial,
        GROWTH: _grows,
    }
    plain = _Plain(certificate.model)
    needs_inverse = certificate.code not in (CLOSED, GROWTH)
    return not (needs_inverse and sp.cancel(plain.G.det()) == 0) and check[certificate.code](plain, certificate)


class _Plain:
    """The operators of a model, with its parameters at their values."""

    def __init__(self, model: Model):
        values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
        f, h, G, S = (
            matrix.xreplace(values) for matrix in (model.drift, model.observation, model.covariance, model.observation_noise)
        )
        self.x, self.n = model.x, model.n
        entries = [*f, *h, *G, *S]
        exact = all(e.is_rational_function(*model.x) and _has_rational_numbers(e) for e in entries)
        whole = all(e.is_polynomial(*model.x) for e in entries)
        self.ring = (sp.ring if whole else sp.field)(model.x, sp.QQ)[0] if exact else None
        self.drift, self.h, self.G = f, h, G
        energy = (h.T * S.LUsolve(h))[0, 0]
        zero = (0,) * self.n
        L0: dict[tuple[int, ...], sp.Expr] = {}
        for i, j in itertools.product(range(self.n), repeat=2):
            _accumulate(L0, _plus(_plus(zero, i), j), G[i, j] / 2)
        for i in range(self.n):
            _accumulate(L0, _plus(zero, i), -f[i])
        _accumulate(L0, zero, -sum(sp.diff(f[i], s) for i, s in enumerate(self.x)) - energy / 2)
        self.energy = energy
        self.generators = [self.prepared(L0)] + [self.prepared({zero: entry}) for entry in h]
        self.word = lru_cache(maxsize=None)(self._word)

    def prepared(self, operator: Operator) -> Operator:
        """Coefficients as SymPy's sparse polynomials, or quotients of them, where all are; or else expanded."""
        ring = self.ring
        if ring is None:
            return {alpha: e for alpha, c in operator.items() if (e := sp.expand(c)) != 0}
        made = {alpha: ring.from_expr(sp.expand(c)) if isinstance(c, sp.Expr) else c for alpha, c in operator.items()}
        return {alpha: c for alpha, c in made.items() if c}

    def _word(self, word: tuple[int, ...]) -> Operator:
        if len(word) == 1:
            return self.generators[word[0]]
        return self.bracket(self.generators[word[0]], self.word(word[1:]))

    def compose(self, a: Operator, b: Operator) -> dict[tuple[int, ...], Any]:
        """sum_alpha sum_beta a_alpha (alpha over gamma) (d^gamma b_beta) d^(alpha - gamma + beta)."""
        result: dict[tuple[int, ...], Any] = {}
        zero = (0,) * self.n
        slopes = {zero: b}
        for alpha, left in a.items():
            for gamma in itertools.product(*(range(k + 1) for k in alpha)):
                if gamma not in slopes:  # gamma without its last index was before it
                    i = max(j for j, k in enumerate(gamma) if k)
                    lower = (*gamma[:i], gamma[i] - 1, *gamma[i + 1 :])
                    slopes[gamma] = {beta: self.slope(right, i) for beta, right in slopes[lower].items()}
                times = math.prod(map(math.comb, alpha, gamma))
                for beta, right in slopes[gamma].items():
                    if right != 0:
                        _accumulate(result, tuple(i - j + k for i, j, k in zip(alpha, gamma, beta)), times * left * right)
        return result

    def slope(self, coefficient: Any, i: int) -> Any:
        """The derivative of a coefficient in the i-th coordinate."""
        return sp.diff(coefficient, self.x[i]) if self.ring is None else coefficient.diff(self.ring.gens[i])

    def monomials(self, words: Mapping[tuple[int, ...], sp.Expr]) -> list[tuple[int, ...]]:
        """The exponents of x and of the derivatives in a combination of words."""
        if isinstance(self.ring, PolyRing):
            return [(*m, *alpha) for alpha, c in self.total(words).items() for m in c.monoms()]
        return [(*m, *alpha) for alpha, c in self.combination(words).items() for m in sp.Poly(c, *self.x).monoms()]

    def bracket(self, a: Operator, b: Operator) -> Operator:
        result = self.compose(a, b)
        for alpha, c in self.compose(b, a).items():
            _accumulate(result, alpha, -c)
        return self.prepared(result)

    def total(self, words: Mapping[tuple[int, ...], sp.Expr]) -> Operator:
        """A combination of words; no coefficient is zero."""
        total: dict[tuple[int, ...], Any] = {}
        for word, number in words.items():
            factor = number if self.ring is None else sp.QQ.from_sympy(number)
            for alpha, c in self.word(word).items():
                _accumulate(total, alpha, c * factor)
        if self.ring is not None:
            return {alpha: c for alpha, c in total.items() if c}
        return {alpha: e for alpha, c in total.items() if not self.is_zero(e := sp.expand(c))}

    def combination(self, words: Mapping[tuple[int, ...], sp.Expr]) -> Operator:
        """A combination of words, with SymPy expressions for coefficients."""
        return self.expressions(self.total(words))

    def expressions(self, operator: Operator) -> dict[tuple[int, ...], Any]:
        return {alpha: c if self.ring is None else c.as_expr() for alpha, c in operator.items()}

    def order(self, words: Mapping) -> int:
        return max((sum(alpha) for alpha in self.combination(words)), default=-1)

    def function(self, words: Mapping) -> sp.Expr:
        return self.combination(words).get((0,) * self.n, sp.Integer(0))

    def is_zero(self, e: sp.Expr) -> bool:
        e = sp.expand(e)
        if e.is_polynomial(*self.x):
            return bool(e == 0)
        values = values_at_random_points(e, self.x)
        return bool(values) and all(abs(value) < TINY for value in values)

    def is_polynomial(self, e: sp.Expr, degree: int) -> bool:
        """Whether a function is a polynomial of at most this degree."""
        e = sp.expand(e)
        if e.is_polynomial(*self.x):
            return sp.Poly(e, *self.x).total_degree() <= degree
        return differences_vanish(e, self.x, degree + 1)

    def precision_times_drift(self) -> sp.MatrixBase:
        return self.G.LUsolve(self.drift)

    def omega_is_constant(self) -> bool:
        g = self.precision_times_drift()
        pairs = itertools.combinations(range(self.n), 2)
        return all(self.is_polynomial(sp.diff(g[j], self.x[i]) - sp.diff(g[i], self.x[j]), 0) for i, j in pairs)

    def eta(self) -> sp.Expr:
        divergence = sum(sp.diff(entry, symbol) for entry, symbol in zip(self.drift, self.x))
        return (self.drift.T * self.precision_times_drift())[0, 0] + divergence + self.energy

    def is_smooth(self) -> bool:
        """No formula divides by what may vanish, takes a logarithm, or a tangent."""
        for part in sp.preorder_traversal(sp.Tuple(*self.drift, *self.h)):
            if isinstance(part, sp.tan):
                return False
            denominator = part.base if isinstance(part, sp.Pow) and part.exp.is_negative else None
            argument = part.args[0] if isinstance(part, sp.log) else denominator
            if argument is not None and not argument.is_positive and not sp.expand(argument).is_positive:
                return False
        return True


def _is_closed(plain: _Plain, certificate: Certificate) -> bool:
    """The generators are in the span, every bracket is the combination that is claimed, and the basis is independent."""
    pairs = set(itertools.combinations(range(len(certificate.elements)), 2))
    if certificate.constants is None or set(certificate.constants) != pairs:
        return False
    basis = [plain.combination(words) for words in certificate.elements]
    prepared = [plain.prepared(operator) for operator in basis]
    for (i, j), row in certificate.constants.items():
        rest = plain.expressions(plain.bracket(prepared[i], prepared[j]))
        for c, element in zip(row, basis):
            for alpha, value in element.items():
                _accumulate(rest, alpha, -c * value)
        if not all(plain.is_zero(c) for c in rest.values()):
            return False
    present = [plain.expressions(generator) for generator in plain.generators if generator]
    return _rank(basis, plain) == len(basis) == _rank([*basis, *present], plain)


def _rank(operators: Sequence[Operator], plain: _Plain) -> int:
    """The dimension of the span of some operators, from their values at random points."""
    orders = sorted({alpha for operator in operators for alpha in operator})
    columns = [sp.expand(operator.get(alpha, sp.Integer(0))) for operator in operators for alpha in orders]
    if all(c.is_polynomial(*plain.x) for c in columns):
        return _rank_of_polynomials(operators, orders, plain)
    count = 2 * len(operators)
    values = [list(values_at_random_points(c, plain.x, count)) for c in columns]
    if min(map(len, values)) < count:
        raise ArithmeticError("the operators have no values at random points")
    rows = [sum(values[k * len(orders) : (k + 1) * len(orders)], []) for k in range(len(operators))]
    return sp.Matrix(rows).rank(iszerofunc=lambda v: abs(v) < TINY)


def _rank_of_polynomials(operators: Sequence[Operator], orders: Sequence[tuple[int, ...]], plain: _Plain) -> int:
    rows = []
    for operator in operators:
        rows.append({(alpha, m): c for alpha, e in operator.items() for m, c in sp.Poly(e, *plain.x).terms() if alpha in orders})
    monomials = sorted({key for row in rows for key in row})
    return int(sp.Matrix([[row.get(key, sp.Integer(0)) for key in monomials] for row in rows]).rank())


def _has_maximal_rank(plain: _Plain, certificate: Certificate) -> bool:
    functions = [plain.function(words) for words in certificate.elements]
    if any(plain.order(words) != 0 for words in certificate.elements) or not plain.is_smooth():
        return False
    if not all(plain.is_polynomial(function, 1) for function in functions):
        return False
    gradients = sp.Matrix(functions).jacobian(plain.x)
    return gradients.rank() == plain.n and not (plain.omega_is_constant() and plain.is_polynomial(plain.eta(), 2))


def _has_a_symbol_that_is_not_polynomial(plain: _Plain, certificate: Certificate) -> bool:
    operator = plain.combination(certificate.elements[0])
    order = max((sum(alpha) for alpha in operator), default=0)
    top = [c for alpha, c in operator.items() if sum(alpha) == order]
    return order >= 1 and not all(_is_a_polynomial(c, plain) for c in top)


def _grows(plain: _Plain, certificate: Certificate) -> bool:
    """The coefficients of the leading monomials of ad_A^m B, one after the other, are not zero."""
    n, weights = plain.n, certificate.weights
    sums = [weights[j] + weights[n + j] for j in range(n)]
    i = sums.index(min(sums))
    if min(sums) <= 0 or sums.count(min(sums)) > 1:
        return False
    monomials = []
    for words in certificate.elements:
        support = plain.monomials(words)
        heaviest = max(sum(w * k for w, k in zip(weights, m)) for m in support)
        leading = [m for m in support if sum(w * k for w, k in zip(weights, m)) == heaviest]
        if len(leading) > 1:
            return False
        monomials += leading
    A, B = monomials
    unit = [int(j in (i, n + i)) for j in range(2 * n)]
    m = sp.Symbol("m", integer=True, nonnegative=True)
    c, d = B[i] + m * (A[i] - 1), B[n + i] + m * (A[n + i] - 1)
    zeros = sp.solveset(sp.expand(A[n + i] * c - A[i] * d), m, sp.S.Naturals0)
    return list(A) != unit and zeros == sp.S.EmptySet


def _is_a_polynomial(e: sp.Expr, plain: _Plain) -> bool:
    """Whether a function is a polynomial of any degree; one of which high differences do not vanish is not taken for one."""
    e = sp.expand(e)
    return e.is_polynomial(*plain.x) or differences_vanish(e, plain.x, 24)


def _has_rational_numbers(e: sp.Expr) -> bool:
    return all(part.is_Rational or not part.is_number for part in sp.preorder_traversal(e))


def _plus(alpha: tuple[int, ...], i: int) -> tuple[int, ...]:
    return (*alpha[:i], alpha[i] + 1, *alpha[i + 1 :])


def _accumulate(table: dict, key: tuple[int, ...], value: Any) -> None:
    table[key] = table[key] + value if key in table else value
