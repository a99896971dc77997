"""The general direct method: a Gaussian sum for time-varying Yau systems with any h, in any dimension.

The survey of Chen and Dong, Algorithm 4 (Algorithm 2 where nothing depends on time), corrected.  For f = L x + l + G grad phi
and a quadratic q the gauge u = e^phi v makes the Kolmogorov equation linear-quadratic, and a Gaussian stays one, exactly.  What
is approximate is the observation's factor of a nonlinear h: each component is replaced by the Gaussian with its moments.
Components are split where h is curved over them and merged where that costs least.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.theorems import general_direct as theorem
from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.methods._options import one_of, real_number, whole_number
from zakai.methods._protocol import Info, Method
from zakai.methods.sums import start
from zakai.methods.sums.backward import BACKWARD
from zakai.methods.sums.intervals import Prepared, advance, prepared_of
from zakai.methods.sums.static import Sum, sum_of
from zakai.methods.sums.update import SPLIT_FACTOR
from zakai.models import features
from zakai.models.model import Model
from zakai.numerics.sums.mixture import Array, Components, selected, shares, wrapped
from zakai.records.schedule import Schedule

TOLERANCE = 1e-3
# What the transitions and the integrals over time of likelihoods must be known to.
_KNOWN = 1e-9, 1e-6
# The ways to keep the sum small, and up to which n.
_REDUCTIONS: dict[str, float] = {"split-merge": np.inf, "algorithm-1": 1}


class State(NamedTuple):
    """Two sums in gauge, each with u = e^phi v of mass one, in z = x - origin.

    The first is the result; the second has another number of components and takes increments in halves, and has none where it
    would be the same; their distance estimates the error. `most` (2,) are the numbers that they may have, `edge` (K,) marks the
    outermost of the start where nothing is merged, `start_error` is the distance of the first from the prior, `difference` that
    of the two log-likelihoods.
    """

    first: Components
    second: Components
    most: Array
    edge: Array
    start_error: float
    difference: float
    time: float


def prepare(
    model: Model,
    schedule: Schedule,
    theta: Array,
    *,
    components: int | None = None,
    splitting: str = "strang",
    reduction: str = "split-merge",
    tolerance: float = TOLERANCE,
    alpha: float = 0.01,
) -> Prepared:
    """Return the transition and the likelihood of every interval.

    Args:
        model: The model.
        schedule: The K intervals.
        theta: The parameters (p,).
        components: The largest number of components; by default according to the directions in which h and phi vary.
        splitting: "strang" or "lie": where the factor of an increment is.
        reduction: "split-merge" or "algorithm-1".
        tolerance: The loss below which components are not split.
        alpha: The threshold of Algorithm 1.

    Raises:
        InputError: An option is not one of these, or h and phi vary in too many directions.
    """
    _check(model, components, splitting, reduction, tolerance, alpha)
    static = sum_of(model, splitting, components, reduction, float(tolerance), float(alpha))
    prepared, errors = prepared_of(static, schedule, theta)
    return replace(prepared, notes=_notes(static, schedule, errors))


def _check(model: Model, components: Any, splitting: Any, reduction: Any, tolerance: Any, alpha: Any) -> None:
    one_of("reduction", reduction, _REDUCTIONS)
    if model.n > _REDUCTIONS[reduction]:
        most = _REDUCTIONS[reduction]
        raise InputError(f'option reduction: "{reduction}" is for n <= {most}, here n = {model.n}; use "split-merge"')
    if reduction != "split-merge" and model.periodic:
        raise InputError(f'option reduction: "{reduction}" does not support angles; use "split-merge"')
    one_of("splitting", splitting, ("strang", "lie"))
    if components is not None:
        whole_number("components", components, 1)
    for name, value in (("alpha", alpha), ("tolerance", tolerance)):
        real_number(name, value, "a number between 0 and 1", lambda number: 0 < number < 1)
    if splitting == "lie" and model.observation_kind != "samples" and model.observation.free_symbols & set(model.u):
        raise InputError('option splitting: "lie" is for an observation without inputs; use "strang"')


def _notes(static: Sum, schedule: Schedule, errors: tuple[float, float]) -> tuple[str, ...]:
    """Return where the method is not exact in its class."""
    notes: list[str] = []
    if any(error > known for error, known in zip(errors, _KNOWN, strict=True)):
        known = f"known to {max(errors):.1g} only" if max(errors) < 1 else "not known"
        notes.append(f"the coefficients vary so fast within an interval that its flow is {known}; give shorter intervals")
    if static.reduction != "split-merge":
        notes.append(f'the reduction "{static.reduction}" has no error figures: its error is not known')
    elif not static.system.unobserved and not static.system.sampled and not schedule.inside.all():
        notes.append(
            "where observations are missing the transition without the observation's potential is not linear-quadratic: its "
            "potential is kept inside and removed again at the end, which is exact only as the intervals shrink"
        )
    return tuple(notes)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior, cut into Gaussians and divided by e^phi."""
    static, theta = prepared.static, prepared.theta
    model, gauge, origin = static.model, static.gauge, static.system.origin
    t = float(model.start)
    now = prepared.first()
    with np.errstate(all="ignore"):
        doubt = None if gauge.none else lambda u: gauge.doubt(u, t, theta)
        far = static.affine and static.asked is None
        u, edge = start.cut_prior(model, prior, static.start_directions, origin, theta, doubt, far)
        narrow = gauge.divide(u, t, theta)
        share = now.share(narrow)[0].real
        loss, most = now.losses(narrow, share), static.limits(len(share))
        # Before a sample there are as many as while it is used.
        factor = SPLIT_FACTOR if static.split_before else 1
        counts = most if static.split_time else dict.fromkeys(most)
        sums = [start.merged(narrow, share, loss, factor * count, static.angles) for count in counts]
        error = start.difference(gauge.lift(sums[0], t, theta), start.given(model, prior, origin), static.angles)
        if doubt is not None:
            error = max(error, float(np.max(doubt(u))))
        sums = [now.normalised(v)[0] for v in sums]
    # Once components are exchanged or merged, none of them is the outermost for good.
    edge = edge if static.affine and len(edge) <= most[0] else np.zeros(0)
    second = sums[1] if len(sums) > 1 else selected(sums[0], slice(0))
    return State(sums[0], second, np.array(most), edge, error, 0.0, t)


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance both sums over interval k: factor at the start, transition, factor at the end, reduction."""
    try:
        with np.errstate(all="ignore"):
            return _step(prepared, k, state, values)
    except np.linalg.LinAlgError:
        n = prepared.static.model.n
        health = dict.fromkeys([*BOUNDS, "components"], np.nan)
        return state, Info(np.nan, np.full(n, np.nan), np.full((n, n), np.nan), health)


def _step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    most = [int(count) for count in state.most]
    first, info = advance(prepared, k, state.first, values, most[0], state.edge)
    second, other = state.second, info
    if len(second.signs):
        second, other = advance(prepared, k, second, values, most[1], state.edge, halves=True)
    difference = state.difference + float((info.log_likelihood_increment - other.log_likelihood_increment).real)
    deviation, companion = (np.sqrt(np.maximum(np.diagonal(result.cov).real, 1e-300)) for result in (info, other))
    distance = np.abs(wrapped((info.mean - other.mean).real, prepared.static.angles)) / deviation
    known = 1.0 if prepared.static.split_merge else np.nan
    # Both sums lose the shape of the same products of a sample, as at a kink, so that their distance does not show it.
    lost = LOST * info.health["nonlinearity"] ** 0.5 if prepared.static.system.sampled else 0.0
    errors = {
        "mean_error": float(distance.max()) * known,
        "deviation_error": float(np.abs(companion / deviation - 1.0).max()) * known,
        "evidence_error": max(abs(difference), lost) * known,
        "start_error": state.start_error,
    }
    state = State(first, second, state.most, state.edge, state.start_error, difference, float(prepared.whole.schedule.stops[k]))
    return state, info._replace(health={**info.health, **errors})


def density(prepared: Prepared, state: State) -> GaussianMixture:
    """Return the posterior u = e^phi v as a `GaussianMixture`."""
    static = prepared.static
    model = static.model
    u = static.gauge.lift(state.first, state.time, prepared.theta)
    share = shares(u)[0].real
    kept = share != 0
    periodic = tuple(name in model.periodic for name in model.state)
    means = wrapped(static.system.origin + u.means.real[kept], static.angles)
    return GaussianMixture(share[kept], means, u.covs.real[kept], model.state, periodic)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state that was read from a file fit together."""
    n = prepared.static.model.n
    for logs, means, covs, signs in (state.first, state.second):
        K = len(logs)
        if logs.shape != (K,) or means.shape != (K, n) or covs.shape != (K, n, n) or signs.shape != (K,):
            return False
    most = np.asarray(state.most)
    return most.shape == (2,) and bool((most >= 1).all()) and state.edge.ndim == 1 and len(state.first.log_weights) > 0


