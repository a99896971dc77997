"""Whether q of a Yau system is quadratic in the state, and its coefficients; decided once for a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import sympy as sp
from flint import fmpq

from zakai.algebra._readable import brief, is_short, readable, short
from zakai.algebra.balls import LINES, POINTS, sampled
from zakai.algebra.identities import NOT_ZERO, Answer, evidence
from zakai.algebra.tower import Element, OutOfBounds
from zakai.algebra.yau import DISPLAYED, YauDecision, YauForm, affine_drift, inverse, prove_form, yau_decision
from zakai.algebra.yau_proof import YauProof
from zakai.algebra.yau_values import YauValues
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

MOST_STATES = 3  # for which the coefficients of a q without a proof are derivatives of formulas


@dataclass(frozen=True)
class Quadratic:
    """x'`matrix` x + `linear`.x + `constant`: what -q/2 is when q is quadratic in x."""

    matrix: sp.ImmutableMatrix
    linear: sp.ImmutableMatrix
    constant: sp.Expr

    def q(self, x: Sequence[sp.Symbol]) -> sp.Expr:
        """Return q itself."""
        state = sp.Matrix(x)
        value = (state.T * self.matrix * state)[0, 0] + (self.linear.T * state)[0, 0] + self.constant
        return sp.collect(sp.expand(-2 * value), list(x)) if value.count_ops() < 200 else -2 * value


class QuadraticAnswer(NamedTuple):
    """-q/2 as a quadratic or None, whether q is one, and what decided it."""

    quadratic: Quadratic | None
    holds: bool | None
    evidence: str


@once_for_a_model
def decided_q(model: Model, energy: bool) -> QuadraticAnswer:
    """Return whether q is quadratic in x, without the observation's energy h'S^-1 h or with it; the model has a Yau form."""
    decided, x = yau_decision(model), model.x
    form = decided.form
    assert isinstance(form, YauForm)
    if not form.curved and not energy:
        flat = sp.ImmutableMatrix.zeros(model.n, model.n)
        return _found(Quadratic(flat, sp.ImmutableMatrix.zeros(model.n, 1), -form.matrix.trace()), x)
    values = YauValues(model)
    test = values.curvature(energy) if form.curved else values.observed
    refuted = sampled(test, values.symbols, x, LINES)
    if refuted.holds is False:
        return _refuted(model, energy, refuted.witness)
    try:
        proof, why = _proof(model, decided, energy), NOT_ZERO
        if proof is not None:
            return _found(_quadratic(proof, decided, model), x)
    except OutOfBounds as bound:
        why = str(bound)
    formulas = [*model.drift, *model.covariance, *([*model.observation, *model.observation_noise] if energy else [])]
    found = evidence(test, formulas, x, why)
    if found.holds and form.curved and not values.moving:
        pieces = sampled(values.pieces(energy), values.symbols, x, POINTS)
        found = Answer(False, "value", pieces.witness) if pieces.holds is False else found
    if found.holds is False:
        return _refuted(model, energy, found.why)
    if found.holds is None or model.n > MOST_STATES:
        return QuadraticAnswer(None, None, f"it is not proved that q is quadratic in {', '.join(map(str, x))}: {found.why}")
    quadratic = _by_derivatives(model, form, energy)
    return QuadraticAnswer(quadratic, True, f"{_found(quadratic, x).evidence}; {found.why}")


@once_for_a_model
def displayed_q(model: Model, energy: bool) -> sp.Expr | None:
    """Return q as a formula in the state, or None where it is too long; the model has a Yau form."""
    decided = yau_decision(model)
    quadratic, form = decided_q(model, energy).quadratic, decided.form
    if quadratic is not None:
        return quadratic.q(model.x)
    assert isinstance(form, YauForm)
    try:
        proof = _begun(model, decided, energy, DISPLAYED)
        if proof is None:
            return None
        T = proof.reader
        proof.quadratic(energy)
        rate = None if proof.phi is None else proof.phi.rate
        if rate is not None:
            return T.expression(proof.q + rate * 2) + 2 * form.matrix.trace()
        moving = sp.Integer(0) if form.potential is None else 2 * sp.diff(form.potential, model.t)
        return T.expression(proof.q) + moving + 2 * form.matrix.trace()
    except OutOfBounds:
        return None


def _found(quadratic: Quadratic, x: Sequence[sp.Symbol]) -> QuadraticAnswer:
    parts = (quadratic.matrix, quadratic.linear, sp.Matrix([quadratic.constant]))
    words = short(str(quadratic.q(x))) if all(is_short(e) for part in parts for e in part) else "a quadratic"
    return QuadraticAnswer(quadratic, True, f"q = {words}")


