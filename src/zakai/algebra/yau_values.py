"""What refutes the Yau form of a drift and a quadratic q by values, without G^-1, L, l or phi.

J is the Jacobian of f.  Wong's Omega is constant if and only if J G - (J G)' is free of x.  With P = G^-1,

    D2 q[d, d] = 2 d_t (d'P Df[d]) + D2(div f + f'P f + h'S^-1 h)[d, d] + a function of t,

so that q is quadratic if and only if this is free of x for every direction d.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp
from flint import arb, arb_mat, arb_series

from zakai.algebra.balls import TIME, Line, Test, Trial, concrete, constant, sampled
from zakai.algebra.identities import symbols_of
from zakai.models.model import Model


class YauValues:
    """The tests of a model; undetermined functions are replaced by concrete ones."""

    def __init__(self, model: Model):
        parts = (model.drift, model.covariance, model.observation, model.observation_noise)
        drift, self._G, h, self._S = (part.applyfunc(concrete) for part in parts)
        self._f, self._h = list(drift), list(h)
        self._x, self._t, self._n = model.x, model.t, model.n
        self.symbols = symbols_of([*self._f, *self._G, *self._h, *self._S, model.t], model.x)
        self.moving = any(e.has(model.t) for e in (*self._f, *self._G))

    def regular(self, count: int) -> bool | None:
        """Return whether the determinant of G is not zero at some point: True, or False if it was zero at all."""
        zero = sampled(lambda trial: self._matrix(self._G, trial.line(trial.draw())).det(), self.symbols, self._x, count)
        return None if zero.holds is None else not zero.holds

    def curl(self, trial: Trial) -> arb:
        """Return the change of w'J G z - z'J G w, which is zero where Omega is constant."""
        w, z, step = trial.draw(), trial.draw(), trial.draw()
        G = self._matrix(self._G, trial.line(w))

        def along(v: Sequence[arb], k: int) -> list[arb]:
            pushed = [row[0] for row in (G * arb_mat([[c] for c in v])).tolist()]
            line = trial.line(pushed, (step, k))
            return [line(e).value[1] for e in self._f]

        def turned(k: int) -> arb:
            forth = sum((a * b for a, b in zip(w, along(z, k))), arb(0))
            return forth - sum((a * b for a, b in zip(z, along(w, k))), arb(0))

        return turned(0) - turned(1)

    def curvature(self, energy: bool) -> Test:
        """Return the test of D2 q[d, d] between two points; `energy`: with h'S^-1 h."""

        def test(trial: Trial) -> arb:
            d, step = trial.draw(), trial.draw()
            lines = [trial.line(d, (step, k), self._t) for k in (0, 1)]
            P = self._matrix(self._G, lines[0]).inv()
            dG = arb_mat([[lines[0](e).slopes.get(TIME, constant(0))[0] for e in row] for row in self._G.tolist()])
            dP = -(P * dG * P)
            first, second = (self._one(line, d, P, dP, energy) for line in lines)
            return first - second

        return test

    def _one(self, line: Line, d: Sequence[arb], P: arb_mat, dP: arb_mat, energy: bool) -> arb:
        zero, f = constant(0), [line(e) for e in self._f]
        total = 2 * self._energies(line, P, energy)[2]
        for i, d_i in enumerate(d):
            for j, f_j in enumerate(f):
                total += 2 * d_i * (P[i, j] * f_j.slopes.get(TIME, zero)[1] + dP[i, j] * f_j.value[1])
        return total

    def _energies(self, line: Line, P: arb_mat, energy: bool) -> arb_series:
        """Return div f + f'P f (+ h'S^-1 h) along a line: q but for phi_t and a quadratic."""
        f, zero = [line(e) for e in self._f], constant(0)
        found = sum((f_i.slopes.get(i, zero) for i, f_i in enumerate(f)), zero)
        for i, f_i in enumerate(f):
            for j, f_j in enumerate(f):
                found = found + P[i, j] * f_i.value * f_j.value
        if energy:
            R, h = self._matrix(self._S, line).inv(), [line(e).value for e in self._h]
            for i, h_i in enumerate(h):
                for j, h_j in enumerate(h):
                    found = found + R[i, j] * h_i * h_j
        return found

    def pieces(self, energy: bool) -> Test:
        """Return the test of the third differences of q, which see pieces and jumps; it is for f and G without t."""

        def test(trial: Trial) -> arb:
            d = trial.draw()
            lines = [trial.line(d, (d, k), self._t) for k in range(4)]
            P = self._matrix(self._G, lines[0]).inv()
            a, b, c, e = (self._energies(line, P, energy)[0] for line in lines)
            return e - 3 * c + 3 * b - a

        return test

    def observed(self, trial: Trial) -> arb:
        """Return the change of D2(h'S^-1 h)[d, d]: for an affine drift, whose q is quadratic without the observation."""
        d, step = trial.draw(), trial.draw()
        changes = []
        for k in (0, 1):
            line = trial.line(d, (step, k))
            R, h = self._matrix(self._S, line).inv(), [line(e).value for e in self._h]
            products = (R[i, j] * h_i * h_j for i, h_i in enumerate(h) for j, h_j in enumerate(h))
            changes.append(sum(products, constant(0))[2])
        return changes[0] - changes[1]

    def _matrix(self, matrix: sp.MatrixBase, line: Line) -> arb_mat:
        return arb_mat([[line.value(e) for e in row] for row in matrix.tolist()])
