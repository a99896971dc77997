"""Innovations and their normalised square, NIS.

Between two observations the Gaussian with the filter's mean m and covariance P moves by the linearised equations, together with
the integral of the observation,

    dm = f dt,   da = h dt,   d Sigma = (A Sigma + Sigma A' + diag(G, S)) dt,   A = (F 0; H 0),   F = df/dx, H = dh/dx at m,

from Sigma = diag(P, 0).  An increment y(t_k) - y(t_{k-1}) is then expected to be a with the covariance Sigma_yy; a sample to be
h(m) with H P H' + S.  For a linear system this is exact (Jazwinski 1970, chapter 7).  Observations of another law than a
Gaussian have no innovations.
"""

from __future__ import annotations

import numpy as np

from zakai.models.angles import nearest
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.records import Record
from zakai.records.schedule import Schedule, schedule_of
from zakai.studies.metrics import mahalanobis

_STEP = 0.1  # of the Runge-Kutta steps, in units of 1/|A|
_MOST_STEPS = 160
_LATE = 1 + 1e-9


class Innovations:
    """The innovations of records of one model, from the moments of a filter."""

    def __init__(self, model: Model):
        n, m = model.n, model.m
        self.model, self.theta = model, model.theta()
        self.drift = numpy_function(model.drift, model)
        self.observation = numpy_function(model.observation, model)
        self.drift_slope = numpy_function(model.drift.jacobian(model.x), model, (n, n))
        self.slope = numpy_function(model.observation.jacobian(model.x), model, (m, n))
        self.covariance = numpy_function(model.covariance, model, (n, n))
        self.noise = numpy_function(model.observation_noise, model, (m, m))

    def __call__(self, record: Record, mean: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the innovations (K, m) and their covariances (K, m, m).

        They are NaN where nothing was observed, or an increment was gathered over more than its interval.

        Args:
            record: K observations.
            mean: means of the filter (K+1, n), the prior first.
            cov: their covariances (K+1, n, n).
        """
        schedule, values = schedule_of(self.model, record)
        n, m = self.model.n, self.model.m
        law = self.model.observation_law
        u = self._inputs(schedule, schedule.stops, schedule.stops)
        undefined = self.model.log_density is not None or set(law.families) != {"gaussian"}
        with np.errstate(invalid="ignore", over="ignore"):
            x, sigma = self._moved(schedule, np.asarray(mean, float)[:-1], np.asarray(cov, float)[:-1])
            if record.kind == "samples":
                slope = self.slope(x[:, :n], schedule.stops, self.theta, u)
                expected = self.observation(x[:, :n], schedule.stops, self.theta, u)
                noise = self.noise(x[:, :n], schedule.stops, self.theta, u)
                spread = slope @ sigma[:, :n, :n] @ np.swapaxes(slope, 1, 2) + noise
                late = np.zeros((len(x), m), bool)
            else:
                expected, spread = x[:, n:], sigma[:, n:, n:]
                late = schedule.elapsed > _LATE * (schedule.stops - schedule.starts)[:, None]
        apart = nearest(values, expected, law.angles) - expected
        return np.where(late | ~schedule.seen | undefined, np.nan, apart), spread

    def nis(self, record: Record, mean: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return nu' S^-1 nu (K,), and the number of observed coordinates (K,), the degrees of freedom of its chi-square law.

        For a filter of a linear system with the right model it is chi-square with m degrees and independent from time to time
        (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2); for a curved h it is that to first order.
        """
        found, spread = self(record, mean, cov)
        seen = ~np.isnan(found)
        both = seen[:, :, None] & seen[:, None, :]
        value = mahalanobis(np.where(seen, found, 0.0), np.where(both, spread, np.eye(self.model.m)))
        count = seen.sum(axis=1)
        return np.where(count > 0, value, np.nan), count

    def _moved(self, schedule: Schedule, mean: np.ndarray, cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, y) and their covariance at the ends of the intervals, by the classical Runge-Kutta method."""
        n, m, K = self.model.n, self.model.m, len(mean)
        z = np.concatenate([mean, np.zeros((K, m))], axis=1)
        sigma = np.zeros((K, n + m, n + m))
        sigma[:, :n, :n] = cov
        for starts, stops in _pieces(schedule):
            z, sigma = self._over(schedule, starts, stops, z, sigma)
        return z, sigma

    def _over(
        self, schedule: Schedule, starts: np.ndarray, stops: np.ndarray, z: np.ndarray, sigma: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, y) and their covariance after a piece of each interval in which the inputs are smooth."""
        lengths = stops - starts
        u = self._inputs(schedule, starts, starts)
        size = np.abs(self._matrix(z[:, : self.model.n], starts, u)).sum(axis=2).max(axis=1) * lengths
        finite = size[np.isfinite(size)]
        steps = int(np.clip(np.ceil(finite.max(initial=0.0) / _STEP), 1, _MOST_STEPS))
        z[np.nan_to_num(size, nan=np.inf) > 10 * _STEP * _MOST_STEPS] = np.nan  # stiffer than this method can follow
        d = lengths / steps
        for j in range(steps):
            t = starts + j * d
            u0, u1, u2 = (self._inputs(schedule, starts, at) for at in (t, t + 0.5 * d, t + d))
            z1, s1 = self._rates(z, sigma, t, u0)
            z2, s2 = self._rates(z + 0.5 * d[:, None] * z1, sigma + 0.5 * d[:, None, None] * s1, t + 0.5 * d, u1)
            z3, s3 = self._rates(z + 0.5 * d[:, None] * z2, sigma + 0.5 * d[:, None, None] * s2, t + 0.5 * d, u1)
            z4, s4 = self._rates(z + d[:, None] * z3, sigma + d[:, None, None] * s3, t + d, u2)
            z = z + d[:, None] / 6 * (z1 + 2 * z2 + 2 * z3 + z4)
            sigma = sigma + d[:, None, None] / 6 * (s1 + 2 * s2 + 2 * s3 + s4)
        return z, sigma

    def _inputs(self, schedule: Schedule, starts: np.ndarray, t: np.ndarray) -> np.ndarray | None:
        """Return the inputs (K, number of inputs) at times t of pieces that begin at `starts`."""
        if schedule.inputs is None:
            return None
        return schedule.inputs.at(starts if self.model.input_hold == "zero" else t, self.model.input_hold)

    def _matrix(self, x: np.ndarray, t: np.ndarray, u: np.ndarray | None) -> np.ndarray:
        n, m = self.model.n, self.model.m
        matrix = np.zeros((len(x), n + m, n + m))
        matrix[:, :n, :n] = self.drift_slope(x, t, self.theta, u)
        matrix[:, n:, :n] = self.slope(x, t, self.theta, u)
        return matrix

    def _rates(self, z: np.ndarray, sigma: np.ndarray, t: np.ndarray, u: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        n = self.model.n
        x = z[:, :n]
        rate = self._matrix(x, t, u) @ sigma
        rate = rate + np.swapaxes(rate, 1, 2)
        rate[:, :n, :n] += self.covariance(x, t, self.theta, u)
        rate[:, n:, n:] += self.noise(x, t, self.theta, u)
        return np.concatenate([self.drift(x, t, self.theta, u), self.observation(x, t, self.theta, u)], axis=1), rate


def _pieces(schedule: Schedule) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return starts and stops (K,) of the pieces of all intervals between their input times; missing ones have length zero."""
    if schedule.inputs is None:
        return [(schedule.starts, schedule.stops)]
    cuts = [schedule.inputs.within(start, stop) for start, stop in zip(schedule.starts, schedule.stops)]
    ends = np.repeat(schedule.stops[:, None], 1 + max(map(len, cuts)), axis=1)
    for row, own in zip(ends, cuts):
        row[: len(own)] = own
    return list(zip(np.column_stack([schedule.starts, ends]).T, ends.T))