def _refuted(model: Model, energy: bool, witness: str) -> QuadraticAnswer:
    """Return that q is not quadratic, with its terms that are not, where they are soon made, and the witness."""
    changes = f"its second derivative along a line changes by {witness}"
    try:
        proof = _begun(model, yau_decision(model), energy, DISPLAYED)
        if proof is not None:
            proof.quadratic(energy)
            q = proof.q if proof.phi is None or proof.phi.rate is None else proof.q + proof.phi.rate * 2
            terms = brief(readable(proof.reader.expression(proof.reader.beyond(q, 2))))
            return QuadraticAnswer(
                None, False, f"q contains {short(terms)}, which is not quadratic in {', '.join(map(str, model.x))}: {changes}"
            )
    except OutOfBounds:
        pass
    return QuadraticAnswer(None, False, f"q is not quadratic: {changes}")


def _proof(model: Model, decided: YauDecision, energy: bool) -> YauProof | None:
    """Return the proof that q is quadratic, at first with independent arguments, or None."""
    proof = _begun(model, decided, energy)
    if proof is None:
        return None
    if proof.quadratic(energy):
        return proof
    joint = {} if proof.reader.joint else proof.reader.joint_arguments()
    if not joint:
        return None
    proof = YauProof(model, energy, affine_drift(model).slope is None, joint)
    return proof if proof.form() and proof.quadratic(energy) else None


def _begun(model: Model, decided: YauDecision, energy: bool, share: int = 1) -> YauProof | None:
    """Return the proof of the form with new bounds of its work, in a tower that holds h and S where they are needed."""
    proof = decided.proof
    if proof is None or (energy and not proof.energy):
        proof = prove_form(model, energy)
    if proof is not None:
        proof.reader.begin(share)
    return proof


def _quadratic(proof: YauProof, decided: YauDecision, model: Model) -> Quadratic:
    """Return -q/2 from the derivatives of q, and from q and phi_t at one point."""
    T, x, form = proof.reader, model.x, decided.form
    assert isinstance(form, YauForm)
    at = dict(zip(x, form.base))
    matrix, linear = [], []
    for e in proof.slopes:
        row, offset, rest = T.affine_part(e)
        if rest:  # its second derivatives vanish
            row = [T.diff(e, s) for s in x]
            offset = e - T.sum(c * T.symbols[s] for c, s in zip(row, x))
        matrix.append(row)
        linear.append(offset)

    def formula(e: Element) -> sp.Expr:
        text = T.expression(e)
        return text.xreplace(at) if text.has(*x) else text

    A = sp.ImmutableMatrix([list(map(formula, row)) for row in matrix])
    b = sp.ImmutableMatrix(list(map(formula, linear)))
    constant = 2 * form.matrix.trace() + _constant(proof, decided, matrix, linear)
    return Quadratic(-A / 4, -b / 2, -constant / 2)


def _constant(proof: YauProof, decided: YauDecision, matrix: Sequence[Sequence[Element]], linear: Sequence[Element]) -> sp.Expr:
    """Return q - 2 tr L less its quadratic and linear parts."""
    T, x, form = proof.reader, proof.x, decided.form
    assert isinstance(form, YauForm)
    states = [T.symbols[s] for s in x]
    squares = T.sum(c * y * z for row, y in zip(matrix, states) for c, z in zip(row, states) if c)
    rest = proof.q - squares * fmpq(1, 2) - T.sum(c * y for c, y in zip(linear, states) if c)
    phi = proof.phi
    if phi is not None and phi.rate is not None:
        whole = rest + phi.rate * 2
        if not T.moving(whole):
            return T.expression(whole)
    at = dict(zip(x, form.base))
    rate = sp.Integer(0) if form.potential is None else sp.diff(form.potential, proof.t).xreplace(at)
    return T.expression(rest).xreplace(at) + 2 * rate


def _by_derivatives(model: Model, form: YauForm, energy: bool) -> Quadratic:
    """Return -q/2 from derivatives of formulas at one point, where q is quadratic by evidence."""
    x, p = sp.Matrix(model.x), form.gradient
    at = dict(zip(model.x, form.base))
    r, a = model.covariance * p, form.matrix * x + form.offset
    q = sum(sp.diff(e, s) for e, s in zip(r, model.x)) + (p.T * (r + 2 * a))[0, 0]
    if energy:
        q += (model.observation.T * inverse(model.observation_noise) * model.observation)[0, 0]
    slopes = sp.Matrix([sp.diff(q, s) + 2 * sp.diff(p_i, model.t) for s, p_i in zip(model.x, p)])
    A, point = slopes.jacobian(model.x).xreplace(at), sp.Matrix(form.base)
    b = slopes.xreplace(at) - A * point
    rate = sp.Integer(0) if form.potential is None else sp.diff(form.potential, model.t).xreplace(at)
    level = q.xreplace(at) + 2 * rate + 2 * form.matrix.trace()
    constant = level - (point.T * A * point)[0, 0] / 2 - (b.T * point)[0, 0]
    return Quadratic(sp.ImmutableMatrix(-A / 4), sp.ImmutableMatrix(-b / 2), -constant / 2)
