"""Whether the formulas have values within the prior, and a sample a law at its mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp

from zakai.errors import InputError
from zakai.models.families import FAMILIES
from zakai.models.numeric import explain_nonfinite, numpy_function
from zakai.models.prior import DensityPrior

if TYPE_CHECKING:
    from zakai.models.model import Model

ROUNDING = 1e-12  # of the largest variance, below which a negative one is rounding
REACH = np.linspace(-8.0, 8.0, 33)  # standard deviations of the prior within which a formula must have a value somewhere
LIKELY = 0.5  # a location that every family has


def check_possible(model: Model, t: float, u: Any = None) -> None:
    """Raise InputError where a formula has no value at any state of the prior, or a sample no law at its mean.

    A negative probability is no law. The mean of one component of a mixture at which it is possible is enough. What has no value
    there, as log(-1), is not checked, and neither is a prior that is given by its density, but for formulas that do not depend on
    the state.

    Args:
        model: the model, with a prior.
        t: a time of observation.
        u: the inputs (number of inputs,) at that time; a model with inputs is not checked without them.
    """
    if model.inputs and u is None:
        return
    _check_values(model, t, u)
    if model.observation_kind != "samples" or model.log_density is not None:
        return
    known = not isinstance(model.prior, DensityPrior) and model.prior is not None
    points = model.prior.components[1] if known else np.zeros((1, model.n))  # type: ignore[union-attr]
    with np.errstate(all="ignore"):
        faults = [_fault(model, x, t, u, known) for x in points]
    if all(faults):
        raise InputError(f"{model.source}: {faults[0]}")


def _check_values(model: Model, t: float, u: Any) -> None:
    """Raise InputError where a formula of the state is finite at none of the states within eight deviations of the prior."""
    if isinstance(model.prior, DensityPrior) or model.prior is None:
        return
    _, means, covs = model.prior.components
    deviations = np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0.0))
    points = (means[:, None, None] + REACH[:, None, None] * deviations[:, None, None] * np.eye(model.n)).reshape(-1, model.n)
    for name, interval in model.domain.items():
        points = points[interval.contains(points[:, model.state.index(name)])]
    if not len(points):
        return
    for key in ("drift", "diffusion", "observation"):
        formulas = [formula for formula in getattr(model, key) if _is_partial(formula, model)]
        with np.errstate(all="ignore"):
            values = numpy_function(formulas, model)(points, t, model.theta(), u) if formulas else np.zeros((1, 0))
        if not np.isfinite(values).any(axis=0).all():
            reason = explain_nonfinite(model, key, getattr(model, key), points[len(points) // 2], t, u)
            raise InputError(f"{model.source}: {reason}, and no state of the prior has a value; change the formula, or the prior")


def _is_partial(formula: Any, model: Model) -> bool:
    """Return whether a formula of the state, and not of the observed path, may have no value."""
    names = formula.free_symbols
    return bool(names & set(model.x)) and not names & set(model.z) and formula.has(sp.log, sp.Pow, sp.asin, sp.acos)


def _fault(model: Model, x: Any, t: float, u: Any, known: bool) -> str:
    """Return what is impossible at a state, or nothing; where that is not `known`, of formulas without the state."""
    h, S, shapes = model.observation_law.parameters(x, t, model.theta(), u)
    place = ", ".join(f"{name} = {value:.6g}" for name, value in zip(model.state, x, strict=True))
    where = f" at the mean of the prior ({place})" if known else ""

    def checked(formula: Any) -> bool:
        return known or not formula.free_symbols & set(model.x)

    smallest = float(np.linalg.eigvalsh(S)[0]) if np.isfinite(S).all() else 0.0
    noisy = any(FAMILIES[family].noise for family in model.observation_family)
    if noisy and checked(model.observation_noise) and smallest < -ROUNDING * float(np.abs(S).max()):
        entry = f"[0][0] = {model.observation_noise[0, 0]}" if model.m == 1 else ""
        return f"observation_noise{entry}: has the negative variance {smallest:.6g}{where}; give a formula that is positive there"
    for j, name in enumerate(model.observation_family):
        if not (np.isfinite(h[j]) and np.isfinite(shapes[j]) and _lawless(name, h[j], shapes[j])):
            continue
        key, value, formula = f"observation[{j}]", h[j], model.observation[j]
        shape = FAMILIES[name].parameter
        if shape is not None and _lawless(name, LIKELY, shapes[j]):
            key, value, formula = shape, shapes[j], model.family_parameters[shape, j]
        if checked(formula):
            text = f"{key} = {str(formula)[:60]}"
            return f"{text}: is {value:.6g}{where}, and the family {name} has no such law; give a formula of possible values"
    return ""


def _lawless(name: str, location: float, shape: float) -> bool:
    """Return whether a family has no law with a location and a shape."""
    family = FAMILIES[name]
    return bool(np.isnan(family.log_density(np.ones(()), np.array(location), np.ones(()), np.array(shape))))
