"""When each method holds: every assumption of its theorem, decided from the equations of one model.

Each function takes a Model and gives a tuple of `Condition`.  A theorem says when a method holds, never how it computes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import sympy as sp

from zakai.algebra.conditions import Condition
from zakai.algebra.identities import all_zero, is_zero
from zakai.algebra.yau import (
    NoYauForm,
    Quadratic,
    YauForm,
    as_quadratic,
    inverse,
    observation_energy,
    q_without_observation,
    short,
    yau_form,
)
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

_CLY = "Chen, Luo and Yau 2017"


@dataclass(frozen=True)
class YauSystem:
    """A time-varying Yau system whose transition between observations is linear-quadratic after the gauge u = e^phi v.

    `bare` is -q/2 without the observation's energy h'S^-1 h and `full` with it, each None where it is not quadratic.
    `slope` C (m, n) and `intercept` c (m, 1) are those of an affine h = C x + c, else None.
    """

    form: YauForm
    bare: Quadratic | None
    full: Quadratic | None
    slope: sp.ImmutableMatrix | None
    intercept: sp.ImmutableMatrix | None


@lru_cache(maxsize=64)
def cached_yau_form(model: Model) -> YauForm | NoYauForm:
    """`yau_form`, computed once for each model."""
    return yau_form(model)


@lru_cache(maxsize=64)
def _q_parts(model: Model):
    """(-q/2 as a quadratic, whether q is one, why) without and with the observation's energy."""
    form = cached_yau_form(model)
    assert isinstance(form, YauForm)
    bare = q_without_observation(model, form)
    first = as_quadratic(bare, model.x)
    return first, as_quadratic(bare + observation_energy(model), model.x)


@lru_cache(maxsize=64)
def affine_observation(model: Model) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """C and c if h = C x + c, else None."""
    seconds = [sp.diff(h, a, b) for h in model.observation for a in model.x for b in model.x]
    if all_zero(seconds) is not True:
        return None
    origin = {symbol: 0 for symbol in model.x}
    slope = model.observation.jacobian(model.x).subs(origin)
    return sp.ImmutableMatrix(slope), sp.ImmutableMatrix(model.observation.subs(origin))


def yau_system(model: Model) -> YauSystem | None:
    """What the direct methods compute with, or None where the drift has no Yau form."""
    form = cached_yau_form(model)
    if not isinstance(form, YauForm):
        return None
    (bare, _, _), (full, _, _) = _q_parts(model)
    slope, intercept = affine_observation(model) or (None, None)
    return YauSystem(form, bare, full, slope, intercept)


@lru_cache(maxsize=64)
def limited_direct(model: Model) -> tuple[Condition, ...]:
    """The assumptions under which the Kolmogorov equation of a time-varying Yau system has an explicit kernel.

    Chen, Luo and Yau (2017), Theorems 1 to 3, in their corrected form.
    """
    conditions = [
        determined(model),
        Condition(
            "the state has one or two coordinates, so that the density fits on a lattice",
            model.n <= 2,
            f"n = {model.n}",
            "the lattice of this method",
        ),
    ]
    if conditions[0].holds is not True:
        return tuple(conditions)
    conditions.append(definite_covariance(model))
    form = cached_yau_form(model)
    statement = "f = L(t) x + l(t) + G(t) grad phi(t, x)"
    if not isinstance(form, YauForm):
        return (*conditions, Condition(statement, form.holds, form.evidence, f"{_CLY}, (17) corrected"))
    conditions.append(Condition(statement, True, _form_text(form), f"{_CLY}, (17) corrected"))
    conditions.append(
        Condition(
            "L = G Omega + F' F^-1 with Omega symmetric for some square root F of G",
            True,
            "F = Fc R, Fc the Cholesky factor and R' = W R a rotation, makes it true for every L",
            f"{_CLY}, Assumption 2",
        )
    )
    conditions.append(_quadratic_condition(model))
    conditions.extend(_angle_conditions(model, form))
    return tuple(conditions)


def _quadratic_condition(model: Model) -> Condition:
    bare, full = _q_parts(model)
    sampled = model.observation_kind == "samples"
    _, holds, evidence = bare if sampled else full
    statement = (
        "q = 2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L"
        + ("" if sampled else " + h'S^-1 h")
        + " is quadratic in x"
    )
    if sampled and bare[1]:
        evidence += " (a sample enters only at its time, so that h may be any function)"
    return Condition(statement, holds, evidence, f"{_CLY}, Assumption 3 with 2 phi_t")


def _angle_conditions(model: Model, form: YauForm):
    """What an angle needs: an affine part and a potential that do not know how often it has turned."""
    for name in model.periodic:
        i = model.state.index(name)
        symbol = model.x[i]
        column = [form.matrix[j, i] for j in range(model.n)]
        turned = form.potential.subs(symbol, symbol + 2 * sp.pi) - form.potential
        (bare, _, _), (full, _, _) = _q_parts(model)
        q = bare if model.observation_kind == "samples" else full
        parts = [*column, turned]
        if q is not None:
            parts += [*q.matrix.row(i), q.linear[i]]
        holds = all_zero(parts)
        yield Condition(
            f"L, phi and q are the same after a turn of {name}",
            holds,
            "column of L: " + str(column) + f", phi({name} + 2 pi) - phi({name}) = {turned if not holds else 0}",
            "a density on the circle",
        )


def determined(model: Model) -> Condition:
    """No undetermined function: a model with one can be analysed and not filtered."""
    return Condition(
        "every function of the model is given",
        not model.functions,
        f"undetermined: {', '.join(model.functions)}" if model.functions else "no undetermined functions",
        "needed to compute",
    )


def definite_covariance(model: Model) -> Condition:
    """G = g Q g' is positive definite; at the times of a record it is checked again."""
    source = f"{_CLY}, Assumption 1"
    statement = "G = g Q g' is positive definite"
    determinant = sp.factor(model.covariance.det())
    if is_zero(determinant):
        return Condition(statement, False, "det G = 0", source)
    evaluate = numpy_function(model.covariance, model, model.covariance.shape)
    times = model.start + np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 40)])
    for time in times:
        matrix = evaluate(np.zeros(model.n), time, model.theta())
        if not np.all(np.isfinite(matrix)) or np.linalg.eigvalsh(matrix)[0] <= 0:
            # The record may never reach this time, so that only the start refutes.
            holds = False if time == model.start else None
            return Condition(statement, holds, f"G is not positive definite at t = {time:g}", source)
    return Condition(statement, True, f"det G = {short(str(determinant))}", source)


@lru_cache(maxsize=64)
def smooth_system(model: Model) -> tuple[Condition, ...]:
    """Any smooth system: what a method that only linearises asks for."""
    return (determined(model),)


def _form_text(form: YauForm) -> str:
    return f"L = {short(str(form.matrix.tolist()))}, l = {short(str(list(form.offset)))}, phi = {short(str(form.potential))}"


# The theorem that says when a method holds, by the method's name.
THEOREMS: Mapping[str, Callable[[Model], tuple[Condition, ...]]] = {
    "limited-direct": limited_direct,
    "extended-kalman-bucy": smooth_system,
}

__all__ = [
    "THEOREMS",
    "YauSystem",
    "affine_observation",
    "cached_yau_form",
    "inverse",
    "limited_direct",
    "smooth_system",
    "yau_system",
]
