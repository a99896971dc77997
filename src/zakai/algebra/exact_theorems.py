"""When a filter has finitely many statistics: the theorems of Kalman and Bucy, of Benes, and of Hu and Yau."""

from __future__ import annotations

from collections.abc import Iterator

import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.affine import affine
from zakai.algebra.conditions import Condition
from zakai.algebra.gauges import gauge
from zakai.algebra.poles import finite_drift
from zakai.algebra.quadratics import decided_q
from zakai.algebra.systems import definite_covariance, determined
from zakai.algebra.yau import NoYauForm, affine_drift, affine_h, no_form_text, yau_form
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.prior import DensityPrior

_KALMAN = "Kalman and Bucy 1961"
_BENES = "Benes 1981"
_HU_YAU = "Hu and Yau 2002"
_MOST_STATES = 3


@once_for_a_model
def kalman_bucy(model: Model) -> tuple[Condition, ...]:
    """Affine f and h, with coefficients that may depend on time; G may be singular (Kalman and Bucy 1961)."""
    conditions = [determined(model)]
    if conditions[0].holds is not True:
        return tuple(conditions)
    return (
        *conditions,
        _affine("f = L(t) x + l(t)", model.drift, model, _KALMAN),
        _affine("h = C(t) x + c(t)", model.observation, model, _KALMAN),
        *posterior_on_the_line(model),
    )


@once_for_a_model
def benes(model: Model) -> tuple[Condition, ...]:
    """f = L x + l + G grad log cosh(q.x + delta) with a quadratic q, and affine h (Benes 1981, in any dimension)."""
    conditions = _yau_conditions(model, _BENES, "G")
    if any(condition.holds is not True for condition in conditions):
        return conditions
    form, own = gauge(model), yau_form(model)
    assert not isinstance(own, NoYauForm)
    statement = "phi = log cosh(q(t).x + delta(t)) but for an affine function, which is part of l"
    return (
        *conditions,
        Condition(statement, form is not None and form.is_log_cosh, f"phi = {short(own.phi)}", _BENES),
        *posterior_on_the_line(model),
    )


@once_for_a_model
def hu_yau(model: Model) -> tuple[Condition, ...]:
    """f = G grad F + l with affine l, a quadratic eta and affine h (Hu and Yau 2002, Theorems 3 to 6).

    With l affine, eta is quadratic if and only if G:Hess F + grad F'G grad F + 2 l.grad F is. The theorems are stated for
    constant coefficients; what is asked here, with 2 F_t, is what they need when coefficients vary in time.
    """
    conditions = _yau_conditions(model, f"{_HU_YAU}, conditions C1 to C3", "G")
    if any(condition.holds is not True for condition in conditions):
        return conditions
    form = gauge(model)
    words = "more than two directions"
    if form is not None:
        kind = "no finite sum of exponentials" if form.slopes is None else "a sum of exponentials"
        words = f"e^F is {kind}, directions {short(str(form.directions.tolist()))}, n = {model.n}"
    return (
        *conditions,
        Condition(
            "e^F is a sum of exponentials in one or two directions, or n is at most two",
            form is not None and (form.slopes is not None or model.n <= 2),
            words,
            "the nodes of this method",
        ),
        *finite_drift(model),
        *posterior_on_the_line(model),
    )


def _yau_conditions(model: Model, source: str, covariance: str) -> tuple[Condition, ...]:
    """h affine, f of Yau form, q quadratic."""
    first = determined(model)
    if first.holds is not True:
        return (first,)
    observed = _affine("h = C(t) x + c(t)", model.observation, model, source)
    statement = f"f = L(t) x + l(t) + {covariance}(t) grad phi(t, x)"
    if affine_drift(model).slope is not None:
        return first, observed, Condition(statement, True, "f is affine, phi = 0", source)
    form = yau_form(model)
    if isinstance(form, NoYauForm):
        # With inputs in G there is no Yau form, and no number to decide whether G is definite.
        known = () if model.covariance.free_symbols & set(model.u) else (definite_covariance(model),)
        return first, observed, *known, Condition(statement, form.holds, no_form_text(form), source)
    definite = definite_covariance(model)
    _, holds, evidence = decided_q(model, False)
    quadratic = "2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L is quadratic in x"
    found = Condition(statement, True, form.text, source)
    return first, observed, definite, found, Condition(quadratic, holds, evidence, source)


def _affine(statement: str, field: sp.MatrixBase, model: Model, source: str) -> Condition:
    holds = (affine_h(model) if field is model.observation else affine_drift(model)).slope is not None
    curved = None if holds else next((e for e in field if affine(sp.Matrix([e]), model.x).slope is None), None)
    evidence = "affine" if holds else f"{short(str(curved))} is not affine in {', '.join(map(str, model.x))}"
    return Condition(statement, holds, evidence, source)


def posterior_on_the_line(model: Model) -> Iterator[Condition]:
    """What Gaussians need of the prior and of the states."""
    fits = not isinstance(model.prior, DensityPrior) or model.n <= _MOST_STATES
    kind = "no prior" if model.prior is None else type(model.prior).__name__.removesuffix("Prior").lower()
    yield Condition(
        f"the prior is Gaussian or a mixture, or a density in at most {_MOST_STATES} states",
        fits,
        f"prior: {kind}, n = {model.n}",
        "the nodes of this method",
    )
    yield Condition("no state is an angle", not model.periodic, f"periodic: {list(model.periodic)}", "a Gaussian is on the line")
