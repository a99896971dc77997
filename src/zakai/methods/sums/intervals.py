"""The intervals of a record as a Gaussian-sum method prepares them, and one sum over one of them, whole or in halves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zakai.methods._protocol import Info
from zakai.methods.sums.static import Sum
from zakai.methods.sums.system import Factor
from zakai.methods.sums.update import Moment, average, move
from zakai.numerics.flow import Transition, at
from zakai.numerics.sums.mixture import Array, Components, shares
from zakai.records.schedule import Schedule


class Intervals(NamedTuple):
    """The transitions (K, ...) and the factors of the K intervals of a schedule."""

    schedule: Schedule
    transitions: Transition
    factors: list[Factor]


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data: of K intervals, and of the halves of those (R,) with the rows `halved` (K,), -1 for none."""

    static: Sum
    theta: Array
    whole: Intervals
    halves: Intervals
    halved: Array
    precision: Array
    inputs: list[Array | None]
    notes: tuple[str, ...] = ()

    def moment(self, k: int, time: float) -> Moment:
        """Return what acts on sums at a time of interval k, with the inputs at its end."""
        return Moment(self.static, time, self.theta, self.precision[k], self.inputs[k])

    def first(self) -> Moment:
        """Return what acts on the prior, which knows no inputs."""
        static, none = self.static, np.zeros(len(self.static.model.u))
        return Moment(static, float(static.model.start), self.theta, static.system.start_precision(self.theta.real), none)


def prepared_of(static: Sum, schedule: Schedule, theta: Array) -> tuple[Prepared, tuple[float, float]]:
    """Return the intervals of a schedule, and the errors of their transitions and of their integrals over time."""
    rows = np.flatnonzero(schedule.inside.all(axis=1) & static.split_time)
    halved = np.full(len(schedule), -1)
    halved[rows] = np.arange(len(rows))
    whole, errors = _intervals(static, schedule, theta)
    halves, _ = _intervals(static, schedule.halved(rows), theta)
    inputs = static.system.end_inputs(schedule)
    u = np.zeros((len(schedule), len(static.model.u))) if schedule.inputs is None else np.array(inputs)
    return Prepared(static, theta, whole, halves, halved, static.system.precision(schedule.stops, theta.real, u), inputs), errors


def _intervals(static: Sum, schedule: Schedule, theta: Array) -> tuple[Intervals, tuple[float, float]]:
    flow = static.system.transitions(schedule, theta)
    factors, error = static.system.factors(schedule, theta)
    return Intervals(schedule, flow.transition, factors), (float(flow.error.max(initial=0.0)), error)


def advance(
    prepared: Prepared, k: int, v: Components, values: Array, most: int, edge: Array, halves: bool = False
) -> tuple[Components, Info]:
    """Return a sum after interval k, taken whole or as `halves`, reduced to at most `most` components, and what it reports."""
    static, rows, intervals, log_likelihood = prepared.static, [k], prepared.whole, 0.0
    if halves and prepared.halved[k] >= 0:
        rows, intervals, values = [2 * prepared.halved[k], 2 * prepared.halved[k] + 1], prepared.halves, 0.5 * values
    schedule = intervals.schedule
    for row in rows:
        factor, moved = intervals.factors[row], 0.0
        t0, t1 = float(schedule.starts[row]), float(schedule.stops[row])
        if factor.before is not None:
            product = prepared.moment(k, t0).multiply(v, factor, values, start=True)
            v, moved = product.sum, average(shares(product.sum)[0], product.moved)
        if t1 > t0:
            v = move(at(intervals.transitions, row), v, inputs_of(static, schedule, row, values), static.angles)
        v, info = prepared.moment(k, t1).update(v, factor, values, most, edge, moved)
        log_likelihood = log_likelihood + info.log_likelihood_increment
    return v, info._replace(log_likelihood_increment=log_likelihood)


def inputs_of(static: Sum, schedule: Schedule, row: int, values: Array) -> Array:
    """Return what drives the equation over an interval: one, and for affine h the rates of the increments."""
    if not static.system.rates:
        return np.ones(1)
    return np.append(1.0, np.where(schedule.inside[row], values, 0.0) / schedule.lengths[row])
