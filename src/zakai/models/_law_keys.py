"""The keys of a model file that say the law of the samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy

from zakai.errors import InputError
from zakai.models import _entries
from zakai.models._errors import did_you_mean, listing, named
from zakai.models.families import FAMILIES
from zakai.models.formulas import parse_expression

if TYPE_CHECKING:
    from zakai.models.model import Model


def read_observed(model: Model, keys: Mapping[str, Any]) -> int:
    """Read the names in `observed`, and return how many there are."""
    for key in ("observation", "observation_noise", "observation_family", "degrees_of_freedom", "concentration"):
        if keys.get(key) is not None:
            raise InputError(f"{key}: describes the observation, as observation_log_density does; leave one of them out")
    if model.observation_kind != "samples":
        kind = model.observation_kind
        raise InputError(f'observation_log_density: is for samples; give observation_kind = "samples", not "{kind}"')
    with named("observed"):
        observed = _entries.names(keys.get("observed", ()), 'a list of names such as ["z"]')
        if not 1 <= len(observed) <= 64:
            raise InputError("expected a list of 1 to 64 names of what is observed, used in observation_log_density")
        for names, what in (
            (model.state, "a state"),
            (model.parameters, "a parameter"),
            (model.inputs, "an input"),
            (model.functions, "an undetermined function"),
            (model.tables, "a table"),
        ):
            for name in observed:
                if name in names:
                    raise InputError(f"the name {name!r} is already {what}")
    vars(model).update(observed=observed, z=tuple(sympy.Symbol(name, real=True) for name in observed))
    return len(observed)


def read_law(model: Model, keys: Mapping[str, Any], read: Callable[..., sympy.Expr]) -> None:
    """Read the family of each coordinate and its parameters, or the log density; `read` reads a formula."""
    canonical: dict[str, Any] = vars(model)["_keys"]
    if model.z:
        with named("observation_log_density"):
            text = _entries.formula(keys["observation_log_density"])
            symbols = {symbol.name: symbol for symbol in (*model.x, *model.parameter_symbols, *model.u, *model.z, model.t)}
            vars(model)["log_density"] = parse_expression(text, symbols, model.functions, model.tables)
            if not model.log_density.has(*model.z):  # type: ignore[union-attr]
                raise InputError(f"does not contain {listing(model.observed)}; it is log p({', '.join(model.observed)} | x)")
        canonical.update(observation_log_density=text, observed=list(model.observed))
    elif "observed" in keys:
        raise InputError("observed: goes with observation_log_density, which is missing")
    families = _families(model, keys)
    parameters: dict[tuple[str, int], sympy.Expr] = {}
    for key in ("degrees_of_freedom", "concentration"):
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
    vars(model).update(observation_family=families, family_parameters=parameters)
    _check_noise_of_families(model, keys)


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
