"""How a system is filtered: as a whole by one method, or block by block, each by its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from zakai import _registry
from zakai.algebra.choice import Conditions, Division, chosen, divided
from zakai.engine.blocks import joined_blocks, record_of_block
from zakai.engine.loop import KEPT_BYTES, Run
from zakai.engine.results import FilterResult
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Method
from zakai.models.model import Model
from zakai.records import Record


class Whole(NamedTuple):
    """One method for the whole system, why, and the conditions of every method that was considered."""

    setting: Setting
    why: str
    considered: Mapping[str, Conditions]

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The setting of each run."""
        return (self.setting,)

    def runs(self, record: Record, keep: str | None, most: float = KEPT_BYTES, theta: Any = None) -> list[Run]:
        """Return what is to be run for a record; `theta` (p,) are other values of the parameters, complex for a derivative."""
        return [Run(self.setting.at(theta), record, keep, most)]

    def result(self, runs: Sequence[Run]) -> FilterResult:
        """Return the result of the runs."""
        return _with_origin(runs[0].result(self.why, self.considered), self, runs)


class ByBlocks(NamedTuple):
    """A method for each of the independent blocks of a system."""

    model: Model
    division: Division
    settings: tuple[Setting, ...]

    def runs(self, record: Record, keep: str | None, most: float = KEPT_BYTES, theta: Any = None) -> list[Run]:
        """Return what is to be run for a record: one run for each block."""
        return [
            Run(setting.at(theta), record_of_block(record, block), keep, most / len(self.settings))
            for setting, block in zip(self.settings, self.division.blocks, strict=True)
        ]

    def result(self, runs: Sequence[Run]) -> FilterResult:
        """Return the result of the runs, assembled."""
        return _with_origin(joined_blocks(self.model, self.division, runs), self, runs)


Plan = Whole | ByBlocks


def _with_origin(result: FilterResult, plan: Plan, runs: Sequence[Run]) -> FilterResult:
    """Return a result that holds what continues it: the plan, and the last state of each run."""
    result.origin = plan, tuple(run.state for run in runs)
    return result


def plan_of(model: Model, prior: Any, method: str, options: Mapping[str, Any], by_value: bool = True) -> Plan:
    """Return how a system with this prior is filtered; parameters that are equal make equal blocks only `by_value`.

    Raises:
        InputError: unknown method or option.
        ConditionError: no method holds.
    """
    if method != "auto":
        _registry.load(method)  # an unknown name is refused before anything is computed
    division = divided(model, prior, method, by_value)
    if division is None:
        name, why, considered = chosen(model, method)
        loaded = _registry.load(name)
        return Whole(Setting.of(model, prior, loaded, _own_options([loaded], options)[0]), why, considered)
    names = dict.fromkeys(division.methods.values())
    methods = [_registry.load(name) for name in names]
    own = dict(zip(names, zip(methods, _own_options(methods, options), strict=True), strict=True))
    settings = (Setting.of(b.model, b.prior, *own[division.methods[b.model]]) for b in division.blocks)
    return ByBlocks(model, division, tuple(settings))


def _own_options(methods: Sequence[Method[Any, Any]], options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the options of each method: its defaults, updated by those given that it has."""
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
