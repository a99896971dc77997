"""What a model has beyond f(x, t), g(t), h(x, t) and Gaussian noise: a method must say that it handles it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import sympy

from zakai.models._entries import formula
from zakai.models.angles import observed_angles, without_branch
from zakai.models.functions import ComplementaryError, Floor, LogGamma, Maximum, Minimum, Sinc, TableFunction

if TYPE_CHECKING:
    from zakai.models.model import Model

STATE_DEPENDENT_DIFFUSION = "state-dependent diffusion"
INPUTS = "inputs"
CROSS_NOISE = "cross noise"
STATE_DEPENDENT_OBSERVATION_NOISE = "state-dependent observation noise"
OBSERVATION_FAMILY = "observation family"
OBSERVATION_LOG_DENSITY = "observation log density"
OBSERVED_ANGLES = "observed angles"
OBSERVED_PATH = "observed path"
DOMAIN = "domain"
TABLES = "tables"
KINKS = "kinks"
JUMPS = "jumps"
SINC = "sinc"

# The features that belong to the observation alone: the law of the state is that of an ordinary model.
OF_OBSERVATION = frozenset(
    {STATE_DEPENDENT_OBSERVATION_NOISE, OBSERVATION_FAMILY, OBSERVATION_LOG_DENSITY, OBSERVED_ANGLES}
)
JUMP_FUNCTIONS: tuple[type, ...] = (sympy.sign, Floor, sympy.atan2)
_OF_FORMULAS: dict[str, tuple[type, ...]] = {
    TABLES: (TableFunction,),
    KINKS: (Minimum, Maximum),
    JUMPS: JUMP_FUNCTIONS,
    SINC: (Sinc, LogGamma, ComplementaryError),
}


# The features that leave a model with a derivative almost everywhere, and with Gaussian noise in a small step.
LINEARISED = frozenset(
    {STATE_DEPENDENT_DIFFUSION, STATE_DEPENDENT_OBSERVATION_NOISE, OBSERVED_ANGLES, TABLES, KINKS, JUMPS, SINC}
)


# What the theorem of a method assumes that does not handle the feature.
ASSUMPTIONS = {
    STATE_DEPENDENT_DIFFUSION: "g does not depend on the state",
    INPUTS: "there are no inputs",
    CROSS_NOISE: "dv and dw are independent",
    STATE_DEPENDENT_OBSERVATION_NOISE: "S does not depend on the state",
    OBSERVATION_FAMILY: "the noise of observations is Gaussian",
    OBSERVATION_LOG_DENSITY: "the noise of observations is Gaussian",
    OBSERVED_ANGLES: "no observation is an angle",
    OBSERVED_PATH: "no formula contains the observed path (conditionally-gaussian takes such formulas)",
    DOMAIN: "every state is free to take any value",
    TABLES: "formulas are without tables",
    KINKS: "formulas are without min and max",
    JUMPS: "formulas are without sign, floor, heaviside and atan2",
    SINC: "formulas are without sinc, lgamma and erfc",
}


def of_dynamics(model: Model) -> dict[str, str]:
    """Return the features that the law of the state has, apart from what is observed."""
    matrices = (model.diffusion, model.process_noise)
    found = {feature: words for feature, words in model.features.items() if feature not in (*OF_OBSERVATION, *_OF_FORMULAS)}
    found |= _of_formulas([*model.drift, *(entry for matrix in matrices for entry in matrix.todok().values())], model)
    if not any(part.free_symbols & set(model.u) for part in (model.drift, model.diffusion)):
        found.pop(INPUTS, None)
    return found


def features_of(model: Model) -> dict[str, str]:
    """Return the features of a model, each with the words that show it: {"inputs": "inputs: u, wind"}."""
    found: dict[str, str] = {}
    state, inputs = set(model.x), set(model.u)

    def first(matrix: sympy.MatrixBase, symbols: set[sympy.Symbol]) -> sympy.Expr | None:
        return next((entry for entry in matrix.todok().values() if entry.free_symbols & symbols), None)

    if (entry := first(model.diffusion, state)) is not None:
        found[STATE_DEPENDENT_DIFFUSION] = f"diffusion contains {_short(entry)}"
    if inputs:
        found[INPUTS] = f"inputs: {', '.join(model.inputs)}"
    if not model.cross_noise.is_zero_matrix:
        found[CROSS_NOISE] = "cross_noise is not zero"
    if (entry := first(model.observation_noise, state)) is not None:
        found[STATE_DEPENDENT_OBSERVATION_NOISE] = f"observation_noise contains {_short(entry)}"
    if set(model.observation_family) != {"gaussian"}:
        found[OBSERVATION_FAMILY] = f"observation_family: {', '.join(dict.fromkeys(model.observation_family))}"
    if any(observed_angles(model)):
        names = [name for name, angle in zip(model.observation_names, observed_angles(model), strict=True) if angle]
        found[OBSERVED_ANGLES] = f"observed angles: {', '.join(names)}"
    if model.log_density is not None:
        found[OBSERVATION_LOG_DENSITY] = f"observation_log_density: {_short(model.log_density)}"
    if model.log_density is None and (entry := next((f for f in formulas_of(model) if f.free_symbols & set(model.z)), None)):
        found[OBSERVED_PATH] = f"a formula contains what is observed: {_short(entry)}"
    if model.domain:
        found[DOMAIN] = f"domain: {', '.join(f'{name} {interval}' for name, interval in model.domain.items())}"
    return found | _of_formulas(formulas_of(model, without_branch(model)), model)


def formulas_of(model: Model, observation: list[sympy.Expr] | None = None) -> list[sympy.Expr]:
    """Return the formulas of a model that are not zero, those of the prior apart; `observation` may stand for its own."""
    matrices = (model.diffusion, model.process_noise, model.observation_noise, model.cross_noise)
    formulas = [*model.drift, *(observation or model.observation), *model.family_parameters.values()]
    formulas += [entry for matrix in matrices for entry in matrix.todok().values()]
    return formulas + ([] if model.log_density is None else [model.log_density])


def _of_formulas(formulas: list[sympy.Expr], model: Model) -> dict[str, str]:
    """Return the features that functions of the state are; a function of time and inputs alone is a coefficient."""
    found = {}
    for feature, functions in _OF_FORMULAS.items():
        calls = (call for formula in formulas for call in formula.atoms(*functions) if call.has(*model.x))
        if (call := next(calls, None)) is not None:
            found[feature] = f"a formula contains {_short(call)}"
    return found


def _short(expression: sympy.Expr) -> str:
    text = formula(expression)
    return text if len(text) <= 60 else text[:57] + "..."
