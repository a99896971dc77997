"""The substeps of an interval: measured, or those of the last measurement where that still holds."""

from __future__ import annotations

import math

import numpy as np

from zakai.methods.particles.events import Interval
from zakai.methods.particles.interval import Scheme
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import PILOT, Control, Prepared, State
from zakai.methods.particles.time_step import (
    MOST_SUBSTEPS,
    MOST_TIME_ERROR,
    OF_RANDOM_ERROR,
    PILOTS,
    TIME_ERROR,
    Pilots,
    Steps,
    least_substeps,
    steps_of,
)
from zakai.methods.particles.window import taken
from zakai.numerics.particles.population import systematic
from zakai.numerics.particles.random import uniform_number

# Of the time error: the share of the allowed one below which it holds in so many more intervals; in how many it does at most,
# twice as many each time, where it was no more than so many times the substeps that were expected; the ratio of errors by length
# up to which it holds.  It does not where the drift moves the mean by more than a deviation in the interval, and so many times as
# fast as where it was measured, or where df/dx is so many times as large: the error is of the third order in it, and twice it is
# within what `SURE` leaves.
SURE, TRUSTED, MOST_TRUSTED, FORESEEN, LONGER, FASTER, STEEPER = 0.5, 4, 8, 1.3, 4.0, 2.0, 2 ** (1 / 3)


def allowed_error(control: Control, count: int) -> float:
    """Return the error of a mean by the time step, in standard deviations, that an interval may have."""
    return min(max(OF_RANDOM_ERROR * math.sqrt(control.variance / count), TIME_ERROR), MOST_TIME_ERROR)


def substeps(
    prepared: Prepared, interval: Interval, values: Array, state: State, about: tuple[Array, Array]
) -> tuple[Steps, Control]:
    """Return the substeps of an interval, measured where the last measurement does not hold any more, and the controls."""
    control, (mean, scale), hold = state.control, about, prepared.model.input_hold
    length = interval.stop - interval.start
    if length <= 0:
        return Steps(Scheme(1, 4), np.zeros(len(mean)), 0.0, 0.0), control
    if prepared.system.exact:
        count, _ = least_substeps(prepared.motion, interval, values, about)
        return Steps(Scheme(count, 4), np.zeros(len(mean)), 0.0, 0.0), control
    # The error of an interval is of the third order of its length, and was measured in deviations of that time.
    jumps, pace = interval.inputs_change(hold), prepared.motion.pace(interval, values, mean, scale)
    ratio = (length / control.length) ** 3 if control.length and not jumps else np.inf
    ratio *= max(1.0, float((state.last_scale / scale).max()))
    allowed = allowed_error(control, len(state.log_weights))
    needed = control.substeps * np.sqrt(control.error * ratio / allowed)
    guess = max(1, int(np.ceil(needed))) if needed <= MOST_SUBSTEPS else max(1, control.substeps)
    alike, steepness = pace * length <= 1.0, 0.0
    if not alike:  # the mean moves to where the error may be another one
        steepness = prepared.motion.steepness(interval, values, mean, scale)
        alike = pace <= FASTER * control.pace and steepness <= STEEPER * control.steepness
    if control.trusted and alike and ratio <= LONGER and guess <= MOST_SUBSTEPS:
        if control.substeps > 1:
            guess = max(guess, least_substeps(prepared.motion, interval, values, about)[0])
        ratio *= (control.substeps / guess) ** 2
        error = control.error * ratio
        known = Steps(Scheme(guess, control.stages), state.last_shift * ratio, error, error, False)
        return known, control._replace(trusted=control.trusted - 1)
    key = prepared.key(control.interval + 1, PILOT)
    chosen = np.empty(PILOTS, np.int32)
    systematic(np.exp(state.log_weights), uniform_number(key), chosen)
    pilots = Pilots(taken(state.particles, chosen), mean, scale, int(key[0] >> np.uint64(2)), allowed)
    found = steps_of(prepared.motion, interval, values, pilots, guess)
    count, stages = found.scheme
    expected = count * np.sqrt(found.error / allowed) <= FORESEEN * needed
    trusted = min(max(1, 2 * control.granted), MOST_TRUSTED) if expected else 0
    trusted = max(trusted, TRUSTED) if found.surely <= SURE * allowed else trusted
    trusted = 0 if jumps else trusted  # of other inputs than those that the next interval begins with
    return found, control._replace(
        substeps=count, stages=stages, error=found.error, length=length, trusted=trusted, granted=trusted, pace=pace,
        steepness=steepness,
    )
