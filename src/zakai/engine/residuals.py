"""Residuals: where each observation lies in its one-step-ahead predictive law.

The density of a coordinate z given the past is the evidence of the filter's own step as a function of z; for an increment, times
the density of the noise alone.  Its distribution function is a quadrature over z, so that every method and every kind of
observation is served, with the accuracy of the method.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from math import inf, isfinite, log, nan, pi
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zakai.engine.forecast import origin_of
from zakai.engine.loop import CHUNK, PIECE, Run, advance
from zakai.engine.plan import ByBlocks
from zakai.errors import InputError
from zakai.models.numeric import numpy_function
from zakai.records.schedule import Schedule

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

Array = NDArray[Any]
COUNTS, ANGLES = ("poisson", "bernoulli"), ("von-mises",)
NODES, MOST_NODES = 12, 1536  # of the quadrature: doubled until it has converged
CHANGE = 3e-3  # between two numbers of nodes; the error of the larger is about its square
NEGLIGIBLE = 11.0  # nats below the maximum of the density
MASS_ERROR = 0.02  # of a predictive law, in nats, above which the residuals are reported as doubtful
WIDTH = 3.0  # predictive standard deviations to which half of the nodes are given
SUMMED = 64  # the largest count whose probabilities are summed one by one


def residuals(result: FilterResult, seed: int = 0, first: int = 0) -> Array:
    """Return the probability integral transforms (K, m); see `FilterResult.residuals`.  Rows before `first` are left out."""
    plan, _, record = origin_of(result, "residuals")
    draws = np.random.default_rng(seed).uniform(size=record.values.shape)
    found: Array = np.full(draws.shape, np.nan)
    runs = plan.runs(record, "moments")
    blocks: Sequence[Any] = plan.division.blocks if isinstance(plan, ByBlocks) else [None]
    error = 0.0
    for run, block in zip(runs, blocks, strict=True):
        columns = list(range(record.values.shape[1])) if block is None else list(block.observations)
        if not columns:
            continue
        laws = _PredictiveLaws(run)
        for k, row in laws.rows(first):
            below, upto = row
            found[k, columns] = below + draws[k, columns] * (upto - below)
        error = max(error, laws.mass_error)
    if error > MASS_ERROR:
        warnings.warn(
            f"residuals: the mass of a predictive law differs from 1 by {error:.2g} nats: the steps are too long for increments, "
            "the law of the samples is not normalised, or the filter is not accurate there",
            stacklevel=3,
        )
    return found


class _PredictiveLaws:
    """The laws of the observations of one run, each given those before it.

    `mass_error`: the largest error of the logarithm of the mass of a law.
    """

    def __init__(self, run: Run):
        self.run, self.setting = run, run.setting
        model = run.setting.model
        self.samples = model.observation_kind == "samples"
        self.families = model.observation_law.families if self.samples else ("gaussian",) * model.m
        if self.samples and model.log_density is not None and model.m > 1:
            raise InputError(
                f"{model.source}: residuals: observation_log_density of several coordinates gives no law of one of them"
            )
        self.theta = run.setting.theta
        self.h = None if model.log_density is not None else numpy_function(list(model.observation), model)
        self.noise = numpy_function(model.observation_noise, model, model.observation_noise.shape)
        self.mass_error = 0.0
        spread = [_spread(run.values[run.schedule.seen[:, j], j]) for j in range(model.m)]
        self.centres, self.scales = (np.array(column) for column in zip(*spread, strict=True))

    def rows(self, first: int) -> Any:
        """Yield (k, (P(Z < z), P(Z <= z))), both (m,), for the rows from `first` on."""
        run, count = self.run, len(self.run.schedule)
        state = run.state
        for start in range(0, count, CHUNK):
            chunk = run.schedule.part(slice(start, min(start + CHUNK, count)))
            prepared = self.setting.prepared(chunk)
            prefixes: list[tuple[Schedule, Any]] = []
            if start + len(chunk) > first:
                prefixes = [(part, self.setting.prepared(part)) for part in _prefixes(chunk)]
            for begin in range(0, len(chunk), PIECE):
                rows = slice(begin, min(begin + PIECE, len(chunk)))
                with np.errstate(all="ignore"):
                    states, _ = advance(self.setting, prepared, rows, state, run.values[start + rows.start : start + rows.stop])
                    for k, before in zip(range(rows.start, rows.stop), [state, *states]):
                        if start + k >= first:
                            yield start + k, self._row(k, before, run.values[start + k], prefixes)
                state = states[-1]

    def _row(self, k: int, state: Any, values: Array, prefixes: list[tuple[Schedule, Any]]) -> tuple[Array, Array]:
        """Return P(Z < z) and P(Z <= z) of the coordinates of one row."""
        seen = np.flatnonzero(prefixes[-1][0].seen[k])
        below, upto = np.full((2, len(values)), np.nan)
        for i, j in enumerate(map(int, seen)):
            known = seen[:i]
            earlier = np.where(np.isin(range(len(values)), known), values, 0.0)
            log_mass, info = self._evidence(prefixes[i], k, state, earlier, known)
            schedule = prefixes[i + 1][0]

            def log_density(z: float, i: int = i, j: int = j, known: Any = known, log_mass: float = log_mass) -> float:
                row = np.where(np.isin(range(len(values)), known), values, 0.0)
                row[j] = z
                value = self._evidence(prefixes[i + 1], k, state, row, np.append(known, j))[0] - log_mass
                return value if isfinite(value) else -inf

            below[j], upto[j] = self._probabilities(log_density, float(values[j]), j, self._location(schedule, k, info, j))
        return below, upto

    def _evidence(
        self, prefix: tuple[Schedule, Any], k: int, state: Any, values: Array, known: Array
    ) -> tuple[float, tuple[Array, Array]]:
        """Return the log density of some coordinates of a row given the past, and the moments of the state given both."""
        schedule, prepared = prefix
        _, info = self.setting.method.step(prepared, k, state, values)
        value = float(np.real(info.log_likelihood_increment))
        if not self.samples and len(known):  # the step gives the density relative to that of the noise
            cov = self._noise_covariance(schedule, k, known)
            z = values[known]
            value -= 0.5 * float(z @ np.linalg.solve(cov, z) + np.linalg.slogdet(2 * pi * cov)[1])
        return value, (info.mean, info.cov)

    def _noise_covariance(self, schedule: Schedule, k: int, known: Array) -> Array:
        """Return the covariance of the noise of increments of some coordinates, integrated over their common time."""
        elapsed, stop = schedule.elapsed[k, known], float(schedule.stops[k])
        common = np.minimum.outer(elapsed, elapsed)
        nodes, weights = np.polynomial.legendre.leggauss(4)
        total = np.zeros(common.shape)
        for node, weight in zip(0.5 * (nodes + 1), 0.5 * weights, strict=True):
            for a, row in enumerate(known):
                for b, column in enumerate(known):
                    t = stop - common[a, b] * node
                    total[a, b] += weight * common[a, b] * self._at(self.noise, np.zeros(self.setting.model.n), t)[row, column]
        return total

    def _at(self, function: Callable[..., Array], points: Array, t: float) -> Array:
        """Return a function of the model at points of the state."""
        inputs = self.run.schedule.inputs
        u = None if inputs is None else inputs.at(t, self.setting.model.input_hold)
        return np.real(function(points, t, self.theta, u))

    def _location(self, schedule: Schedule, k: int, moments: tuple[Array, Array], j: int) -> tuple[float, float]:
        """Return the centre and the scale of the nodes: the predictive moments by a rule of degree three."""
        mean, cov = moments
        n, t = len(mean), float(schedule.stops[k])
        if self.h is not None and np.isfinite(cov).all():
            values, vectors = np.linalg.eigh(cov)
            steps = np.sqrt(n + 2) * (vectors * np.sqrt(np.maximum(values, 0.0))).T
            points = np.concatenate([mean[None], mean + steps, mean - steps])
            weights = np.full(2 * n + 1, 0.5 / (n + 2))
            weights[0] = 2.0 / (n + 2)
            h = self._at(self.h, points, t)[:, j]
            centre = float(weights @ h)
            variance = float(weights @ (h - centre) ** 2)
            time = 1.0 if self.samples else float(schedule.elapsed[k, j])
            if self.families[j] in COUNTS:
                noise = max(centre, 1.0)
            else:
                noise = float(self._at(self.noise, mean, t)[j, j])
            scale = float(np.sqrt(variance * time**2 + noise * time))
            if isfinite(centre) and isfinite(scale) and scale > 0:
                return centre * time, WIDTH * scale
        return float(self.centres[j]), WIDTH * float(self.scales[j])

    def _probabilities(
        self, log_density: Callable[[float], float], z: float, j: int, location: tuple[float, float]
    ) -> tuple[float, float]:
        """Return P(Z < z) and P(Z <= z) for one coordinate."""
        family = self.families[j]
        if family in COUNTS and z <= SUMMED:
            terms = np.exp([log_density(float(count)) for count in range(int(z) + 1)])
            return float(terms[:-1].sum()), float(terms.sum())
        if family in ANGLES:
            z = pi - (pi - z) % (2 * pi)
            location = 0.0, 0.0
        # The sum over many counts is the integral between halves.
        ends = [z - 0.5, z + 0.5] if family in COUNTS else [z]
        positive = (lambda v: log_density(v) if v > -0.5 else -inf) if family in COUNTS else log_density
        found, log_mass = distribution(positive, ends, *location)
        self.mass_error = max(self.mass_error, abs(log_mass) if isfinite(log_mass) else inf)
        return found[0], found[-1]


def distribution(
    log_density: Callable[[float], float], ends: Sequence[float], centre: float, scale: float
) -> tuple[list[float], float]:
    """Return the distribution function of a density at some ends, normalised, and the logarithm of the density's mass.

    With z = centre + scale tan(u) the density of u is periodic and smooth, and so is the sum of its Fourier series, which is
    integrated term by term; the error falls exponentially with the number of nodes (Trefethen and Weideman 2014).  A scale of
    zero stands for an angle, z = 2 u.
    """
    angle = scale == 0.0
    places = 0.5 * np.asarray(ends) if angle else np.arctan((np.asarray(ends) - centre) / scale)

    def log_value(u: float) -> float:
        if angle:
            return log_density(2.0 * u) + log(2.0)
        return log_density(centre + scale * float(np.tan(u))) + log(scale) - 2.0 * log(np.cos(u))

    count, logs = NODES, _first_values(log_value, angle)
    previous, found, log_mass = np.full(len(places), inf), np.full(len(places), nan), -inf
    skip = True  # nodes that add nothing; until mass is missing
    while True:
        top = logs.max()
        if isfinite(top):
            found, mass = _integrated(np.exp(logs - top), places)
            log_mass = log(mass) + top if mass > 0 else -inf
            if np.abs(found - previous).max() < CHANGE:
                if abs(log_mass) < MASS_ERROR or count >= 16 * NODES:
                    break
                skip = False
        if count >= MOST_NODES:
            break
        previous, count = found, 2 * count
        finer = np.full(count, -inf)
        finer[::2] = logs
        near = np.maximum(finer, np.maximum(np.roll(finer, 1), np.roll(finer, -1)))
        for j in np.flatnonzero(np.isneginf(finer)):
            if (j % 2 and near[j] > top - NEGLIGIBLE) or not (skip and isfinite(top)):
                finer[j] = log_value(pi * (j / count - 0.5)) if j or angle else -inf
        logs = finer
    return [float(np.clip(value, 0.0, 1.0)) for value in found], log_mass


def _first_values(log_value: Callable[[float], float], angle: bool) -> Array:
    """Return the logarithms at the first nodes, from the middle outward; the tails end where an extrapolation is negligible.

    An observation far in the tail can cost a method many times more than a usual one.
    """
    nodes = pi * (np.arange(NODES) / NODES - 0.5)
    if angle:
        return np.array([log_value(u) for u in nodes])
    logs, z, middle = np.full(NODES, -inf), np.tan(nodes), NODES // 2
    for j in range(middle - 2, middle + 3):
        logs[j] = log_value(nodes[j])
    for side in (-1, 1):
        for j in (middle + side * step for step in range(3, middle)):
            last = [j - 3 * side, j - 2 * side, j - side]
            if np.isfinite(logs[last]).all():
                expected = np.polyval(np.polyfit(z[last], logs[last], 2), z[j])
                if max(expected, logs[j - side] - NEGLIGIBLE / 2) < logs.max() - NEGLIGIBLE:
                    break
            logs[j] = log_value(nodes[j])
    return logs


def _integrated(values: Array, places: Array) -> tuple[Array, float]:
    """Return the share of the integral of a function of period pi that lies below each place, and the integral from -pi/2."""
    count = len(values)
    coefficients = np.fft.rfft(values) / count
    order = np.arange(1, len(coefficients))
    weights = np.where(2 * order == count, 1.0, 2.0) * coefficients[1:] / (2j * order)
    mean = coefficients[0].real
    waves = np.exp(2j * np.multiply.outer(places + 0.5 * pi, order)) - 1.0
    return ((waves @ weights).real + mean * (places + 0.5 * pi)) / (mean * pi), mean * pi


def _prefixes(schedule: Schedule) -> list[Schedule]:
    """Return the schedules in which only the first 0, 1, ..., m of the observed coordinates of each row are observed."""
    order = np.cumsum(schedule.seen, axis=1)
    found = []
    for count in range(schedule.seen.shape[1] + 1):
        seen = schedule.seen & (order <= count)
        elapsed = np.where(seen, schedule.elapsed, 0.0)
        found.append(Schedule(schedule.starts, schedule.stops, seen, elapsed, schedule.inputs))
    return found


def _spread(values: Array) -> tuple[float, float]:
    """Return the median of the observations of one coordinate and a scale of them."""
    if not len(values):
        return 0.0, 1.0
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return float(middle), float(high - low) / 3.3 or max(abs(float(middle)), 1.0)
