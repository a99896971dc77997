"""The law of the observations of a row by sums over densities of the state: points of a grid, Gaussians, or quasi-random draws.

Samples: P(Z <= z) = E F(z | x) over the predicted density. A sum of Gaussians whose observation is not affine, and a tensor
train, give `DRAWS` points: F has errors of at most about 1e-3 then.

An increment over an interval of length tau is the integral I of h plus noise. With x the state in the middle of the interval, I
has the mean of tau h(x) to second order in tau, and its variance less E C, C = tau^3 H G H' / 6, H = dh/dx. So an increment has
the law of a mixture of N(tau h(x), R (R + C)^-1 R), R = S tau, where the noise is reduced by C to first order and stays positive.
An increment over several intervals has the law that the filter gives it, from the state at its end. Coordinates of a row are
taken in order, each given those before it: by weights, or, of samples with draws, by the filter's update with those before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.algebra.systems import affine_observation
from zakai.densities import (
    ConditionalParticleDensity,
    Density,
    GaussianMixture,
    GridDensity,
    IntervalDensity,
    PointMasses,
    TensorTrainDensity,
)
from zakai.densities.logarithmic import LogarithmicDensity
from zakai.densities.mapped import MappedDensity
from zakai.engine.setting import Setting
from zakai.methods.system.residuals import Sensors
from zakai.models.checks import depends_on_state
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import STEP
from zakai.numerics.quasi_random import quasi_random
from zakai.records.schedule import Schedule

Array = NDArray[Any]
Pair = tuple[Array, Array]
ROUGH = 0.05  # difference of the sums over even and odd points above which a grid is too coarse; the error is about its 4th power
_CELLS = 1024  # of a density between reflecting ends
NEGLIGIBLE = 1e-15  # weight of a point, relative to the largest
DRAWS = 2**14  # of a density that is neither a grid nor points
FEWEST = 2**11  # effective number of draws, below which they are too few


class Mixture(NamedTuple):
    """A density as points (N, n) with `weights` (N,); with `covs` (N, n, n) they are Gaussians.

    `signs` are alternating signs (N,) along each axis of a grid; `fewest` is the effective number of points that is needed.
    """

    weights: Array
    points: Array
    covs: Array | None
    signs: Sequence[Array]
    fewest: float = 0.0

    @classmethod
    def drawn(cls, density: Density) -> Mixture | None:
        """Return a density as quasi-random draws, always the same; None where it has none."""
        if isinstance(density, TensorTrainDensity):
            weights, points = density.quadrature(DRAWS)
        elif isinstance(density, GaussianMixture):
            weights, points = density.drawn(quasi_random(DRAWS, len(density.names) + 1))
        else:
            return None
        return cls(weights, points, None, (), FEWEST)

    @classmethod
    def of(cls, density: Density) -> Mixture | None:
        """Return a density as a mixture, without what is negligible; None where it is none."""
        if isinstance(density, GaussianMixture):
            return None if any(density.periodic) else cls(density.weights, density.means, density.covs, ())
        if isinstance(density, ConditionalParticleDensity):
            density = density.drawn()
        if isinstance(density, PointMasses):
            return cls(density.weights, density.points, None, ())
        if isinstance(density, IntervalDensity):
            faces = np.linspace(density.nodes[0], density.nodes[-1], _CELLS + 1)
            points = 0.5 * (faces[1:] + faces[:-1])[:, None]
            weights = np.exp(density.log_density(points))
            weights = weights / np.sum(weights)
        elif isinstance(density, GridDensity | LogarithmicDensity | MappedDensity):
            weights, points = density.weights, density.points
        else:
            return None
        used = weights > NEGLIGIBLE * weights.max()
        signs = [np.where(np.indices(weights.shape)[axis] % 2, -1.0, 1.0)[used] for axis in range(weights.ndim)]
        return cls(weights[used], points[used], None, signs)

    def probabilities(self, seen: Array, terms: Array, below: Array, upto: Array) -> Pair | None:
        """Return P(Z_j < z_j) and P(Z_j <= z_j) (m,) given those before; None where the grid is too coarse or points too few.

        Args:
            seen: the observed coordinates (m,).
            terms: the log densities (N, m) of the coordinates, each given the point and the coordinates before.
            below: P(Z_j < z_j) (N, m), likewise.
            upto: P(Z_j <= z_j) (N, m), likewise.
        """
        found = np.full((2, len(seen)), np.nan)
        logs = np.zeros(len(self.weights))
        for j in np.flatnonzero(seen):
            shares = self.weights * np.exp(logs - logs.max())
            both = np.stack([np.ones(len(shares)), below[:, j], upto[:, j]])
            total, *sums = both @ shares
            if total**2 < self.fewest * (shares @ shares):
                return None
            for sign in self.signs:
                if not np.all(np.abs(both @ (sign * shares)) <= ROUGH * total):
                    return None
            found[:, j] = np.array(sums) / total
            if not np.isfinite(found[:, j]).all():
                return None
            logs = logs + terms[:, j]
        return found[0], found[1]


class PredictiveSums:
    """The laws of the rows of one run by sums; `row` returns None where another way is needed.

    `length_share`: the largest tr(tau H G H' / (6 S)) of a row, the correction of an increment's variance.
    """

    def __init__(self, setting: Setting, schedule: Schedule):
        self.setting, self.model, self.theta = setting, setting.model, setting.theta
        self.schedule, self.inside, self.lengths = schedule, schedule.inside, schedule.lengths
        self.length_share = 0.0
        self.prefixes: dict[int, tuple[Schedule, Any]] = {}
        model, symbols = self.model, self.model.observation.free_symbols
        self.samples = model.observation_kind == "samples"
        fixed = not symbols & {model.t, *model.u} and not model.cross_noise.todok()
        self.possible = model.log_density is None if self.samples else fixed
        gaussian = not self.samples or model.observation_law.is_gaussian
        self.gaussian = gaussian and not depends_on_state(model.observation_noise, model)
        self.sensors = Sensors.of(model)
        self.h, self.noise = self.sensors.observed, self.sensors.noise
        self.spread = numpy_function(model.covariance, model, (model.n, model.n))

    @cached_property
    def affine(self) -> bool:
        """Whether h is an affine function of the state."""
        return affine_observation(self.model) is not None

    def inputs(self, t: float) -> Array | None:
        """Return the known inputs at a time."""
        known = self.schedule.inputs
        return None if known is None else known.at(t, self.model.input_hold)

    def slopes(self, points: Array, t: float) -> Array:
        """Return the Jacobian of h (N, m, n) at points."""
        moved = points[:, None] + 1j * STEP * np.eye(self.model.n)
        found = self.h(moved, t, self.theta, self.inputs(t)).imag / STEP
        return np.swapaxes(found, 1, 2)

    def noise_of_increments(self, k: int) -> Array:
        """Return the covariance (m, m) of the noise of the increments at the end of interval k, over the time they share."""
        elapsed, stop = self.schedule.elapsed[k], float(self.schedule.stops[k])
        return self.sensors.shared_noise(stop, elapsed, self.theta, np.arange(self.model.m))

    def prefix(self, count: int) -> tuple[Schedule, Any]:
        """Return the schedule in which the first coordinates of a row are observed, and what is prepared for it.

        Samples are predicted once: its intervals begin at the times of the rows.
        """
        if count not in self.prefixes:
            seen = self.schedule.seen & (np.cumsum(self.schedule.seen, axis=1) <= count)
            starts = self.schedule.stops if self.samples else self.schedule.starts
            elapsed = np.where(seen, self.schedule.elapsed, 0.0)
            found = Schedule(starts, self.schedule.stops, seen, elapsed, self.schedule.inputs)
            self.prefixes[count] = found, self.setting.prepared(found)
        return self.prefixes[count]

    @cached_property
    def unobserved(self) -> Schedule:
        """The schedule of predictions from the start of each interval to the time of its law, with nothing observed."""
        starts, stops, seen, elapsed, inputs = self.schedule
        times = stops if self.samples else np.where(self.inside.any(axis=1), 0.5 * (starts + stops), stops)
        return Schedule(starts, times, np.zeros_like(seen), np.zeros_like(elapsed), inputs)

    def predicted(self, k: int, state: Any) -> tuple[Any, Any]:
        """Return what is prepared for predictions, and the state at the time of the law of interval k."""
        prepared = self.setting.prepared(self.unobserved)
        return prepared, self.setting.method.step(prepared, k, state, np.zeros(self.model.m))[0]

    def row(self, k: int, state: Any, values: Array) -> Pair | None:
        """Return P(Z_j < z_j) and P(Z_j <= z_j) (m,) of the observations at the end of interval k, from the state before it."""
        which, inside = np.flatnonzero(self.schedule.seen[k]), self.inside[k].any()
        if not self.possible or (inside and np.any(self.inside[k] != self.schedule.seen[k])):
            return None
        prepared, predicted = self.predicted(k, state)
        density = self.setting.method.density(prepared, predicted)
        mixture = Mixture.of(density)
        if mixture is None or (mixture.covs is not None and not (self.gaussian and self.affine)):
            mixture = Mixture.drawn(density)
            if mixture is not None and self.samples:
                return self._samples_drawn(k, which, mixture, predicted, values)
        if mixture is None:
            return None
        found = (self._samples if self.samples else self._increments)(k, which, mixture, values)
        return None if found is None else mixture.probabilities(self.schedule.seen[k], *found)

    def _samples_at(self, k: int, which: Array, points: Array, values: Array) -> tuple[Array, Array, Array]:
        """Return what `_samples` returns, at points (N, n)."""
        law, t = self.model.observation_law, float(self.schedule.stops[k])
        given = np.full(len(values), np.nan)
        given[which] = values[which]
        return law.terms(given, points, t, self.theta, self.inputs(t)), *law.cdf(given, points, t, self.theta, self.inputs(t))

    def _samples(self, k: int, which: Array, mixture: Mixture, values: Array) -> tuple[Array, Array, Array] | None:
        """Return the log densities and both distribution functions (N, m) of the coordinates `which`, each given those before."""
        if mixture.covs is None:
            return self._samples_at(k, which, mixture.points, values)
        model, t, points = self.model, float(self.schedule.stops[k]), mixture.points
        inputs = self.inputs(t)
        slopes = self.slopes(points, t)
        covs = self.noise(np.zeros(model.n), t, self.theta, inputs) + slopes @ mixture.covs @ np.swapaxes(slopes, 1, 2)
        return _gaussian(which, values - self.h(points, t, self.theta, inputs), covs)

    def _samples_drawn(self, k: int, which: Array, mixture: Mixture, state: Any, values: Array) -> Pair:
        """Return the law of samples from the predicted state and draws of it; each coordinate updates the state for the next."""
        method, below, upto = self.setting.method, np.full(len(values), np.nan), np.full(len(values), np.nan)
        for count, j in enumerate(which):
            if count:
                prepared = self.prefix(count)[1]
                known = np.where(self.prefix(count)[0].seen[k], values, 0.0)
                updated = Mixture.drawn(method.density(prepared, method.step(prepared, k, state, known)[0]))
                assert updated is not None
                mixture = updated
            _, *pair = self._samples_at(k, which[: count + 1], mixture.points, values)
            below[j], upto[j] = (mixture.weights @ side[:, j] for side in pair)  # NaN where the density is lost
        return below, upto

    def noise_at(self, k: int, which: Array, mixture: Mixture) -> Array:
        """Return the covariances (N, m, m) of the increments of interval k given the state in its middle."""
        t, span, points = float(self.unobserved.stops[k]), self.schedule.elapsed[k], mixture.points
        covs = np.broadcast_to(self.noise_of_increments(k), (len(points), len(span), len(span))).copy()
        if self.inside[k].any():
            slopes = span[:, None] * self.slopes(points, t)
            spread = self.spread(points, t, self.theta, self.inputs(t))
            excess = self.lengths[k] / 6.0 * (slopes @ spread @ np.swapaxes(slopes, 1, 2))
            block = np.ix_(np.arange(len(points)), which, which)
            noise, total = covs[block], covs[block] + excess[block]
            share = mixture.weights @ np.trace(np.linalg.solve(noise, excess[block]), axis1=1, axis2=2)
            self.length_share = max(self.length_share, float(share))
            covs[block] = noise @ np.linalg.solve(total, noise)
        return covs

    def _increments(self, k: int, which: Array, mixture: Mixture, values: Array) -> tuple[Array, Array, Array] | None:
        t, span = float(self.unobserved.stops[k]), self.schedule.elapsed[k]
        points, inputs = mixture.points, self.inputs(t)
        slopes = span[:, None] * self.slopes(points, t)
        back = np.swapaxes(slopes, 1, 2)
        covs = self.noise_at(k, which, mixture)
        if mixture.covs is not None:
            covs = covs + slopes @ mixture.covs @ back
        return _gaussian(which, values - span * self.h(points, t, self.theta, inputs), covs)


def _gaussian(which: Array, apart: Array, covs: Array) -> tuple[Array, Array, Array] | None:
    """Return the log densities and (twice) the distribution functions (N, m) of z - mean = `apart`, each given those before."""
    from scipy.special import ndtr

    try:
        factors = np.linalg.cholesky(covs[:, which[:, None], which])
    except np.linalg.LinAlgError:
        return None
    white = np.linalg.solve(factors, apart[:, which, None])[..., 0]
    terms, cdf = np.zeros(apart.shape), np.full(apart.shape, np.nan)
    terms[:, which] = -0.5 * white**2 - np.log(np.diagonal(factors, axis1=1, axis2=2))
    cdf[:, which] = ndtr(white)
    return terms, cdf, cdf
