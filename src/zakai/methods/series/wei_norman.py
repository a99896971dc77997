"""The filter of Wei and Norman for a finite estimation algebra, in one to three states.

    sigma(t) = exp(r_d(t) E_d) ... exp(r_1(t) E_1) exp(t L_0) sigma_0,      r' a polynomial in r and dy/dt

The observations enter only through the statistics r, which obey ordinary differential equations that follow from the structure
constants; v = exp(t L_0) sigma_0 depends on no observation and is computed on a grid.  For z = x + sum_k r_k a_k, exp(r_k E_k)
goes from z - r_1 a_1 - ... - r_k a_k to the point before it, so that sigma is v on a grid that is shifted as a whole, times exp
of integrals along these segments: nothing is interpolated.  Statistics grow exponentially in time, and the multiplier that they
make amplifies the rounding of the tails; before it is large the density is formed and both restart.

Wei and Norman (1964); for their bases Yau (1993), Theorem 6, corrected, and Dong, Chen and Yau (2021), Theorem 4.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.exponentials import wei_norman_filter as theorem
from zakai.densities import GridDensity
from zakai.methods._options import whole_number
from zakai.methods._protocol import Info, Method
from zakai.methods.series.borrowed_backward import OF_MESSAGE, borrowed
from zakai.methods.series.wei_norman_system import Array, System
from zakai.methods.space.system import prior_on_grid
from zakai.methods.system.residuals import Factor
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.series import sinc_grid
from zakai.numerics.series.sinc_grid import Field, Generator, moments, resolution_of
from zakai.records.schedule import Schedule

KEPT = 8  # values of the parameters for which a model's system is kept
POINTS = {1: 96, 2: 56, 3: 44}  # along an axis at the start
MOST_POINTS = {1: 256, 2: 112, 3: 72}  # at most
RESOLVED = 1e-10  # share of the density at the highest frequency from which the grid gets more points
RESTART = 3.0  # nats over which the multiplier may range where the density matters, before the statistics restart
SHIFT = 0.1  # how far the product may shift the density, as a share of the grid
DRIVE = 2.0  # nats that one part of an interval may add
STEP = 0.25  # length of a part in units of the linear part of the statistics' equations
MATTERS = 1e-10  # of the maximum
TRAVEL = 0.04  # share of an axis over which the drift may carry the density in one part
STATIONARY = 1e-13  # relative change of a density in a part, below which it is stationary
MOST_PARTS = 2048  # of an interval
PATIENCE = 200  # parts after which a step that would need more than MOST_PARTS ends


class State(NamedTuple):
    """v = exp(t L_0) sigma_0 since the last restart, `values` at `low` + `spacing` * index, and the `statistics` (d,).

    The density of mass one is exp(`log_scale`) times their product, with the `mean` (n,); `driven` (n,) is the number of standard
    deviations by which recent observations shifted it into its tails, which may have been cut.
    """

    values: Array
    low: Array
    spacing: Array
    statistics: Array
    log_scale: Any
    mean: Array
    driven: Array

    @property
    def field(self) -> Field:
        """v on its grid."""
        return Field(self.values, self.low, self.spacing)

    def on(self, field: Field) -> State:
        """Return the state with another v."""
        return self._replace(values=field.values, low=field.low, spacing=field.spacing)


@dataclass(frozen=True, eq=False)
class Prepared:
    """What is known without data."""

    system: System
    schedule: Schedule
    lengths: Array
    points: int | None
    notes: tuple[str, ...] = ()


def prepare(model: Model, schedule: Schedule, theta: Array, *, points: int | None = None) -> Prepared:
    """Return the equations of the statistics and the functions of L_0.

    Args:
        model: a model with a finite estimation algebra.
        schedule: the K intervals.
        theta: (p,) the parameters, real or complex.
        points: the size of each axis of the grid; by default from 96, 56 or 44 as many as needed.

    Raises:
        InputError: `points` is not a whole number from 16.
    """
    if points is not None:
        whole_number("points", points, 16, 4096)
    system = kept(model, System, lambda: System(model, theta), (theta.tobytes(), theta.dtype.str), KEPT)
    return Prepared(system, schedule, schedule.lengths, points)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior on a grid."""
    model, theta, n = prepared.system.model, prepared.system.theta, prepared.system.n
    found = prior_on_grid(model, prior, theta, 1e-12, (False,) * n)
    real = found.log_values.real
    held = found.points[real > real.max() + np.log(sinc_grid.SUPPORT)]
    sizes = np.full(n, prepared.points or POINTS[n])
    spacing = (held.max(axis=0) - held.min(axis=0)) / (sinc_grid.FILLED * sizes)
    low = 0.5 * (held.max(axis=0) + held.min(axis=0)) - 0.5 * spacing * (sizes - 1)
    points = Field(np.zeros(tuple(sizes)), low, spacing).points
    if isinstance(prior, DensityPrior):
        logs = numpy_function([prior.log_density], model, ())(points, model.start, theta)
        logs = np.where(np.isnan(logs.real), -np.inf, logs)
    else:
        logs = prior.log_density(points)
    field = Field(np.exp(logs - logs.real.max()), low, spacing)
    log_mass, mean, _ = moments(field)
    return State(field.values, low, spacing, np.zeros(prepared.system.count), -log_mass, mean, np.zeros(n))


