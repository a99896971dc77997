"""What the theorems ask about a model: its Yau form, its q, whether h is affine, whether G is definite; each decided once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.conditions import Condition
from zakai.algebra.identities import all_zero, is_in_one_piece, is_zero
from zakai.algebra.quadratics import Quadratic, as_quadratic
from zakai.algebra.yau import NoYauForm, YauForm, observation_energy, q_without_observation, yau_form
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

CLY = "Chen, Luo and Yau 2017"


@dataclass(frozen=True)
class YauSystem:
    """A time-varying Yau system whose transition between observations is linear-quadratic after the gauge u = e^phi v.

    `unobserved` is -q/2 without the observation's energy h'S^-1 h and `full` with it, each None where it is not quadratic.
    `slope` C (m, n) and `intercept` c (m, 1) are those of an affine h = C x + c, else None.
    """

    form: YauForm
    unobserved: Quadratic | None
    full: Quadratic | None
    slope: sp.ImmutableMatrix | None
    intercept: sp.ImmutableMatrix | None


@once_for_a_model
def cached_yau_form(model: Model) -> YauForm | NoYauForm:
    """`yau_form`, computed once for each model."""
    return yau_form(model)


@once_for_a_model
def q_parts(model: Model):
    """(-q/2 as a quadratic, whether q is one, why) without and with the observation's energy."""
    form = cached_yau_form(model)
    assert isinstance(form, YauForm)
    unobserved = q_without_observation(model, form)
    first = as_quadratic(unobserved, model.x)
    return first, as_quadratic(unobserved + observation_energy(model), model.x)


@once_for_a_model
def affine_observation(model: Model) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """C and c if h = C x + c, else None."""
    return affine_parts(model.observation, model.x)


def affine_parts(
    field: sp.MatrixBase, x: tuple[sp.Symbol, ...]
) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """C and c if the field is C x + c for all x, else None."""
    slope = sp.Matrix([[sp.diff(entry, symbol) if entry.has(symbol) else sp.Integer(0) for symbol in x] for entry in field])
    # Where a derivative still contains the state it may do so in name only.
    seconds = (sp.diff(entry, symbol) for entry in slope for symbol in entry.free_symbols & set(x))
    if all_zero(seconds) is not True:
        return None
    origin = {symbol: sp.Integer(0) for symbol in x}
    slope, intercept = slope.xreplace(origin), field.xreplace(origin)
    # The slope of asin(sin(x)) is constant in each of its pieces, and not the same in all.
    if not all(is_in_one_piece(entry, x) for entry in field):
        if all_zero(list(field - slope * sp.Matrix(x) - intercept)) is not True:
            return None
    return sp.ImmutableMatrix(slope), sp.ImmutableMatrix(intercept)


def yau_system(model: Model) -> YauSystem | None:
    """What the direct methods compute with, or None where the drift has no Yau form."""
    form = cached_yau_form(model)
    if not isinstance(form, YauForm):
        return None
    (unobserved, _, _), (full, _, _) = q_parts(model)
    slope, intercept = affine_observation(model) or (None, None)
    return YauSystem(form, unobserved, full, slope, intercept)


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
    source = f"{CLY}, Assumption 1"
    statement = "G = g Q g' is positive definite"
    determinant = model.covariance.det()
    if determinant.is_polynomial(*determinant.free_symbols):  # a factor exp(-1000 t) would be one of degree 1000
        determinant = sp.factor(determinant)
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
