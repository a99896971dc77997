"""The Yau form of a drift, Wong's Omega, and the function q of a time-varying Yau system.

A drift has Yau form if f(x, t) = L(t) x + l(t) + G(t) grad phi(x, t).  With g = G^-1 f that is so if and only if Wong's
matrix omega_ij = d_i g_j - d_j g_i does not depend on x (Yau 1993, Theorem 1, for G = I).  Then u = e^phi v takes the
Kolmogorov equation to one whose drift is affine and whose potential is -q/2, with

    q = 2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L + h'S^-1 h.

The printed q (Chen, Luo and Yau 2017, (20)) lacks 2 phi_t and its Yau form (17) lacks the G before grad phi.

Both are decided by values first, then by a proof in a tower of generators, which gives the coefficients; each once for a model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import sympy as sp

from zakai.algebra._readable import brief, readable, short, tidy
from zakai.algebra.affine import Affine, affine
from zakai.algebra.balls import LINES, POINTS, sampled
from zakai.algebra.identities import NOT_ZERO, evidence
from zakai.algebra.tower import OutOfBounds
from zakai.algebra.yau_proof import YauProof
from zakai.algebra.yau_values import YauValues
from zakai.models.features import INPUTS, JUMP_FUNCTIONS, of_dynamics
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

DISPLAYED = 8  # what is only displayed may take this part of the work of a proof


@dataclass(frozen=True)
class YauForm:
    """f = `matrix` x + `offset` + G grad `potential`: L (n, n), l (n, 1), phi; `gradient` is grad phi (n, 1).

    `potential` is None where no closed form of phi was found: phi is then the integral of its gradient along the line from
    `base` (n, 1), where it is zero.
    """

    matrix: sp.ImmutableMatrix
    offset: sp.ImmutableMatrix
    potential: sp.Expr | None
    gradient: sp.ImmutableMatrix
    base: sp.ImmutableMatrix

    @cached_property
    def curved(self) -> bool:
        """Whether phi is more than zero."""
        return any(entry != 0 for entry in self.gradient)

    @cached_property
    def phi(self) -> str:
        """The potential in words."""
        if self.potential is not None:
            return str(self.potential)
        return f"the line integral of ({', '.join(map(brief, self.gradient))}), for which no closed form was found"

    @cached_property
    def text(self) -> str:
        """The form for a sentence."""
        matrix = ", ".join(f"[{', '.join(map(brief, row))}]" for row in self.matrix.tolist())
        return f"L = {short(f'[{matrix}]')}, l = {short(str(list(map(brief, self.offset))))}, phi = {short(self.phi)}"


@dataclass(frozen=True)
class NoYauForm:
    """Why no Yau form was found: `holds` is False if there is none, None if that is not known; `witness` is a point or empty."""

    holds: bool | None
    evidence: str
    witness: str = ""


class YauDecision(NamedTuple):
    """The form of a model, with its proof where there is one."""

    form: YauForm | NoYauForm
    proof: YauProof | None


def inverse(matrix: sp.MatrixBase) -> sp.MatrixBase:
    """Return the inverse, by cofactors and with tidied entries where they are not numbers."""
    if matrix.is_diagonal():
        return sp.diag(*[1 / entry for entry in matrix.diagonal()])
    if all(entry.is_Rational for entry in matrix):
        return matrix.inv()
    return matrix.inv(method="ADJ").applyfunc(tidy)


@once_for_a_model
def affine_drift(model: Model) -> Affine:
    """Return whether the drift is affine, decided once for a model."""
    return affine(model.drift, model.x)


@once_for_a_model
def affine_h(model: Model) -> Affine:
    """Return whether h is affine, decided once for a model."""
    return affine(model.observation, model.x)


@once_for_a_model
def is_regular(model: Model) -> bool | None:
    """Return whether G is regular at almost every time; None if that is not decided."""
    if all(e.is_Rational for e in model.covariance):
        return bool(model.covariance.rank() == model.n)
    return YauValues(model).regular(POINTS)


def yau_form(model: Model) -> YauForm | NoYauForm:
    """Return the Yau form of the drift, or why there is none."""
    return yau_decision(model).form


@once_for_a_model
def yau_decision(model: Model) -> YauDecision:
    """Return the Yau form of the drift with its proof, or why there is none."""
    n, zero = model.n, sp.ImmutableMatrix.zeros(model.n, 1)
    if features := [words for feature, words in of_dynamics(model).items() if feature != INPUTS]:
        return _refused(False, f"{'; '.join(features)}: the Yau form is for f(x, u, t) with g(u, t)")
    drift = affine_drift(model)
    if drift.slope is not None and drift.intercept is not None:
        return YauDecision(YauForm(drift.slope, drift.intercept, sp.Integer(0), zero, zero), None)
    driven = model.drift.free_symbols | model.covariance.free_symbols
    if driven & set(model.u) and (driven := (model.covariance.free_symbols | _curved_part(model).free_symbols) & set(model.u)):
        return _refused(False, f"phi would depend on the input {min(map(str, driven))}, and jump where it jumps")
    if is_regular(model) is not True:
        return _refused(False, "the drift is not affine and G is singular, so that G grad phi cannot be solved for phi")
    values = YauValues(model)
    if n > 1:
        refuted = sampled(values.curl, values.symbols, model.x, LINES)
        if refuted.holds is False:
            return _refused(False, _moving_omega(model), refuted.witness)
    jumps = model.covariance.row_join(model.drift).atoms(*JUMP_FUNCTIONS)
    if jumps and (jumps := model.covariance.row_join(_curved_part(model)).atoms(*JUMP_FUNCTIONS)):
        return _refused(False, f"phi contains {readable(min(jumps, key=str))}, and would jump in time")
    try:
        proof, why = prove_form(model, _is_defined(model)), NOT_ZERO
        if proof is not None:
            return _formed(proof)
    except OutOfBounds as bound:
        why = str(bound)
    found = evidence(values.curl, [*model.drift, *model.covariance], model.x, why)
    if found.holds is False:
        return _refused(False, _moving_omega(model), found.why)
    return _refused(None, f"it is not proved that Omega is constant: {found.why}")


def _is_defined(model: Model) -> bool:
    """Return whether h and S have values everywhere: where they have not, they would bound the states of which f is decided."""
    return not any(
        isinstance(e, sp.log) or (e.is_Pow and not e.exp.is_Integer)
        for part in (model.observation, model.observation_noise)
        for e in part.atoms(sp.log, sp.Pow)
    )


def prove_form(model: Model, energy: bool) -> YauProof | None:
    """Return a proof of the Yau form in a tower, which holds h and S where `energy` is set, or None.

    Raises:
        OutOfBounds: the work is beyond its bound.
    """
    curved = affine_drift(model).slope is None
    proof = YauProof(model, energy, curved)
    if proof.form():
        return proof
    joint = proof.reader.joint_arguments()
    proof = YauProof(model, energy, curved, joint)
    return proof if joint and proof.form() else None


def _refused(holds: bool | None, words: str, witness: str = "") -> YauDecision:
    return YauDecision(NoYauForm(holds, words, witness), None)


def _curved_part(model: Model) -> sp.Matrix:
    """Return the terms of the drift that are not affine."""
    return sp.Matrix(
        [
            sp.Add(*[term for term in sp.Add.make_args(e) if affine(sp.Matrix([term]), model.x).slope is None])
            for e in model.drift
        ]
    )


def _formed(proof: YauProof) -> YauDecision:
    T, x = proof.reader, proof.x
    gradient = sp.ImmutableMatrix(list(map(T.expression, proof.p)))
    form = YauForm(
        sp.ImmutableMatrix([list(map(T.expression, row)) for row in proof.L]),
        sp.ImmutableMatrix(list(map(T.expression, proof.l))),
        None if proof.phi is None else proof.phi.formula,
        gradient,
        _base(gradient, x),
    )
    return YauDecision(form, proof)


def _base(gradient: sp.MatrixBase, x: tuple[sp.Symbol, ...]) -> sp.ImmutableMatrix:
    """Return a point where the gradient has a value; the origin reads best."""
    for value in (sp.Integer(0), sp.Rational(1, 2), sp.Rational(7, 5)):
        values = gradient.xreplace(dict.fromkeys(x, value))
        if not values.has(sp.nan, sp.zoo, sp.oo):
            break
    return sp.ImmutableMatrix([value] * len(x))


def _moving_omega(model: Model) -> str:
    """Return the entry of Omega that depends on the state, in words."""
    try:
        proof = YauProof(model, False, True)
        T, omega = proof.reader, proof.omega(proof.r)
        for i in range(model.n):
            for j in range(i + 1, model.n):
                for symbol in model.x:
                    if T.diff(omega[i][j], symbol):
                        entry = readable(T.expression(omega[i][j]))
                        return f"omega_{i + 1}{j + 1} = {short(str(entry))} depends on {symbol}"
    except OutOfBounds:
        pass
    return "Omega is not constant"


@once_for_a_model
def wong_omega(model: Model) -> sp.ImmutableMatrix | None:
    """Return Wong's matrix omega_ij = d_i g_j - d_j g_i with g = G^-1 f, or None where G is singular or it is too long."""
    if of_dynamics(model) or is_regular(model) is not True:
        return None
    if model.n == 1:
        return sp.ImmutableMatrix.zeros(1, 1)
    try:
        proof = YauProof(model, False, True)
        T = proof.reader
        T.begin(DISPLAYED)
        return sp.ImmutableMatrix([list(map(T.expression, row)) for row in proof.omega(list(map(T, model.drift)))])
    except OutOfBounds:
        return None


@once_for_a_model
def eta(model: Model) -> sp.Expr | None:
    """Return Wong's eta = f'G^-1 f + div f + h'S^-1 h, or None where G is singular or the model has other features."""
    if model.features or is_regular(model) is not True:
        return None
    try:
        proof = YauProof(model, True, True)
        proof.reader.begin(DISPLAYED)
        return proof.reader.expression(proof.eta())
    except OutOfBounds:
        return None


def observation_energy(model: Model) -> sp.Expr:
    """Return h'S^-1 h."""
    return (model.observation.T * inverse(model.observation_noise) * model.observation)[0, 0]


def no_form_text(form: NoYauForm) -> str:
    """Return why there is no Yau form, with the witness, for a sentence."""
    return f"{form.evidence} (J G - (J G)' changes by {form.witness})" if form.witness else form.evidence
