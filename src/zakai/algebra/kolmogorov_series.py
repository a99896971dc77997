"""The series of the Kolmogorov equation's kernel, exactly, for polynomial f and h.

    u_t = G : Hess u / 2 - f . grad u - (div f + h'S^-1 h / 2) u,         z = x - y

    phi(t, x, y) = (2 pi t)^(-n/2) |G|^(-1/2) exp(-z'G^-1 z / (2 t) + a(x, y)) (1 + A_1 t + A_2 t^2 + ...)
    a = int_0^1 z'G^-1 f(y + s z) ds
    W = G : Hess a / 2 + grad a'G grad a / 2 - f . grad a - div f - h'S^-1 h / 2
    (k + z . grad) A_k = W A_(k-1) + G : Hess A_(k-1) / 2 + (G grad a - f) . grad A_(k-1)

All derivatives are with respect to x.  Where the sum is written as exp(L_1 t + L_2 t^2 + ...),

    (k + z . grad) L_k = [k = 1] W + G : Hess L_(k-1) / 2 + (G grad a - f) . grad L_(k-1) + sum_(i+j=k-1) grad L_i'G grad L_j / 2.

In z and y the operator k + z . grad multiplies a monomial of degree j in z by k + j; its inverse is the paper's integral
int_0^1 s^(k-1) (.)(y + s z, y) ds.

Source: Yau (1993), Theorems 10 and 11, which are these formulas in the coordinates in which G is the identity.  Their h need
not be constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy as sp
from flint import Ordering, fmpq, fmpq_mpoly_ctx

from zakai.algebra._readable import short
from zakai.algebra.identities import is_zero
from zakai.errors import ConditionError
from zakai.models.model import Model

Polynomial = Any  # a flint.fmpq_mpoly in z and y


class Ring:
    """Q[z, y] with the operations of the series, for a constant covariance G of rational numbers."""

    def __init__(self, covariance: sp.MatrixBase):
        self.n = covariance.rows
        names = [f"z{i}" for i in range(self.n)] + [f"y{i}" for i in range(self.n)]
        self.context = fmpq_mpoly_ctx.get(names, Ordering.lex)
        self.zero, self.one = self.context.constant(0), self.context.constant(1)
        self.z, self.y = self.context.gens()[: self.n], self.context.gens()[self.n :]
        self.covariance = [[_rational(covariance[i, j]) for j in range(self.n)] for i in range(self.n)]
        inverse = covariance.inv()
        self.precision = [[_rational(inverse[i, j]) for j in range(self.n)] for i in range(self.n)]

    def read(self, expression: sp.Expr, x: Sequence[sp.Symbol]) -> Polynomial:
        """A polynomial in x = y + z with rational coefficients."""
        in_x = {monomial: _rational(c) for monomial, c in sp.Poly(expression, *x).terms()}
        padded = {(*monomial, *[0] * self.n): c for monomial, c in in_x.items() if c}
        return self.context.from_dict(padded).compose(*[y + z for y, z in zip(self.y, self.z)], *self.y)

    def gradient(self, p: Polynomial) -> list[Polynomial]:
        """The derivatives with respect to x."""
        return [p.derivative(i) for i in range(self.n)]

    def weighted(self, a: Sequence[Polynomial], b: Sequence[Polynomial]) -> Polynomial:
        """a'G b."""
        G = self.covariance
        return sum((G[i][j] * a[i] * b[j] for i in range(self.n) for j in range(self.n) if G[i][j]), self.zero)

    def laplacian(self, p: Polynomial) -> Polynomial:
        """G : Hess p."""
        G, n = self.covariance, self.n
        return sum((G[i][j] * p.derivative(i).derivative(j) for i in range(n) for j in range(n) if G[i][j]), self.zero)

    def radial(self, p: Polynomial, k: int) -> Polynomial:
        """int_0^1 s^(k-1) p(s z, y) ds: what k + z . grad makes p of."""
        return self.context.from_dict({m: c / (k + sum(m[: self.n])) for m, c in p.to_dict().items()})


@dataclass(frozen=True)
class KolmogorovSeries:
    """The coefficients of the series up to t^`order` as polynomials in `x` and `y` (n symbols each), exact.

    The exponent a, the potential W, the coefficients A_0 = 1, A_1, ... and the logarithms L_1, L_2, ... belong to the kernel of
    G = `covariance`. The paper's a_k(x, xi) are e^a A_k.
    """

    order: int
    x: tuple[sp.Symbol, ...]
    y: tuple[sp.Symbol, ...]
    covariance: sp.ImmutableMatrix
    exponent: sp.Poly
    potential: sp.Poly
    coefficients: tuple[sp.Poly, ...]
    logarithms: tuple[sp.Poly, ...]

    @cached_property
    def log_gaussian(self) -> sp.Expr:
        """-z'G^-1 z / 2, over t the exponent of the Gaussian."""
        z = sp.Matrix([x - y for x, y in zip(self.x, self.y, strict=True)])
        return -(z.T * self.covariance.inv() * z)[0] / 2

    def terms(self) -> tuple[int, ...]:
        """How many terms A_0, A_1, ... have."""
        return tuple(len(p.terms()) for p in self.coefficients)


