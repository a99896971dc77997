"""When each method holds: every assumption of its theorem, decided from the equations of one model.

Each function takes a Model and gives a tuple of `Condition`.  A theorem says when a method holds, never how it computes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import sympy as sp

from zakai import _registry
from zakai.algebra._readable import short
from zakai.algebra.conditional import conditionally_gaussian
from zakai.algebra.conditions import Condition
from zakai.algebra.exact_theorems import benes, hu_yau, kalman_bucy
from zakai.algebra.exponentials import wei_norman_filter
from zakai.algebra.feature_conditions import (
    correlated,
    features_beside_inputs,
    features_of_samples,
    inputs_of_increments,
    on_characteristics,
    reflecting_ends,
)
from zakai.algebra.identities import all_zero
from zakai.algebra.poles import finite_drift
from zakai.algebra.quadratics import decided_q
from zakai.algebra.systems import CLY, affine_observation, definite_covariance, determined
from zakai.algebra.yau import YauForm, no_form_text, yau_form
from zakai.models import features
from zakai.models.features import ASSUMPTIONS
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

_SURVEY = "Chen and Dong, survey of direct methods"


@once_for_a_model
def limited_direct(model: Model) -> tuple[Condition, ...]:
    """The assumptions under which the Kolmogorov equation of a time-varying Yau system has an explicit kernel.

    Chen, Luo and Yau (2017), Theorems 1 to 3, in their corrected form.
    """
    conditions = [determined(model), _fits_on_a_grid(model, 3, "three"), *features_of_samples(model)]
    if any(condition.holds is not True for condition in (conditions[0], *conditions[2:])):
        return tuple(conditions)
    conditions.append(definite_covariance(model))
    root = Condition(
        "L = G Omega + F' F^-1 with Omega symmetric for some square root F of G",
        True,
        "F = Fc R, Fc the Cholesky factor and R' = W R a rotation, makes it true for every L",
        f"{CLY}, Assumption 2",
    )
    return (*conditions, *_yau_conditions(model, f"{CLY}, (17) corrected", lambda form: root))


def _fits_on_a_grid(model: Model, most: int, words: str) -> Condition:
    statement = f"the state has at most {words} coordinates, so that the density fits on a grid"
    return Condition(statement, model.n <= most, f"n = {model.n}", "the grid of this method")


def _yau_conditions(model: Model, source: str, further: Callable[[YauForm], Condition]) -> Iterator[Condition]:
    """Yield what the direct methods ask of a time-varying Yau system; `further` is a condition of one method."""
    form = yau_form(model)
    statement = "f = L(t) x + l(t) + G(t) grad phi(t, x)"
    if not isinstance(form, YauForm):
        yield Condition(statement, form.holds, no_form_text(form), source)
        return
    yield Condition(statement, True, form.text, source)
    yield further(form)
    yield _quadratic_condition(model)
    yield from _angle_conditions(model, form)


def _quadratic_condition(model: Model) -> Condition:
    sampled = model.observation_kind == "samples"
    _, holds, evidence = decided_q(model, not sampled)
    statement = (
        "q = 2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L"
        + ("" if sampled else " + h'S^-1 h")
        + " is quadratic in x"
    )
    if sampled and holds:
        evidence += " (a sample enters only at its time, so that h may be any function)"
    return Condition(statement, holds, evidence, f"{CLY}, Assumption 3 with 2 phi_t")


def _angle_conditions(model: Model, form: YauForm) -> Iterator[Condition]:
    """What an angle needs: an affine part and a potential that do not know how often it has turned."""
    for name in model.periodic:
        i = model.state.index(name)
        symbol = model.x[i]
        column = [form.matrix[j, i] for j in range(model.n)]
        q = decided_q(model, model.observation_kind != "samples").quadratic
        parts = [*column] if q is None else [*column, *q.matrix.row(i), q.linear[i]]
        turned: sp.Expr | None = None
        if form.potential is not None:
            turned = form.potential.subs(symbol, symbol + 2 * sp.pi) - form.potential
            parts.append(turned)
        holds = all_zero(parts)
        if holds and turned is None:
            holds = None
        yield Condition(
            f"L, phi and q are the same after a turn of {name}",
            holds,
            "column of L: " + str(column) + f", phi({name} + 2 pi) - phi({name}) = {0 if holds else turned or 'an integral'}",
            "a density on the circle",
        )


@once_for_a_model
def general_direct(model: Model) -> tuple[Condition, ...]:
    """The assumptions under which a Gaussian stays one, in gauge, between the observations of a time-varying Yau system.

    Chen and Dong, Theorems 6 and 7, in their corrected form; G may be singular where the drift is affine.
    """
    conditions = [determined(model)]
    conditions.extend(features_beside_inputs(model))
    if any(condition.holds is not True for condition in conditions):
        return tuple(conditions)
    source = f"{_SURVEY}, (32) corrected"
    own = inputs_of_increments(model)
    few = _yau_conditions(model, source, lambda form: _few_directions(model, form))
    return (*conditions, *own, *few, *finite_drift(model))


@once_for_a_model
def gaussian_sum(model: Model) -> tuple[Condition, ...]:
    """The survey's Theorems 2 and 3: the same for a system that does not depend on time."""
    conditions = general_direct(model)
    if conditions[0].holds is not True:
        return conditions
    parts = [*model.drift, *model.covariance, *model.observation, *model.observation_noise, *model.family_parameters.values()]
    varying = [part for part in parts if model.t in part.free_symbols]
    evidence = f"{short(str(varying[0]))} depends on t" if varying else "no coefficient depends on t"
    return (*conditions, Condition("f, h, G and S are constant in time", not varying, evidence, f"{_SURVEY}, (14)"))


