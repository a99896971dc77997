"""The extended Kalman-Bucy filter: a Gaussian that follows the linearised system, to compare with.

With F and H the Jacobians of f and h at the mean m,

    dm = f dt + P H'S^-1 (dy - h dt),    dP/dt = F P + P F' + G - P H'S^-1 H P                              (1)

(Jazwinski 1970, theorem 8.1).  `riccati="euler"` steps (1) as it stands by Euler's explicit method and blows up when the last
term outruns P: in one dimension as soon as P H'S^-1 H dt > 1.  `riccati="stable"` halves the observation's factor around the
prediction, each half a Kalman update (Joseph's form), and predicts by the exact flow of the system linearised in the middle of
the step; P stays positive semidefinite whatever the step, and the error is of second order in it.  The precision of a part of an
interval is the integral of S^-1 over it.

A Gaussian prior enters as it is, a mixture or a density by its first two moments.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp

from zakai.algebra.theorems import smooth_system as theorem
from zakai.densities import GaussianMixture
from zakai.errors import InputError
from zakai.methods._affine_system import RESOLVED, precision_of
from zakai.methods._moments import prior_moments
from zakai.methods._protocol import Info, Method
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import cholesky, is_complex
from zakai.numerics.flow import Coefficients, integrate
from zakai.numerics.linear_flow import linear_flow
from zakai.numerics.transition import Array
from zakai.records.schedule import Schedule


class State(NamedTuple):
    """The Gaussian: `mean` (n,) and `cov` (n, n)."""

    mean: Array
    cov: Array


class _Formulas:
    """The formulas of a model, and their derivatives, as functions of x, t and the parameters."""

    def __init__(self, model: Model):
        n, m, x = model.n, model.m, list(model.x)
        drift, observation = sp.Matrix(model.drift), sp.Matrix(model.observation)
        slope, change = drift.jacobian(x), drift.diff(model.t)
        self.shapes = (n, m)
        self.motion = numpy_function([*drift, *slope, *change, *model.covariance], model)
        self.sensor = numpy_function([*observation, *observation.jacobian(x)], model)
        self.noise = numpy_function(model.observation_noise, model, (m, m))
        self.noise_varies = bool(model.observation_noise.has(model.t))

    def drift(self, x: Array, t: float, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Return f (n,), df/dx (n, n), df/dt (n,) and G (n, n)."""
        n, values = self.shapes[0], self.motion(x, np.asarray(t), theta)
        slope, rest = values[n : n + n * n].reshape(n, n), values[n + n * n :]
        return values[:n], slope, rest[:n], rest[n:].reshape(n, n)

    def observe(self, x: Array, t: float, theta: Array) -> tuple[Array, Array]:
        """Return h (m,) and dh/dx (m, n)."""
        n, m = self.shapes
        values = self.sensor(x, np.asarray(t), theta)
        return values[:m], values[m:].reshape(m, n)


_FORMULAS: WeakKeyDictionary[Model, _Formulas] = WeakKeyDictionary()


