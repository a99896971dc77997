"""When the product of Wei and Norman can be computed, and what each of its factors does to a density.

Every element after L_0 must be E = a.D + w(x) with a constant direction a.  Then, with D = d - g and g = G^-1 f,

    exp(r E) phi(x) = exp(int_0^r (w - a.g)(x + s a) ds) phi(x + r a),

a shift and a multiplier (Yau 1993, Theorem 6; Dong, Chen and Yau 2021, Theorem 4.1, for their bases).
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.conditions import Condition
from zakai.algebra.estimation_algebra import EstimationAlgebra, estimation_algebra
from zakai.algebra.normal_form import operator_symbols
from zakai.algebra.systems import determined
from zakai.algebra.yau import inverse
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

_SOURCE = "Wei and Norman 1964"
_MOST_STATES = 3


@dataclass(frozen=True)
class Exponential:
    """What exp(r E) is: a shift along `direction` a (n,), and the integral of `rate` = w - a.g along it."""

    direction: tuple[sp.Expr, ...]
    rate: sp.Expr


def exponentials(model: Model, algebra: EstimationAlgebra) -> tuple[Exponential, ...] | str:
    """The exponentials of E_1, ..., E_d of a finite algebra; or the element, in words, that gives no shift and multiplier."""
    drift, G = model.drift, model.covariance
    own = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    singular = sp.cancel(G.xreplace(own).det()) == 0  # then D_i is d_i
    g = sp.zeros(model.n, 1) if singular else inverse(G) * drift
    found, D = [], operator_symbols(model)[1]
    for element in algebra.basis[1:]:
        direction, function = [sp.Integer(0)] * model.n, sp.Integer(0)
        for term in sp.Add.make_args(sp.expand(element)):
            numbers, operators = term.args_cnc()
            factor = sp.Mul(*numbers)
            which = [i for i in range(model.n) if operators == [D[i]]]
            if which and not factor.free_symbols & set(model.x):
                direction[which[0]] += factor
            elif not operators:
                function += factor
            else:
                return f"{short(str(element))} is not"
        rate = function - sum((a * g_i for a, g_i in zip(direction, g, strict=True)), sp.Integer(0))
        found.append(Exponential(tuple(direction), rate))
    return tuple(found)


@once_for_a_model
def wei_norman_filter(model: Model) -> tuple[Condition, ...]:
    """A finite estimation algebra whose exponentials are shifts and multipliers, in few enough states for a grid."""
    grid = "the grid of exp(t L_0)"
    conditions = [
        determined(model),
        Condition(f"the state has at most {_MOST_STATES} coordinates", model.n <= _MOST_STATES, f"n = {model.n}", grid),
        Condition(
            "the observations act in continuous time",
            model.observation_kind != "samples",
            "samples: the likelihood of one is the exponential of no element of E"
            if model.observation_kind == "samples"
            else model.observation_kind,
            _SOURCE,
        ),
        Condition("no state is an angle", not model.periodic, f"periodic: {list(model.periodic)}", grid),
    ]
    if any(condition.holds is not True for condition in conditions):
        return tuple(conditions)
    algebra = estimation_algebra(model)
    holds = {"finite": True, "infinite": False}.get(algebra.verdict)
    size = f"of dimension {algebra.dimension}" if algebra.dimension is not None else algebra.note
    conditions.append(Condition("the estimation algebra is finite dimensional", holds, f"{algebra.verdict}, {size}", _SOURCE))
    if holds is not True:
        return tuple(conditions)
    equations = algebra.wei_norman
    shown = f"u = {equations.product}" if equations is not None else algebra.no_wei_norman
    conditions.append(Condition("its basis gives a product of exponentials", equations is not None, shown, _SOURCE))
    if equations is not None:
        factors = exponentials(model, algebra)
        shown = factors if isinstance(factors, str) else ", ".join(short(str(element)) for element in algebra.basis)
        statement = "every element after L_0 is a.D + w(x) with a constant a"
        conditions.append(Condition(statement, not isinstance(factors, str), shown, _SOURCE))
    return tuple(conditions)
