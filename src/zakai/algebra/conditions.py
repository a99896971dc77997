"""A theorem's assumption, decided for one model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Condition:
    """One assumption of a theorem: `holds` is True, False, or None where it could not be decided.

    `evidence` is the expression that decided it, `source` the paper and the number of the assumption.
    """

    statement: str
    holds: bool | None
    evidence: str
    source: str


def all_hold(conditions: tuple[Condition, ...]) -> bool | None:
    """True if every condition holds, False if one fails, None if none fails but one is undecided."""
    values = [condition.holds for condition in conditions]
    return False if False in values else None if None in values else True