def kolmogorov_series(model: Model, order: int) -> KolmogorovSeries:
    """The exact series of a model with polynomial f and h and a constant, positive definite G, up to t^`order`.

    Parameters have their values.  Raises ConditionError where f or h is no polynomial in the state with rational
    coefficients, depends on time, or G does, or is not positive definite.

        >>> model = zakai.Model(state=["x"], drift=["-x"], observation=["0"])
        >>> kolmogorov_series(model, 1).logarithms[0].as_expr()
        -x**2/6 - x*y_x/6 - y_x**2/6 + 1/2

    Source: Yau (1993), Theorems 10 and 11.
    """
    f, potential, G = _polynomial_system(model)
    ring = Ring(G)
    drift = [ring.read(f_i, model.x) for f_i in f]
    n = ring.n
    along = sum((ring.precision[i][j] * ring.z[i] * drift[j] for i in range(n) for j in range(n)), ring.zero)
    a = ring.radial(along, 0)  # every term has a factor z
    slope = ring.gradient(a)
    transport = [
        sum((ring.covariance[i][j] * slope[j] for j in range(n)), ring.zero) - drift[i] for i in range(n)
    ]

    def diffused(p: Polynomial) -> Polynomial:
        """G : Hess p / 2 + (G grad a - f) . grad p."""
        return ring.laplacian(p) / 2 + sum((t * d for t, d in zip(transport, ring.gradient(p))), ring.zero)

    divergence = sum((drift[i].derivative(i) for i in range(n)), ring.zero)
    W = diffused(a) - ring.weighted(slope, slope) / 2 - divergence - ring.read(potential, model.x)
    coefficients: list[Polynomial] = [ring.one]
    logarithms: list[Polynomial] = []
    for k in range(1, order + 1):
        coefficients.append(ring.radial(W * coefficients[-1] + diffused(coefficients[-1]), k))
        rate = W if k == 1 else diffused(logarithms[-1])
        gradients = [ring.gradient(p) for p in logarithms]
        rate = rate + sum((ring.weighted(gradients[i - 1], gradients[k - 2 - i]) for i in range(1, k - 1)), ring.zero) / 2
        logarithms.append(ring.radial(rate, k))
    return _readable(model, ring, G, order, a, W, coefficients, logarithms)


def _polynomial_system(model: Model) -> tuple[list[sp.Expr], sp.Expr, sp.ImmutableMatrix]:
    """f, h'S^-1 h / 2 and G with the values of the parameters, or ConditionError."""
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    f, h, G, S = (m.xreplace(values) for m in (model.drift, model.observation, model.covariance, model.observation_noise))
    for name, part in (("f", f), ("h", h), ("G", G), ("S", S)):
        if model.t in part.free_symbols:
            raise ConditionError(f"{model.source}: the series of the kernel needs {name} without time")
    if is_zero(G.det()) is not False or not G.is_positive_definite:
        raise ConditionError(f"{model.source}: the series of the kernel needs a positive definite G: {short(str(G.tolist()))}")
    potential = (h.T * S.inv() * h)[0] / 2
    for expression in (*f, potential):
        p = sp.expand(expression)
        if not p.is_polynomial(*model.x) or not all(c.is_Rational for c in sp.Poly(p, *model.x).coeffs()):
            said = short(str(expression))
            raise ConditionError(f"{model.source}: {said} is no polynomial with rational coefficients, as the series needs")
    if not all(entry.is_Rational for entry in G):
        raise ConditionError(f"{model.source}: the exact series needs a rational G; G = {short(str(G.tolist()))}")
    return list(f), potential, sp.ImmutableMatrix(G)


def _readable(model, ring, G, order, a, W, coefficients, logarithms) -> KolmogorovSeries:
    """The polynomials in x and y instead of z and y."""
    used_names = {symbol.name for symbol in (*model.x, *model.parameter_symbols)}
    prefix = "y_"
    while any(prefix + name in used_names for name in model.state):
        prefix += "_"
    y = tuple(sp.Symbol(prefix + name, real=True) for name in model.state)
    # The places of z are taken by x.
    shift = [*[z - y for z, y in zip(ring.z, ring.y)], *ring.y]

    def polynomial(p: Polynomial) -> sp.Poly:
        terms = {m: sp.Rational(int(c.p), int(c.q)) for m, c in p.compose(*shift).to_dict().items()}
        return sp.Poly.from_dict(terms, *model.x, *y, domain="QQ")

    return KolmogorovSeries(
        order,
        tuple(model.x),
        y,
        G,
        polynomial(a),
        polynomial(W),
        tuple(map(polynomial, coefficients)),
        tuple(map(polynomial, logarithms)),
    )


def _rational(value: sp.Expr) -> fmpq:
    return fmpq(int(value.p), int(value.q))
