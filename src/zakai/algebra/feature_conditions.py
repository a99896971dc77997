"""What the features of a model, such as inputs, families, correlated noise and ends, mean for the theorems of the methods."""

from __future__ import annotations

from zakai.algebra._readable import short
from zakai.algebra.conditions import Condition
from zakai.algebra.systems import affine_observation
from zakai.models import features
from zakai.models.model import Model


def features_of_samples(model: Model) -> tuple[Condition, ...]:
    """Return what holds where formulas have features: these may be in what a sample of one state depends on."""
    if not model.features:
        return ()
    own, source = features.of_dynamics(model), "a sample enters only at its time"
    found, words = list(own.values()), "; ".join(model.features.values())
    sampled = model.n == 1 and model.observation_kind == "samples"
    return (
        Condition("f and g are formulas of the class", not found, "; ".join(found) or words, source),
        Condition("there is one state, which samples observe, where h has features", sampled, words, source),
    )


def features_beside_inputs(model: Model) -> tuple[Condition, ...]:
    """Return what holds where formulas have features other than inputs: these may be in what a sample depends on."""
    every = {name: words for name, words in model.features.items() if name != features.INPUTS}
    if not every:
        return ()
    own = {name: words for name, words in features.of_dynamics(model).items() if name != features.INPUTS}
    holds, words = model.observation_kind == "samples" and not own, "; ".join(own.values() or every.values())
    return (Condition("features are in what a sample depends on", holds, words, "a sample enters only at its time"),)


def inputs_of_increments(model: Model) -> tuple[Condition, ...]:
    """Return what holds of inputs in h that act in continuous time."""
    entry = next((part for part in model.observation if part.free_symbols & set(model.u)), None)
    if entry is None or model.observation_kind == "samples":
        return ()
    affine = affine_observation(model) is not None
    words = f"h contains {short(str(entry))}, and {'is affine' if affine else 'is not affine'}"
    return (Condition("h is affine where increments depend on inputs", affine, words, "the integral of h'S^-1 dy"),)


def on_characteristics(model: Model) -> tuple[Condition, ...]:
    """Return what fails where the density moves along the characteristics of the drift: without noise, or in several states."""
    noiseless = model.n == 1 and model.covariance.is_zero_matrix
    parts = [*model.drift, *model.covariance] if model.n > 1 or noiseless else []
    jumps = [call for part in parts for call in part.atoms(*features.JUMP_FUNCTIONS) if call.has(*model.x)]
    source, found = "the grid of this method in two or more states", []
    if jumps:
        words = f"a formula contains {short(str(jumps[0]))}{', and there is no noise' if noiseless else ''}"
        source = "a density on a grid, which has no point of positive probability" if noiseless else source
        found.append(Condition("f and g do not jump where the state changes", False, words, source))
    if model.n > 3 and features.STATE_DEPENDENT_DIFFUSION in model.features:
        words = f"n = {model.n}, and {model.features[features.STATE_DEPENDENT_DIFFUSION]}"
        found.append(Condition("the state has at most three coordinates where g depends on it", False, words, source))
    return tuple(found)


def correlated(model: Model) -> tuple[Condition, ...]:
    """Return what fails of the equation with correlated noise, which contains derivatives of h and g."""
    if features.CROSS_NOISE not in model.features:
        return ()
    source, words = "the Zakai equation with correlated noise on a grid", model.features[features.CROSS_NOISE]
    cross = model.diffusion * model.cross_noise
    depends = next((str(entry) for entry in cross.todok().values() if entry.free_symbols & set(model.x)), "")
    few = Condition(
        "the state has at most three coordinates where g C depends on it",
        model.n <= 3 or not depends,
        f"n = {model.n}, and {f'g C contains {short(depends)}' if depends else words}",
        source,
    )
    parts = [*model.observation, *model.diffusion]
    jumps = [call for part in parts for call in part.atoms(*features.JUMP_FUNCTIONS) if call.has(*model.x)]
    words = f"a formula contains {short(str(jumps[0]))}" if jumps else "neither jumps"
    return few, Condition("h and g do not jump where dv and dw are correlated", not jumps, words, source)


def reflecting_ends(model: Model) -> tuple[Condition, ...]:
    """Return the conditions of a state with reflecting ends."""
    reflecting = [f"{name} {interval}" for name, interval in model.domain.items() if interval.reflecting]
    if not reflecting:
        return ()
    source, words = "the equation without flux at the ends", f"domain: {', '.join(reflecting)}"
    jumps = [call for part in (*model.drift, *model.diffusion) for call in part.atoms(*features.JUMP_FUNCTIONS)]
    return (
        Condition("there is one state where ends reflect", model.n == 1, f"n = {model.n}, {words}", source),
        Condition("dv and dw are independent where ends reflect", model.cross_noise.is_zero_matrix, words, source),
        Condition("f and g do not jump where ends reflect", not jumps, words, source),
    )