# Error of the next log-likelihoods, in nats, by the square root of the relative entropy that a sample loses, as was measured.
LOST = 1.0 / 3.0
BOUNDS = {
    "mean_error": (0.04, "distance of the mean from that of a shorter sum, which halves increments, in standard deviations"),
    "deviation_error": (0.1, "relative distance of a standard deviation from that of the second sum"),
    "evidence_error": (0.04, "distance of the log-likelihood so far from that of the second sum, or what lost shape adds"),
    "start_error": (0.01, "distance of the first sum, or of a part of it, from the prior in mass, mean or variance"),
    "nonlinearity": (0.1, "relative entropy lost in one step by keeping one Gaussian where an observation made none"),
    "quadrature": (1e-2, "relative error of the masses of components, by two rules of quadrature"),
    "pruned": (1e-3, "weight of components that were dropped in one step"),
    "merged": (0.1, "loss by merging components because their number is limited"),
    "outside_tables": (1e-4, "share of the mass where a table is constant beyond its range"),
    "edge_weight": (1e-6, "weight of the outermost Gaussians of the start: the posterior is in tails that it has not"),
    "without_law": (1e-6, "share of the mass where the law of the observation has no value, as for counts with a negative mean"),
    "tail_depth": (1.0, "distance by which the observation moves the density into the tails of single Gaussians"),
}

METHOD = Method(
    name="general-direct",
    source="Chen and Dong, A survey of direct methods for Yau filtering systems, Theorems 6 and 7, Algorithm 4, corrected",
    exactness="exact between observations; a Gaussian sum of the posterior where h is nonlinear, whose error health tells",
    theorem=theorem,
    options={"components": None, "splitting": "strang", "reduction": "split-merge", "tolerance": TOLERANCE, "alpha": 0.01},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds=BOUNDS,
    valid=valid,
    backward=BACKWARD,
    shorter="give fewer components",
    handles=features.OF_OBSERVATION | {features.INPUTS, features.JUMPS, features.KINKS, features.SINC, features.TABLES},
)
