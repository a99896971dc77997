"""Bayes' rule for a predicted density: one build in the frame of the product, by powers of a sharp or distant likelihood."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zakai.methods.frame.build import CLOUD, Builder
from zakai.methods.frame.chain import Prediction
from zakai.methods.frame.placement import Mass
from zakai.methods.frame.state import Choice
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.carried import Carried, Likelihood
from zakai.numerics.trains.train import Train

FEW = 30.0  # effective points of the prediction that a likelihood must leave, or powers of it are taken
MOST_POWERS = 24  # an observation sixty deviations away needs fifteen
DEPTH_POINTS, APART = 128, 3  # an odd distance leaves quasi-random points evenly spread
ROUGHLY = 0.01  # relative error that densities between powers of a likelihood need: they only show where the mass is
OFF_CENTRE, NARROW, WIDE = 0.5, 0.6, 1.6  # shift and deviation of a density in its frame, from which it gets another frame
LOST = 3.0  # shift in that other frame, from which the density is in a corner of its box


class Updated(NamedTuple):
    """A density of mass one, the log of the evidence, the share of the points left, the powers taken, and the prediction used.

    `top` is the log of the largest likelihood, `choice` how the density was built where choices are kept.
    """

    density: Train
    log_evidence: float
    effective: float
    powers: int
    prediction: Carried
    top: float
    choice: Choice | None


def update(builder: Builder, prediction: Prediction, likelihood: Likelihood) -> Updated:
    """Return the density after an observation.

    Every build is one of the prediction times a power of the likelihood, never of a product that was built before.
    """
    motion, mass = builder.prepared.motion, prediction.mass
    if not likelihood.counted.any():
        v, _ = builder.build(prediction.function, mass)
        return _normalised(builder, v, prediction, 0.0, 1.0, 0)
    logs = motion.logs(likelihood, mass.points)
    if not np.isfinite(logs).any():
        raise Unresolved("the observation is impossible everywhere in the predicted density")
    effective = mass.reweighted(logs).effective / mass.effective
    done, powers = 0.0, 0
    if mass.reweighted(_finite(logs)).effective < FEW:
        # The likelihood is sharp or distant: it may need the tails.
        prediction = replace(prediction, function=prediction.function.with_tails(builder.tails))
    loose = max(1.0, ROUGHLY / builder.rule.tolerance)
    while mass.reweighted((1.0 - done) * _finite(logs)).effective < FEW and powers < MOST_POWERS:
        power = min(done + (1.0 - done) * mass.power((1.0 - done) * _finite(logs), 1.5 * FEW), 1.0)
        v, _ = _product(builder, prediction, mass.reweighted((power - done) * _finite(logs)), likelihood, power, loose)
        mass = Mass(*v.cloud(CLOUD))
        logs, done, powers = motion.logs(likelihood, mass.points), power, powers + 1
        if not np.isfinite(logs).any():
            raise Unresolved("the observation is impossible everywhere in the predicted density")
    mass = mass.reweighted((1.0 - done) * _finite(logs))
    v, top = _product(builder, prediction, mass, likelihood, 1.0, 1.0)
    if _off_centre(v):
        v, top = _product(builder, prediction, Mass(*v.cloud(CLOUD)), likelihood, 1.0, 1.0)
        if not np.abs(_in_frame(v)[0]).max() < LOST:
            raise Unresolved("the density after the observation is at the edge of its grid")
    return _normalised(builder, v, prediction, top, effective, powers)


def _finite(logs: Array) -> Array:
    """Return logarithms with a number where they are -inf: powers of zero are zero."""
    return np.maximum(logs, np.max(logs) - 1e6)


def _product(
    builder: Builder, prediction: Prediction, mass: Mass, likelihood: Likelihood, power: float, loose: float
) -> tuple[Train, float]:
    """Return the prediction times a power of the likelihood over its largest value on the mass, and the log of that value."""
    if not np.isfinite(mass.weights).all():
        raise Unresolved("the density has no mass on the way to the observation")
    logs = builder.prepared.motion.logs(likelihood, mass.points)
    top = power * float(np.max(logs[mass.weights > 1e-3 * mass.weights.max()]))
    function = prediction.function.times(likelihood._replace(power=power, top=top))
    v, _ = builder.build(function, mass, loose=loose)
    return v, top


def _normalised(
    builder: Builder, v: Train, prediction: Prediction, top: float, effective: float, powers: int
) -> Updated:
    total = v.mass
    if not total > 0 or not math.isfinite(total):
        raise Unresolved(f"the density has mass {total:.1g} after the observation")
    log_evidence = math.log(total) + top + prediction.log_scale
    return Updated(v.scaled(1.0 / total), log_evidence, effective, powers, prediction.function, top, builder.choice(v))


def _off_centre(v: Train) -> bool:
    """Return whether the moments of a density are far from those of its frame."""
    shift, scale = _in_frame(v)
    return bool(((np.abs(shift) > OFF_CENTRE) | (scale < NARROW) | (scale > WIDE)).any())


def _in_frame(v: Train) -> tuple[Array, Array]:
    """Return the means and the deviations of a density along the axes of its frame; zero and one on closed axes."""
    grid = v.grid
    mean, P = v.moments()
    shift = np.linalg.solve(grid.basis, mean - grid.centre)
    scale = np.sqrt(np.maximum(np.diag(np.linalg.solve(grid.basis, np.linalg.solve(grid.basis, P).T)), 0.0))
    return np.where(grid.closed, 0.0, shift), np.where(grid.closed, 1.0, scale)


def depth_of(u: Carried, mass: Mass, posterior: Train, tolerance: float) -> float:
    """Return log(max u / u) where the posterior is, of a prediction known to a share of max u; zero for equal Gaussians."""
    points, weights = Mass(*posterior.cloud(CLOUD)).part(DEPTH_POINTS)
    values = u(np.concatenate([points, mass.points[:, ::APART]], axis=1))
    values = np.where(values > 0, values, tolerance * values.max())  # no more is known of it where it is not positive
    return float(math.log(values.max()) - weights @ np.log(values[: len(weights)]) - 0.5 * len(points))
