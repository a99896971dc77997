"""Whether a method holds a density over the first interval of a record, which "auto" asks before it takes the method.

The work of a density of several states depends on what the drift does to it between two observations, and a model does not say
how long that is.  The prior is advanced over the first interval of positive length with a bound on the work.  A record and an
online filter have that interval in common, and both choose by it; what is observed has no influence.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zakai.algebra.expected_work import MARGIN, MOST_TIMES, most_points, most_seconds, work_of_step
from zakai.algebra.order import GENERAL
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Method, Prepared, State
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.one_thread import one_thread
from zakai.records import Inputs, Record
from zakai.records.schedule import Schedule

KEPT = 8  # intervals of each model


class FirstInterval(NamedTuple):
    """The end of an interval from the model's start, and the known inputs."""

    stop: float
    inputs: Inputs | None

    def fault(self, setting: Setting) -> str:
        """Return why a method cannot take a density over the interval, or nothing."""
        method, model = setting.method, setting.model
        if not asked(setting) or not self.stop > float(model.start):
            return ""
        nothing = np.zeros((1, model.m))
        inputs = self.inputs if model.inputs else None
        schedule = Schedule(np.array([float(model.start)]), np.array([self.stop]), nothing > 0, nothing, inputs).part(slice(1))
        if setting.prior is not model.prior:
            return _fault(setting, schedule)
        key = (method.name, tuple(sorted(setting.options.items())), setting.theta.tobytes(), *schedule.key())
        return kept(model, FirstInterval, lambda: _fault(setting, schedule), key, KEPT)


def asked(setting: Setting) -> bool:
    """Return whether "auto" takes a method by the first interval: one for any system of several states, particles apart."""
    return setting.model.n > 1 and setting.method.name in GENERAL and not setting.method.random


def first_interval(model: Model, record: Record) -> FirstInterval:
    """Return the first interval of positive length of a record; where there is none, one of length zero."""
    later = record.times[record.times > model.start]
    return FirstInterval(float(later[0]) if len(later) else float(model.start), record.inputs)


def any_fault(*faults: Callable[[Setting], str]) -> Callable[[Setting], str]:
    """Return the function that returns the first fault that several ones find."""
    return lambda setting: next((found for fault in faults if (found := fault(setting))), "")


@one_thread
def _fault(setting: Setting, schedule: Schedule) -> str:
    method: Method[Prepared, State] = setting.method
    model, tolerance = setting.model, setting.options.get("tolerance")
    try:
        _, state = setting.begin()
    except InputError:  # the filter itself reports it
        return ""
    try:
        with np.errstate(all="ignore"):
            prepared = setting.prepared(schedule)
            if method.bounded is not None:
                prepared = method.bounded(prepared, most_points(model, tolerance))
            _, info = method.step(prepared, 0, state, np.zeros(model.m))
    except InputError as wrong:
        return f"not over the first interval: {wrong}"
    lost = any(not info.health.get(name, 0.0) <= limit for name, limit in method.losses.items())
    # A train of the largest rank does not hold what comes next.
    lost = lost or not np.isfinite(info.mean).all() or info.health.get("rank", 0.0) >= setting.options.get("most_rank", np.inf)
    work = work_of_step(method.name, model, info.health)
    if not lost and (work is None or MARGIN * work.seconds <= most_seconds(model, tolerance)):
        return ""
    return f"over the first interval it loses the density, or takes more than {MOST_TIMES:g} times the work of particles"
