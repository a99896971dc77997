"""The parts of a system that have nothing to do with each other, each a system of its own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy as sp

from zakai.algebra.identities import tidy
from zakai.models.model import Model


@dataclass(frozen=True)
class Block:
    """A part of a system: its `model`, without a prior, and the places in the whole of its states and its observations."""

    states: tuple[int, ...]
    observations: tuple[int, ...]
    model: Model


@lru_cache(maxsize=64)
def blocks(model: Model) -> tuple[Block, ...]:
    """The connected parts of (f, G, h, S): without common noise, and none in the formulas of another.

    Given priors that are independent too, the conditional density is the product of theirs.  L_0 is the sum of theirs, and as
    operators of different blocks commute, the estimation algebra is finite dimensional if and only if each of theirs is.  An
    observation that no state enters counts to the first block.

        >>> system = zakai.Model(state=["x", "y"], drift=["-x", "sin(y)"], observation=["y"])
        >>> [block.model.state for block in blocks(system)]
        [('x',), ('y',)]
    """
    n, G, S = model.n, model.covariance.applyfunc(tidy), model.observation_noise.applyfunc(tidy)
    place = {symbol: i for i, symbol in enumerate(model.x)}
    # Nodes are the states and, after them, the observations.
    group = list(range(n + model.m))

    def join(i: int, j: int) -> None:
        old, new = group[j], group[i]
        group[:] = [new if g == old else g for g in group]

    for i, formula in enumerate([*model.drift, *model.observation]):
        for symbol in formula.free_symbols & place.keys():
            join(place[symbol], i)
    for matrix, first in ((G, 0), (S, n)):
        for i in range(matrix.rows):
            for j in range(i):
                if matrix[i, j] != 0:
                    join(first + j, first + i)
    parts = sorted({tuple(i for i in range(n + model.m) if group[i] == g) for g in group})
    with_states = [part for part in parts if part[0] < n]
    with_states[0] += tuple(i for part in parts if part[0] >= n for i in part)
    return tuple(_block(model, tuple(i for i in part if i < n), tuple(i - n for i in part if i >= n)) for part in with_states)


def _block(model: Model, states: tuple[int, ...], rows: tuple[int, ...]) -> Block:
    if len(states) == model.n:
        return Block(states, rows, model)
    names = tuple(model.state[i] for i in states)
    observed = [model.observation[i] for i in rows] or [sp.Integer(0)]
    keys: dict[str, Any] = {
        "name": f"{model.name}: {', '.join(names)}",
        "state": names,
        "drift": [model.drift[i] for i in states],
        "process_noise": model.covariance.extract(states, states).tolist(),
        "observation": observed,
        "observation_noise": model.observation_noise.extract(rows, rows).tolist() if rows else None,
        "observation_kind": model.observation_kind,
        "start": model.start,
        "periodic": [name for name in model.periodic if name in names],
        "parameters": model.parameters,
        "functions": model.functions,
    }
    return Block(states, rows, Model(**keys))
