"""One step of the frame filter, and the prior with which it begins.

Stable for other files: `State`, `Prepared` (state.py), `Builder.build` (build.py), `Chain.predict` (chain.py), `update`
(update.py), and `Train` with `Carried` (numerics/trains).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import TensorTrainDensity
from zakai.densities._values import wrap
from zakai.methods._protocol import Info
from zakai.methods.frame import again
from zakai.methods.frame.build import CLOUD, Builder
from zakai.methods.frame.chain import MOST_SUBSTEPS, Chain, Prediction, extrapolated
from zakai.methods.frame.errors import Error, root_of
from zakai.methods.frame.moves import Shift
from zakai.methods.frame.placement import Mass
from zakai.methods.frame.state import Choice, Control, Made, Prepared, State, Substeps
from zakai.methods.frame.time_error import measured
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.frame.update import depth_of, update
from zakai.methods.particles.programs import Array
from zakai.methods.system.escape_of_states import RARE, check_escape
from zakai.models.prior import DensityPrior
from zakai.numerics.trains.carried import Likelihood
from zakai.numerics.trains.train import Train, quasi_random

PRIOR_POINTS, BLOCK = 1024, 1024
# Substeps are chosen for this share of the tolerance.  What is extrapolated has a third to a twentieth of the error.
SAFETY, GAIN = 0.5, 4.0
IN_TAILS = 0.03  # error of a mean over tolerance e^depth: linear tracks with observations 4 and 6 deviations away
BEYOND = 0.3  # error of a mean over the distance of an observation, where a Gaussian stands for the tails
OF_MEAN = 0.6  # error of a mean over what a motion loses of the mass and what is near an edge
DEEP, SHARPEST = 2.0, 0.03  # depth in nats from which a prediction has a smaller tolerance, and the least factor of it
UNKNOWN = 1e3  # deviations of an error of which nothing is known
WITHIN = 3.0  # tolerances that the error of a mean may reach
FIGURES = (
    "error_estimate", "tolerance_ratio", "rank", "mass_defect", "off_grid_error", "edge_mass", "tail_depth", "powers",
    "substeps", "time_error", "effective_share",
)  # fmt: skip


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior on a grid."""
    model, system, theta = prepared.model, prepared.system, prepared.theta
    builder = Builder(prepared)
    density, mass = _density_prior(prepared, prior) if isinstance(prior, DensityPrior) else _mixture(prepared, prior)

    def function(x: Array) -> Array:
        values = density(x)
        inside = ((x >= system.lower[:, None]) & (x <= system.upper[:, None])).all(axis=0)
        return np.where(inside & np.isfinite(values), values, 0.0)

    choices, key = prepared.choices, (tuple(model.state), -1)
    known = None if choices is None else choices.made.get(key)
    if isinstance(known, Choice):
        return again.begun(prepared, function, known)
    v, _ = builder.build(function, mass)
    if choices is not None and (made := builder.choice(v)) is not None:
        choices.made[key] = made
    assert model.n == len(mass.points) and len(theta) == len(prepared.theta)
    _, P = mass.unwrapped(system.base.angles).moments()
    error = builder.missed.after(np.zeros(len(builder.missed.relative)), P, system.base.angles)
    control = Control(0, Substeps(1.0, 0.0), error)
    return State.of(v.scaled(1.0 / v.mass), control)


