"""What the theorems ask about a model: its Yau form, its q, whether h is affine, whether G is definite; each decided once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.affine import affine
from zakai.algebra.conditions import Condition
from zakai.algebra.quadratics import Quadratic, decided_q
from zakai.algebra.yau import YauForm, affine_h, is_regular, yau_form
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

CLY = "Chen, Luo and Yau 2017"
_TIMES = 40  # at which a covariance that depends on time is checked
_MOST_SHOWN = 3  # states up to which det G is written out


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


def affine_observation(model: Model) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """Return C and c if h = C x + c, else None."""
    found = affine_h(model)
    return None if found.slope is None or found.intercept is None else (found.slope, found.intercept)


def affine_parts(
    field: sp.MatrixBase, x: tuple[sp.Symbol, ...]
) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """Return C and c if the field is C x + c for all x, else None."""
    found = affine(field, x)
    return None if found.slope is None or found.intercept is None else (found.slope, found.intercept)


def yau_system(model: Model) -> YauSystem | None:
    """What the direct methods compute with, or None where the drift has no Yau form."""
    form = yau_form(model)
    if not isinstance(form, YauForm):
        return None
    unobserved, full = (decided_q(model, energy).quadratic for energy in (False, True))
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
    if is_regular(model) is False:
        return Condition(statement, False, "det G = 0", source)
    evaluate = numpy_function(model.covariance, model, model.covariance.shape)
    times = model.start + np.concatenate([[0.0], np.geomspace(1e-3, 1e2, _TIMES)])
    for time in times:
        matrix = evaluate(np.zeros(model.n), time, model.theta())
        if not np.all(np.isfinite(matrix)) or np.linalg.eigvalsh(matrix)[0] <= 0:
            # The record may never reach this time, so that only the start refutes.
            holds = False if time == model.start else None
            return Condition(statement, holds, f"G is not positive definite at t = {time:g}", source)
    return Condition(statement, True, _determinant(model.covariance), source)


def _determinant(G: sp.MatrixBase) -> str:
    """Return det G in words, where it is short."""
    if len(G.free_symbols) and G.rows > _MOST_SHOWN and not G.is_diagonal():
        return f"at {_TIMES} times after the start"
    determinant = sp.prod(G.diagonal()) if G.is_diagonal() else G.det()
    if determinant.is_polynomial(*determinant.free_symbols):  # a factor exp(-1000 t) would be one of degree 1000
        determinant = sp.factor(determinant)
    return f"det G = {short(str(determinant))}"
