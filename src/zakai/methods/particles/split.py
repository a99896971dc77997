"""Which states particles carry by a Kalman filter instead of by draws.

    du = (a + A v) dt + g_u dv,    the noise of u observes v where A is not zero:  G_uu must be regular there

Of the states that are linear given the others those are left to the draws that move another state which has no noise of its own:
a path of it would give them away, so that nothing is left to filter.  Moves of the past serve such states.
"""

from __future__ import annotations

from typing import NamedTuple

from zakai.algebra.conditionally_linear import conditionally_linear, gaussian_coordinates, moved_by
from zakai.algebra.identities import is_zero
from zakai.models.features import OBSERVED_PATH
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

MOST = 10  # linear states: a particle carries k (k + 1) / 2 entries of their covariance, each with a rate of k products


class Split(NamedTuple):
    """The numbers of the states that each particle carries by their mean and covariance, none where `reason` says why not.

    `coupled`: whether they move the others, so that the path of those says something about them.
    """

    linear: tuple[int, ...]
    reason: str
    coupled: bool = False


@once_for_a_model
def split_of(model: Model) -> Split:
    """Return the states that particles carry by a Kalman filter."""
    found = conditionally_linear(model)
    linear = [model.state.index(name) for name in found]
    if not linear:
        return Split((), "no state is linear given the others")
    if not found.given:
        return Split((), "all states are linear: kalman-bucy is exact")
    if not model.cross_noise.is_zero_matrix or OBSERVED_PATH in model.features:
        return Split((), "the noise of the state is correlated with that of the observations")
    rows = [j for j in range(model.m) if reads(model, j, linear)]
    if any(model.observation_noise[i, j] != 0 for i in rows for j in range(model.m) if i != j):
        return Split((), f"the noise of the observation {model.observation_names[rows[0]]} is correlated with that of another")
    quiet: list[str] = []
    while True:
        driven = [i for i in moved_by(model, linear) if model.covariance[i, i] == 0]
        if not driven:
            break
        quiet += [model.state[i] for i in driven if model.state[i] not in quiet]
        seen = set().union(*(model.drift[i].free_symbols for i in driven))
        linear = [i for i in linear if model.x[i] not in seen]
    if not linear:
        return Split((), f"{', '.join(quiet)}, without noise of its own, would give the linear states away")
    if len(linear) > MOST:
        return Split((), f"they are {len(linear)}, more than {MOST}")
    if is_coupled(model, linear):
        noisy = noisy_others(model, linear)
        if is_zero(model.covariance.extract(noisy, noisy).det()) is not False:
            return Split((), f"the noise of {', '.join(model.state[i] for i in noisy)} is singular")
    return Split(tuple(linear), "", bool(moved_by(model, linear)))


def reads(model: Model, j: int, linear: list[int]) -> bool:
    """Return whether observation j is Gaussian and its h contains a linear state."""
    own = {model.x[i] for i in linear}
    return gaussian_coordinates(model)[j] and bool(model.observation[j].free_symbols & own)


def noisy_others(model: Model, linear: list[int]) -> list[int]:
    """Return the states outside of the linear ones that have noise."""
    return [i for i in range(model.n) if i not in linear and model.covariance[i, i] != 0]


def is_coupled(model: Model, linear: list[int]) -> bool:
    """Return whether the noise of the others says something about the linear states."""
    others = [i for i in range(model.n) if i not in linear]
    return bool(moved_by(model, linear)) or any(model.covariance[i, j] != 0 for i in others for j in linear)
