"""The backward pass of the Gaussian families: what the observations after t say of the state at t.

With u = e^phi v, the density of the later observations given x, times e^phi, obeys the adjoint of the equation of v, and stays a
sum of exponentials, `numerics/gaussian/exponents.py`, all of one quadratic part.

It begins as e^phi at the last time.  The smoothed density is v times this message: a mixture of Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.methods._protocol import Backward, Info, Infos
from zakai.methods._states import field_of
from zakai.methods.gaussian.families import (
    Prepared,
    State,
    health_of,
    health_of_gaussian,
    health_of_gaussians,
    inputs_of,
    is_single,
)
from zakai.methods.gaussian.gauge import Tilts, posterior
from zakai.methods.gaussian.gauged_density import mixture_of
from zakai.methods.gaussian.paths import draw
from zakai.numerics.families import Family, weigh
from zakai.numerics.gaussian import backward as gaussian_backward
from zakai.numerics.gaussian.exponents import Exponents, adjoint
from zakai.numerics.transition import Array, at


def message(prepared: Prepared, state: State) -> Exponents:
    """Return the message at the last time.

    Raises:
        InputError: e^phi is no sum of exponentials.
    """
    gauge, setup, n = prepared.gauge, prepared.setup, prepared.model.n
    if not gauge.exact and not gauge.trivial:
        raise InputError(
            f"{prepared.model.source}: smooth: e^phi of this system is not a sum of exponentials, and its smoother needs that; "
            "take another method"
        )
    slopes, logs = np.zeros((1, n)), np.zeros(1)
    if not gauge.trivial:
        tilts = gauge.at_one(state.time)
        assert tilts.slopes is not None and tilts.logs is not None
        slopes, logs = tilts.slopes, tilts.logs
    matrix, slope = (np.zeros((n, n)), np.zeros(n)) if setup.quadratic is None else setup.quadratic
    return Exponents(np.zeros(n), logs, slopes + slope, np.broadcast_to(-matrix, (len(logs), n, n)))


@np.errstate(all="ignore")
def backward(prepared: Prepared, k: int, later: Exponents, values: Array, state: State) -> Exponents:
    """Return the message at the start of interval k from that at its end; `values` (m,) are what is observed."""
    ends, rows = prepared.ends, prepared.ends.observed[k]
    centre, logs, slopes, information = later
    if rows.any():
        white, H = (ends.whiten[k] @ values)[rows], ends.slope[k][rows]
        residual = white - ends.intercept[k][rows] - H @ centre
        constant = ends.constant[k] - 0.5 * residual @ residual + (0.5 * white @ white if ends.relative else 0.0)
        later = Exponents(centre, logs + constant, slopes + residual @ H, information + H.T @ H)
    if prepared.lengths[k] == 0:
        return later
    return adjoint(at(prepared.transitions, k), later, inputs_of(prepared, k, values), centre)


def _product(state: State, later: Exponents) -> tuple[Exponents, Family, Tilts]:
    """Return the message about the state's mean, the families weighed by its largest exponential, and the others' excess."""
    families = state.families
    own = later.around(families.mean[np.argmax(families.log_mass)])
    first = np.argmax(own.logs)
    shifted = families._replace(mean=families.mean - own.centre)
    weighed = weigh(shifted, own.information[first], own.slopes[first], own.logs[first])
    return own, weighed, Tilts(own.slopes[:0], own.slopes - own.slopes[first], own.logs - own.logs[first])


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: State, later: Exponents) -> tuple[Exponents, Info]:
    """Return the message, normalised so that its product with the state has mass one, and the moments of the product.

    The `log_likelihood_increment` is the logarithm of the mass before: the evidence of the observations that the message has
    gained since it was normalised.
    """
    own, families, tilts = _product(state, later)
    origin = own.centre + prepared.setup.origin
    if len(own.logs) == len(families.log_mass) == 1 and not families.nodes.shape[2]:
        log_mass, mean, cov = families.log_mass[0], families.mean[0], families.cov[0]
        health = health_of_gaussian(cov)
    else:
        found = posterior(prepared.gauge, tilts, state.time, families)
        log_mass, mean, cov, health = found.log_mass, found.mean, found.cov, health_of(state, families, found)
    return own._replace(logs=own.logs - log_mass), Info(log_mass, mean + origin, cov, health)


def density(prepared: Prepared, state: State, later: Exponents) -> GaussianMixture:
    """Return the smoothed density."""
    own, families, tilts = _product(state, later)
    found = posterior(prepared.gauge, tilts, state.time, families)
    return mixture_of(prepared.model, prepared.setup.origin + own.centre, families, found)


def segment(
    prepared: Prepared, rows: slice, states: Sequence[State], later: Exponents, values: Array
) -> tuple[Exponents, Infos] | None:
    """Take a message from the end of a slice of intervals to its start by the compiled loop, where there is one Gaussian."""
    if not is_single(prepared, states[0]) or len(later.logs) > 1:
        return None
    assert prepared.loop is not None
    means, covs = (np.array(field_of(states, name)[1:, 0]) for name in ("mean", "cov"))
    moved, masses = Exponents(*(np.array(field, order="C") for field in later)), np.empty(len(values))
    parts = (moved.centre, moved.information[0], moved.slopes[0], moved.logs)
    gaussian_backward.segment(rows.start, parts, *prepared.loop, np.ascontiguousarray(values), means, covs, masses)
    return moved, Infos(masses, means + prepared.setup.origin, covs, health_of_gaussians(covs))


BACKWARD: Backward[Prepared, State, Exponents] = Backward(message, backward, smoothed, density, segment, draw)
