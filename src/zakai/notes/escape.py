"""Drifts that lead to infinity, of results of methods that do not refuse them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai import _registry
from zakai.methods.system.escape import EscapeError, divisors_of
from zakai.methods.system.escape_of_states import check_escape, growing
from zakai.models.model import Model
from zakai.records.schedule import Schedule

# They have moments where there is no density; all others refuse the interval.
UNCHECKED = ("extended-kalman-bucy", *_registry.PEERS)


class _System(NamedTuple):
    model: Model
    schedule: Schedule
    theta: np.ndarray


def notes_on_escape(
    method: str, model: Model, schedule: Schedule, theta: np.ndarray, mean: np.ndarray, cov: np.ndarray
) -> list[str]:
    """Return a sentence on the first interval in which more than a hundredth of the paths reach infinity, or a pole.

    Args:
        method: The name of the method.
        model: The model.
        schedule: The K intervals.
        theta: The parameters (p,).
        mean: (K+1, n), that of the prior first.
        cov: (K+1, n, n).
    """
    if method not in UNCHECKED:
        return []
    system = _System(model, schedule, theta)
    rows = range(len(schedule)) if divisors_of(model) is not None else np.flatnonzero(growing(system, slice(None))).tolist()
    try:
        for k in rows:
            check_escape(system, k, lambda k=k: (mean[k], cov[k]))  # type: ignore[misc]
    except EscapeError as error:
        return [str(error).removeprefix(f"{model.source}: ")]
    return []
