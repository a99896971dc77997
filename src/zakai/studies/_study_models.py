"""The models, parameters and methods of a study file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from decimal import Decimal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from zakai import _registry
from zakai.errors import InputError
from zakai.models import _entries
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models.files import load_model
from zakai.models.model import Model
from zakai.studies.specification import Entry, Point

MOST_POINTS, MOST_METHODS = 10_000, 100


def checked_table(
    key: str, value: Any, allowed: tuple[str, ...] | None = None, required: tuple[str, ...] = ()
) -> Mapping[str, Any]:
    """Return a table of allowed keys, with those that are required."""
    with named(key):
        if not isinstance(value, Mapping):
            raise InputError(f"expected a table, got {_entries.kind_of(value)}")
        if allowed is not None:
            _entries.known_keys(value, allowed)
        for name in required:
            if name not in value:
                raise InputError(f"{name}: missing; the table needs {listing(required)}")
    return value


def checked_text(key: str, value: Any) -> str:
    """Return a text that is not empty and can be printed."""
    if not isinstance(value, str) or not value or not value.isprintable():
        raise InputError(f"{key}: expected a text, got {_entries.kind_of(value)}")
    return value


def checked_whole(key: str, value: Any, least: int, most: int) -> int:
    """Return a whole number within limits."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InputError(f"{key}: expected a whole number from {least} to {most:,}, got {_entries.kind_of(value)}")
    return value


def models_of(keys: Mapping[str, Any], folder: Path) -> list[tuple[Point, Model]]:
    """Return the points of a study, every model with every combination of its parameters."""
    entries = keys["models"]
    if not isinstance(entries, list) or not entries:
        raise InputError('models: expected a list, as in models = ["gallery:benes", "system.toml"]')
    shared = checked_table("parameters", keys.get("parameters", {}))
    found: list[tuple[Point, Model]] = []
    used: set[str] = set()
    read: dict[str, Model] = {}
    for number, entry in enumerate(entries):
        with named(f"models[{number}]"):
            source, own = _model_entry(entry)
            at = source if source.startswith("gallery:") else str(folder / source)
            if at not in read:
                read[at] = load_model(at)
            model = read[at]
            grid = {**{name: values for name, values in shared.items() if name in model.parameters}, **own}
            used |= set(grid)
            label = source.removeprefix("gallery:").removesuffix(".toml")
            found += _points(label, source, model, grid)
        if len(found) > MOST_POINTS:
            raise InputError(f"parameters: the grid has more than {MOST_POINTS:,} points, the most that fit one study")
    for name in shared:
        if name not in used:
            known = [parameter for _, model in found for parameter in model.parameters]
            hint = did_you_mean(name, known)
            raise InputError(f"parameters.{shown_name(name)}: no model has this parameter{hint}; take it out")
    _check_different("models", [point.label for point, _ in found])
    return found


def _check_different(key: str, labels: list[str]) -> None:
    twice = next((label for label, count in Counter(labels).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{key}: {twice[:80]} is there twice; take one out")


def shown_name(name: str) -> str:
    """Return a name out of the file, as a part of an error."""
    return name if name.isprintable() and len(name) <= 40 else echo(name, 40)


def _model_entry(entry: Any) -> tuple[str, Mapping[str, Any]]:
    if isinstance(entry, str):
        return entry, {}
    table = checked_table("", entry, ("model", "parameters"), ("model",)) if isinstance(entry, Mapping) else None
    if table is None:
        raise InputError(f"expected a file, gallery:NAME or a table with the key model, got {_entries.kind_of(entry)}")
    return checked_text("model", table["model"]), checked_table("parameters", table.get("parameters", {}))


def _points(label: str, source: str, model: Model, grid: Mapping[str, Any]) -> list[tuple[Point, Model]]:
    axes = []
    for name, values in grid.items():
        with named(f"parameters.{shown_name(name)}"):
            values = values if isinstance(values, list) else [values]
            if not values:
                raise InputError("the list is empty; give at least one value, or take the key out")
            if len(values) > MOST_POINTS:
                raise InputError(f"the list has {len(values):,} values; at most {MOST_POINTS:,} fit one study")
            axes.append([(name, value, _entries.formula(value)) for value in values])
            for value in values:
                _entries.exact_number(value)
    if np.prod([len(axis) for axis in axes], dtype=float) > MOST_POINTS:
        raise InputError(f"parameters: the grid has more than {MOST_POINTS:,} points, the most that fit one study")
    points = []
    for chosen in product(*axes):
        own = model.with_parameters(**{name: value for name, value, _ in chosen}) if chosen else model
        said = ", ".join(f"{name} = {text}" for name, _, text in chosen)
        points.append((Point(f"{label}, {said}" if said else label, source, own.to_toml(), {n: t for n, _, t in chosen}), own))
    return points


def methods_of(value: Any) -> tuple[Entry, ...]:
    """Return the methods with their options, in the order of the file."""
    table = checked_table("methods", value)
    if not table:
        raise InputError("methods: is empty; give a table for each, as in [methods.limited-direct]")
    if len(table) > MOST_METHODS:
        raise InputError(f"methods: there are {len(table):,}; at most {MOST_METHODS} fit one study")
    entries = []
    for label, given in table.items():
        key = f"methods.{shown_name(label)}"
        own = checked_table(key, given, ("method", "options"))
        with named(key):
            checked_text("label", label)
            name = checked_text("method", own.get("method", label))
            options = {name: _plain(name, value) for name, value in checked_table("options", own.get("options", {})).items()}
            if name != "auto":
                known = _registry.load(name).options
                for option in options:
                    if option not in known:
                        hint = did_you_mean(option, known)
                        raise InputError(f"options: {name} has no option {echo(option, 40)}{hint}; its options: {listing(known)}")
        entries.append(Entry(label, name, options))
    return tuple(entries)


def _plain(key: str, value: Any) -> Any:
    """An option as Python has it; decimals are doubles."""
    if isinstance(value, list):
        return [_plain(key, entry) for entry in value]
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, str | int | float | bool):
        return value
    kind = _entries.kind_of(value)
    raise InputError(f"options.{shown_name(key)}: expected a number, a text, true, false or a list of them, got {kind}")