class Health:
    """The worst figures over the parts of an interval, and the last `aliasing`."""

    def __init__(self, aliasing: float):
        self.aliasing = aliasing
        self.figures = {"aliasing": aliasing, "edge_mass": 0.0, "gauge_exponent": 0.0, "tail_depth": 0.0, "unfinished": 0.0}

    def add(self, **figures: float) -> None:
        """Keep the larger of each figure and the stored one; NaN stays."""
        for name, value in figures.items():
            self.figures[name] = max(self.figures[name], float(value)) if value == value else np.nan


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance one interval in parts, apply what is observed at its end only, and compute the moments."""
    system, schedule, length = prepared.system, prepared.schedule, float(prepared.lengths[k])
    inside = schedule.inside[k]
    which = np.flatnonzero(inside)
    whole = bool(inside.all()) and len(inside) > 0
    rates = np.where(inside, values, 0.0) / (length or 1.0)
    precision = np.linalg.inv(system.sensors.noise_at(np.zeros(1), system.theta, which)[0]) if len(which) else np.zeros((0, 0))
    if not whole:
        # A missing coordinate changes L_0 and the algebra: the other coordinates then act on the density within the interval.
        state = _formed(system, state)
    health = Health(resolution_of(state.values).aliasing)
    left, shift, logs = length, np.zeros(system.n), np.zeros(state.values.shape)
    with np.errstate(all="ignore"):
        for part in range(MOST_PARTS):
            if not left > 0 or not np.isfinite(state.log_scale):
                break
            before, refine = state, prepared.points is None and health.aliasing > RESOLVED
            state, tau, shift, logs = _part(system, state, left, _Inside(rates, which, precision, whole), health, refine)
            left = left - tau if tau < left else 0.0
            if part > (PATIENCE if whole else 4 * PATIENCE) and MOST_PARTS * tau < left:
                break
            if not whole and state.values.shape == before.values.shape and np.array_equal(state.low, before.low):
                if np.max(np.abs(state.values - before.values)) < STATIONARY:  # further terms change the mass only
                    state = state._replace(log_scale=state.log_scale + left / tau * (state.log_scale - before.log_scale))
                    left = 0.0
        late = schedule.seen[k] & ~inside
        if late.any():
            state = _as_one(state, shift, logs)
            shift, logs = np.zeros(system.n), np.zeros(state.values.shape)
            factor = system.sensors.at_end(schedule, k, values, system.theta, late)
            state = _observed(system, state, factor, health)
        top = np.max(logs.real)
        log_mass, mean, cov = moments(Field(state.values * np.exp(logs - top), state.low - shift, state.spacing))
    log_mass = log_mass + top + state.log_scale
    health.add(unfinished=left / (length or 1.0))
    return state._replace(log_scale=state.log_scale - log_mass), Info(log_mass, mean, cov, health.figures)


class _Inside(NamedTuple):
    """What is observed within an interval: the rates (m,), their coordinates, their precision, and whether all are observed."""

    rates: Array
    which: Array
    precision: Array
    whole: bool


def _part(
    system: System, state: State, left: float, inside: _Inside, health: Health, refine: bool
) -> tuple[State, float, Array, Array]:
    """Advance by the longest part that the grid and the statistics allow; return its length, the shift and the multiplier."""
    rates, which, precision, whole = inside
    sizes = state.field.sizes
    if refine and (bigger := sizes + 8 * (4 - system.n)).max() <= MOST_POINTS[system.n]:
        sizes = bigger
    field = sinc_grid.fitted(state.field, sizes)
    points = field.points
    h = system.sensors.observed(points, 0.0, system.theta)[..., which]
    weights = h @ precision
    drive, potential = weights @ rates[which], 0.5 * np.sum(weights * h, axis=-1)
    if not whole:
        potential = potential - drive
    level = potential.real.min()
    f = np.moveaxis(system.drift(points, 0.0, system.theta), -1, 0)
    generator = Generator(system.covariance, list(f), potential - level)
    matters = field.values.real > MATTERS
    ranging = np.ptp(drive.real[matters]) if matters.any() else 0.0
    stable = sinc_grid.STABLE / generator.size(field.spacing)
    fastest = max(np.max(np.abs(one.real[matters]), initial=0.0) / d for one, d in zip(f, field.spacing * sizes))
    longest = max(stable, min(8 * stable, TRAVEL / max(fastest, 1e-300)))
    tau = float(np.nanmin([left, longest, DRIVE / max(ranging, 1e-300), STEP / max(system.speed, 1e-300)]))
    field, scale, noise = sinc_grid.cleaned(sinc_grid.exponential(generator, field, tau))
    statistics = system.advanced(state.statistics, rates, tau) if whole else state.statistics
    state = state.on(field)._replace(statistics=statistics, log_scale=state.log_scale + scale - level * tau)
    shift, logs = system.product(statistics, points, field.spacing)
    spread, exponent, density = _reach(field.values, logs)
    # Shift of the mean beyond the drift, in standard deviations; diffusion restores the tails.
    _, mean, cov = moments(Field(density, field.low - shift, field.spacing))
    variance = np.diagonal(cov)
    drifted = np.array([np.sum(field.values * one).real for one in f]) / field.values.real.sum()
    kept = np.exp(-tau * np.diagonal(system.covariance).real / variance)
    driven = kept * state.driven + (mean - state.mean - tau * drifted) / np.sqrt(variance)
    resolved = resolution_of(density)
    health.aliasing = resolved.aliasing
    health.add(aliasing=max(noise, resolved.aliasing), edge_mass=resolved.edge_mass)
    health.add(gauge_exponent=exponent, tail_depth=np.abs(driven).max())
    state = state._replace(mean=mean, driven=driven)
    if spread > RESTART or np.max(np.abs(shift) / (field.spacing * field.sizes)) > SHIFT:
        return _as_one(state, shift, logs), tau, np.zeros(system.n), np.zeros(logs.shape)
    return state, tau, shift, logs


def _reach(values: Array, logs: Array) -> tuple[float, float, Array]:
    """Return the range of a multiplier and the amplification of the rounding of the tails, in nats, and their density."""
    values, logs = values.real, logs.real
    top = np.max(logs[values > 0], initial=-np.inf)
    density = values * np.exp(np.minimum(logs - top, 0.0))
    highest = np.max(density)
    matters = density > MATTERS * highest
    return float(np.ptp(logs[matters])) if matters.any() else np.nan, float(-np.log(highest)), density


def _formed(system: System, state: State) -> State:
    """Return the same density with statistics of zero."""
    if not np.any(state.statistics != 0):
        return state
    return _as_one(state, *system.product(state.statistics, state.field.points, state.spacing))


def _as_one(state: State, shift: Array, logs: Array) -> State:
    """Return the product of the multiplier and v on the shifted grid as a new v, with statistics of zero."""
    top = np.max(logs.real)
    field, scale, _ = sinc_grid.cleaned(Field(state.values * np.exp(logs - top), state.low - shift, state.spacing))
    return state.on(field)._replace(statistics=np.zeros(len(state.statistics)), log_scale=state.log_scale + top + scale)


def _observed(system: System, state: State, factor: Factor, health: Health) -> State:
    """Return the state, with statistics of zero, after the factor of what is observed at the end of an interval."""
    residuals = factor.residuals(system.sensors.observed, state.field.points, system.theta)
    logs = -0.5 * np.sum(residuals * residuals, axis=0)
    _, exponent, density = _reach(state.values, logs)
    _, before, cov = moments(state.field)
    state = _as_one(state, np.zeros(system.n), logs + factor.constant)
    mean = moments(state.field).mean
    driven = state.driven + (mean - before) / np.sqrt(np.diagonal(cov))
    health.add(aliasing=resolution_of(density).aliasing, gauge_exponent=exponent, tail_depth=np.abs(driven).max())
    return state._replace(mean=mean, driven=driven)


def density(prepared: Prepared, state: State) -> GridDensity:
    """Return the posterior on its grid; values below rounding are zero."""
    field = _formed(prepared.system, state).field
    with np.errstate(divide="ignore"):
        logs = np.log(np.maximum(field.values.real, 0.0))
    centre = field.low.real + field.spacing * (field.sizes // 2)
    return GridDensity(logs, centre, np.diag(field.spacing), prepared.system.model.state, (False,) * prepared.system.n)


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether the arrays of a state that was read from a file fit together."""
    n, d = prepared.system.n, prepared.system.count
    shapes = [np.shape(a) for a in (state.low, state.spacing, state.mean, state.driven)]
    sizes = np.array(np.shape(state.values))
    fits = len(sizes) == n and 16 <= sizes.min() and sizes.max() <= max(prepared.points or 0, MOST_POINTS[n])
    return bool(fits) and shapes == [(n,)] * 4 and np.shape(state.statistics) == (d,)


METHOD = Method(
    name="wei-norman",
    source="Wei and Norman 1964; Yau 1993, Theorem 6, corrected; Dong, Chen and Yau 2021, Theorem 4.1",
    exactness="exact for y that is linear between observations, up to the grid of exp(t L_0), whose error health figures watch",
    theorem=theorem,
    options={"points": None},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds={
        **OF_MESSAGE,
        "aliasing": (1e-8, "share of the density at the highest frequency of the grid; set points to more"),
        "edge_mass": (1e-9, "probability in the outermost points of the grid"),
        "tail_depth": (3.0, "deviations by which the observations drove the density into its tails, of which rounding leaves 7"),
        "gauge_exponent": (12.0, "nats by which a multiplier amplified the rounding of the tails; take shorter intervals"),
        "unfinished": (0.0, "share of an interval that was left out: so fine a grid needs more parts than there may be"),
    },
    shorter="set points to fewer",
    valid=valid,
    backward=borrowed(density, lambda prepared: 1e-6),
)
