"""How a system is filtered: as a whole by one method, or block by block, each by its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai import _registry
from zakai.algebra.choice import Conditions, Division, chosen, divided
from zakai.algebra.conditions import all_hold
from zakai.algebra.independent import IndependentBlock
from zakai.algebra.order import in_order
from zakai.algebra.theorems import conditions_of
from zakai.engine.blocks import joined_blocks, record_of_block
from zakai.engine.loop import KEPT_BYTES, Run
from zakai.engine.results import FilterResult
from zakai.engine.run_result import result_of_run
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Method
from zakai.methods.system.prior_moments import prior_moments
from zakai.models.model import Model
from zakai.models.prior import DensityPrior, GaussianPrior, Prior
from zakai.notes.lengths import notes_on_increments
from zakai.numerics.sums.mixture import wrapped
from zakai.records import Record


class Plan(NamedTuple):
    """One method for the whole system, or one for each of its independent blocks.

    `settings` are those of the `blocks`; a system that is filtered as a whole is one block. `why` says on what grounds the
    methods were chosen, and `considered` has the conditions of every method that was checked for the whole.
    """

    model: Model
    blocks: tuple[IndependentBlock, ...]
    settings: tuple[Setting, ...]
    why: str
    considered: Mapping[str, Conditions]
    division: Division | None = None
    request: tuple[str, Mapping[str, Any]] = ("auto", {})  # the method and the options that were asked for

    @property
    def method(self) -> str:
        """The name of the method, or of those of the blocks."""
        return self.settings[0].method.name if self.division is None else self.division.method

    def runs(self, record: Record, keep: str | None, most: float = KEPT_BYTES) -> list[Run]:
        """Return a run for each block; densities may take `most` bytes in all."""
        if self.division is None:
            return [Run(self.settings[0], record, keep, most)]
        return [
            Run(setting, record_of_block(record, block), keep, most / len(self.settings))
            for setting, block in zip(self.settings, self.blocks, strict=True)
        ]

    def at(self, theta: np.ndarray) -> Plan:
        """Return the plan for other values of the parameters; it was made with `by_value` false where it has several blocks."""
        return self._replace(settings=tuple(setting._replace(theta=theta) for setting in self.settings))

    def result(self, runs: Sequence[Run], warned: bool = True) -> FilterResult:
        """Return the result of the runs, with what continues it: the plan, and the last state of each run.

        Where it is not `warned`, nothing is checked that only gives warnings.
        """
        if self.division is None:
            result = result_of_run(runs[0], self.why, self.considered, warned)
        else:
            result = joined_blocks(self.model, self.division, runs, warned)
        result.warnings.extend(notes_on_increments(result.times, result.increment_law_error))
        result.origin = self, tuple(run.state for run in runs)
        result._states = tuple(run.kept_states for run in runs)
        return result


# Differences of moments, in deviations and relative, beyond which "auto" takes another method: of a prior whose moments are
# known, and of a formula, whose own are sums over a grid.
_KEPT_PRIOR, _KEPT_FORMULA = 1e-3, 2e-2
_NARROW = 0.3  # variance of an angle up to which its moments hardly depend on whether they are wrapped


def plan_of(
    model: Model,
    prior: Prior | None,
    method: str,
    options: Mapping[str, Any],
    by_value: bool = True,
    unfit: Callable[[Setting], str] | None = None,
) -> Plan:
    """Return how a system with this prior is filtered; parameters that are equal make equal blocks only `by_value`.

    `unfit` says why "auto" may not take a method, or nothing.

    Raises:
        InputError: unknown method or option.
        ConditionError: no method holds.
    """
    if method != "auto":
        _registry.load(method)  # an unknown name is refused before anything is computed
    division = divided(model, prior, method, by_value, tolerance_asked(options))
    if division is None:
        return _plan_of_whole(model, prior, method, options, unfit)._replace(request=(method, options))
    if unfit is not None and method == "auto":
        plans = {block.model: _plan_of_whole(block.model, block.prior, method, options, unfit, True) for block in division.blocks}
        own_methods = {part: plan.method for part, plan in plans.items()}
        division = replace(division, methods=own_methods, conditions={part: plan.considered for part, plan in plans.items()})
    names = dict.fromkeys(division.methods.values())
    methods = [_registry.load(name) for name in names]
    own = dict(zip(names, zip(methods, _own_options(methods, options), strict=True), strict=True))
    settings = tuple(Setting.of(b.model, b.prior, *own[division.methods[b.model]]) for b in division.blocks)
    return Plan(model, division.blocks, settings, division.why, {}, division, (method, options))


def tolerance_asked(options: Mapping[str, Any]) -> float | None:
    """Return the option `tolerance` where it is a positive number, else None: the method itself checks it."""
    given = options.get("tolerance")
    number = isinstance(given, int | float) and not isinstance(given, bool) and given > 0
    return float(given) if number else None  # type: ignore[arg-type]


_LAST = "guided-particles"  # which keeps a prior no better than a grid does


def _plan_of_whole(
    model: Model, prior: Prior | None, method: str, options: Mapping[str, Any], unfit: Callable[[Setting], str] | None = None,
    shared: bool = False,
) -> Plan:
    """Return the plan of one method for the whole system, or for a block, for which of `shared` options the tolerance counts.

    "auto" goes on to the next one that holds where a method is unfit, or loses the density at the prior.
    """
    tolerance = tolerance_asked(options)
    name, why, considered = chosen(model, method, tolerance)
    lost: list[str] = []
    own = options
    while True:
        loaded = _registry.load(name)
        if shared:
            own = {"tolerance": tolerance} if "tolerance" in loaded.options and tolerance is not None else {}
        setting = Setting.of(model, prior, loaded, _own_options([loaded], own)[0])
        exact = name == "kalman-bucy" and isinstance(prior, GaussianPrior)
        order = in_order(model, tolerance)
        later = order[order.index(name) + 1 :] if method == "auto" and not exact else ()
        others = [one for one in later if all_hold(conditions_of(one, model)) is True]
        fault = unfit(setting) if unfit and others else ""
        if not fault and set(others) - {_LAST}:
            fault = _fault_at_prior(setting)
        elif not fault and others and setting.prior_has_ends:
            fault = _refused_at_prior(setting)
        if not fault:
            whole = IndependentBlock(tuple(range(model.n)), tuple(range(model.m)), model.state, model, prior)
            return Plan(model, (whole,), (setting,), "; ".join([why, *lost]), considered)
        lost.append(f"{name} holds too, but {fault}")
        name, considered = others[0], {**considered, others[0]: conditions_of(others[0], model)}


def _refused_at_prior(setting: Setting) -> str:
    """Return why a method refuses the prior, or nothing."""
    try:
        setting.begin()
    except InputError as wrong:
        return f"refuses the prior: {wrong}"
    return ""


def _fault_at_prior(setting: Setting) -> str:
    """Return how a method's density at the start differs from the prior, or nothing; draws differ by chance."""
    if setting.method.random:
        return ""
    prior, model = setting.prior, setting.model
    try:
        with np.errstate(all="ignore"):
            prepared, state = setting.begin()
            density = setting.method.density(prepared, state)
            mean, cov = density.mean(), density.cov()
    except InputError as wrong:
        return f"loses the density at the prior: {wrong}"
    if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
        return "loses the density at the prior: it is not finite"
    if isinstance(prior, DensityPrior) and model.n > 2:
        return ""
    expected, cov_of_prior = prior_moments(model, prior, setting.theta.real)
    spread, angle = np.diag(cov_of_prior), np.array([name in model.periodic for name in model.state])
    wide = (spread > 0) & ~(angle & (spread > _NARROW))
    apart = np.abs(wrapped(mean - expected, tuple(np.flatnonzero(angle).tolist())))[wide] / np.sqrt(spread[wide])
    off = max(apart.max(initial=0.0), np.abs(np.diag(cov)[wide] / spread[wide] - 1.0).max(initial=0.0))
    kept = _KEPT_FORMULA if isinstance(prior, DensityPrior) else _KEPT_PRIOR
    return f"loses the density at the prior: its moments are off by {off:.1g} deviations" if off > kept else ""


def _own_options(methods: Sequence[Method[Any, Any]], options: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the options of each method: its defaults, updated by those given that it has."""
    for name in sorted(options):
        if not any(name in method.all_options for method in methods):
            what = " and ".join(method.name for method in methods)
            known = sorted({option for method in methods for option in method.options})
            listed = f"the options are {', '.join(known)}" if known else "there is no option"
            if len(methods) == 1:
                raise InputError(f'{what} has no option "{name}"; {listed}')
            raise InputError(f'none of {what} has an option "{name}"; {listed}')
    return [
        {**method.all_options, **{name: value for name, value in options.items() if name in method.all_options}}
        for method in methods
    ]
