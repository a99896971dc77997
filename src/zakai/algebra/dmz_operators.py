"""The operators of the Duncan-Mortensen-Zakai equation of a model, in one ring with everything that theorems ask about.

    L_0 = (d'G d)/2 - f.d - div f - h'S^-1 h / 2 = (D'G D - eta) / 2,     D = d - g,  g = G^-1 f
    omega_ij = d_i g_j - d_j g_i,   [D_i, D_j] = -omega_ij,               eta = f'G^-1 f + div f + h'S^-1 h

G is a constant matrix and need not be the identity; no square root is taken.  It may be singular: then there is no g.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import sympy as sp

from zakai.algebra.generators import Reader, Unreadable
from zakai.algebra.linear_span import Numbers
from zakai.algebra.operators import Symbol
from zakai.algebra.yau import inverse
from zakai.models.model import Model


class DmzOperators:
    """The operators of the Zakai equation of a model, as elements of `ring`.

    `L0`, `f` (n), `h` and `driven` = S^-1 h (m), `covariance` G (n, n), `g` (n) or None, `eta` or None and `omega`.

    Args:
        model: the system.
        values: numbers for parameters; the other parameters stay symbols.
        jets: the order up to which derivatives of undetermined functions are elements of the ring.

    Raises:
        Unreadable: a coefficient is not an element of such a ring.
    """

    def __init__(self, model: Model, values: Mapping[sp.Symbol, sp.Expr], jets: int = 6):
        self.model = model
        if model.features:
            raise Unreadable(f"{'; '.join(model.features.values())}: the Zakai equation is that of another kind of model")
        given = (model.drift, model.observation, model.covariance, model.observation_noise)
        drift, h, G, S = (matrix.xreplace(dict(values)) for matrix in given)
        symbols = drift.free_symbols | h.free_symbols | G.free_symbols | S.free_symbols
        if model.t in symbols:
            raise Unreadable("the coefficients depend on time")
        constants = [symbol for symbol in model.parameter_symbols if symbol in symbols]
        S_inverse = inverse(S)
        G_inverse = inverse(G) if sp.cancel(G.det()) != 0 else None
        matrices = [drift, h, G, S_inverse, *([] if G_inverse is None else [G_inverse])]
        self.reader = reader = Reader([entry for matrix in matrices for entry in matrix], model.x, constants, jets)
        self.ring = ring = reader.ring
        self.numbers = Numbers(ring, bool(constants) or drift.has(sp.pi) or h.has(sp.pi) or G.has(sp.pi) or S.has(sp.pi), reader)
        self.f = f = [reader.read(entry) for entry in drift]
        self.h = [reader.read(entry) for entry in h]
        self.covariance = covariance = _rows(G, reader)
        self.driven = [ring.normal(_form([ring.one], [row], self.h)) for row in _rows(S_inverse, reader)]
        energy = sum((a * b for a, b in zip(self.h, self.driven)), ring.zero)
        divergence = sum((ring.total_derivative(f_i, i) for i, f_i in enumerate(f)), ring.zero)
        transport = sum((f_i * xi for f_i, xi in zip(f, ring.xi)), ring.zero)
        self.L0 = ring.normal(_form(ring.xi, covariance, ring.xi) / 2 - transport - divergence - energy / 2)
        self.g: list[Symbol] | None = None
        self.eta: Symbol | None = None
        if G_inverse is not None:
            precision = _rows(G_inverse, reader)
            self.g = [ring.normal(sum((p * f_j for p, f_j in zip(row, f)), ring.zero)) for row in precision]
            self.eta = ring.normal(sum((a * b for a, b in zip(f, self.g)), ring.zero) + divergence + energy)

    @cached_property
    def omega(self) -> dict[tuple[int, int], Symbol]:
        """omega_ij for i < j."""
        assert self.g is not None
        ring, g = self.ring, self.g
        return {
            (i, j): ring.normal(ring.total_derivative(g[j], i) - ring.total_derivative(g[i], j))
            for i in range(ring.n)
            for j in range(i + 1, ring.n)
        }

    def is_polynomial(self, p: Symbol, degree: int) -> bool:
        """Whether a function is a polynomial in x of at most this degree."""
        return not self.ring.has_generators(p) and self.ring.degree(p) <= degree

    def in_D(self, p: Symbol) -> Symbol:
        """The operator sum_a c_a D_1^a1 ... D_n^an as the polynomial sum_a c_a xi^a; as it is where G is singular."""
        if self.g is None:
            return p
        ring, result = self.ring, self.ring.zero
        while ring.order(p) > 0:
            top = ring.principal(p)
            result = result + top
            for monomial in {m[: ring.n] for m in top.monoms()}:
                c = ring.context.from_dict(
                    {(*[0] * ring.n, *m[ring.n :]): c for m, c in top.to_dict().items() if m[: ring.n] == monomial}
                )
                p = p - c * self.power_of_D(monomial)
            p = ring.normal(p)
        return result + p

    def power_of_D(self, exponents: Sequence[int]) -> Symbol:
        """D_1^a1 ... D_n^an; needs a regular G."""
        assert self.g is not None
        power = self.ring.one
        for i in reversed(range(self.ring.n)):
            for _ in range(exponents[i]):
                power = self.ring.compose(self.ring.xi[i] - self.g[i], power)
        return power


def _rows(matrix: sp.MatrixBase, reader: Reader) -> list[list[Symbol]]:
    return [[reader.read(entry) for entry in row] for row in matrix.tolist()]


def _form(left: Sequence[Symbol], matrix: list[list[Symbol]], right: Sequence[Symbol]) -> Symbol:
    return sum((a * c * b for a, row in zip(left, matrix) for c, b in zip(row, right)), left[0] * 0)
