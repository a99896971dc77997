"""The parts of a system that have nothing to do with each other, each a system of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import sympy as sp

from zakai.algebra._readable import tidy
from zakai.models.features import (
    DOMAIN,
    INPUTS,
    JUMPS,
    KINKS,
    OBSERVATION_FAMILY,
    OBSERVED_ANGLES,
    SINC,
    STATE_DEPENDENT_DIFFUSION,
    STATE_DEPENDENT_OBSERVATION_NOISE,
    TABLES,
)
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

# The features with which a model is divided.
DIVIDED = frozenset(
    {
        INPUTS, STATE_DEPENDENT_DIFFUSION, STATE_DEPENDENT_OBSERVATION_NOISE, OBSERVATION_FAMILY, OBSERVED_ANGLES, DOMAIN,
        TABLES, KINKS, JUMPS, SINC,
    }
)  # fmt: skip


@dataclass(frozen=True)
class Block:
    """A part of a system: its `model`, without a prior, and the places in the whole of its states and its observations."""

    states: tuple[int, ...]
    observations: tuple[int, ...]
    model: Model


@once_for_a_model
def blocks(model: Model) -> tuple[Block, ...]:
    """The connected parts of (f, G, h, S): without common noise, and none in the formulas of another.

    Given priors that are independent too, the conditional density is the product of theirs.  L_0 is the sum of theirs, and as
    operators of different blocks commute, the estimation algebra is finite dimensional if and only if each of theirs is.  An
    observation that no state enters counts to the first block.

        >>> system = zakai.Model(state=["x", "y"], drift=["-x", "sin(y)"], observation=["y"])
        >>> [block.model.state for block in blocks(system)]
        [('x',), ('y',)]
    """
    return tuple(Block(states, rows, part_of(model, states, rows)) for states, rows in connected(model))


class Groups:
    """States, and after them observations, that hang together; at first each by itself."""

    def __init__(self, model: Model):
        self.n = model.n
        self._parent = list(range(model.n + model.m))

    def root(self, i: int) -> int:
        """The one that stands for the group of i."""
        while self._parent[i] != i:
            self._parent[i] = i = self._parent[self._parent[i]]
        return i

    def join(self, nodes: Iterable[int]) -> None:
        """Put the groups of the nodes together; the smallest one stands for all."""
        roots = {self.root(node) for node in nodes}
        for root in roots:
            self._parent[root] = min(roots)

    def parts(self) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """The states and the observations of each group, in the order of their first states."""
        found: dict[int, tuple[list[int], list[int]]] = {}
        for node in range(len(self._parent)):
            # States come first, and an observation without one counts to the first state's group.
            root = self.root(node)
            states, rows = found.setdefault(root if root < self.n else 0, ([], []))
            if node < self.n:
                states.append(node)
            else:
                rows.append(node - self.n)
        return [(tuple(states), tuple(rows)) for states, rows in found.values()]


def connected(model: Model, join: Callable[[Groups], None] | None = None) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """The places of the states and of the observations of each connected part; `more` may join some."""
    if not model.features.keys() <= DIVIDED:
        return [(tuple(range(model.n)), tuple(range(model.m)))]
    groups, place = Groups(model), {symbol: i for i, symbol in enumerate(model.x)}

    def join_used(node: int, formula: sp.Expr) -> None:
        used = [place[symbol] for symbol in formula.free_symbols if symbol in place]
        if used:
            groups.join([node, *used])

    for i, formula in enumerate([*model.drift, *model.observation]):
        join_used(i, formula)
    for (_, row), formula in model.family_parameters.items():
        join_used(model.n + row, formula)
    for matrix, first in ((model.covariance, 0), (model.observation_noise, model.n)):
        for (i, j), entry in matrix.todok().items():
            join_used(first + i, entry)
            if i < j and tidy(entry) != 0:
                groups.join((first + i, first + j))
    if join is not None:
        join(groups)
    return groups.parts()


def _noise(model: Model, states: tuple[int, ...]) -> dict[str, Any]:
    """Return the noise of some states: their block of G, or their rows of g and the noises in them where g has states."""
    if STATE_DEPENDENT_DIFFUSION not in model.features:
        return {"process_noise": model.covariance.extract(states, states).tolist()}
    rows = model.diffusion.extract(states, range(model.diffusion.cols))
    used = [j for j in range(rows.cols) if any(entry != 0 for entry in rows[:, j])] or [0]
    noise = model.process_noise.extract(used, used)
    return {"diffusion": rows.extract(range(len(states)), used).tolist(), "process_noise": noise.tolist()}


def _families(model: Model, rows: tuple[int, ...]) -> dict[str, Any]:
    """Return the families of some observations, with their parameters."""
    families = [model.observation_family[row] for row in rows]
    if set(families) <= {"gaussian"}:
        return {}
    keys: dict[str, Any] = {"observation_family": families}
    for name in dict.fromkeys(name for name, _ in model.family_parameters):
        given = [model.family_parameters[name, row] for row in rows if (name, row) in model.family_parameters]
        if given:
            keys[name] = given
    return keys


def _inputs(model: Model, states: tuple[int, ...], rows: tuple[int, ...]) -> dict[str, Any]:
    """Return the known inputs, all of them, for a part whose formulas contain one; a part without takes none."""
    formulas = [*(model.drift[i] for i in states), *(model.observation[j] for j in rows)]
    formulas += [*model.covariance.extract(states, states), *model.observation_noise.extract(rows, rows)]
    formulas += [formula for (_, row), formula in model.family_parameters.items() if row in rows]
    if not any(formula.free_symbols & set(model.u) for formula in formulas):
        return {}
    return {"inputs": model.inputs, "input_hold": model.input_hold}


def part_of(model: Model, states: tuple[int, ...], rows: tuple[int, ...], prior: Any = None) -> Model:
    """The part of a model with these states and observations, and a prior for them."""
    if len(states) == model.n and prior is None:
        return model
    names = tuple(model.state[i] for i in states)
    observed = [model.observation[i] for i in rows] or [sp.Integer(0)]
    keys: dict[str, Any] = {
        "name": f"{model.name}: {', '.join(names)}",
        "state": names,
        "drift": [model.drift[i] for i in states],
        **_noise(model, states),
        "observation": observed,
        "observation_noise": model.observation_noise.extract(rows, rows).tolist() if rows else None,
        "observation_names": [model.observation_names[i] for i in rows] or None,
        "observed_angles": [model.observation_names[i] for i in rows if model.observation_names[i] in model.observed_angles],
        "observation_kind": model.observation_kind,
        "start": model.start,
        "periodic": [name for name in model.periodic if name in names],
        "parameters": model.parameters,
        "functions": model.functions,
        "prior": prior,
        **_inputs(model, states, rows),
        "domain": {name: interval.keys() for name, interval in model.domain.items() if name in names},
        "tables": {name: table.keys() for name, table in model.tables.items()},
        **_families(model, rows),
    }
    return Model._from_file(keys, f"{model.source}: block {', '.join(names)}", None)
