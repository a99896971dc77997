"""The law of the observations of a row by quadrature over the evidence of the filter's own step, for every method."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.diagnostics.predictive import Pair, PredictiveSums
from zakai.engine.setting import Setting
from zakai.models.families import COUNTS
from zakai.numerics.tangent_quadrature import distribution
from zakai.records.schedule import Schedule

Array = NDArray[Any]
WIDTH = 3.0  # predictive standard deviations to which half of the nodes are given
SUMMED = 64  # the largest count whose probabilities are summed one by one


class PredictiveEvidence:
    """The laws of the rows of a schedule.

    `mass_error`: the largest error of the logarithm of the mass of a law.
    """

    def __init__(self, setting: Setting, schedule: Schedule, sums: PredictiveSums, spread: list[tuple[float, float]]):
        self.setting, self.model, self.sums, self.spread = setting, setting.model, sums, spread
        self.samples = self.model.observation_kind == "samples"
        law = self.model.observation_law
        self.families = law.families if self.samples else ("gaussian",) * self.model.m
        self.angles = [angle or family == "von-mises" for angle, family in zip(law.angles, self.families, strict=True)]
        self.schedule = schedule
        self.mass_error = 0.0

    def row(self, k: int, state: Any, values: Array) -> Pair:
        """Return P(Z_j < z_j) and P(Z_j <= z_j) (m,) of the observations at the end of interval k, from the state before it."""
        seen = np.flatnonzero(self.schedule.seen[k])
        below, upto = np.full((2, len(values)), np.nan)
        if self.samples:
            state = self.sums.predicted(k, state)[1]
        for i, j in enumerate(map(int, seen)):
            known = seen[:i]
            earlier = np.where(np.isin(range(len(values)), known), values, 0.0)
            log_mass, moments = self._evidence(i, k, state, earlier, known)

            def log_density(z: float, i: int = i, j: int = j, known: Any = known, log_mass: float = log_mass) -> float:
                row = np.where(np.isin(range(len(values)), known), values, 0.0)
                row[j] = z
                value = self._evidence(i + 1, k, state, row, np.append(known, j))[0] - log_mass
                return value if isfinite(value) else -inf

            location = self._location(self.sums.prefix(i + 1)[0], k, moments, j)
            below[j], upto[j] = self._probabilities(log_density, float(values[j]), j, location)
        return below, upto

    def _evidence(self, count: int, k: int, state: Any, values: Array, known: Array) -> tuple[float, Pair]:
        """Return the log density of some coordinates of a row given the past, and the moments of the state given both."""
        _, info = self.setting.method.step(self.sums.prefix(count)[1], k, state, values)
        value = float(np.real(info.log_likelihood_increment))
        if not self.samples and len(known):  # the step gives the density relative to that of the noise
            cov = self.sums.noise_of_increments(k)[np.ix_(known, known)]
            z = values[known]
            value -= 0.5 * float(z @ np.linalg.solve(cov, z) + np.linalg.slogdet(2 * pi * cov)[1])
        return value, (info.mean, info.cov)

    def _location(self, schedule: Schedule, k: int, moments: tuple[Array, Array], j: int) -> tuple[float, float]:
        """Return the centre and the scale of the nodes: the predictive moments by a rule of degree three."""
        mean, cov = moments
        n, t = len(mean), float(schedule.stops[k])
        near_h = self.families[j] not in ("log-normal", "exponential")  # h is the place of z, and S its variance
        if self.model.log_density is None and near_h and np.isfinite(cov).all():
            values, vectors = np.linalg.eigh(cov)
            steps = np.sqrt(n + 2) * (vectors * np.sqrt(np.maximum(values, 0.0))).T
            points = np.concatenate([mean[None], mean + steps, mean - steps])
            weights = np.full(2 * n + 1, 0.5 / (n + 2))
            weights[0] = 2.0 / (n + 2)
            h = np.real(self.sums.h(points, t, self.sums.theta, self.sums.inputs(t)))[:, j]
            centre = float(weights @ h)
            variance = float(weights @ (h - centre) ** 2)
            time = 1.0 if self.samples else float(schedule.elapsed[k, j])
            if self.families[j] in COUNTS:
                noise = max(centre, 1.0)
            else:
                noise = float(np.real(self.sums.noise(mean, t, self.sums.theta, self.sums.inputs(t)))[j, j])
            scale = float(np.sqrt(variance * time**2 + noise * time))
            if isfinite(centre) and isfinite(scale) and scale > 0:
                return centre * time, WIDTH * scale
        centre, scale = self.spread[j]
        return centre, WIDTH * scale

    def _probabilities(
        self, log_density: Callable[[float], float], z: float, j: int, location: tuple[float, float]
    ) -> tuple[float, float]:
        """Return P(Z < z) and P(Z <= z) for one coordinate."""
        family = self.families[j]
        if family in COUNTS and z <= SUMMED:
            terms = np.exp([log_density(float(count)) for count in range(int(z) + 1)])
            return float(terms[:-1].sum()), float(terms.sum())
        if self.angles[j]:
            z = pi - (pi - z) % (2 * pi)
            location = 0.0, 0.0
        # The sum over many counts is the integral between halves.
        ends = [z - 0.5, z + 0.5] if family in COUNTS else [z]
        positive = (lambda v: log_density(v) if v > -0.5 else -inf) if family in COUNTS else log_density
        found, log_mass = distribution(positive, ends, *location)
        self.mass_error = max(self.mass_error, abs(log_mass) if isfinite(log_mass) else inf)
        return found[0], found[-1]

