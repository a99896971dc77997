"""The extended Kalman-Bucy filter: a Gaussian that follows the linearised system, to compare with.

With F and H the Jacobians of f and h at the mean m,

    dm = f dt + P H'S^-1 (dy - h dt),    dP/dt = F P + P F' + G - P H'S^-1 H P                              (1)

(Jazwinski 1970, theorem 8.1).  `riccati="euler"` steps (1) as it stands by Euler's explicit method and blows up when the last
term outruns P: in one dimension as soon as P H'S^-1 H dt > 1.  `riccati="stable"` halves the observation's factor around the
prediction, each half a Kalman update (Joseph's form), and predicts by the exact flow of the system linearised in the middle of
the step; P stays positive semidefinite whatever the step, and the error is of second order in it.  The precision of a part of an
interval is the integral of S^-1 over it.  An interval is cut where known inputs jump, or their slope does; G(x) is taken at the
mean, S(x) of samples at the predicted mean, and derivatives almost everywhere: that of sign(x) is zero.

With correlated noise E dv dw' = C dt and a = g C the gain is (P H' + a) S^-1 in both equations (1).  What is observed enters the
prediction, f + a S^-1 (dy/dt - h) with the noise G - a S^-1 a', which leaves independent noises; for `riccati="stable"` alone.

A Gaussian prior enters as it is, a mixture or a density by its first two moments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.densities import GaussianMixture
from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.methods._options import one_of, whole_number
from zakai.methods._protocol import Info, Infos
from zakai.methods.gaussian.extended.compiled import Loop, advance, loop_of
from zakai.methods.gaussian.extended.linearisation import linearisation
from zakai.methods.gaussian.extended.linearised_system import Formulas, Part, formulas_of, part_of, rate_noise_of, subdivided
from zakai.methods.system.input_pieces import Pieces, pieces_of
from zakai.methods.system.notes import OMITTED
from zakai.methods.system.prior_moments import prior_moments, wrapped
from zakai.models.angles import other_image
from zakai.models.model import Model
from zakai.numerics.complex_step import cholesky, is_complex
from zakai.numerics.flow import Coefficients, integrate
from zakai.numerics.transition import Array, at
from zakai.records.schedule import Schedule


class State(NamedTuple):
    """The Gaussian: `mean` (n,) and `cov` (n, n)."""

    mean: Array
    cov: Array


class Moved(NamedTuple):
    """The moments before and after the motion over a part of an interval, and dx/dx0 (n, n)."""

    before: State
    after: State
    matrix: Array


class _Observed(NamedTuple):
    """Values with covariance `noise` (m, m) of `spans` (m,) times h; zero spans and a unit of variance for what is missing."""

    values: Array
    spans: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data.

    The formulas; the parts of the intervals, of which those of interval k begin at `first`[k]; the coordinates that act inside an
    interval and those at its end (K, m) with their `spans` (K, m) and the inputs there; the covariance of the rates in each half
    of a part (J, 2, m, m) and that at the end (K, m, m).  `loop` is what the compiled loop receives, None where there is none:
    for tables of two arguments, correlated noise, derivatives and riccati="euler".
    """

    model: Model
    formulas: Formulas
    theta: Array
    schedule: Schedule
    riccati: str
    parts: Pieces
    first: Array
    end_inputs: list[Array | None]
    inside: Array
    at_end: Array
    spans: Array
    rate_noise: Array
    end_noise: Array
    notes: tuple[str, ...]
    loop: Loop | None