class _Reading(NamedTuple):
    """Values with covariance `noise` (m, m) of `spans` (m,) times h; zero spans and a unit of variance where nothing is read."""

    values: Array
    spans: Array
    noise: Array


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data: the formulas, which coordinates act inside an interval and which at its end (K, m) with their
    `spans` (K, m), the covariance of the rates in each half of a substep (K, 2 substeps, m, m), and that at the end (K, m, m)."""

    model: Model
    formulas: _Formulas
    theta: Array
    schedule: Schedule
    riccati: str
    substeps: int
    inside: Array
    at_end: Array
    spans: Array
    rate_noise: Array
    end_noise: Array
    notes: tuple[str, ...]


def prepare(model: Model, schedule: Schedule, theta: Array, *, riccati: str = "stable", substeps: int = 1) -> Prepared:
    """Return the noise of every interval.

    Args:
        model: Any smooth model.
        schedule: The intervals.
        theta: The parameters (p,).
        riccati: "stable" or "euler".
        substeps: The number of equal parts in which an interval is stepped.

    Raises:
        InputError: an option has another value.
    """
    if riccati not in ("stable", "euler"):
        raise InputError(f'option riccati: "{riccati}" is neither "stable" nor "euler"')
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise InputError(f"option substeps: {substeps!r} is not a whole number from 1")
    if model not in _FORMULAS:
        _FORMULAS[model] = _Formulas(model)
    formulas = _FORMULAS[model]
    sampled, seen = model.observation_kind == "samples", schedule.seen
    # Observations that all belong to just the interval act inside of it, else all act at its end.
    inside = seen & np.all(schedule.inside == seen, axis=1, keepdims=True) & (not sampled)
    at_end = seen & ~inside
    spans = np.where(at_end, 1.0 if sampled else schedule.elapsed, 0.0)
    noise = formulas.noise(np.zeros(model.n), schedule.stops, theta)
    shared = 1.0 if sampled else np.minimum(spans[:, :, None], spans[:, None, :])
    both = at_end[:, :, None] & at_end[:, None, :]
    end_noise = np.where(both, noise * shared, 0.0) + np.eye(model.m) * ~at_end[:, None, :]
    rate_noise, notes = _rate_noise(model, formulas, schedule, theta, inside, 2 * substeps)
    return Prepared(
        model, formulas, theta, schedule, riccati, substeps, inside, at_end, spans, rate_noise, end_noise, notes
    )


def _rate_noise(
    model: Model, formulas: _Formulas, schedule: Schedule, theta: Array, inside: Array, parts: int
) -> tuple[Array, tuple[str, ...]]:
    """Return the covariances (K, parts, m, m) of the rates in equal parts of the intervals, and notes."""
    count, m = inside.shape
    origin, lengths = np.zeros(model.n), (schedule.stops - schedule.starts) / parts
    alone = (np.eye(m) * ~inside[:, None, :])[:, None]
    notes: tuple[str, ...] = ()
    with np.errstate(all="ignore"):
        if not formulas.noise_varies:
            noise = formulas.noise(origin, np.zeros(count), theta)
            both = inside[:, :, None] & inside[:, None, :]
            rate = np.where(both, noise / lengths[:, None, None], 0.0)[:, None]
            return np.repeat(rate + alone, parts, axis=1), notes

        def coefficients(times: Array, rows: Array) -> Coefficients:
            precision = precision_of(formulas.noise(origin, times, theta), inside[rows // parts])
            zero = np.zeros_like(precision)
            return Coefficients(zero, zero[:, :, :1], precision, zero, zero[:, :, :1], zero[:, 0, :1])

        # The noise that a state without drift gathers is the integral of its covariance.
        starts = (schedule.starts[:, None] + lengths[:, None] * np.arange(parts)).ravel()
        found = integrate(coefficients, starts, starts + np.repeat(lengths, parts), False)
        worst = float(found.error.max(initial=0.0))
        if worst > RESOLVED:
            notes = (
                f"observation_noise varies so fast within an interval that its integral is known to {worst:.1g} only; "
                "give shorter intervals",
            )
        precision = found.transition.noise.reshape(count, parts, m, m)
        return np.linalg.inv(precision + alone), notes


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior's mean and covariance."""
    return State(*prior_moments(prepared.model, prior, prepared.theta))


@np.errstate(all="ignore")
def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval, in equal parts, and then use what is observed at its end."""
    start, stop = prepared.schedule.starts[k], prepared.schedule.stops[k]
    inside = prepared.inside[k]
    log_factor: Any = 0.0
    if stop > start:
        length = (stop - start) / prepared.substeps
        rates = np.where(inside, values, 0.0) / (stop - start) if inside.any() else None
        one = _euler if prepared.riccati == "euler" else _stable
        for part in range(prepared.substeps):
            halves = prepared.rate_noise[k, 2 * part : 2 * part + 2]
            readings = None if rates is None else [_Reading(rates, inside.astype(float), noise) for noise in halves]
            state, more = one(prepared, state, readings, start + part * length, length)
            log_factor = log_factor + more
    at_end = prepared.at_end[k]
    if at_end.any():
        reading = _Reading(np.where(at_end, values, 0.0), prepared.spans[k], prepared.end_noise[k])
        state, more = _update(prepared, state, reading, stop)
        log_factor = log_factor + more
    return state, _info(state, log_factor)


def _stable(
    prepared: Prepared, state: State, readings: list[_Reading] | None, start: float, length: float
) -> tuple[State, Any]:
    """Use half of the observation's factor, predict, and use the other half."""
    first = second = 0.0
    if readings is not None:
        state, first = _update(prepared, state, readings[0], start)
    # The mean in the middle, to second order, is where the system is linearised.
    middle, _, _ = _linearised(prepared, state.mean, state.mean, start, start, length / 2)
    mean, matrix, spread = _linearised(prepared, state.mean, middle, start, start + length / 2, length)
    cov = matrix @ state.cov @ matrix.T + spread
    state = State(_wrapped(prepared.model, mean), 0.5 * (cov + cov.T))
    if readings is not None:
        state, second = _update(prepared, state, readings[1], start + length)
    return state, first + second


