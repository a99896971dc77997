"""The backward pass of the Gaussian-sum methods: what the observations after t say of the state at t.

In the gauge u = e^phi v, the message psi = e^phi p(later observations | x) obeys the adjoint of the equation of v, and is kept as
a sum of exponentials of quadratics, of which each is moved exactly.  The observations multiply psi g, with a Gaussian g that
covers the filter's density (Briers, Doucet and Maskell 2010): a Gaussian sum, which is split, merged and refitted as that of the
filter.  The smoothed density is v psi.

Two distances estimate its error: from the product of psi with the filter's second sum, and from the product of v and psi before
the observation, which multiplies psi there and v after it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.methods._protocol import Backward, Info
from zakai.methods.gaussian.paths import drawn, given_end
from zakai.methods.sums import start
from zakai.methods.sums.intervals import Prepared, inputs_of
from zakai.methods.sums.update import move
from zakai.models.prior import GaussianPrior
from zakai.numerics.flow import at
from zakai.numerics.gaussian.exponents import Exponents, adjoint, product, quotient
from zakai.numerics.sums.mixture import (
    Array,
    Components,
    components,
    moments,
    selected,
    shares,
    weighed,
    wrapped,
)

WIDER = 3.0  # variance of g relative to that of the filter's density
FLAT = 2  # directions in which a Gaussian is cut into many
NEGLIGIBLE = 1e-14  # share of a Gaussian of a smoothed density that is left out
LEAST = 1e-9  # variance of g along an axis relative to that of the prior
OF_OBSERVATIONS = ("nonlinearity", "quadrature", "pruned", "merged", "without_law", "outside_tables", "tail_depth")
FIGURES = ("mean_error", "deviation_error", "start_error", "edge_weight", *OF_OBSERVATIONS)


class Message(NamedTuple):
    """psi in z = x - origin, the health of the last observation, and the smoothed mean (n,) and covariance (n, n), if known."""

    psi: Exponents
    health: Mapping[str, float]
    mean: Array | None = None
    cov: Array | None = None


def message(prepared: Prepared, state: Any) -> Message:
    """Return the message at the last time, e^phi.

    Raises:
        InputError: the reduction may give a sum with negative parts.
    """
    static = prepared.static
    if not static.split_merge:
        raise InputError(
            f'{static.model.source}: smooth: reduction="{static.reduction}" has no backward pass; take "split-merge"'
        )
    return Message(_last(prepared, state.first, state.time, int(state.most[0])), dict.fromkeys(FIGURES, 0.0))


def _last(prepared: Prepared, v: Components, time: float, most: int) -> Exponents:
    """Return e^phi as a sum of exponentials: as it is, or cut into at most `most` that are narrow where h is curved.

    Samples cut it themselves; in more directions than `FLAT` the sum of the narrow ones would not be flat.
    """
    static, theta, origin = prepared.static, prepared.theta, prepared.static.system.origin
    gauge, n = static.gauge, static.model.n
    mean, cov = _cover(prepared, v, time)
    cut = static.directions.shape[1] and not static.split_before and static.start_directions.shape[1] <= FLAT
    if not cut and (gauge.none or gauge.exact):
        constants, slopes = gauge.terms(time, theta)
        return Exponents(np.zeros(n), constants, slopes, np.zeros((len(constants), n, n))).around(mean)
    doubt = None if gauge.none else lambda u: gauge.doubt(u, time, theta)
    far = static.affine and static.asked is None
    g = GaussianPrior(origin + mean, cov)
    narrow, _ = start.cut_prior(static.model, g, static.start_directions, origin, theta, doubt, far)
    narrow = gauge.lift(narrow, time, theta)
    share = shares(narrow)[0]
    loss = replace(prepared.first(), static=static.plain, time=time).losses(narrow, share)
    return quotient(start.merged(narrow, share, loss, most, ()), mean, cov)


def _cover(prepared: Prepared, v: Components, time: float) -> tuple[Array, Array]:
    """Return the mean (n,) and the covariance (n, n) of g.

    Where every product is exact g is narrow, so that its product with any message is a Gaussian.
    """
    static = prepared.static
    u = static.gauge.lift(v, time, prepared.theta)
    mean, cov = moments(shares(u)[0], u.means, u.covs, static.angles)
    scale = np.where(static.system.scale > 0, static.system.scale, 1.0)
    if static.directions.shape[1]:
        cov = WIDER * cov
    else:
        cov = v.covs[np.argmin(np.trace(v.covs / np.outer(scale, scale), axis1=1, axis2=2))]
    return mean, cov + np.diag(LEAST * scale**2)


def _near(psi: Exponents, centre: Array, angles: tuple[int, ...]) -> Exponents:
    """Return a message about another centre; angles are taken at the turn that is nearest to it."""
    return psi._replace(centre=centre - wrapped(centre - psi.centre, angles)).around(centre)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, later: Message, values: Array, state: Any) -> Message:
    """Return the message at the start of interval k."""
    try:
        return _back(prepared, k, later, values, state.first, int(state.most[0]))
    except np.linalg.LinAlgError:
        return Message(later.psi._replace(logs=later.psi.logs * np.nan), dict.fromkeys(FIGURES, np.nan))


def _back(prepared: Prepared, k: int, later: Message, values: Array, v: Components, most: int) -> Message:
    """Return the message at the start of interval k, where the filter has v."""
    static, psi, factor, health = prepared.static, later.psi, prepared.whole.factors[k], dict.fromkeys(FIGURES, 0.0)
    schedule, transition = prepared.whole.schedule, at(prepared.whole.transitions, k)
    t0, t1 = float(schedule.starts[k]), float(schedule.stops[k])
    mean, cov = _cover(prepared, v, t0)
    if factor.before is not None:
        v = prepared.moment(k, t0).multiply(v, factor, values, start=True).sum
    if t1 > t0:
        inputs = inputs_of(static, schedule, k, values)
        v = move(transition, v, inputs, static.angles)
    if factor.energy is not None or factor.after is not None or factor.law is not None:
        g = _cover(prepared, v, t1)
        now = replace(prepared.moment(k, t1), static=static.plain)
        covered, info = now.update(_covered(psi, *g, static.angles), factor, values, most, np.zeros(0), 0.0)
        covered = covered._replace(log_weights=covered.log_weights + info.log_likelihood_increment)
        psi = quotient(covered, *g)
        health |= {name: info.health[name] for name in OF_OBSERVATIONS}
        if later.mean is not None and later.cov is not None:
            health |= _distances(later.mean, later.cov, *_moments(prepared, v, psi)[2:], static.angles)
    if t1 > t0:
        psi = _near(psi, transition.map @ mean + transition.offset @ inputs, static.angles)
        psi = adjoint(transition, psi, inputs, mean)
    if factor.before is not None:
        now = replace(prepared.moment(k, t0), static=static.plain)
        product_ = now.multiply(_covered(psi, mean, cov, static.angles), factor, values, start=True)
        psi = quotient(product_.sum, mean, cov)
    return Message(psi, health)


def _covered(psi: Exponents, mean: Array, cov: Array, angles: tuple[int, ...]) -> Components:
    """Return psi g."""
    return product(components([0.0], mean[None], cov[None]), _near(psi, mean, angles))


def _product(prepared: Prepared, v: Components, psi: Exponents) -> Components:
    """Return v psi, the smoothed density: the products of the first component first."""
    angles = prepared.static.angles
    near = v._replace(means=psi.centre + wrapped(v.means - psi.centre, angles))
    found = product(near, psi)
    return found._replace(means=wrapped(found.means, angles))


def _moments(prepared: Prepared, v: Components, psi: Exponents) -> tuple[Array, Any, Array, Array]:
    """Return the shares of the Gaussians of v psi, the logarithm of its mass, its mean and its covariance."""
    pairs = _product(prepared, v, psi)
    share, log_mass = shares(pairs)
    return share, log_mass, *moments(share, pairs.means, pairs.covs, prepared.static.angles)


def _distances(mean: Array, cov: Array, other: Array, companion: Array, angles: tuple[int, ...]) -> dict[str, float]:
    """Return the distances of two means, in deviations, and of two deviations."""
    deviations, others = (np.sqrt(np.maximum(np.diagonal(one), 1e-300)) for one in (cov, companion))
    return {
        "mean_error": float(np.max(np.abs(wrapped(mean - other, angles)) / deviations)),
        "deviation_error": float(np.max(np.abs(others / deviations - 1.0))),
    }


@np.errstate(all="ignore")
def smoothed(prepared: Prepared, state: Any, later: Message) -> tuple[Message, Info]:
    """Return the message, normalised, and the moments and the health of its product with the state."""
    try:
        return _smoothed(prepared, state, later)
    except np.linalg.LinAlgError:
        nothing = np.full((prepared.static.model.n,) * 2, np.nan)
        return later, Info(np.nan, nothing[0], nothing, dict.fromkeys(FIGURES, np.nan))


def _smoothed(prepared: Prepared, state: Any, later: Message) -> tuple[Message, Info]:
    static, psi, health = prepared.static, later.psi, dict(later.health)
    share, log_mass, mean, cov = _moments(prepared, state.first, psi)
    if len(state.second.signs):
        for name, distance in _distances(mean, cov, *_moments(prepared, state.second, psi)[2:], static.angles).items():
            health[name] = max(health[name], distance)
    edge = np.repeat(state.edge, len(psi.logs))
    health |= {"start_error": state.start_error, "edge_weight": float(edge @ share) if len(edge) == len(share) else 0.0}
    own = Message(psi._replace(logs=psi.logs - log_mass), later.health, mean, cov)
    return own, Info(log_mass, wrapped(static.system.origin + mean, static.angles), cov, health)


def density(prepared: Prepared, state: Any, later: Message) -> GaussianMixture:
    """Return the smoothed density."""
    static = prepared.static
    pairs = _product(prepared, state.first, later.psi)
    share = shares(pairs)[0]
    kept = share > NEGLIGIBLE
    pairs, periodic = selected(pairs, kept), tuple(name in static.model.periodic for name in static.model.state)
    means = wrapped(static.system.origin + pairs.means, static.angles)
    return GaussianMixture(share[kept] / share[kept].sum(), means, pairs.covs, static.model.state, periodic)


@np.errstate(all="ignore")
def draw(prepared: Prepared, k: int, later: Array, values: Array, state: Any, rng: np.random.Generator) -> tuple[Array, float]:
    """Return draws (P, n) of the state at the start of interval k given those at its end: exact for the filtered sum."""
    static, schedule, factor = prepared.static, prepared.whole.schedule, prepared.whole.factors[k]
    if schedule.lengths[k] == 0:
        return later, 0.0
    v, origin, own = state.first, static.system.origin, at(prepared.whole.transitions, k)
    if factor.before is not None:
        v = prepared.moment(k, float(schedule.starts[k])).multiply(v, factor, values, start=True).sum
    inputs = inputs_of(static, schedule, k, values)
    v = weighed(v, 0.0, own.vector @ inputs, own.information)
    z = later - origin - own.offset @ inputs
    parts = [given_end(v.log_weights[[i]], v.means[[i]], v.covs[i], own, z, static.angles) for i in range(len(v.signs))]
    return wrapped(origin + drawn(static.model.source, parts, v.signs, rng), static.angles), 0.0


def accuracy(prepared: Prepared) -> float:
    """Return the error of the evidence of an interval beyond which a result warns."""
    return 1e-2 if prepared.static.directions.shape[1] else 1e-6


BACKWARD: Backward[Prepared, Any, Message] = Backward(message, step, smoothed, density, draw=draw, accuracy=accuracy)