def prepare(model: Model, schedule: Schedule, theta: Array, *, riccati: str = "stable", substeps: int = 1) -> Prepared:
    """Return the noise of every interval.

    Args:
        model: Any smooth model.
        schedule: The intervals.
        theta: The parameters (p,).
        riccati: "stable" or "euler".
        substeps: The number of equal parts in which an interval, or a piece of it between jumps of the inputs, is stepped.

    Raises:
        InputError: an option has another value.
    """
    one_of("riccati", riccati, ("stable", "euler"))
    whole_number("substeps", substeps, 1)
    formulas = formulas_of(model)
    if riccati == "euler" and formulas.cross is not None:
        raise InputError('option riccati: "euler" is for independent noises, and there is cross_noise; use "stable"')
    sampled, seen = model.observation_kind == "samples", schedule.seen
    # Observations that all belong to just the interval act inside of it, else all act at its end.
    inside = seen & np.all(schedule.inside == seen, axis=1, keepdims=True) & (not sampled)
    at_end = seen & ~inside
    spans = np.where(at_end, 1.0 if sampled else schedule.elapsed, 0.0)
    ends = np.zeros((len(schedule), len(model.u)))
    if schedule.inputs is not None:
        ends = schedule.inputs.at(schedule.stops, model.input_hold, before=not sampled)
    noise: Array = np.eye(model.m)  # where it depends on the state it is taken at the prediction
    if not formulas.noise_of_state:
        noise = formulas.noise(np.zeros(model.n), schedule.stops, theta, ends)
    shared = 1.0 if sampled else np.minimum(spans[:, :, None], spans[:, None, :])
    both = at_end[:, :, None] & at_end[:, None, :]
    end_noise = np.where(both, noise * shared, 0.0) + np.eye(model.m) * ~at_end[:, None, :]
    parts = subdivided(pieces_of(schedule, model.input_hold, len(model.u)), substeps)
    rate_noise, notes = rate_noise_of(model, formulas, parts, theta, inside[parts.row])
    notes = (*notes, OMITTED) if formulas.cross is not None and at_end.any() else notes
    first = np.searchsorted(parts.row, np.arange(len(schedule) + 1))
    loop = None
    if riccati == "stable" and formulas.cross is None and not is_complex(theta):
        each = (schedule.stops, schedule.lengths, ends, inside, at_end, spans, end_noise)
        loop = loop_of(model, theta, first, parts, rate_noise, each)
    inputs: list[Array | None] = list(ends) if model.inputs else [None] * len(schedule)
    return Prepared(
        model, formulas, theta, schedule, riccati, parts, first, inputs, inside, at_end, spans, rate_noise, end_noise, notes, loop
    )


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior's mean and covariance."""
    return State(*prior_moments(prepared.model, prior, prepared.theta))


@np.errstate(all="ignore")
def step(
    prepared: Prepared, k: int, state: State, values: Array, keep: Callable[[Moved], None] | None = None
) -> tuple[State, Info]:
    """Advance one interval, in equal parts, and then use what is observed at its end; `keep` receives the motion of each part."""
    if keep is None and prepared.loop is not None and not is_complex(*state):
        (state,), infos = advance_many(prepared, slice(k, k + 1), state, values[None])
        health = {name: float(part[0]) for name, part in infos.health.items()}
        return state, Info(infos.log_likelihood_increment[0], infos.mean[0], infos.cov[0], health)
    start, stop = prepared.schedule.starts[k], prepared.schedule.stops[k]
    inside = prepared.inside[k]
    log_factor, before = 0.0, state
    if stop > start:
        rates = np.where(inside, values, 0.0) / (stop - start) if inside.any() else None
        for j in range(prepared.first[k], prepared.first[k + 1]):
            observed = None
            if rates is not None:
                observed = [_Observed(rates, inside.astype(float), noise) for noise in prepared.rate_noise[j]]
            part = part_of(prepared.parts, j)
            if prepared.riccati == "euler":
                state, gained = _euler(prepared, state, observed, part)
            else:
                state, gained = _stable(prepared, state, observed, part, keep)
            log_factor = log_factor + gained
    at_end, noise = prepared.at_end[k], _noise_at_end(prepared, k, state)
    curved = linearisation(prepared, k, before, state, noise)
    more: dict[str, float] = {}
    if any(prepared.formulas.angles):
        more["other_image"] = _other_image(prepared, k, state, values, noise)
    if at_end.any():
        observed_end = _Observed(np.where(at_end, values, 0.0), prepared.spans[k], noise)
        state, gained = _update(prepared, state, observed_end, stop, prepared.end_inputs[k])
        log_factor = log_factor + gained
    info = info_of(state, log_factor)
    return state, info._replace(health={**info.health, "linearisation": curved, **more})


def _other_image(prepared: Prepared, k: int, state: State, values: Array, noise: Array) -> float:
    """Return the largest weight of another image of an angle that is observed at the end of interval k."""
    which = prepared.at_end[k] & np.array(prepared.formulas.angles)
    stop, u = float(prepared.schedule.stops[k]), prepared.end_inputs[k]
    value, slope = prepared.formulas.observe(state.mean, stop, prepared.theta, u)
    variance = np.diagonal(slope @ state.cov @ slope.T + noise)
    return other_image(wrap(values - value)[which], variance[which])


