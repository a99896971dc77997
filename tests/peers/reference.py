"""The exact filter of the linear system of `systems`, plain and slow: moments by Runge-Kutta, observations by Bayes' rule."""

from __future__ import annotations

import numpy as np

PARTS = 40
DRIFT = np.array([[0.0, 1.0], [-2.0, -0.5]])
SEEN = np.array([[1.0, 0.0], [-0.5, 1.0]])
NOISE = np.array([[1 / 4, 1 / 8], [1 / 8, 1 / 5]])


def rates(t, mean, cov, drift, spread):
    pushed = np.zeros(len(mean))
    pushed[1] = np.sin(t)
    grown = np.zeros_like(cov)
    grown[:2, :2] = np.diag([0.25, (1 + t / 10) ** 2])
    return drift @ mean + pushed, drift @ cov + cov @ drift.T + grown + spread


def moved(start, stop, mean, cov, drift, spread):
    d = (stop - start) / PARTS
    for t in start + d * np.arange(PARTS):
        a = rates(t, mean, cov, drift, spread)
        b = rates(t + d / 2, mean + d / 2 * a[0], cov + d / 2 * a[1], drift, spread)
        c = rates(t + d / 2, mean + d / 2 * b[0], cov + d / 2 * b[1], drift, spread)
        e = rates(t + d, mean + d * c[0], cov + d * c[1], drift, spread)
        mean, cov = (x + d / 6 * (i + 2 * j + 2 * k + l) for x, i, j, k, l in zip((mean, cov), a, b, c, e))
    return mean, cov


def bayes(mean, cov, H, noise, value):
    residual, spread = value - H @ mean, H @ cov @ H.T + noise
    gain = np.linalg.solve(spread, H @ cov).T
    evidence = -0.5 * (residual @ np.linalg.solve(spread, residual) + np.linalg.slogdet(2 * np.pi * spread)[1])
    return mean + gain @ residual, cov - gain @ H @ cov, evidence


def filtered(record):
    """The means (K, 2), covariances (K, 2, 2) and log-likelihood increments (K,) of samples, or of increments by their law.

    An increment is a state of its own that starts at zero with each interval and is read without noise at its end.
    """
    mean, cov, start, rows = np.array([0.4, -0.2]), np.array([[0.6, 0.1], [0.1, 0.4]]), 0.0, []
    for stop, value in zip(record.times, record.values, strict=True):
        seen = ~np.isnan(value)
        if record.kind == "samples":
            mean, cov = moved(start, stop, mean, cov, DRIFT, np.zeros((2, 2)))
            mean, cov, evidence = bayes(mean, cov, SEEN[seen], NOISE[np.ix_(seen, seen)], value[seen])
        else:
            whole, spread = np.zeros((4, 4)), np.zeros((4, 4))
            whole[:2, :2], whole[2:, :2], spread[2:, 2:] = DRIFT, SEEN, NOISE
            both = np.zeros((4, 4))
            both[:2, :2] = cov
            mean, cov = moved(start, stop, np.append(mean, [0.0, 0.0]), both, whole, spread)
            mean, cov, evidence = bayes(mean, cov, np.eye(4)[2:][seen], np.zeros((seen.sum(), seen.sum())), value[seen])
            mean, cov = mean[:2], cov[:2, :2]
            pure = NOISE[np.ix_(seen, seen)] * (stop - start)
            evidence += 0.5 * (value[seen] @ np.linalg.solve(pure, value[seen]) + np.linalg.slogdet(2 * np.pi * pure)[1])
        rows.append((mean, cov, evidence))
        start = stop
    return tuple(np.array(part) for part in zip(*rows, strict=True))
