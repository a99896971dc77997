"""The Yau form of a drift and its q in a tower of generators.

r is the part of f that is not affine.  Omega is constant if and only if B = J G - (J G)', J the Jacobian of r, is free of x; a
constant B belongs to L, as B G^-1 / 2.  Then p = grad phi = G^-1 r, and with a = L x + l

    d_i q = d_i(div r + p'r + 2 a'p + h'S^-1 h) + 2 d_t p_i,

so that q is quadratic if and only if each of these is affine: phi is not needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp
from flint import fmpq

from zakai.algebra.identities import is_affine, is_in_one_piece
from zakai.algebra.potential import Potential, potential
from zakai.algebra.reading import Joint, Reader
from zakai.algebra.tower import Element, OutOfBounds
from zakai.models.model import Model


class YauProof:
    """A drift in a tower: f = L x + l + r; `form` sets p and phi, and `quadratic` sets q and its derivatives.

    `energy`: the tower holds h and S; `curved`: the drift is not affine, as decided before.
    """

    def __init__(self, model: Model, energy: bool, curved: bool, joint: Mapping[str, Joint] | None = None):
        self.energy = energy
        self.model, self.x, self.n, self.t = model, model.x, model.n, model.t
        parts = [model.drift, model.covariance, *([model.observation, model.observation_noise] if energy else [])]
        formulas = [e for part in parts for e in part]
        self.one_piece = all(is_in_one_piece(e, model.x) for e in formulas)
        self.reader = T = Reader([*formulas, model.t], model.x, joint)
        self.L = [[T.zero] * self.n for _ in self.x]
        self.l, self.r = [T.zero] * self.n, [T.zero] * self.n
        self.p: list[Element] = [T.zero] * self.n
        self.phi: Potential | None = None
        self.q, self.slopes = T.zero, [T.zero] * self.n
        for i, e in enumerate(model.drift) if curved else ():
            # Term by term: a common denominator that depends on x would hide the affine ones.
            for term in sp.Add.make_args(e):
                linear, offset, rest = T.affine_part(T(term))
                self.L[i] = [a + b for a, b in zip(self.L[i], linear)]
                self.l[i], self.r[i] = self.l[i] + offset, self.r[i] + rest

    def _matrix(self, matrix: sp.MatrixBase) -> list[list[Element]]:
        return [[self.reader(e) for e in row] for row in matrix.tolist()]

    def _jacobian(self, field: Sequence[Element]) -> list[list[Element]]:
        return [[self.reader.diff(e, s) for s in self.x] for e in field]

    def _turning(self) -> list[list[Element]]:
        """Return B = J G - (J G)'."""
        J, G, T = self._jacobian(self.r), self._matrix(self.model.covariance), self.reader
        JG = [[T.sum(a * G[k][j] for k, a in enumerate(row) if a and G[k][j]) for j in range(self.n)] for row in J]
        return [[JG[i][j] - JG[j][i] for j in range(self.n)] for i in range(self.n)]

    def form(self) -> bool:
        """Return whether the Yau form is proved; L, l, r and p are then those of the form."""
        if not any(self.r):
            return True
        T, n, B = self.reader, self.n, self._turning()
        if any(T.diff(B[i][j], s) for i in range(n) for j in range(i) for s in self.x):
            return False
        G = self._matrix(self.model.covariance)
        if any(e for row in B for e in row):
            if not self.one_piece:
                return False
            # Row i of B G^-1 / 2 is G^-1 times row i of B / 2, for G is symmetric.
            turned = T.solve(G, [[e * fmpq(1, 2) for e in row] for row in B])
            self.L = [[a + b for a, b in zip(own, more)] for own, more in zip(self.L, turned)]
            for i, row in enumerate(turned):
                self.r[i] = self.r[i] - T.sum(c * T.symbols[s] for c, s in zip(row, self.x))
        self.phi = self._potential(G)
        self.p = T.solve(G, [self.r])[0] if self.phi is None else self.phi.gradient
        return True

    def _potential(self, G: Sequence[Sequence[Element]]) -> Potential | None:
        self.reader.begin()
        try:
            return potential(self.reader, self.r, G, self.t)
        except OutOfBounds:
            return None
        finally:
            self.reader.begin()

    def quadratic(self, energy: bool) -> bool:
        """Return whether q is proved to be quadratic; `q` is then q without 2 phi_t + 2 tr L, `slopes` the derivatives of q."""
        T = self.reader
        states = [T.symbols[s] for s in self.x]
        affine = [T.sum(c * y for c, y in zip(row, states) if c) + l for row, l in zip(self.L, self.l)]
        q = T.sum(T.diff(e, s) for e, s in zip(self.r, self.x))
        q = q + T.sum(p * (r + a * 2) for p, r, a in zip(self.p, self.r, affine) if p)
        if energy:
            h = list(map(T, self.model.observation))
            solved = T.solve(self._matrix(self.model.observation_noise), [h])[0]
            q = q + T.sum(a * b for a, b in zip(h, solved))
        self.q = q
        self.slopes = [T.diff(q, s) + T.diff(p, self.t) * 2 for s, p in zip(self.x, self.p)]
        return all(is_affine(T, e, self.one_piece) for e in self.slopes)

    def omega(self, field: Sequence[Element]) -> list[list[Element]]:
        """Return omega_ij = d_i g_j - d_j g_i with g = G^-1 times a field."""
        T, n = self.reader, self.n
        J = self._jacobian(T.solve(self._matrix(self.model.covariance), [field])[0])
        return [[J[j][i] - J[i][j] for j in range(n)] for i in range(n)]

    def eta(self) -> Element:
        """Return f'G^-1 f + div f + h'S^-1 h; the tower must hold h and S."""
        T = self.reader
        f, h = [T(e) for e in self.model.drift], [T(e) for e in self.model.observation]
        g = T.solve(self._matrix(self.model.covariance), [f])[0]
        solved = T.solve(self._matrix(self.model.observation_noise), [h])[0]
        total = T.sum(a * b for a, b in zip([*f, *h], [*g, *solved]))
        return total + T.sum(T.diff(e, s) for e, s in zip(f, self.x))