def _noise_at_end(prepared: Prepared, k: int, state: State) -> Array:
    """Return the covariance (m, m) of what is observed at the end of interval k, at the predicted mean where S depends on it."""
    if not prepared.formulas.noise_of_state:
        return np.asarray(prepared.end_noise[k])
    stop, at_end = np.asarray(prepared.schedule.stops[k]), prepared.at_end[k]
    noise = prepared.formulas.noise(state.mean, stop, prepared.theta, prepared.end_inputs[k])
    return np.asarray(np.where(at_end[:, None] & at_end, noise, 0.0) + np.diag(1.0 * ~at_end))


def advance_many(prepared: Prepared, rows: slice, state: State, values: Array) -> tuple[list[State], Infos]:
    """Return the states after the intervals of a slice, and their reports, by the compiled loop."""
    assert prepared.loop is not None
    means, covs, gains, figures = advance(prepared.loop, rows, *state, values)
    least, indefinite = np.full(len(means), np.inf), np.full(len(means), np.inf)
    finite = np.isfinite(covs).all(axis=(1, 2)) & np.isfinite(means).all(axis=1)
    eigenvalues = covs[finite][:, 0] if means.shape[1] == 1 else np.linalg.eigvalsh(covs[finite])
    least[finite], size = eigenvalues.min(axis=1), np.abs(eigenvalues).max(axis=1)
    indefinite[finite] = np.where(size > 0, np.maximum(-least[finite], 0.0) / np.where(size > 0, size, 1.0), 0.0)
    health = {"indefinite_cov": indefinite, "smallest_eigenvalue": least, "linearisation": figures[0]}
    if any(prepared.formulas.angles):
        health["other_image"] = figures[1]
    return [State(*pair) for pair in zip(means, covs, strict=True)], Infos(gains, means, covs, health)


def segment(prepared: Prepared, rows: slice, state: State, values: Array) -> tuple[list[State], Infos] | None:
    """Return `advance_many` where the compiled loop serves."""
    return None if prepared.loop is None or is_complex(*state) else advance_many(prepared, rows, state, values)


def _stable(
    prepared: Prepared, state: State, observed: list[_Observed] | None, part: Part, keep: Callable[[Moved], None] | None
) -> tuple[State, Any]:
    """Use half of the observation's factor, predict, and use the other half."""
    first = second = 0.0
    start, length = part.start, part.length
    if observed is not None:
        state, first = _update(prepared, state, observed[0], start, part.u)
    # The mean in the middle, to second order, is where the system is linearised.
    middle, *_ = _linearised(prepared, state.mean, state.mean, part, start, length / 2, observed)
    mean, matrix, spread, gained = _linearised(prepared, state.mean, middle, part, start + length / 2, length, observed)
    cov = matrix @ state.cov @ matrix.T + spread
    before, state = state, State(wrapped(prepared.model, mean), 0.5 * (cov + cov.T))
    if keep is not None:
        keep(Moved(before, state, matrix))
    if observed is not None:
        state, second = _update(prepared, state, observed[1], start + length, part.at(start + length))
    return state, first + second + gained


def _linearised(
    prepared: Prepared, mean: Array, centre: Array, part: Part, clock: float, length: float, observed: list[_Observed] | None
) -> tuple[Array, Array, Array, Any]:
    """Return the mean after `length`, dx/dx0 and the noise gathered, for the system linearised at (centre, clock).

    The last number is what correlated noise adds to the logarithm of the evidence.
    """
    formulas, theta, u = prepared.formulas, prepared.theta, part.at(clock)
    drift, slope, change, covariance = formulas.drift(centre, clock, theta, u, part.rate)
    gained: Any = 0.0
    if formulas.cross is not None and observed is not None:
        seen = observed[0].spans[:, None] * observed[0].spans
        gain = np.sum([seen * np.linalg.inv(half.noise) for half in observed], axis=0) / part.length
        (h, H), (a, own) = formulas.observe(centre, clock, theta, u), formulas.correlated(centre, clock, theta, u, gain)
        drift = drift + a @ gain @ (observed[0].values - h) - own
        slope, covariance = slope - a @ gain @ H, covariance - a @ gain @ a.T
        gained = -0.5 * length * (gain * (H @ a)).sum()
    # dx = (A x + a s + b) ds + dv, with the time s as one more state.
    n, kind = len(mean), np.result_type(slope, change, drift, covariance)
    matrix, noise, offset = np.zeros((1, n + 1, n + 1), kind), np.zeros((1, n + 1, n + 1), kind), np.ones((1, n + 1, 1), kind)
    matrix[0, :n, :n], matrix[0, :n, n], noise[0, :n, :n], offset[0, :n, 0] = slope, change, covariance, drift
    system = Coefficients(matrix, offset, noise, 0.0 * noise, 0.0 * offset, np.zeros((1, 1)))
    flow = at(integrate(lambda times, rows: system, np.zeros(1), np.array([length]), True).transition, 0)
    matrix, drifted = flow.map[:n, :n], flow.map[:n, n] * (part.start - clock) + flow.offset[:n, 0]
    return centre + matrix @ (mean - centre) + drifted, matrix, flow.noise[:n, :n], gained


