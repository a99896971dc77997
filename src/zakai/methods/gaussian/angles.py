"""Observed angles of a linear system: the Gaussian families with the image of an angle that is nearest to its prediction.

Of the images z + 2 pi k of an observation the one nearest to h at the predicted mean is taken.  The others have the weights

    exp(-((r + 2 pi k)^2 - r^2) / 2 s),    r = z - h in (-pi, pi],  s the variance of the innovation,

relative to it; the largest of them is reported, and is negligible where deviations are small against pi.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.densities import Density
from zakai.densities._values import wrap
from zakai.methods._protocol import Backward, Info
from zakai.methods.gaussian import families
from zakai.methods.gaussian.backward import BACKWARD as PLAIN
from zakai.methods.gaussian.ends import Ends
from zakai.models.angles import ONE_IMAGE, nearest, other_image
from zakai.models.model import Model
from zakai.numerics.gaussian.exponents import Exponents
from zakai.numerics.transition import Array
from zakai.records.schedule import Schedule

BOUNDS = {
    **families.BOUNDS,
    "other_image": (ONE_IMAGE[0], f'{ONE_IMAGE[1]}; method="general-direct" takes all of them'),
}


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the families need; the same with nothing observed; and C (K, m, n), c (K, m), S (K, m, m) at the ends of intervals."""

    own: families.Prepared
    ahead: families.Prepared
    observation: tuple[Array, Array, Array]
    seen: Array

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the warnings of a result."""
        return self.own.notes

    @property
    def ends(self) -> Ends:
        """The observations at the ends of intervals."""
        return self.own.ends


def prepare(model: Model, schedule: Schedule, theta: Array) -> Prepared:
    """Return the transition of every interval."""
    own = families.prepare(model, schedule, theta)
    starts, stops, seen, elapsed, inputs = schedule
    silent = Schedule(starts, stops, np.zeros_like(seen), np.zeros_like(elapsed), inputs)
    return Prepared(own, families.prepare(model, silent, theta), own.setup.observation(schedule), schedule.seen)


def init(prepared: Prepared, prior: Any) -> families.State:
    """Return the state at the model's start."""
    return families.init(prepared.own, prior)


def _nearest(prepared: Prepared, k: int, state: families.State, values: Array) -> tuple[Array, float]:
    """Return the values (m,) with the nearest images of angles, and the largest weight of another image."""
    model = prepared.own.model
    angles = prepared.seen[k] & np.array(model.observation_law.angles)
    if not angles.any():
        return values, 0.0
    _, info = families.step(prepared.ahead, k, state, np.zeros(len(values)))
    C, c, S = (part[k] for part in prepared.observation)
    expected = C @ (info.mean - prepared.own.setup.origin) + c
    weight = other_image(wrap(values - expected)[angles], np.diagonal(C @ info.cov @ C.T + S)[angles])
    # The image is a whole number of turns away, whatever the derivatives of what is expected.
    return values + np.real(nearest(values, expected, angles) - values), weight


def step(prepared: Prepared, k: int, state: families.State, values: Array) -> tuple[families.State, Info]:
    """Advance one interval, with the nearest images of what is observed at its end."""
    values, weight = _nearest(prepared, k, state, values)
    state, info = families.step(prepared.own, k, state, values)
    return state, info._replace(health={**info.health, "other_image": weight})


def density(prepared: Prepared, state: families.State) -> Density:
    """Return the posterior."""
    return families.density(prepared.own, state)


def valid(prepared: Prepared, state: families.State) -> bool:
    """Return whether the arrays of a state fit together."""
    return families.valid(prepared.own, state)


def _message(prepared: Prepared, state: families.State) -> Exponents:
    return PLAIN.message(prepared.own, state)


def _step_back(prepared: Prepared, k: int, later: Exponents, values: Array, state: families.State) -> Exponents:
    return PLAIN.step(prepared.own, k, later, _nearest(prepared, k, state, values)[0], state)


def _smoothed(prepared: Prepared, state: families.State, later: Exponents) -> tuple[Exponents, Info]:
    later, info = PLAIN.smoothed(prepared.own, state, later)
    return later, info._replace(health={**info.health, "other_image": 0.0})


def _smoothed_density(prepared: Prepared, state: families.State, later: Exponents) -> Density:
    return PLAIN.density(prepared.own, state, later)


def _draw(
    prepared: Prepared, k: int, later: Array, values: Array, state: families.State, rng: np.random.Generator
) -> tuple[Array, float]:
    assert PLAIN.draw is not None
    return PLAIN.draw(prepared.own, k, later, _nearest(prepared, k, state, values)[0], state, rng)


BACKWARD: Backward[Prepared, families.State, Exponents] = Backward(
    _message, _step_back, _smoothed, _smoothed_density, None, _draw
)
