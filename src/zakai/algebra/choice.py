"""Which method is taken for a system, and whether for the whole of it or block by block."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zakai.algebra.advice import nearest, what_to_do
from zakai.algebra.conditions import Condition, all_hold
from zakai.algebra.expected_work import expected_work
from zakai.algebra.independent import IndependentBlock, independent_blocks
from zakai.algebra.order import AFFORDABLE, GENERAL, by_work, in_order, work_in_words
from zakai.algebra.theorems import conditions_of
from zakai.errors import ConditionError
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior

Conditions = tuple[Condition, ...]
# A linear system of so few states is one Kalman-Bucy filter, though it may fall into blocks.
FEW = 8
# A system of independent blocks with more states than this is not analysed as a whole.
MANY = 32
_SHOWN = 3


@dataclass(frozen=True, eq=False)
class Division:
    """A system block by block: of each shared model the name of its method, and the conditions of all that were checked."""

    blocks: tuple[IndependentBlock, ...]
    methods: Mapping[Model, str]
    conditions: Mapping[Model, Mapping[str, Conditions]]
    by_name: bool

    @property
    def method(self) -> str:
        """As in "blocks: 3 x limited-direct, kalman-bucy"."""
        counts = Counter(self.methods[block.model] for block in self.blocks)
        return "blocks: " + ", ".join(name if count == 1 else f"{count} x {name}" for name, count in counts.items())

    @property
    def why(self) -> str:
        """On what grounds, in a sentence."""
        by_method: dict[str, list[IndependentBlock]] = {}
        for block in self.blocks:
            by_method.setdefault(self.methods[block.model], []).append(block)
        named = "; ".join(f"{listed_blocks(blocks)} by {name}" for name, blocks in by_method.items())
        how = "the method asked for holds for each of them" if self.by_name else "each has the first method that holds for it"
        return f"the system falls into {len(self.blocks)} independent blocks, and {how}: {named}"


def chosen(model: Model, method: str, tolerance: float | None = None) -> tuple[str, str, Mapping[str, Conditions]]:
    """Return the method of that name, or for "auto" the first that holds; the reason; and all conditions that were checked.

    `tolerance` is the accuracy that is asked of "auto", None for those of the methods themselves.

    Raises:
        ConditionError: the method does not hold, or none does; the message names the assumption that fails.
    """
    if method != "auto":
        conditions = conditions_of(method, model)
        if all_hold(conditions) is not True:
            advice = what_to_do(model, method)
            raise ConditionError(f"{model.source}: {method} does not hold: {failure(conditions)}\n{advice}")
        return method, "asked for by name, and every assumption of its theorem holds", {method: conditions}
    considered: dict[str, Conditions] = {}
    for name in in_order(model, tolerance):
        considered[name] = conditions_of(name, model)
        if all_hold(considered[name]) is True:
            return name, _reason(name, model, tolerance), considered
    name = nearest(considered)
    reason = failure(considered[name])
    raise ConditionError(
        f"{model.source}: no method holds for this system; the nearest is {name}: {reason}\n{what_to_do(model, method)}"
    )


def _reason(name: str, model: Model, tolerance: float | None) -> str:
    """Return why "auto" takes a method."""
    if name not in GENERAL or model.n == 1:
        return "the first method whose every assumption holds for this system"
    reason = "particles, which hold for any model: no other method that auto tries holds for this system"
    held = [other for other in by_work(model, tolerance) if all_hold(conditions_of(other, model)) is True]
    if len(held) > 1:
        reason = (
            "no exact method holds, and this one is expected to need the least time for its accuracy, or at most "
            f"{AFFORDABLE:g} times that and to be more exact (for an observation {work_in_words(model, tolerance, held)})"
        )
    exact = name == "tensor-train" or (model.n < 3 and name == "yau-yau")
    if exact or all_hold(conditions_of("tensor-train", model)) is not True:
        return reason
    how = "more exactly, and may take much longer" if name == "guided-particles" else "often in less time"
    return f"{reason}; tensor-train by name gives the whole density, {how}"


def divided(
    model: Model, prior: Any, method: str = "auto", by_value: bool = True, tolerance: float | None = None
) -> Division | None:
    """The blocks of a system with their methods, or None where it is better filtered as a whole.

    "auto" takes blocks wherever there are several, but for linear systems of at most `FEW` states with a Gaussian prior; a
    method that is named is taken block by block if it does not hold for the whole, or there are more than `MANY` states.

    Raises ConditionError, with what fails, if a block has no method.
    """
    blocks = independent_blocks(model, prior, by_value)
    if len(blocks) == 1:
        return None
    if method == "auto":
        plain = model.n <= FEW and isinstance(prior, GaussianPrior | None)
        if plain and all_hold(conditions_of("kalman-bucy", model)) is True:
            return None
    elif model.n <= MANY and all_hold(conditions_of(method, model)) is True:
        return None
    methods, conditions = {}, {}
    for part in dict.fromkeys(block.model for block in blocks):
        try:
            methods[part], _, conditions[part] = chosen(part, method, tolerance)
        except ConditionError as error:
            if method == "auto" or model.n > MANY:
                raise
            whole, first = failure(conditions_of(method, model)), str(error).splitlines()[0]
            raise ConditionError(f"{model.source}: {method} does not hold: {whole}; nor block by block: {first}") from None
    return Division(blocks, methods, conditions, method != "auto")


def faster(model: Model, name: str, seconds: float) -> str | None:
    """Return a method for any system that is expected to need a third of `seconds` for an observation, or less; None without one.

    It holds, and is less exact than the method `name` or is expected to need less time.
    """
    own = expected_work(name, model, None)
    for place, other in enumerate(GENERAL):
        work = None if other == name else expected_work(other, model, None)
        if work is None or work.fails or AFFORDABLE * work.seconds > seconds:
            continue
        less_exact = name not in GENERAL or place > GENERAL.index(name)
        if (less_exact or (own is not None and work.seconds < own.seconds)) and all_hold(conditions_of(other, model)) is True:
            return other
    return None


def recommended(model: Model) -> str | None:
    """What "auto" takes, a method's name or as `Division.method`; None where nothing holds."""
    try:
        division = divided(model, model.prior)
        return chosen(model, "auto")[0] if division is None else division.method
    except ConditionError:
        return None


def listed_blocks(blocks: Sequence[IndependentBlock]) -> str:
    """Some blocks by the names of their states: x1, (x2, x3), x4 and 7 more."""
    names = [block.names[0] if len(block.names) == 1 else f"({', '.join(block.names)})" for block in blocks]
    shown = ", ".join(names[:_SHOWN])
    return shown if len(names) <= _SHOWN else f"{shown} and {len(names) - _SHOWN} more"


def failure(conditions: Conditions) -> str:
    """The first assumption that fails, or else that is undecided, in words."""
    for condition in sorted(conditions, key=lambda c: c.holds is None):
        if condition.holds is not True:
            verb = "it fails that" if condition.holds is False else "it is undecided whether"
            return f"{verb} {condition.statement} ({condition.evidence}) [{condition.source}]"
    return "nothing failed"