def _euler(prepared: Prepared, state: State, observed: list[_Observed] | None, part: Part) -> tuple[State, Any]:
    """Take one explicit Euler step of equation (1)."""
    mean, cov = state
    start, length = part.start, part.length
    drift, slope, _, covariance = prepared.formulas.drift(mean, start, prepared.theta, part.u, part.rate)
    growth = slope @ cov + cov @ slope.T + covariance
    moved = mean + drift * length
    log_factor: Any = 0.0
    if observed is not None:
        own = observed[0]
        noise = np.linalg.inv(sum(np.linalg.inv(half.noise) for half in observed))
        # A coordinate without observation keeps a unit of variance.
        noise = noise + np.diag((own.spans == 0) * (1.0 - np.diagonal(noise)))
        _, log_factor = _update(prepared, state, own._replace(noise=noise), start, part.u)
        value, H = prepared.formulas.observe(mean, start, prepared.theta, part.u)
        gain = cov @ np.linalg.solve(length * noise, own.spans[:, None] * H).T
        moved = moved + gain @ (own.values - own.spans * value) * length
        growth = growth - gain @ (own.spans[:, None] * H) @ cov
    new = cov + growth * length
    return State(wrapped(prepared.model, moved), 0.5 * (new + new.T)), log_factor


def _update(prepared: Prepared, state: State, observed: _Observed, t: float, u: Array | None) -> tuple[State, Any]:
    """Return the Kalman update with `values` = spans h(x) + noise, and the logarithm of its evidence.

    For increments the evidence is relative to noise alone.
    """
    mean, cov = state
    value, slope = prepared.formulas.observe(mean, t, prepared.theta, u)
    H, residual, noise = observed.spans[:, None] * slope, observed.values - observed.spans * value, observed.noise
    residual = np.where(prepared.model.observation_law.angles, wrap(residual), residual)
    across = H @ cov
    white, log_factor = _log_normal(np.column_stack([residual, across]), across @ H.T + noise)
    gain = white[1:]
    keep = np.eye(len(mean)) - gain @ H
    if prepared.model.observation_kind == "samples":
        log_factor = log_factor - 0.5 * np.log(2 * np.pi) * np.count_nonzero(observed.spans)
    else:
        log_factor = log_factor - _log_normal(observed.values[:, None], noise)[1]
    new = keep @ cov @ keep.T + gain @ noise @ gain.T
    return State(wrapped(prepared.model, mean + gain @ residual), 0.5 * (new + new.T)), log_factor


def _log_normal(right: Array, covariance: Array) -> tuple[Array, Any]:
    """Return (C^-1 right)' (c, m) for `right` (m, c) and log N(right_0; 0, 2 pi C); NaN where C is not positive definite."""
    try:
        factor = cholesky(covariance)
    except np.linalg.LinAlgError:
        factor = np.full(covariance.shape, np.nan)
    white = np.linalg.solve(factor, right)
    logs = np.log(np.diagonal(factor)).sum()
    return np.linalg.solve(factor.T, white).T, -0.5 * white[:, 0] @ white[:, 0] - logs


def info_of(state: State, log_factor: Any) -> Info:
    """Return the report of a Gaussian."""
    mean, cov = state
    least = indefinite = np.inf
    if np.isfinite(cov).all() and np.isfinite(mean).all():
        values = cov[0].real if len(mean) == 1 else np.linalg.eigvalsh(cov.real)
        least, size = float(values.min()), float(np.abs(values).max())
        indefinite = max(-least, 0.0) / size if size > 0 else 0.0
    return Info(log_factor, mean, cov, {"indefinite_cov": indefinite, "smallest_eigenvalue": least})


def density(prepared: Prepared, state: State) -> GaussianMixture:
    """Return the Gaussian, wrapped where a coordinate is an angle."""
    model = prepared.model
    periodic = tuple(name in model.periodic for name in model.state)
    return GaussianMixture.gaussian(state.mean.real, state.cov.real, model.state, periodic)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state fit together."""
    n = prepared.model.n
    return np.shape(state.mean) == (n,) and np.shape(state.cov) == (n, n) and not is_complex(*state)
