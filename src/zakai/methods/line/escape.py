"""Refuse an interval of one state in which the density reaches infinity or a pole of the drift."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.domain import on_the_line, variable_of
from zakai.methods.line.system import Prepared
from zakai.methods.system.escape import Density, Motion, check_one_state, divisors_of
from zakai.models.domain import Interval

Array = Any


def check_escape(prepared: Prepared, k: int, points: Array, values: Array) -> None:
    """Raise InputError where paths escape from a density in interval k; `values` (N,) are the probabilities of `points` (N,)."""
    model, length = prepared.model, float(prepared.lengths[k])
    if model.periodic or length <= 0:
        return
    system, variable = prepared.system, variable_of(model)
    start, theta = float(prepared.schedule.starts[k]), prepared.theta.real
    divisors = divisors_of(on_the_line(model))

    def at(t: Array | float) -> Array | None:
        return None if system.inputs is None else system.inputs_at(float(np.nextafter(start + t, start)))

    def coefficients(x: Array, t: float) -> tuple[Array, Array]:
        at_time = start + t
        f = system.drift(x[:, None], at_time, theta)[..., 0].real
        return f, np.broadcast_to(system.covariance(x[:, None], at_time, theta)[..., 0, 0].real, f.shape)

    # A natural end is not reached: that was checked.
    interval = model.domain.get(model.state[0], Interval())
    lower, upper = interval.lower, interval.upper
    if variable is not None:
        ends = -np.finfo(float).max, np.finfo(float).max
        lower, upper = (end if np.isfinite(own) else own for own, end in zip((lower, upper), ends, strict=True))
    motion = Motion(
        model, (lambda w: w) if variable is None else lambda w: float(variable.x(np.array([[w]])).item()),
        coefficients, None if divisors is None else lambda x: divisors(x[:, None], start + 0.5 * length, theta, at(0.5 * length)),
        lower, upper, k, start, length, not system.moving,
    )  # fmt: skip
    real = np.maximum(np.nan_to_num(values.real), 0.0)
    if real.sum() > 0:
        check_one_state(motion, Density(points, real / real.sum()))
