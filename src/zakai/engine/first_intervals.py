"""Whether a method holds a density over the first intervals of a record, which "auto" asks before it takes the method.

The work of a density of several states depends on what the drift does to it between two observations, and a model does not say
how long that is.  The prior is advanced over the first interval of positive length, and over one of their typical length, with a
bound on the work.  A record and an online filter have these intervals in common, and both choose by them; what is observed has
no influence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from zakai import _display, _registry
from zakai.algebra.expected_work import GRID_POINT, MARGIN, MOST_TIMES, Work, expected_work, work_of_particles, work_of_step
from zakai.algebra.order import GENERAL
from zakai.engine.setting import Setting
from zakai.errors import InputError
from zakai.methods._protocol import Info, Method, Prepared, State
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.numerics.exhausted import ExhaustedError
from zakai.numerics.one_thread import one_thread
from zakai.records import Inputs, Record
from zakai.records.schedule import Schedule, length_of

KEPT = 8  # intervals of each model
INTERVALS = 8  # of a record, whose lengths count
PARTICLES = 2048  # that find the substeps of an interval: more of them need no smaller error of the time step


class FirstIntervals(NamedTuple):
    """The length of the first interval from the model's start, the typical length of the first ones, and the known inputs.

    The typical length is the mean of the first `INTERVALS`, as the first one times a power of two, or the first one where that
    is longer: a record of irregular lengths tries few of them.
    """

    first: float
    typical: float
    inputs: Inputs | None

    @classmethod
    def of(cls, model: Model, times: Sequence[float], inputs: Inputs | None) -> FirstIntervals:
        """Return those of a record with these times, without times before the start of the model."""
        start = float(model.start)
        later = sorted({float(time) for time in times if time > start})[:INTERVALS]
        if not later:
            return cls(0.0, 0.0, inputs)
        first, mean = length_of(start, later[0]), (later[-1] - start) / len(later)
        return cls(first, first * 2.0 ** max(round(math.log2(mean / first)), 0), inputs)

    def fault(self, setting: Setting) -> str:
        """Return why a method cannot take a density over the intervals, or nothing."""
        if not asked(setting) or not self.first > 0.0:
            return ""
        where = "the first interval"
        found = self._fault(setting, self.first, where)
        if not found and self.typical > self.first:
            where = f"an interval of {_display.rough(self.typical)}, the typical length of the first {INTERVALS},"
            found = self._fault(setting, self.typical, where)
        return found

    def _fault(self, setting: Setting, length: float, where: str) -> str:
        method, model, start = setting.method, setting.model, float(setting.model.start)
        nothing = np.zeros((1, model.m))
        inputs = self.inputs if model.inputs else None
        schedule = Schedule(np.array([start]), np.array([start + length]), nothing > 0, nothing, inputs).part(slice(1))
        if setting.prior is not model.prior:
            return _fault(setting, schedule, where)
        key = (method.name, tuple(sorted(setting.options.items())), setting.theta.tobytes(), where, *schedule.key())
        return kept(model, FirstIntervals, lambda: _fault(setting, schedule, where), key, KEPT)


def asked(setting: Setting) -> bool:
    """Return whether "auto" takes a method by the first intervals: one for any system of several states, particles apart."""
    return setting.model.n > 1 and setting.method.name in GENERAL and not setting.method.random


def first_intervals(model: Model, record: Record) -> FirstIntervals:
    """Return what the first intervals of a record say."""
    return FirstIntervals.of(model, record.times.tolist(), record.inputs)


def any_fault(*faults: Callable[[Setting], str]) -> Callable[[Setting], str]:
    """Return the function that returns the first fault that several ones find."""
    return lambda setting: next((found for fault in faults if (found := fault(setting))), "")


@one_thread
def _fault(setting: Setting, schedule: Schedule, where: str) -> str:
    method, model, tolerance = setting.method, setting.model, setting.options.get("tolerance")
    particles, info = expected_work("guided-particles", model, tolerance), None
    assert particles is not None
    # Particles need more for a stiff system, too: that is measured where it decides.
    for measured in (False, True):
        if measured:
            particles = _work_of_particles(setting, schedule, tolerance) or particles
        try:
            info = info or _advanced(setting, schedule, MOST_TIMES * particles.seconds)
        except InputError as wrong:
            return f"not over {where.removesuffix(',')}: {wrong}"
        except ExhaustedError:
            takes = f"more than {_display.rough(MOST_TIMES * particles.seconds)} s"
            continue
        if info is None:  # the filter itself reports why
            return ""
        lost = any(not info.health.get(name, 0.0) <= limit for name, limit in method.losses.items())
        # A train of the largest rank does not hold what comes next.
        lost = lost or info.health.get("rank", 0.0) >= setting.options.get("most_rank", np.inf)
        if lost or not np.isfinite(info.mean).all():
            return f"over {where} it loses the density"
        work = work_of_step(method.name, model, info.health)
        if work is None or MARGIN * work.seconds <= MOST_TIMES * particles.seconds:
            return ""
        takes = f"{_display.rough(MARGIN * work.seconds)} s"
    return f"over {where} it takes {takes}, and guided-particles {_display.rough(particles.seconds)} s"


def _advanced(setting: Setting, schedule: Schedule, seconds: float) -> Info | None:
    """Return what a method reports of the prior after an interval, with a bound on its work; None where it cannot begin."""
    method: Method[Prepared, State] = setting.method
    try:
        _, state = setting.begin()
    except InputError:
        return None
    with np.errstate(all="ignore"):
        prepared = setting.prepared(schedule)
        if method.bounded is not None:
            prepared = method.bounded(prepared, seconds / GRID_POINT)
        return method.step(prepared, 0, state, np.zeros(setting.model.m))[1]


def _work_of_particles(setting: Setting, schedule: Schedule, tolerance: float | None) -> Work | None:
    """Return the work of particles in an interval, with the substeps that they need; None where they cannot take it."""
    method = _registry.load("guided-particles")
    options = {**method.all_options, "particles": PARTICLES, "split": False}
    try:
        info = _advanced(Setting.of(setting.model, setting.prior, method, options), schedule, math.inf)
    except InputError:
        return None
    return None if info is None else work_of_particles(setting.model, tolerance, info.health["substeps"])
