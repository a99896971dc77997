"""The filter of a linear-quadratic system with affine observations: families of Gaussians, every step exact.

Kalman-Bucy, Benes and Hu-Yau are this filter for phi = 0, phi = log cosh and any phi that leaves the potential quadratic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import Density
from zakai.errors import InputError
from zakai.methods._protocol import Info, Infos
from zakai.methods._states import StackedStates
from zakai.methods.gaussian.affine_system import AffineSystem, Setup, affine_system_of
from zakai.methods.gaussian.ends import Ends, ends_of
from zakai.methods.gaussian.family_prior import prior_families
from zakai.methods.gaussian.gauge import Gauge, Posterior, Tilts, posterior, tilts_at
from zakai.methods.gaussian.gauged_density import density_of
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.numerics.complex_step import is_complex
from zakai.numerics.families import Family, exponents, move, observe, weigh
from zakai.numerics.gaussian.step import Loop, segment
from zakai.numerics.transition import Array, Transition, at
from zakai.records.schedule import Schedule

_LATE = "cross_noise is omitted for increments that were gathered over more than their interval, as if dv and dw were independent"
_KEPT = 8  # values of the parameters for which a model's setup is kept

BOUNDS: Mapping[str, tuple[float, str]] = {
    "negative_variance": (1e-9, "a variance below zero, as a share of the largest: rounding exceeds the smallest variance"),
    "representation_error": (1e-8, "error of the prior's nodes, relative to the posterior"),
    "edge_weight": (1e-8, "weight of the outermost nodes: the posterior reaches beyond the prior's nodes"),
    "gauge_error": (1e-8, "error of the sums over the directions of the gauge"),
}


class State(NamedTuple):
    """The families of v, or of e^S v, relative to the origin (`zakai.numerics.families.Family`).

    They are normalised so that u = e^phi v has mass one. `time` is the time; for each node (J, N), `log_error` is the logarithm
    of the error of the prior's representation, and `edge` marks the nodes at its edge.
    """

    nodes: Array
    log_weights: Array
    signs: Array
    mean: Array
    cov: Array
    response: Array
    tilt: Array
    curvature: Array
    log_mass: Array
    log_error: Array
    edge: Array
    time: float

    @property
    def families(self) -> Family:
        """The families."""
        return Family(*self[:9])


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data: for every interval the transition, its `ends`, and the gauge there.

    `loop`: what the compiled loop of a single Gaussian receives of this; None where there is a gauge.
    """

    model: Model
    setup: Setup
    gauge: Gauge
    lengths: Array
    stops: Array
    frequencies: Array
    transitions: Transition
    loop: Loop | None
    ends: Ends
    notes: tuple[str, ...]

    @cached_property
    def tilts(self) -> Tilts:
        """The gauge at the ends of the intervals."""
        return self.gauge.at(self.stops)


def setup_of(model: Model, theta: Array, kind: type[AffineSystem]) -> tuple[Setup, Gauge]:
    """Return what does not depend on the schedule, kept for the last values of the parameters."""

    def made() -> tuple[Setup, Gauge]:
        prior = model.prior
        # The coordinates are relative to where the state begins.
        origin = np.array(prior.mean) if isinstance(prior, GaussianPrior | MixturePrior) else np.zeros(model.n)
        return Setup(affine_system_of(model, kind), theta, origin), Gauge(model, theta, origin)

    return kept(model, (Setup, kind), made, (theta.dtype, theta.tobytes()), _KEPT)


def prepare(model: Model, schedule: Schedule, theta: Array, kind: type[AffineSystem] = AffineSystem) -> Prepared:
    """Return the transition of every interval; `kind` is the equation, that of v by default."""
    setup, gauge = setup_of(model, np.asarray(theta), kind)
    sampled, inside = model.observation_kind == "samples", schedule.inside
    transitions, notes = setup.transitions(schedule, inside)
    lengths = schedule.stops - schedule.starts
    # A rate is an increment over its interval.
    frequencies = inside / np.where(inside, lengths[:, None], 1.0)
    at_end = np.ascontiguousarray(schedule.seen & ~inside)
    if setup.system.correlated and at_end.any():
        notes = (*notes, _LATE)
    ends = ends_of(sampled, schedule, at_end, model.n, setup.observation)
    loop = None
    if gauge.trivial and setup.quadratic is None:
        # The Gaussian itself may carry a derivative where nothing else does.
        dtype = complex if is_complex(setup.theta) else float
        moves = [np.ascontiguousarray(part, dtype) for part in transitions]
        affine = [np.ascontiguousarray(part, dtype) for part in (ends.whiten, ends.slope, ends.intercept)]
        level = np.ascontiguousarray(ends.constant, dtype)
        loop = Loop((lengths, frequencies, *moves), (*affine, ends.observed, level, ends.relative))
    return Prepared(model, setup, gauge, lengths, schedule.stops, frequencies, transitions, loop, ends, notes)