def _mixture(prepared: Prepared, prior: Any) -> tuple[Callable[[Array], Array], Mass]:
    """Return a Gaussian mixture as a function, and points of it."""
    from scipy.special import ndtri

    weights, means, covs = (np.asarray(part, float) for part in prior.components)
    n, angles = prepared.model.n, prepared.system.base.angles
    roots = []
    for cov in covs:
        # A direction without variance has the width of rounding.
        scale = np.sqrt(np.maximum(np.diag(cov), 0.0))
        scale = np.where(scale > 0, scale, 1e-6 * max(float(scale.max()), 1e-6))
        unit = cov / np.outer(scale, scale)
        np.fill_diagonal(unit, 1.0)
        roots.append(scale[:, None] * np.linalg.cholesky(unit + 1e-10 * np.eye(n)))
    inverses = [np.linalg.inv(root) for root in roots]
    factors = [w / (abs(np.linalg.det(root)) * (2 * math.pi) ** (n / 2)) for w, root in zip(weights, roots, strict=True)]

    turns = itertools.product(*[(-2 * np.pi, 0.0, 2 * np.pi) if angle else (0.0,) for angle in angles])
    images = [np.array(turn) for turn in turns]

    alike = len(weights) > 16 and all(np.array_equal(cov, covs[0]) for cov in covs)
    centres = inverses[0] @ means.T

    def of_kernels(x: Array) -> Array:
        """Return the density of many components with one covariance."""
        total = np.zeros(x.shape[1])
        for image in images:
            white = inverses[0] @ (x + image[:, None])
            for first in range(0, x.shape[1], BLOCK):
                part = white[:, first : first + BLOCK]
                squares = (part**2).sum(axis=0)[:, None] - 2.0 * part.T @ centres + (centres**2).sum(axis=0)
                total[first : first + BLOCK] += np.exp(-0.5 * squares) @ np.array(factors)
        return total

    def density(x: Array) -> Array:
        if alike and not angles.any():
            return of_kernels(x)
        total = np.zeros(x.shape[1])
        for factor, mean, inverse in zip(factors, means, inverses, strict=True):
            apart = x - mean[:, None]
            if angles.any():
                apart[angles] = wrap(apart[angles])
            for image in images:
                total += factor * np.exp(-0.5 * ((inverse @ (apart + image[:, None])) ** 2).sum(axis=0))
        return total

    count = max(4, PRIOR_POINTS // len(weights))
    normal = ndtri(np.clip(quasi_random(count, n), 1e-9, 1 - 1e-9))
    points = np.concatenate([mean[:, None] + root @ normal for mean, root in zip(means, roots, strict=True)], axis=1)
    return density, Mass(points, np.repeat(weights / weights.sum() / count, count))


def _density_prior(prepared: Prepared, prior: DensityPrior) -> tuple[Callable[[Array], Array], Mass]:
    """Return a density that is given by a formula or on a grid as a function, and points of it."""
    from zakai.methods.system.prior_moments import density_grid, prior_moments
    from zakai.models.numeric import numpy_function

    model, theta = prepared.model, prepared.theta
    if model.n > 4:
        prior_moments(model, prior, theta)  # which says what to do
    grid = density_grid(model, prior, theta, 1e-9)
    logs = grid.log_values.ravel()
    top = float(logs.max())
    log_density = numpy_function(prior.log_density, model)
    weights = np.exp(logs - top)
    keep = weights > 1e-12
    mass = Mass(np.ascontiguousarray(grid.points.reshape(-1, model.n)[keep].T), weights[keep] / weights[keep].sum())
    return lambda x: np.exp(np.asarray(log_density(x.T, model.start, theta)) - top), mass


def direction_of(prepared: Prepared, u: Train) -> Array | None:
    """Return the mean directions of angles (n,), NaN for other states; None where there is no angle."""
    angles = prepared.system.base.angles
    if not angles.any():
        return None
    found = np.full(len(angles), np.nan)
    places = np.flatnonzero(angles)
    resultant = u.characteristic(u.grid.basis[places]) * np.exp(1j * u.grid.centre[places])
    found[places] = np.where(np.abs(resultant) > 1e-9, np.angle(resultant), 0.0)
    return found


def density(prepared: Prepared, state: State) -> TensorTrainDensity:
    """Return the density."""
    model = prepared.model
    periodic = tuple(name in model.periodic for name in model.state)
    return TensorTrainDensity(prepared.train(state), model.state, periodic)


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Return the state after interval k of the schedule and what is observed at its stop, and what the step reports."""

    def check(infinity: bool) -> None:
        check_escape(prepared, k, lambda: prepared.train(state).moments(), infinity)

    if np.isnan(state.cores[0]).any():  # a density that is lost stays lost
        return _lost(prepared, state)
    check(infinity=False)
    try:
        after, lost = _step(prepared, k, state, values)
        if lost > 0.5 * RARE:
            check(infinity=True)
        return after
    except (Unresolved, np.linalg.LinAlgError):
        check(infinity=True)
        return _lost(prepared, state)


def figures_of(prepared: Prepared) -> tuple[str, ...]:
    """Return the names of the health figures of a system."""
    return (*FIGURES, "outside_tables") if prepared.system.base.outside else FIGURES


def _lost(prepared: Prepared, state: State) -> tuple[State, Info]:
    """Return a state whose density is lost, and its report."""
    n = len(state.cores)
    state = state._replace(cores=tuple(np.full_like(core, math.nan) for core in state.cores))
    return state, Info(math.nan, np.full(n, math.nan), np.full((n, n), math.nan), dict.fromkeys(figures_of(prepared), math.nan))


def _step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[tuple[State, Info], float]:
    """Return the step, and the share of the mass that the motion loses."""
    interval, control = prepared.interval(k), state.control
    choices, key = prepared.choices, (tuple(prepared.model.state), control.interval)
    known = None if choices is None else choices.made.get(key)
    if isinstance(known, Made):
        return again.step(Chain(prepared, interval, values, Builder(prepared)), state, known, figures_of(prepared)), 0.0
    builder = builder_of(prepared, state)
    chain = Chain(prepared, interval, values, builder)
    likelihood = prepared.motion.likelihood(interval, values)
    prediction, count, time, in_time, of_time = predicted(chain, state, likelihood)
    updated = update(builder, prediction, likelihood)
    v, rule = updated.density, builder.rule
    if choices is not None and updated.choice is not None and not any(isinstance(move, Shift) for move in chain.moves):
        tails = updated.prediction.terms[0].density.tails
        choices.made[key] = Made(prediction.motions, tails, updated.top, updated.choice)
    mean, cov = v.moments(direction_of(prepared, v))
    depth = depth_of(updated.prediction, prediction.mass, v, rule.tolerance)
    reports = builder.reports
    off_grid, edge = sum(report.off_grid for report in reports), max(report.edge for report in reports)
    # Far out a density is known relative to its largest value only; beyond, a Gaussian stands for it.
    far = min(IN_TAILS * rule.tolerance * math.exp(min(depth, 50.0)), BEYOND * math.sqrt(2.0 * max(depth, 0.0)))
    new = math.hypot(OF_MEAN * (prediction.defect + edge), far)
    angles = prepared.system.base.angles
    own = builder.missed.after(np.zeros(len(builder.missed.relative)), cov, angles).plus(of_time)
    for factor, missed in prediction.missed:
        own = own.plus(missed.after(prepared.motion.logs(likelihood, missed.mass.points), cov, angles), factor)
    m, P = prediction.mass.unwrapped(angles).moments()
    root, before, after = root_of(P), root_of(prepared.train(state).moments()[1]), root_of(cov)
    shift = mean - m
    shift[angles] = wrap(shift[angles])
    errors = control.error.along(np.linalg.solve(root, prediction.slope @ before))
    errors = errors.seen(np.linalg.solve(root, after), np.linalg.solve(root, shift)).plus(own)
    errors = errors.plus(Error.by_chance(len(mean), new))
    error = errors.in_deviations(after)
    health = {
        "error_estimate": error,
        "tolerance_ratio": error / (WITHIN * prepared.tolerance),
        "rank": float(max(report.rank for report in reports)),
        "mass_defect": prediction.defect,
        "off_grid_error": off_grid,
        "edge_mass": edge,
        "tail_depth": depth / math.log(1.0 / rule.tolerance),
        "powers": float(updated.powers),
        "substeps": float(count),
        "time_error": in_time,
        "effective_share": updated.effective,
    }
    outside = prepared.system.base.outside
    if outside:
        u = None if interval.inputs is None else interval.inputs.at(interval.stop, prepared.model.input_hold)
        points, weights = v.cloud(CLOUD)
        health["outside_tables"] = float(weights[outside(points.T, interval.stop, prepared.theta, u)].sum() / weights.sum())
    lost = max(chain.lost, prediction.defect)
    prepared.recent.train = v
    control = Control(control.interval + 1, time, errors, builder.after())
    return (State.of(v, control), Info(updated.log_evidence, mean, cov, health)), lost


def error_of(prepared: Prepared, state: State) -> float:
    """Return the estimated error of the mean of a state, in standard deviations."""
    return state.control.error.in_deviations(root_of(prepared.train(state).moments()[1]))


def builder_of(prepared: Prepared, state: State) -> Builder:
    """Return what builds the densities of the interval that follows on a state."""
    return Builder(prepared, error_of(prepared, state), state.control.looser)


class Predicted(NamedTuple):
    """A prediction, the number of its substeps, how the next are divided, and the error of substeps after the observation."""

    prediction: Prediction
    substeps: int
    time: Substeps
    in_time: float
    error: Error


def predicted(chain: Chain, state: State, likelihood: Likelihood) -> Predicted:
    """Return the prediction over an interval; that of a smaller tolerance where a likelihood leads into its tails."""
    found, builder = _predicted(chain, state, likelihood), chain.builder
    mass = found.prediction.mass.unwrapped(chain.prepared.system.base.angles)
    depth = mass.depth(chain.prepared.motion.logs(likelihood, mass.points))
    if depth > DEEP:
        builder.reports.clear()
        builder.sharper = max(math.exp(-depth), SHARPEST)
        found = _predicted(chain, state, likelihood)
        builder.sharper = 1.0
    return found


def _predicted(chain: Chain, state: State, likelihood: Likelihood) -> Predicted:
    """Return the prediction over an interval, whose substeps meet the tolerance where a likelihood leads."""
    base, interval, time = chain.prepared.system.base, chain.interval, state.control.time
    u, length = chain.prepared.train(state), interval.stop - interval.start
    nothing = Error.zero(u.grid.n)
    if length <= 0 or (base.affine and base.sampled and not base.driven):
        prediction, count = chain.first(u, 1)
        return Predicted(prediction, count, time, 0.0, nothing)
    allowed = SAFETY * chain.builder.left
    guess = length * time.substeps / time.length if time.length > 0 else 1.0
    count = min(max(1, math.ceil(guess - 1e-9)), MOST_SUBSTEPS)
    for _ in range(4):
        found = measured(chain, u, count, likelihood)
        error = math.inf if found is None else found.size
        # s substeps have an error of second order, what is extrapolated one of fourth; three times as many are needed for it.
        change = min(error / allowed, MOST_SUBSTEPS**2)
        plain, both = count * math.sqrt(change), count * (0.75 / GAIN * change) ** 0.25
        extrapolate = plain > 3.0 * max(both, 1.0)
        wanted = min(max(1, math.ceil((both if extrapolate else plain) - 1e-9)), MOST_SUBSTEPS)
        if not math.isfinite(error):  # the drift leads to infinity, in however many substeps
            wanted = count
        if count <= 2 * wanted <= 4 * count:
            break
        count = wanted
    try:
        prediction, count = chain.first(u, wanted)
    except (Unresolved, np.linalg.LinAlgError):  # where a part of the density reaches infinity, fewer substeps hold the rest
        prediction, count = chain.first(u, 1)
    time = Substeps(both if extrapolate else plain, length)
    gain = 1.0
    if extrapolate:
        prediction, gain = _extrapolated(chain, u, prediction, count), 0.75 / GAIN
    if found is None:
        return Predicted(prediction, count, time, math.inf, Error.by_chance(u.grid.n, UNKNOWN))
    gain *= (found.substeps / count) ** 2
    return Predicted(prediction, count, time, gain * error, found.error.scaled(gain))


def _extrapolated(chain: Chain, u: Train, coarser: Prediction, count: int) -> Prediction:
    """Return the prediction extrapolated from s and 2 s substeps."""
    finer, _ = chain.first(u, 2 * count)
    missed = [(4.0 / 3.0 * factor, part) for factor, part in finer.missed]
    missed += [(-1.0 / 3.0 * factor, part) for factor, part in coarser.missed]
    function, motions = extrapolated(finer, coarser), (*finer.motions, *coarser.motions)
    return Prediction(function, finer.mass, finer.log_mass, finer.defect, finer.slope, motions, tuple(missed))