def _linearised(
    prepared: Prepared, mean: Array, centre: Array, start: float, clock: float, length: float
) -> tuple[Array, Array, Array]:
    """Return the mean after `length`, dx/dx0 and the noise gathered, for the system linearised at (centre, clock)."""
    drift, slope, change, covariance = prepared.formulas.drift(centre, clock, prepared.theta)
    matrix, drifted, spread = linear_flow(slope, change, drift, covariance, length, start - clock)
    return centre + matrix @ (mean - centre) + drifted, matrix, spread


def _euler(
    prepared: Prepared, state: State, readings: list[_Reading] | None, start: float, length: float
) -> tuple[State, Any]:
    """Take one explicit Euler step of equation (1)."""
    mean, cov = state
    drift, slope, _, covariance = prepared.formulas.drift(mean, start, prepared.theta)
    growth = slope @ cov + cov @ slope.T + covariance
    moved = mean + drift * length
    log_factor: Any = 0.0
    if readings is not None:
        own = readings[0]
        noise = np.linalg.inv(sum(np.linalg.inv(reading.noise) for reading in readings))
        # A coordinate without observation keeps a unit of variance.
        noise = noise + np.diag((own.spans == 0) * (1.0 - np.diagonal(noise)))
        _, log_factor = _update(prepared, state, own._replace(noise=noise), start)
        value, H = prepared.formulas.observe(mean, start, prepared.theta)
        gain = cov @ np.linalg.solve(length * noise, own.spans[:, None] * H).T
        moved = moved + gain @ (own.values - own.spans * value) * length
        growth = growth - gain @ (own.spans[:, None] * H) @ cov
    new = cov + growth * length
    return State(_wrapped(prepared.model, moved), 0.5 * (new + new.T)), log_factor


def _update(prepared: Prepared, state: State, reading: _Reading, t: float) -> tuple[State, Any]:
    """Return the Kalman update with `values` = spans h(x) + noise, and the logarithm of its evidence.

    For increments the evidence is relative to noise alone.
    """
    mean, cov = state
    value, slope = prepared.formulas.observe(mean, t, prepared.theta)
    H, residual, noise = reading.spans[:, None] * slope, reading.values - reading.spans * value, reading.noise
    across = H @ cov
    white, log_factor = _log_normal(np.column_stack([residual, across]), across @ H.T + noise)
    gain = white[1:]
    keep = np.eye(len(mean)) - gain @ H
    if prepared.model.observation_kind == "samples":
        log_factor = log_factor - 0.5 * np.log(2 * np.pi) * np.count_nonzero(reading.spans)
    else:
        log_factor = log_factor - _log_normal(reading.values[:, None], noise)[1]
    new = keep @ cov @ keep.T + gain @ noise @ gain.T
    return State(_wrapped(prepared.model, mean + gain @ residual), 0.5 * (new + new.T)), log_factor


def _log_normal(right: Array, covariance: Array) -> tuple[Array, Any]:
    """Return (C^-1 right)' (c, m) for `right` (m, c) and log N(right_0; 0, 2 pi C); NaN where C is not positive definite."""
    try:
        factor = cholesky(covariance)
    except np.linalg.LinAlgError:
        factor = np.full(covariance.shape, np.nan)
    white = np.linalg.solve(factor, right)
    logs = np.log(np.diagonal(factor)).sum()
    return np.linalg.solve(factor.T, white).T, -0.5 * white[:, 0] @ white[:, 0] - logs


def _wrapped(model: Model, mean: Array) -> Array:
    """Return the mean with its angles in (-pi, pi]."""
    if not model.periodic:
        return mean
    angles = np.array([name in model.periodic for name in model.state])
    return mean + angles * 2.0 * np.pi * np.floor((np.pi - mean.real) / (2.0 * np.pi))


def _info(state: State, log_factor: Any) -> Info:
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


METHOD: Method[Prepared, State] = Method(
    name="extended-kalman-bucy",
    source="Jazwinski 1970, theorem 8.1 and its continuous-discrete form; explicit Euler as in Chen, Luo and Yau 2017, section V",
    exactness="approximate: the system is linearised at the mean; for a linear system second order in the interval "
    "(increments), exact for samples and constant coefficients",
    theorem=theorem,
    options={"riccati": "stable", "substeps": 1},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds={"indefinite_cov": (1e-9, "the covariance has a negative eigenvalue (its share of the largest), or is not finite")},
    valid=valid,
)
