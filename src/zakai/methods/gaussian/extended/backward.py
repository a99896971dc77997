"""The extended Rauch-Tung-Striebel smoother: the filter's linearisation, backward in time.

Over a part of an interval in which the filter goes from N(m, P) to N(n, Q), with dx/dx0 = M, the smoothed moments m', P' follow
from n', Q' at its end,

    m' = m + J (n' - n),    P' = P + J (Q' - Q) J',    J = P M' Q^-1.

What is observed changes the filter's moments, not the smoothed ones.
"""

from __future__ import annotations

import numpy as np

from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.methods._protocol import Info
from zakai.methods.gaussian.extended import filter as ahead
from zakai.methods.system.prior_moments import wrapped
from zakai.numerics.transition import Array


def message(prepared: ahead.Prepared, state: ahead.State) -> ahead.State:
    """Return the smoothed moments at the last time: the filter's.

    Raises:
        InputError: riccati="euler".
    """
    if prepared.riccati == "euler":
        raise InputError(f'{prepared.model.source}: smooth: riccati="euler" has no backward pass; take "stable"')
    return state


@np.errstate(all="ignore")
def step(prepared: ahead.Prepared, k: int, later: ahead.State, values: Array, state: ahead.State) -> ahead.State:
    """Return the smoothed moments at the start of interval k from those at its end."""
    moves: list[ahead.Moved] = []
    ahead.step(prepared, k, state, values, moves.append)
    for before, after, matrix in reversed(moves):
        scale = np.sqrt(np.maximum(np.diagonal(after.cov), 1e-300))
        inverse = np.linalg.pinv(after.cov / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        gain, apart = before.cov @ matrix.T @ inverse, wrapped(prepared.model, later.mean - after.mean)
        cov = before.cov + gain @ (later.cov - after.cov) @ gain.T
        later = ahead.State(wrapped(prepared.model, before.mean + gain @ apart), 0.5 * (cov + cov.T))
    return later


def smoothed(prepared: ahead.Prepared, state: ahead.State, later: ahead.State) -> tuple[ahead.State, Info]:
    """Return the moments and their report, without an evidence: the backward pass has none of its own."""
    return later, ahead.info_of(later, np.nan)


def density(prepared: ahead.Prepared, state: ahead.State, later: ahead.State) -> GaussianMixture:
    """Return the Gaussian."""
    return ahead.density(prepared, later)