def _few_directions(model: Model, form: YauForm) -> Condition:
    """Quadrature is in the coordinates of a nonlinear h and of phi."""
    law = [*model.observation, *model.observation_noise.diagonal(), *model.family_parameters.values()]
    law += [] if model.log_density is None else [model.log_density]
    nonlinear = law if features.OF_OBSERVATION & model.features.keys() else []
    nonlinear = nonlinear or ([] if affine_observation(model) else list(model.observation))
    used = {name for name, symbol in zip(model.state, model.x) if any(f.has(symbol) for f in (*nonlinear, *form.gradient))}
    listed = ", ".join(name for name in model.state if name in used) or "none"
    return Condition(
        "a nonlinear h and phi depend on at most five coordinates, in which quadrature is done",
        len(used) <= 5,
        f"coordinates: {listed}",
        "the quadrature of this method",
    )


@once_for_a_model
def smooth_system(model: Model) -> tuple[Condition, ...]:
    """Any smooth system: what a method that only linearises asks for."""
    return (determined(model),)


@once_for_a_model
def any_model(model: Model) -> tuple[Condition, ...]:
    """Any model without undetermined functions: what a method that samples asks for."""
    return (determined(model),)


@once_for_a_model
def any_smooth_system(model: Model) -> tuple[Condition, ...]:
    """Any smooth system whose density fits on a grid."""
    return (
        determined(model),
        _fits_on_a_grid(model, 4, "four"),
        *on_characteristics(model),
        *correlated(model),
        *reflecting_ends(model),
    )


@once_for_a_model
def tensor_train(model: Model) -> tuple[Condition, ...]:
    """Any smooth system of two to eight states without reflecting ends, whose f and g do not jump."""
    source = "cross interpolation of a density in a moving frame"
    conditions = [determined(model), Condition("there are two to eight states", 2 <= model.n <= 8, f"n = {model.n}", source)]
    jumps = [call for part in (*model.drift, *model.covariance) for call in part.atoms(*features.JUMP_FUNCTIONS)]
    if found := [call for call in jumps if call.has(*model.x)]:
        words = f"a formula contains {short(str(found[0]))}"
        conditions.append(Condition("f and g do not jump where the state changes", False, words, source))
    return (*conditions, *reflecting_ends(model))


@once_for_a_model
def kolmogorov_series(model: Model) -> tuple[Condition, ...]:
    """A smooth drift without time and a constant, definite G: its kernel has the series of Yau 1993, Theorems 10 and 11.

    The paper asks for constant h, which its robust equation needs and the transition between observations does not.
    """
    source = "Yau 1993, Theorems 10 to 12"
    conditions = [determined(model), *features_of_samples(model)]
    if any(condition.holds is not True for condition in conditions):
        return tuple(conditions)
    varying = [part for part in (*model.drift, *model.covariance) if model.t in part.free_symbols]
    kinked = [part for part in features.formulas_of(model) if part.has(sp.Abs, sp.sign)]
    return (
        *conditions,
        Condition(
            "f and G are constant in time",
            not varying,
            f"{short(str(varying[0]))} depends on t" if varying else "neither depends on t",
            source,
        ),
        definite_covariance(model),
        Condition(
            "f and the law of observations are smooth",
            not kinked,
            short(str(kinked[0])) if kinked else "no absolute value",
            source,
        ),
        Condition("there is one state", model.n == 1, f"n = {model.n}", "the grid of this method"),
        Condition("the state is no angle", not model.periodic, f"periodic: {list(model.periodic)}", "the grid of this method"),
    )


# The theorem that says when a method holds, by the method's name.
THEOREMS: Mapping[str, Callable[[Model], tuple[Condition, ...]]] = {
    "kalman-bucy": kalman_bucy,
    "conditionally-gaussian": conditionally_gaussian,
    "benes": benes,
    "hu-yau": hu_yau,
    "limited-direct": limited_direct,
    "general-direct": general_direct,
    "gaussian-sum": gaussian_sum,
    "wei-norman": wei_norman_filter,
    "yau-yau": any_smooth_system,
    "kolmogorov-series": kolmogorov_series,
    "tensor-train": tensor_train,
    "guided-particles": any_model,
    "extended-kalman-bucy": smooth_system,
}
# Filters of other libraries; an analysis is about the system, and leaves them out.
PEERS: Mapping[str, Callable[[Model], tuple[Condition, ...]]] = dict.fromkeys(("ekf", "ukf", "enkf", "particle"), smooth_system)


def theorem_of(name: str) -> Callable[[Model], tuple[Condition, ...]]:
    """The theorem of a method or a peer."""
    return THEOREMS[name] if name in THEOREMS else PEERS[name]


NOT_HANDLED = "what this method handles"  # the source of a condition about a feature


def conditions_of(name: str, model: Model) -> tuple[Condition, ...]:
    """Return the conditions under which a method, own or of another library, holds for a model; nothing else decides this.

    Features of the model that the method does not handle fail first, and its theorem, which does not know them, is not asked.
    """
    if model.features:
        # Filters of other libraries handle the same, and are not loaded for an answer.
        handled = _registry.load(name).handles if name in _registry.METHODS else features.LINEARISED
        refused = tuple(
            Condition(ASSUMPTIONS[feature], False, words, NOT_HANDLED)
            for feature, words in model.features.items()
            if feature not in handled
        )
        if refused:
            return refused
    return theorem_of(name)(model)
