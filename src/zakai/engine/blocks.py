"""The results of the independent blocks of a system, put together to that of the whole."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from zakai.algebra.choice import Division, listed_blocks
from zakai.algebra.independent import IndependentBlock
from zakai.densities import Density, ProductDensity
from zakai.densities.product import renamed
from zakai.engine.loop import KEPT_BYTES, Run
from zakai.engine.results import FilterResult
from zakai.engine.run_result import result_of_run
from zakai.engine.versions import versions
from zakai.models.model import Model
from zakai.records import Record

# Of these figures of health the smallest is the worst; of all others the largest.
SMALLEST_IS_WORST = ("std_in_spacings",)
_NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")


def record_of_block(record: Record, block: IndependentBlock) -> Record:
    """Return the observations of one block; a block without sensors has one coordinate that is never observed."""
    values = record.values[:, list(block.observations)] if block.observations else np.full((len(record), 1), np.nan)
    return Record(record.times, values, record.kind, record.inputs if block.model.inputs else None)


def joined_blocks(model: Model, division: Division, runs: Sequence[Run], warned: bool = True) -> FilterResult:
    """Return the result of the whole system, from one run for each block; its warnings are sought where it is `warned`."""
    blocks, parts = division.blocks, []
    mean = np.empty((len(runs[0].record) + 1, model.n))
    variance = np.empty_like(mean)
    increments = np.zeros(len(mean))
    errors, squares = np.zeros_like(mean), 0.0
    health: dict[str, np.ndarray] = {}
    bounds: dict[str, tuple[float, str]] = {}
    for run, block in zip(runs, blocks, strict=True):
        part = result_of_run(run, division.why, division.conditions[block.model], warned)
        _rename(part, block)
        parts.append(part)
        mean[:, block.states], variance[:, block.states] = part.mean, part.variance
        if part.mean_standard_error is not None:
            errors[:, block.states] = part.mean_standard_error
            squares += (part.log_likelihood_standard_error or 0.0) ** 2
        increments += part.log_likelihood_increments
        for name, values in part.health.items():
            worse = np.fmin if name in SMALLEST_IS_WORST else np.fmax
            health[name] = worse(health[name], values) if name in health else values
        for name, bound in part.bounds.items():
            bounds[name] = min(bound, bounds.get(name, bound))
    random = any(part.mean_standard_error is not None for part in parts)
    kept = all(part.has_densities for part in parts)
    lost = [part.increment_law_error for part in parts if part.increment_law_error is not None]
    return FilterResult(
        times=parts[0].times,
        mean=mean,
        variance=variance,
        log_likelihood_increments=increments,
        health=health,
        warnings=_warnings(blocks, parts),
        method=division.method,
        why=division.why,
        model=model,
        conditions=_conditions(division),
        bounds=bounds,
        state=model.state,
        attributes={**{key: _all_of(parts, key) for key in ("source", "exactness")}, **versions()},
        blocks=tuple(parts),
        mean_standard_error=errors if random else None,
        log_likelihood_standard_error=squares**0.5 if random else None,
        increment_law_error=np.sum(lost, axis=0) if lost else None,
        _density=_Densities(model, blocks, runs) if kept else None,
        _no_density=_no_density(runs),
    )


def _rename(part: FilterResult, block: IndependentBlock) -> None:
    """Give the states of a block their own names instead of those of the block with which it shares its model."""
    own = block.names == block.model.state
    part.state = block.names
    part.model = part.model if own else None
    density = part._density
    if density is not None and not own:
        part._density = lambda k: renamed(density(k), block.names)


def _conditions(division: Division) -> dict[str, Any]:
    found = {}
    for part, considered in division.conditions.items():
        who = listed_blocks([block for block in division.blocks if block.model is part])
        found.update({f"{name} for {who}": conditions for name, conditions in considered.items()})
    return found


def _all_of(parts: Sequence[FilterResult], key: str) -> str:
    """Return an attribute of the methods, with their names where they differ."""
    said = {part.method: part.attributes[key] for part in parts}
    return next(iter(said.values())) if len(said) == 1 else "; ".join(f"{name}: {text}" for name, text in said.items())


def _warnings(blocks: Sequence[IndependentBlock], parts: Sequence[FilterResult]) -> list[str]:
    """Return the warnings of all blocks; warnings that differ only in their numbers become one, with the names of the blocks."""
    found: dict[str, list[tuple[IndependentBlock, str]]] = {}
    for block, part in zip(blocks, parts, strict=True):
        for warning in part.warnings:
            found.setdefault(_NUMBER.sub("0", warning), []).append((block, warning))
    sentences = []
    for alike in found.values():
        who, texts = [block for block, _ in alike], {text for _, text in alike}
        first = alike[0][1]
        if len(texts) == 1:
            count = f" ({len(who)} blocks)" if len(who) > 1 else ""
            sentences.append(f"{listed_blocks(who)}{count}: {first}")
        else:
            sentences.append(
                f"{listed_blocks(who[:1])}: {first}; the same, in other numbers, of {len(who) - 1} more blocks: "
                f"{listed_blocks(who[1:])}"
            )
    return sentences


def _no_density(runs: Sequence[Run]) -> str:
    """Return why densities were not kept, which one block without densities decides."""
    if any(run.keep is False and run.bytes for run in runs):
        return (
            f"the densities of {len(runs[0].record)} steps of {len(runs)} blocks were not kept: they need more than "
            f'{KEPT_BYTES / 2**20:.3g} MiB; keep="densities" keeps them all'
        )
    return 'the densities were not kept; keep="densities" keeps them'


class _Densities:
    """The joint density at an index of the result."""

    def __init__(self, model: Model, blocks: Sequence[IndependentBlock], runs: Sequence[Run]):
        self.blocks, self.runs = blocks, runs
        self.names, self.periodic = model.state, tuple(name in model.periodic for name in model.state)

    def __call__(self, index: int) -> Density:
        parts = _Parts(self.blocks, self.runs, index)
        return ProductDensity(parts, tuple(block.states for block in self.blocks), self.names, self.periodic)


class _Parts(Sequence[Density]):
    """The densities of the blocks at one time, each made when it is asked for: a marginal asks for few of them."""

    def __init__(self, blocks: Sequence[IndependentBlock], runs: Sequence[Run], index: int):
        self.blocks, self.runs, self.time = blocks, runs, index
        self.made: dict[int, Density] = {}

    def __len__(self) -> int:
        return len(self.runs)

    def __getitem__(self, number: Any) -> Any:
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(len(self)))]
        if number not in self.made:
            self.made[number] = renamed(self.runs[number].density(self.time), self.blocks[number].names)
        return self.made[number]
