"""What the filters on density grids in two to four states share: the formulas of a model, its prior, and moments of densities."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import lru_cache
from typing import Any

import numpy as np
import sympy

from zakai.methods.space.filter import State
from zakai.methods.space.functions import PointFunction
from zakai.models.features import OF_OBSERVATION, STATE_DEPENDENT_DIFFUSION
from zakai.models.functions import Floor, Maximum, Minimum, TableFunction, without_jumps
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.prior_grid import PriorGrid, mixture_grid, prior_grid
from zakai.numerics.space.average import average
from zakai.numerics.space.field import Field
from zakai.numerics.space.grid import Grid, weighted_products
from zakai.numerics.space.survey import Survey, survey
from zakai.numerics.space.transport import Dynamics
from zakai.records.inputs import Inputs

Array = Any
_ROUGH: tuple[Any, ...] = (sympy.Abs, sympy.sign, Floor, Maximum, Minimum, TableFunction)
Caches = tuple[dict[Any, Any], dict[Any, Any]]


class System:
    """The formulas of a model as functions of many points, times, parameters and, where the model has some, inputs."""

    def __init__(self, model: Model):
        n, m, x = model.n, model.m, model.x
        divergence = sum((without_jumps(f, s) for f, s in zip(model.drift, x, strict=True)), start=sympy.S.Zero)
        self.n, self.hold = n, model.input_hold
        self.drift: Callable[..., Array] = PointFunction([*model.drift, divergence], model, (n + 1,))
        self.jacobian: Callable[..., Array] = PointFunction([without_jumps(f, s) for f in model.drift for s in x], model, (n, n))
        self.covariance = numpy_function(model.covariance, model, (n, n))
        self.observe = PointFunction(list(model.observation), model, (m,))
        self.slopes = PointFunction([without_jumps(h, s) for h in model.observation for s in x], model, (m, n))
        self.noise = numpy_function(model.observation_noise, model, (m, m))
        given = {model.t, *model.u}
        self.drift_varies = bool(model.drift.free_symbols & given)
        self.covariance_varies = bool(model.covariance.free_symbols & given)
        self.observation_varies = bool(model.observation.free_symbols & given)
        self.noise_varies = bool(model.observation_noise.free_symbols & given)
        self.varies = self.drift_varies or self.covariance_varies or self.observation_varies or self.noise_varies
        self.varies = self.varies or bool(model.u)
        # Whether samples have a law that is not N(h(x, t), S(t)).
        self.general = model.observation_kind == "samples" and bool(model.u or OF_OBSERVATION & model.features.keys())
        # Whether the law of what is observed has kinks or jumps in the state.
        parts = [*model.observation, *model.observation_noise, *model.family_parameters.values()]
        calls = set().union(*(part.atoms(*_ROUGH) for part in [*parts, *([model.log_density] if model.log_density else [])]))
        self.rough = any(call.has(*x) and not (isinstance(call, TableFunction) and call.table.degree > 1) for call in calls)
        self.tables = [(call.table, numpy_function(list(call.args), model, (len(call.args),))) for call in _table_calls(model)]
        self.state_dependent = STATE_DEPENDENT_DIFFUSION in model.features
        self._caches: dict[bytes, Caches] = {}

    def over(self, inputs: Inputs | None, start: float, stop: float) -> System:
        """Return the functions with the inputs over a part of an interval, whose end counts as the limit from inside."""
        if inputs is None:
            return self
        bound, last = copy(self), np.nextafter(stop, start)

        def bind(function: Callable[..., Array]) -> Callable[..., Array]:
            def with_inputs(x: Array, t: Any, theta: Array) -> Array:
                return function(x, t, theta, inputs.at(np.clip(t, start, last), self.hold))

            return with_inputs

        for name in ("drift", "jacobian", "covariance", "observe", "slopes", "noise"):
            setattr(bound, name, bind(getattr(self, name)))
        return bound

    def outside(self, points: Array, t: float, theta: Array, u: Array | None) -> Array:
        """Return which points (J, n) lead beyond the range of a table."""
        found = np.zeros(len(points), bool)
        for table, arguments in self.tables:
            found |= table.outside(*np.moveaxis(arguments(points, t, theta, u).real, -1, 0))
        return found

    def caches(self, theta: Array) -> Caches:
        """Return the tables that are kept for some parameters: what they hold does not depend on who asks for it."""
        key = np.asarray(theta).tobytes()
        if key not in self._caches:
            if len(self._caches) >= 4:
                self._caches.clear()
            self._caches[key] = {}, {}
        return self._caches.get(key, ({}, {}))

    def dynamics(self, theta: Array) -> Dynamics:
        """Return the drift and the noise for some parameters."""
        origin = np.zeros(self.n)
        constant = None if self.covariance_varies or self.state_dependent else self.covariance(origin, 0.0, theta)

        def diffusion(x: Array, t: float) -> Array:
            found = self.covariance(x, t, theta)
            return np.where(valid_noise(found)[:, None, None], found, 0.0)

        def noise(t0: float, t1: float) -> tuple[Array, Array]:
            if constant is not None:
                return constant, 0.5 * constant
            found = average(lambda t: self.covariance(origin, t, theta), t0, t1 - t0)
            return found.whole, found.falling

        return Dynamics(
            lambda x, t: self.drift(x, t, theta), lambda x, t: self.jacobian(x, t, theta), noise, self.drift_varies,
            diffusion if self.state_dependent else None,
            self.drift.formulas(theta) if isinstance(self.drift, PointFunction) else None,
        )  # fmt: skip


def valid_noise(noise: Array) -> Array:
    """Return which matrices (J, n, n) are finite and have no negative variance."""
    variances = np.diagonal(noise.real, axis1=1, axis2=2)
    return np.asarray(np.isfinite(noise.real).all(axis=(1, 2)) & (variances >= 0).all(axis=1))


def _table_calls(model: Model) -> list[Any]:
    """Return the calls of tables in the formulas of a model that depend on the state."""
    parts = [*model.drift, *model.diffusion, *model.observation, *model.observation_noise, *model.family_parameters.values()]
    parts += [] if model.log_density is None else [model.log_density]
    return sorted({call for part in parts for call in part.atoms(TableFunction) if call.has(*model.x)}, key=str)


@once_for_a_model
def system_of(model: Model) -> System:
    """Return the functions of a model, made once."""
    return System(model)


def grid_of(state: State, periodic: tuple[bool, ...]) -> Grid:
    """Return the grid of a state."""
    sizes = state.values.shape
    closed = tuple(angle and abs(state.basis[d, d] * sizes[d] - 2 * np.pi) < 1e-9 for d, angle in enumerate(periodic))
    return _shared(np.asarray(state.centre, float).tobytes(), np.asarray(state.basis, float).tobytes(), sizes, closed)


@lru_cache(maxsize=4)
def _shared(centre: bytes, basis: bytes, sizes: tuple[int, ...], closed: tuple[bool, ...]) -> Grid:
    """Return one grid for all states on it, with what was computed for it."""
    n = len(sizes)
    return Grid(np.frombuffer(centre).copy(), np.frombuffer(basis).reshape(n, n).copy(), sizes, closed)


def prior_on_grid(model: Model, prior: Any, theta: Array, tolerance: float, periodic: tuple[bool, ...]) -> PriorGrid:
    """Return the prior on a grid; InputError where it has no density."""
    source = f"{model.source}: prior"
    aligned = any(periodic)
    if isinstance(prior, DensityPrior):
        function = numpy_function([prior.log_density], model, ())
        return prior_grid(
            lambda x: function(x, model.start, theta), model.n, periodic, tolerance=tolerance, aligned=aligned,
            source=f"{source}: log_density",
        )  # fmt: skip
    weights, means, covs = prior.components
    return mixture_grid(weights, means, covs, periodic, tolerance=tolerance, aligned=aligned, source=source)


def moments_of(values: Array, grid: Grid, periodic: tuple[bool, ...], found: Survey | None = None) -> tuple[Array, Array]:
    """Return the mean (n,) and covariance (n, n) of a real density, whose survey may be given.

    The mean of an angle is the direction of its resultant, and its deviations are wrapped to (-pi, pi].
    """
    if not any(periodic):
        found = survey(values, grid) if found is None else found
        return grid.centre + found.mean, found.cov
    weights = values.reshape(-1) / values.sum()
    offsets, angle = grid.offsets, np.array(periodic)
    cos, sin = weights @ np.cos(offsets), weights @ np.sin(offsets)
    direction = np.where(np.hypot(sin, cos) > 1e-9, np.arctan2(sin, cos), -grid.centre)
    mean = np.where(angle, direction, weights @ offsets)
    apart = offsets - mean
    apart = np.where(angle, apart - 2 * np.pi * np.round(apart / (2 * np.pi)), apart)
    where = grid.centre + mean
    return np.where(angle, np.pi - np.mod(np.pi - where, 2 * np.pi), where), weighted_products(weights, apart)


def moments_of_exponentials(
    field: Field, periodic: tuple[bool, ...], logarithms: tuple[bool, ...]
) -> tuple[Array, Array, float]:
    """Return the mean (n,) and covariance (n, n) of x, x_i = e^(w_i) for `logarithms`, from a real density of w on a grid.

    The third is the largest value at the edges of the grid of the marginals of x_i^2 times the density, relative to their maxima.
    """
    grid, chosen = field.grid, np.flatnonzero(logarithms)
    mean, cov = moments_of(field.values.real, grid, periodic)
    weights, points = field.values.real.reshape(-1) / field.values.real.sum(), grid.points
    x = np.exp(points[:, chosen])
    apart = points - mean
    apart = np.where(periodic, apart - 2 * np.pi * np.round(apart / (2 * np.pi)), apart)
    mean, edges = mean.copy(), []
    for d, column in zip(chosen, x.T, strict=True):
        mean[d] = weights @ column
        apart[:, d] = column - mean[d]
        edges.append(survey((weights * (column / mean[d]) ** 2).reshape(grid.sizes), grid, 0.0).edges.max())
    return mean, weighted_products(weights, apart), float(max(edges))