@np.errstate(all="ignore")
def init(prepared: Prepared, prior: Any) -> State:
    """Return the state at the model's start."""
    model, setup, gauge = prepared.model, prepared.setup, prepared.gauge
    found = prior_families(gauge, model, prior)
    families = found.families
    log_mass = posterior(gauge, gauge.at_one(model.start), model.start, families).log_mass
    families = families._replace(log_mass=families.log_mass - log_mass)
    if setup.quadratic is not None:
        families = times_gauge(families, setup, 1.0)
        _check_normalisable(model, families.cov)
    return State(*families, found.log_error, found.edge, float(model.start))


def times_gauge(families: Family, setup: Setup, sign: float) -> Family:
    """Return the families times e^{sign S}, where the equation is that of e^S v."""
    if setup.quadratic is None:
        return families
    matrix, slope = setup.quadratic
    return weigh(families, sign * matrix, -sign * slope, 0.0)


def _check_normalisable(model: Model, covs: Array) -> None:
    """Raise InputError where e^S grows faster than the prior decays."""
    # At the limit the covariances are infinite.
    if not (np.isfinite(covs).all() and np.all(np.linalg.eigvalsh(covs.real) >= 0)):
        raise InputError(
            f'{model.source}: option theorem: with "theorem-6" e^S outgrows the prior, so that e^S v is no density; '
            'take theorem="theorem-4" or a narrower prior'
        )


def move_families(prepared: Prepared, k: int, families: Family, inputs: Array) -> Family:
    """Return the families after the transition of interval k."""
    if prepared.lengths[k] == 0:
        return families
    return move(families, at(prepared.transitions, k), inputs)


def inputs_of(prepared: Prepared, k: int, values: Array) -> Array:
    """Return e = (1, rates of y) in interval k."""
    inputs = np.empty(1 + len(values))
    inputs[0] = 1.0
    inputs[1:] = values * prepared.frequencies[k]
    return inputs


def observe_end(ends: Ends, k: int, families: Family, values: Array) -> Family:
    """Return the families times the factor of what is observed at the end of interval k."""
    rows = ends.observed[k].nonzero()[0]
    if not len(rows):
        return families
    white = ends.whiten[k].dot(values)
    residual, slope = white - ends.intercept[k], ends.slope[k]
    constant = ends.constant[k]
    for row in rows:
        families = observe(families, slope[row], residual[row])
        if ends.relative:
            constant = constant + 0.5 * white[row] ** 2
    return families._replace(log_mass=families.log_mass + constant)


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval: the transition, with the rates of y inside; what is observed at its end; normalise."""
    if is_single(prepared, state):
        return step_of_gaussian(prepared, k, state, values)
    gauge, setup, inputs = prepared.gauge, prepared.setup, inputs_of(prepared, k, values)
    families = observe_end(prepared.ends, k, move_families(prepared, k, state.families, inputs), values)
    moved = State(*families, state.log_error, state.edge, float(prepared.stops[k]))
    own = times_gauge(families, setup, -1.0)
    found = posterior(gauge, tilts_at(prepared.tilts, k), prepared.stops[k], own)
    info = Info(found.log_mass, found.mean + setup.origin, found.cov, health_of(moved, own, found))
    return moved._replace(log_mass=families.log_mass - found.log_mass), info


def is_single(prepared: Prepared, state: State) -> bool:
    """Return whether a state is one Gaussian, which is advanced by the compiled loop."""
    return prepared.loop is not None and state.nodes.shape == (1, 1, 0)


def step_of_gaussian(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Return the state after interval k, and its report, for one Gaussian: `segment_of_gaussian` for one interval, quickly."""
    means, covs, gains = _advanced(prepared, k, state, values[None])
    mean, cov = means[0, 0] + prepared.setup.origin, covs[0, 0]
    variances = cov.diagonal().real.tolist()
    negative = max(0.0, -min(variances)) / max(max(map(abs, variances)), 1e-300)
    negative = negative if all([value == value for value in variances]) else np.nan
    health = {"negative_variance": negative, "representation_error": 0.0, "edge_weight": 0.0, "gauge_error": 0.0}
    after = state._replace(mean=means[0], cov=covs[0], log_mass=np.zeros(1), time=float(prepared.stops[k]))
    return after, Info(gains[0], mean, cov, health)


