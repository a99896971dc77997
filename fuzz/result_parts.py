"""Results behind HDF5: every byte chooses a variable, its dimensions and values, or an attribute, as a file may hold them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fuzz.oracle import value_or_one_line
from fuzz.result import check_result
from zakai.engine.stored import result_of
from zakai.errors import InputError

NAMES = ("time", "state", "state_", "mean", "variance", "cov", "log_likelihood_increment", "edge_weight", "\u202e", "x" * 300)
ATTRIBUTES = ("method", "why", "model", "warnings", "log_likelihood", "scale_factor", "_FillValue", "coordinates", "description")
MODEL = 'state = ["x"]\ndrift = ["-x"]\nobservation = ["x"]\n'
WORDS: tuple[Any, ...] = ("", "kalman-bucy", MODEL, "state = [", "\0\n\x1b[31m", "y" * 5000, 1, -0.5, float("nan"), 2**63, True)
STATES, TIMES = np.array(["x", "v"], dtype=object), np.arange(3.0)
WELL = {
    "time": (["time"], TIMES, {}),
    "state": (["state"], STATES, {}),
    "state_": (["state_"], STATES, {}),
    "mean": (["time", "state"], np.zeros((3, 2)), {}),
    "variance": (["time", "state"], np.ones((3, 2)), {}),
    "cov": (["time", "state", "state_"], np.zeros((3, 2, 2)), {}),
    "log_likelihood_increment": (["time"], np.zeros(3), {}),
    "edge_weight": (["time"], np.zeros(3), {"description": "at the edge"}),
}


def one_input(data: bytes) -> None:
    choices = iter(data)
    variables: dict[str, Any] = dict(WELL)
    attributes: dict[str, Any] = {}
    while (choice := next(choices, None)) is not None:
        name = NAMES[choice % len(NAMES)]
        if choice < 32:
            variables.pop(name, None)
        elif choice < 96:
            attributes[ATTRIBUTES[choice % len(ATTRIBUTES)]] = _one_of(WORDS, choices)
        else:
            variables[name] = _variable(choices)
    result = value_or_one_line(lambda: result_of(variables, attributes, "r.nc"))
    if isinstance(result, InputError):
        assert str(result).startswith("r.nc: ")
    else:
        check_result(result)


def _one_of(what: tuple[Any, ...], choices: Iterator[int]) -> Any:
    return what[next(choices, 0) % len(what)]


def _variable(choices: Iterator[int]) -> tuple[list[str], np.ndarray, dict[str, Any]]:
    dimensions = [_one_of(NAMES, choices) for _ in range(next(choices, 0) % 4)]
    shape = tuple({"time": 3, "state": 2, "state_": 2}.get(name, 1) + (next(choices, 0) > 250) for name in dimensions)
    kind = _one_of(("f8", "f4", "f2", "i8", "u1", "words"), choices)
    values = np.full(shape, _one_of(WORDS[:6], choices), dtype=object) if kind == "words" else np.ones(shape, kind)
    return dimensions, values, {_one_of(ATTRIBUTES, choices): _one_of(WORDS, choices) for _ in range(next(choices, 0) % 3)}
