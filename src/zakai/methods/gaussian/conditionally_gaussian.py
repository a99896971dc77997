"""The filter of conditionally Gaussian systems: exact where coefficients depend on what is observed.

    dx = (a_0 + a_1 x) dt + g dv,    dy = (A_0 + A_1 x) dt + dw,    E dw dw' = S dt,   E dv dw' = C dt,

all coefficients functions of t, known inputs and y(t), as in feedback u = k(y) and in multiplicative observation.  Given the
path, x is Gaussian if it is at the start, with

    dm = (a_0 + a_1 m) dt + K (dy - (A_0 + A_1 m) dt),   P' = a_1 P + P a_1' + g Q g' - K S K',   K = (P A_1' + g C) S^-1

(Liptser and Shiryaev 1977, theorem 12.7).  y is linear between observations, and `gaussian/conditional_system.py` has the
difference between Ito and Stratonovich that this makes.  An interval is prepared when its observation is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.conditional import conditionally_gaussian as theorem
from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods._protocol import Backward, Info, Infos, Method
from zakai.methods.gaussian import families
from zakai.methods.gaussian.backward import BACKWARD as PLAIN
from zakai.methods.gaussian.conditional_system import ConditionalSystem
from zakai.models.features import CROSS_NOISE, INPUTS, JUMPS, KINKS, OBSERVED_PATH, SINC
from zakai.models.model import Model
from zakai.models.observed_path import observed_in_formulas, with_path_as_inputs
from zakai.numerics.gaussian.exponents import Exponents
from zakai.numerics.transition import Array
from zakai.records.path_inputs import PathInputs
from zakai.records.schedule import Schedule


class State(NamedTuple):
    """The Gaussian families, and the path y(t) (m,)."""

    own: families.State
    path: Array


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data: the model with the path as inputs, and the observations on which it depends (m,)."""

    model: Model
    derived: Model
    needed: Array
    schedule: Schedule
    theta: Array
    empty: families.Prepared
    notes: tuple[str, ...] = ()

    def along(self, rows: slice, path: Array) -> families.Prepared:
        """Return what is prepared for intervals of a slice with the path (R + 1, m) at their ends.

        Raises:
            InputError: the path is not known there.
        """
        part = self.schedule.part(rows)
        starts, stops, seen, elapsed, inputs = part
        unknown = (self.needed & ~part.inside).any(axis=1)
        if unknown.any():
            row, names = int(np.argmax(unknown)), [n for n, used in zip(self.model.observed, self.needed, strict=True) if used]
            raise InputError(
                f"{self.model.source}: conditionally-gaussian: {', '.join(names)} is not observed from t = {starts[row]:g} to "
                f"{stops[row]:g}, and formulas depend on it; this method needs every observation, and gives no forecast"
            )
        given = PathInputs.of(inputs, self.model.input_hold, np.append(starts, stops[-1:]), path)
        schedule = Schedule(starts, stops, seen, elapsed, given)
        return families.prepare(self.derived, schedule, self.theta, ConditionalSystem)


def prepare(model: Model, schedule: Schedule, theta: Array) -> Prepared:
    """Return what does not depend on the path."""
    derived = with_path_as_inputs(model)
    empty = families.prepare(derived, Schedule.empty(model.m), theta, ConditionalSystem)
    return Prepared(model, derived, observed_in_formulas(model), schedule, np.asarray(theta), empty)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the state at the model's start, where y = 0."""
    return State(families.init(prepared.empty, prior), np.zeros(prepared.model.m))


def _path(state: State, values: Array) -> Array:
    """Return the path (R + 1, m) at the ends of intervals with increments (R, m), added one after the other."""
    return np.add.accumulate(np.concatenate([state.path[None], np.real(values)]), axis=0)


def _one(prepared: Prepared, k: int, state: State, values: Array) -> tuple[families.Prepared, Array]:
    """Return what is prepared for an interval of which the observation is known, and the path at its ends."""
    path = _path(state, values[None])
    return prepared.along(slice(k, k + 1), path), path


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval along the path."""
    own, path = _one(prepared, k, state, values)
    moved, info = families.step(own, 0, state.own, values)
    return State(moved, path[1]), info


def segment(prepared: Prepared, rows: slice, state: State, values: Array) -> tuple[Sequence[State], Infos] | None:
    """Return the states after the intervals of a slice, and their reports, for one Gaussian."""
    path = _path(state, values)
    own = prepared.along(rows, path)
    found = families.segment_of_families(own, slice(0, len(values)), state.own, values)
    if found is None:
        return None
    states, infos = found
    return [State(one, y) for one, y in zip(states, path[1:], strict=True)], infos


def density(prepared: Prepared, state: State) -> Density:
    """Return the posterior."""
    return families.density(prepared.empty, state.own)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit together."""
    return np.shape(state.path) == (prepared.model.m,) and families.valid(prepared.empty, state.own)


def _message(prepared: Prepared, state: State) -> Exponents:
    return PLAIN.message(prepared.empty, state.own)


def _step_back(prepared: Prepared, k: int, later: Exponents, values: Array, state: State) -> Exponents:
    return PLAIN.step(_one(prepared, k, state, values)[0], 0, later, values, state.own)


def _smoothed(prepared: Prepared, state: State, later: Exponents) -> tuple[Exponents, Info]:
    return PLAIN.smoothed(prepared.empty, state.own, later)


def _smoothed_density(prepared: Prepared, state: State, later: Exponents) -> Density:
    return PLAIN.density(prepared.empty, state.own, later)


def _draw(
    prepared: Prepared, k: int, later: Array, values: Array, state: State, rng: np.random.Generator
) -> tuple[Array, float]:
    assert PLAIN.draw is not None
    return PLAIN.draw(_one(prepared, k, state, values)[0], 0, later, values, state.own, rng)


METHOD: Method[Prepared, State] = Method(
    name="conditionally-gaussian",
    source="Liptser and Shiryaev 1977, chapter 12; other priors: Makowski 1986",
    exactness="exact for y that is linear between observations",
    theorem=theorem,
    options={},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds=families.BOUNDS,
    valid=valid,
    handles=frozenset({CROSS_NOISE, INPUTS, JUMPS, KINKS, OBSERVED_PATH, SINC}),
    absolute=True,
    segment=segment,
    backward=Backward(_message, _step_back, _smoothed, _smoothed_density, None, _draw),
)