def _advanced(prepared: Prepared, first: int, state: State, values: Array) -> tuple[Array, Array, Array]:
    """Return the means (K, 1, n), the covariances (K, 1, n, n) and the gains (K,) of the intervals from `first` on."""
    assert prepared.loop is not None
    dtype = prepared.loop.motion[2].dtype
    mean, cov = state.mean[0].astype(dtype), state.cov[0].astype(dtype)
    (count, _), n = values.shape, len(mean)
    means, covs, gains = np.empty((count, 1, n), dtype), np.empty((count, 1, n, n), dtype), np.empty(count, dtype)
    segment(first, mean, cov, *prepared.loop, np.ascontiguousarray(values), (means[:, 0], covs[:, 0], gains))
    gains[0] += state.log_mass[0]
    return means, covs, gains


def segment_of_gaussian(prepared: Prepared, rows: slice, state: State, values: Array) -> tuple[Sequence[State], Infos]:
    """Return the states after the intervals of a slice, and their reports, for one Gaussian."""
    means, covs, gains = _advanced(prepared, rows.start, state, values)
    count = len(values)
    fields = {"mean": means, "cov": covs, "log_mass": np.zeros((count, 1)), "time": prepared.stops[rows].tolist()}
    infos = Infos(gains, means[:, 0] + prepared.setup.origin, covs[:, 0], health_of_gaussians(covs[:, 0]))
    return StackedStates(state, fields), infos


def segment_of_families(
    prepared: Prepared, rows: slice, state: State, values: Array
) -> tuple[Sequence[State], Infos] | None:
    """Return the states after the intervals of a slice, and their reports, for one Gaussian."""
    return segment_of_gaussian(prepared, rows, state, values) if is_single(prepared, state) else None


def health_of_gaussians(covs: Array) -> dict[str, Array]:
    """Return the health of posteriors without nodes, with covariances (R, n, n)."""
    variances, zero = np.diagonal(covs, axis1=1, axis2=2).real, np.zeros(len(covs))
    negative = np.maximum(0.0, -variances.min(axis=1)) / np.maximum(np.abs(variances).max(axis=1), 1e-300)
    return {"negative_variance": negative, "representation_error": zero, "edge_weight": zero, "gauge_error": zero}


def health_of_gaussian(cov: Array) -> dict[str, float]:
    """Return the health of a posterior without nodes."""
    return {name: float(figures[0]) for name, figures in health_of_gaussians(cov[None]).items()}


def health_of(state: State, families: Family, found: Posterior) -> dict[str, float]:
    """Return the health of the posterior of `families`, which are not yet normalised; `state` has the errors of the nodes."""
    health = health_of_gaussian(found.cov)
    if families.nodes.shape[2] == 0:
        return health
    # The effect of an error of the prior's representation on the posterior, wherever it was made.
    log_mass = np.real(found.log_mass)
    gained = exponents(families).real
    tilt = np.max(found.logs.real - (families.log_weights.real + gained)[:, :, None], axis=2)
    tilt = np.where(np.isfinite(tilt), tilt, -np.inf)
    shares = np.sum(np.exp(found.logs.real - log_mass), axis=2)
    return health | {
        "representation_error": float(np.sum(np.exp(state.log_error + gained - log_mass + tilt))),
        "edge_weight": float(np.sum(shares * state.edge)),
        "gauge_error": found.doubt,
    }


def density(prepared: Prepared, state: State) -> Density:
    """Return the posterior: a mixture of Gaussians where e^phi is a sum of exponentials, else by its formula."""
    families = Family(*(array.real for array in times_gauge(state.families, prepared.setup, -1.0)))
    return density_of(prepared.model, prepared.gauge.real(), state.time, families)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit together."""
    count, n = state.mean.shape
    nodes, k = state.nodes.shape[1:]
    each, arrays = (count, nodes), [np.asarray(part) for part in state[:11]]
    shapes = [(*each, k), each, each, (count, n), (count, n, n), (count, n, k), (count, k), (count, k, k), (count,), each, each]
    return (
        n == prepared.model.n
        and count >= 1
        and nodes >= 1
        and k <= n
        and all(part.shape == shape for part, shape in zip(arrays, shapes, strict=True))
        and bool(np.isin(state.signs, (-1.0, 1.0)).all())
        and not any(np.isnan(part).any() for part in arrays)
    )
