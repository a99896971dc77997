"""How a system is filtered: as a whole by one method, or block by block, each by its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from zakai import _registry
from zakai.algebra.choice import Conditions, Division, chosen, divided
from zakai.errors import InputError
from zakai.filters._blocks import joined, record_of_block
from zakai.filters._protocol import Method
from zakai.filters._run import KEPT_BYTES, Run, Setting
from zakai.filters.results import FilterResult
from zakai.models.model import Model
from zakai.records import Record


class Whole(NamedTuple):
    """One method for the whole system, why, and the conditions of every method that was looked at."""

    setting: Setting
    why: str
    considered: Mapping[str, Conditions]

    @property
    def settings(self) -> tuple[Setting, ...]:
        """By what each run filters."""
        return (self.setting,)

    def runs(self, record: Record, keep: str | None, recorded: bool = False, most: float = KEPT_BYTES) -> list[Run]:
        """What is to be run for a record."""
        return [Run(self.setting, record, keep, recorded, most)]

    def result(self, runs: Sequence[Run]) -> FilterResult:
        """What the runs gave."""
        return runs[0].result(self.why, self.considered)


class ByBlocks(NamedTuple):
    """A method for each of the blocks that a system falls into."""

    model: Model
    division: Division
    settings: tuple[Setting, ...]

    def runs(self, record: Record, keep: str | None, recorded: bool = False, most: float = KEPT_BYTES) -> list[Run]:
        """What is to be run for a record: one run for each block."""
        return [
            Run(setting, record_of_block(record, block), keep, recorded, most / len(self.settings))
            for setting, block in zip(self.settings, self.division.blocks, strict=True)
        ]

    def result(self, runs: Sequence[Run]) -> FilterResult:
        """What the runs gave, put together."""
        return joined(self.model, self.division, runs)


Plan = Whole | ByBlocks


def plan_of(model: Model, prior: Any, method: str, options: Mapping[str, Any], by_value: bool = True) -> Plan:
    """How a system with this prior is filtered.  Parameters that are equal make equal blocks only `by_value`.

    Raises InputError for an unknown method or option, ConditionError where no method holds.
    """
    if method != "auto":
        _registry.load(method)  # an unknown one is said before anything is looked at
    division = divided(model, prior, method, by_value)
    if division is None:
        name, why, considered = chosen(model, method)
        loaded = _registry.load(name)
        return Whole(Setting(model, prior, loaded, _own_options([loaded], options)[0]), why, considered)
    names = dict.fromkeys(division.methods.values())
    methods = [_registry.load(name) for name in names]
    own = dict(zip(names, zip(methods, _own_options(methods, options), strict=True), strict=True))
    settings = (Setting(b.model, b.prior, *own[division.methods[b.model]]) for b in division.blocks)
    return ByBlocks(model, division, tuple(settings))


def _own_options(methods: Sequence[Method], options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The options of each method: its own, and what is given of those that it has."""
    for name in sorted(options):
        if not any(name in method.options for method in methods):
            what = " and ".join(method.name for method in methods)
            listed = ", ".join(sorted({option for method in methods for option in method.options})) or "none"
            if len(methods) == 1:
                raise InputError(f'{what} has no option "{name}"; its options are: {listed}')
            raise InputError(f'none of {what} has an option "{name}"; their options are: {listed}')
    return [
        {**method.options, **{name: value for name, value in options.items() if name in method.options}} for method in methods
    ]
