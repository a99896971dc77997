"""Conditions on a system by the names that papers give them.

(C.1) to (C.5) of Dong, Chen and Yau (2021) are for four states and hold as they stand for any number n >= 2; C1, C2, C2' and C3
of the survey of direct methods are for G = I, and are checked with g = G^-1 f.
"""

from __future__ import annotations

import sympy as sp

from zakai.algebra._readable import readable, short
from zakai.algebra.conditions import Condition
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.identities import all_zero, is_quadratic
from zakai.algebra.normal_form import operator_symbols
from zakai.algebra.systems import affine_parts
from zakai.algebra.yau import eta, observation_energy, wong_omega
from zakai.algebra.yau_theorems import DONG, TheoremCheck
from zakai.models.model import Model

SURVEY = "Chen and Dong, survey of direct methods, section 3"


def dong_chen_yau_class(model: Model) -> TheoremCheck:
    """(C.1) to (C.5), with G = I, make L_0, D_1, x_1, 1 the basis of E; a_i and phi_i are functions of x_2, ..., x_n.

        (C.1)  f_i = a_i x_1 + phi_i
        (C.2)  d_j phi_1 = a_j, j >= 2          (C.3)  a_1 is constant, sum a_i^2 a positive constant
        (C.4)  2 a_1 phi_1 + 2 sum_(i>=2) phi_i d_i phi_1 + sum_(i>=2) d_i^2 phi_1 is constant
        (C.5)  h_1, ..., h_m are polynomials of degree one in x_1

    (C.2) and (C.3) make |grad phi_1| constant, and so every a_i, where phi_1 is smooth on the whole space.

    Source: Dong, Chen and Yau (2021), section 3.1.
    """
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    f, h, G = (m.xreplace(values) for m in (model.drift, model.observation, model.covariance))
    first, *others = model.x
    a = [sp.diff(f_i, first) for f_i in f]
    phi = [sp.expand(f_i - a_i * first) for f_i, a_i in zip(f, a)]
    slopes = [sp.diff(phi[0], x_j) for x_j in others]
    length = sum(a_i**2 for a_i in a)
    fourth = 2 * a[0] * phi[0] + sum(
        2 * phi_i * slope + sp.diff(slope, x_i) for phi_i, slope, x_i in zip(phi[1:], slopes, others)
    )
    affine = affine_parts(h, model.x)
    alone = affine is not None and any(affine[0][:, 0]) and not any(affine[0][:, 1:])
    positive = _constant(length, model)
    if positive is True:
        positive = _at_origin(length, model).is_positive
    assumptions = (
        _constant_in_time(model, DONG),
        Condition("G = I", all_zero([*(G - sp.eye(model.n))]), f"G = {G.tolist()}", DONG),
        Condition("f_i = a_i x_1 + phi_i", all_zero([sp.diff(a_i, first) for a_i in a]), f"a = {_text(a)}", f"{DONG}, (C.1)"),
        Condition(
            "d_j phi_1 = a_j",
            all_zero([slope - a_j for slope, a_j in zip(slopes, a[1:])]),
            f"d_j phi_1 = {_text(slopes)}",
            f"{DONG}, (C.2)",
        ),
        Condition(
            "a_1 is constant and sum a_i^2 a positive constant",
            _both(_constant(a[0], model), positive),
            f"a_1 = {_text(a[0])}, sum a_i^2 = {_text(length)}",
            f"{DONG}, (C.3)",
        ),
        Condition(
            "2 a_1 phi_1 + 2 sum phi_i d_i phi_1 + sum d_i^2 phi_1 is constant",
            _constant(fourth, model),
            f"it is {_text(sp.expand(fourth))}",
            f"{DONG}, (C.4)",
        ),
        Condition(f"h is affine in {first} alone and not constant", alone, f"h = {_text(list(h))}", f"{DONG}, (C.5)"),
    )
    algebra, (L0, D) = estimation_algebra(model), operator_symbols(model)
    basis = [str(e) for e in algebra.basis]
    holds = {"finite": algebra.basis == (L0, D[0], first, 1), "infinite": False}.get(algebra.verdict)
    conclusion = Condition(f"E has the basis L_0, D_1, {first}, 1", holds, f"{algebra.verdict}, basis {basis}", DONG)
    return TheoremCheck(f"{DONG}, (C.1) to (C.5)", "E has the basis L_0, D_1, x_1, 1", assumptions, conclusion)


def survey_conditions(model: Model) -> tuple[Condition, ...]:
    """Constant coefficients, C1, C2, C2' and C3: the survey's Theorem 1 assumes C1, C2 and C3, its Theorem 2 C1, C2' and C3.

        C1  Omega is constant         C2   h is affine
        C3  eta is quadratic          C2'  h'S^-1 h is quadratic

    Source: Chen and Dong, A survey of direct methods for Yau filtering systems, section 3.
    """
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    omega, energy, h = wong_omega(model), eta(model), model.observation.xreplace(values)
    square = observation_energy(model).xreplace(values)
    if omega is None or energy is None:
        first = Condition("Omega is constant", False, "G is singular", f"{SURVEY}, C1")
        last = Condition("eta is quadratic", False, "G is singular", f"{SURVEY}, C3")
    else:
        omega, energy = omega.xreplace(values), energy.xreplace(values)
        constant = all_zero([sp.diff(entry, x) for entry in omega for x in model.x])
        first = Condition("Omega is constant", constant, f"Omega = {_text([*omega])}", f"{SURVEY}, C1")
        last = _quadratic("eta", energy, model, "C3")
    second = Condition("h is affine", affine_parts(h, model.x) is not None, f"h = {_text(list(h))}", f"{SURVEY}, C2")
    return _constant_in_time(model, SURVEY), first, second, _quadratic("h'S^-1 h", square, model, "C2'"), last


def _quadratic(name: str, expression: sp.Expr, model: Model, label: str) -> Condition:
    found = f"{name} = {short(str(expression))}"
    return Condition(f"{name} is quadratic", is_quadratic(expression, model.x), found, f"{SURVEY}, {label}")


def _constant_in_time(model: Model, source: str) -> Condition:
    parts = model.drift, model.observation, model.covariance, model.observation_noise
    still = not any(model.t in part.free_symbols for part in parts)
    evidence = "no coefficient depends on t" if still else "a coefficient depends on t"
    return Condition("f, h, G and S are constant in time", still, evidence, source)


def _constant(expression: sp.Expr, model: Model) -> bool | None:
    return all_zero([sp.diff(expression, x) for x in model.x])


def _at_origin(constant: sp.Expr, model: Model) -> sp.Expr:
    return sp.simplify(constant.subs(dict.fromkeys(model.x, 0)))


def _both(*answers: bool | None) -> bool | None:
    return False if False in answers else None if None in answers else True


def _text(value: sp.Basic | list) -> str:
    return short(str([readable(e) for e in value] if isinstance(value, list) else readable(value)))
