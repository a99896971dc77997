"""The keys of a model file that say the law of the samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy

from zakai.errors import InputError
from zakai.models import _entries
from zakai.models._errors import did_you_mean, listing, named
from zakai.models.angles import LINEAR, observed_angles
from zakai.models.families import FAMILIES, PARAMETERS
from zakai.models.formulas import parse_expression

if TYPE_CHECKING:
    from zakai.models.model import Model


def read_observed(model: Model, keys: Mapping[str, Any]) -> int:
    """Read the names in `observed`, and return how many there are."""
    for key in ("observation", "observation_noise", "observation_family", *PARAMETERS, "observed_angles"):
        if keys.get(key) is not None:
            raise InputError(f"{key}: describes the observation, as observation_log_density does; leave one of them out")
    if model.observation_kind != "samples":
        kind = model.observation_kind
        raise InputError(f'observation_log_density: is for samples; give observation_kind = "samples", not "{kind}"')
    _read_names(model, keys, "used in observation_log_density")
    if not 1 <= len(model.observed) <= _MOST_OBSERVED:
        words = f"expected a list of 1 to {_MOST_OBSERVED} names of what is observed, used in observation_log_density"
        raise InputError(f"observed: {words}")
    return len(model.observed)


_MOST_OBSERVED = 64


def read_path(model: Model, keys: Mapping[str, Any]) -> None:
    """Read the names in `observed` that stand in formulas for the current values y(t) of the m observations."""
    if keys.get("observed") is None:
        return
    if model.observation_kind == "samples":
        raise InputError(
            "observed: goes with observation_log_density; samples have no value between their times, so that names of "
            "observations in formulas are for increments, path and rates"
        )
    _read_names(model, keys, "one an observation, which formulas may contain")
    if len(model.observed) != model.m:
        raise InputError(f"observed: expected {model.m} names (one an observation), got {len(model.observed)}")
    vars(model)["_keys"]["observed"] = list(model.observed)


def _read_names(model: Model, keys: Mapping[str, Any], what: str) -> None:
    """Read the names in `observed`."""
    with named("observed"):
        observed = _entries.names(keys.get("observed", ()), f'a list of names such as ["z"], {what}')
        for names, kind in (
            (model.state, "a state"),
            (model.parameters, "a parameter"),
            (model.inputs, "an input"),
            (model.functions, "an undetermined function"),
            (model.tables, "a table"),
        ):
            for name in observed:
                if name in names:
                    raise InputError(f"the name {name!r} is already {kind}")
    vars(model).update(observed=observed, z=tuple(sympy.Symbol(name, real=True) for name in observed))


def read_law(model: Model, keys: Mapping[str, Any], read: Callable[..., sympy.Expr]) -> None:
    """Read the family of each coordinate and its parameters, or the log density; `read` reads a formula."""
    canonical: dict[str, Any] = vars(model)["_keys"]
    if keys.get("observation_log_density") is not None:
        with named("observation_log_density"):
            text = _entries.formula(keys["observation_log_density"])
            symbols = {symbol.name: symbol for symbol in (*model.x, *model.parameter_symbols, *model.u, *model.z, model.t)}
            vars(model)["log_density"] = parse_expression(text, symbols, model.functions, model.tables)
            if not model.log_density.has(*model.z):  # type: ignore[union-attr]
                raise InputError(f"does not contain {listing(model.observed)}; it is log p({', '.join(model.observed)} | x)")
        canonical.update(observation_log_density=text, observed=list(model.observed))
    families = _families(model, keys)
    parameters: dict[tuple[str, int], sympy.Expr] = {}
    for key in PARAMETERS:
        columns = [j for j, name in enumerate(families) if FAMILIES[name].parameter == key]
        with named(key):
            if not columns and keys.get(key) is not None:
                name = next(name for name, family in FAMILIES.items() if family.parameter == key)
                raise InputError(f"goes with the family {name}, which no observation has")
            if columns and keys.get(key) is None:
                raise InputError(f"missing; the family {families[columns[0]]} needs it")
            if columns:
                given = keys[key]
                many = isinstance(given, list | tuple | np.ndarray)
                texts = _entries.vector_of_formulas(given if many else [given] * len(columns), len(columns),
                                                    f"a formula, or a list of {len(columns)}")  # fmt: skip
                canonical[key] = texts if many else texts[0]
                for j, text in zip(columns, texts, strict=True):
                    parameters[key, j] = read(text)
                    if parameters[key, j].is_number and not float(parameters[key, j]) > 0:
                        raise InputError(f"expected a positive number, got {text}")
                    if key == "trials" and parameters[key, j].is_number and not parameters[key, j].is_Integer:
                        raise InputError(f"expected a whole number, got {text}")
    vars(model).update(observation_family=families, family_parameters=parameters)
    _check_noise_of_families(model, keys)
    given = keys.get("observation_names")
    with named("observation_names"):
        vars(model)["observation_names"] = _observation_names(model, given)
    if given is not None:
        vars(model)["_keys"]["observation_names"] = list(model.observation_names)
    vars(model)["observed_angles"] = _observed_angles(model, keys)


def _families(model: Model, keys: Mapping[str, Any]) -> tuple[str, ...]:
    given = keys.get("observation_family", "gaussian")
    with named("observation_family"):
        single = isinstance(given, str)
        names = [given] * model.m if single else _entries.items(given, model.m, f"a family, or a list of {model.m}")
        for name in names:
            if not isinstance(name, str) or name not in FAMILIES:
                hint = did_you_mean(name, FAMILIES) if isinstance(name, str) else ""
                raise InputError(f"expected one of {listing(FAMILIES)}, got {_entries.kind_of(name)}{hint}")
        if set(names) != {"gaussian"} and model.observation_kind != "samples":
            kind = model.observation_kind
            raise InputError(f'{listing(dict.fromkeys(names))}: is for samples; give observation_kind = "samples", not "{kind}"')
    vars(model)["_keys"]["observation_family"] = given if single else list(names)
    return tuple(names)


def _check_noise_of_families(model: Model, keys: Mapping[str, Any]) -> None:
    """A family without noise leaves its row of observation_noise that of the identity; only Gaussian coordinates correlate."""
    if keys.get("observation_noise") is None:
        return
    families = model.observation_family
    with named("observation_noise"):
        for (i, j), entry in model.observation_noise.todok().items():
            if i != j and {families[i], families[j]} != {"gaussian"}:
                other = families[i] if families[i] != "gaussian" else families[j]
                raise InputError(f"[{i}][{j}]: the family {other} has no correlations; give 0")
            if i == j and not FAMILIES[families[i]].noise and entry != 1:
                raise InputError(f"[{i}][{i}]: the family {families[i]} has no noise of its own; give 1, or leave it out")


def _observation_names(model: Model, given: Any) -> tuple[str, ...]:
    """Return the names of the observations: those given, or the state where h is just a state, else y1, y2, ..."""
    if given is None:
        if model.observed:
            return model.observed
        default = [f"y{j + 1}" for j in range(model.m)]
        # A state that is called like the observation at another place would exchange the two.
        own = [formula.name if formula in model.x and formula.name not in default else "" for formula in model.observation]
        return tuple(name if own.count(name) == 1 and name else other for name, other in zip(own, default, strict=True))
    names = _entries.items(given, model.m, f"a list of {model.m} names")
    for name in names:
        if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME or not name.isprintable():
            raise InputError(f"expected a name, got {_entries.kind_of(name)}")
        if name == "time" or name in model.inputs:
            raise InputError(
                f"{name!r} is the name of {'the column of times' if name == 'time' else 'an input'}; give another one"
            )
        if names.count(name) > 1:
            raise InputError(f"{name!r} is there twice")
    return tuple(names)


MAX_NAME = 100  # characters of the name of an observation
_WIDEST = 0.5  # standard deviation, in radians, of an angle whose noise is correlated: its images are then negligible


def _observed_angles(model: Model, keys: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names in `observed_angles`, and check the noise of angles."""
    given = keys.get("observed_angles")
    with named("observed_angles"):
        angles = _entries.names(() if given is None else given, "a list of names of observations that are angles")
        if angles and model.observation_kind != "samples":
            kind = model.observation_kind
            raise InputError(f'is for samples; give observation_kind = "samples", not "{kind}"')
        for name in angles:
            if name not in model.observation_names:
                hint = did_you_mean(name, model.observation_names)
                raise InputError(f"{name!r} is no observation{hint} (the observations are {listing(model.observation_names)})")
            family = model.observation_family[model.observation_names.index(name)]
            if family not in (*LINEAR, "von-mises"):
                raise InputError(f"{name!r} has the family {family}, whose values are {FAMILIES[family].support}, not angles")
    if angles:
        vars(model)["_keys"]["observed_angles"] = list(angles)
    vars(model)["observed_angles"] = angles
    if model.log_density is None and model.observation_kind == "samples":
        for (i, j), entry in model.observation_noise.todok().items():
            angle = next((k for k in (i, j) if i != j and entry != 0 and observed_angles(model)[k]), None)
            variance = None if angle is None else model.observation_noise[angle, angle]
            if variance is not None and variance.is_number and float(variance) > _WIDEST**2:
                raise InputError(
                    f"observation_noise: [{i}][{j}]: correlates an angle whose standard deviation is "
                    f"{float(variance) ** 0.5:.3g}; up to {_WIDEST} the noise of an angle may be correlated; give 0"
                )
    return angles
