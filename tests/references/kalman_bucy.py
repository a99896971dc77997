"""Kalman and Bucy's equations, integrated by DOP853: plain, slow, for y that is linear between observations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp


def kalman_bucy(times, increments, mean, cov, L, l, G, C, S, start=0.0):
    """Mean, covariance and evidence after each interval, y running linearly inside of it; a nan is not observed."""
    n = len(mean)
    out, evidence = [], 0.0
    for stop, dy in zip(times, increments, strict=True):
        rate = dy / (stop - start)
        seen = ~np.isnan(dy)

        def slope(t, z, rate=rate, seen=seen):
            m, P = z[:n], z[n : n + n * n].reshape(n, n)
            H = C[seen]
            gain = np.linalg.solve(S[np.ix_(seen, seen)], H) if seen.any() else np.zeros((0, n))
            y = rate[seen]
            dm = L(t) @ m + l(t) + P @ gain.T @ (y - H @ m)
            dP = L(t) @ P + P @ L(t).T + G(t) - P @ H.T @ gain @ P
            de = (gain @ m) @ y - 0.5 * m @ H.T @ gain @ m - 0.5 * np.trace(gain @ P @ H.T)
            return np.concatenate([dm, dP.ravel(), [de]])

        z = solve_ivp(
            slope, (start, stop), np.concatenate([mean, cov.ravel(), [0.0]]), method="DOP853", rtol=1e-12, atol=1e-13
        ).y[:, -1]
        mean, cov, evidence, start = z[:n], z[n : n + n * n].reshape(n, n), evidence + z[-1], stop
        out.append((mean, cov, evidence))
    return out


def assert_agrees(result, expected, tolerance):
    for k, (mean, cov, evidence) in enumerate(expected, start=1):
        assert result.mean[k] == pytest.approx(mean, abs=tolerance)
        assert result.cov[k] == pytest.approx(cov, abs=tolerance)
        assert result.log_likelihood_increments[: k + 1].sum() == pytest.approx(evidence, abs=tolerance)
