"""The keys of a model as the text of a model file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from decimal import Context, Decimal, Inexact
from functools import lru_cache
from typing import Any

import sympy

from zakai.models.expressions import MAX_DIGITS

_OPTIONAL: dict[str, Any] = {
    "start": 0.0,
    "periodic": (),
    "functions": (),
    "inputs": (),
    "input_hold": "zero",
    "observation_family": "gaussian",
}
_MATRICES = ("diffusion", "process_noise", "observation_noise")
_ORDER = (
    "name",
    "state",
    "drift",
    "observation",
    "observation_kind",
    "observation_names",
    "diffusion",
    "process_noise",
    "observation_noise",
    "start",
    "periodic",
    "functions",
    "inputs",
    "input_hold",
    "cross_noise",
    "observation_family",
    "degrees_of_freedom",
    "concentration",
    "trials",
    "dispersion",
    "observation_log_density",
    "observed",
    "observed_angles",
)


def to_toml(keys: Mapping[str, Any]) -> str:
    """The TOML of a model's keys, all formulas as text; keys that hold their default are left out."""
    kept = [key for key in _ORDER if key in keys and not _is_default(key, keys[key])]
    if "observation_log_density" in keys:
        kept = [key for key in kept if key not in ("observation", "observation_family")]
    lines = [f"{key} = {_value(keys[key])}" for key in kept]
    if keys["parameters"]:
        lines += [
            "",
            "[parameters]",
            *(f"{name} = {_value(value)}" for name, value in keys["parameters"].items()),
        ]
    if keys["prior"]:
        lines += ["", "[prior]", *(f"{name} = {_value(value)}" for name, value in keys["prior"].items())]
    for table in ("domain", "tables"):
        if keys[table]:
            lines += ["", f"[{table}]", *(f"{name} = {_value(value)}" for name, value in keys[table].items())]
    return "\n".join(lines) + "\n"


def _is_default(key: str, value: Any) -> bool:
    if key == "cross_noise":
        return all(entry == "0" for row in value for entry in row)
    if key in _MATRICES:
        size = len(value)
        row = ["0"] * size
        return all(own == [*row[:i], "1", *row[i + 1 :]] for i, own in enumerate(value))
    return key in _OPTIONAL and value == _OPTIONAL[key]


def _value(value: Any) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name} = {_value(entry)}" for name, entry in value.items()) + "}"
    if isinstance(value, sympy.Rational):
        return _rational(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value))


@lru_cache(maxsize=256)
def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _rational(value: sympy.Rational) -> str:
    """A decimal where that is exact and short, otherwise a fraction in quotes."""
    context = Context(prec=MAX_DIGITS, traps=[Inexact])
    try:
        decimal = context.divide(Decimal(int(value.p)), Decimal(int(value.q)))
    except Inexact:
        return f'"{value.p}/{value.q}"'
    return str(decimal).replace("E", "e")
