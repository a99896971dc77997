"""The moment equations of a linear system with known inputs and correlated noise, integrated by DOP853 between input times."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp


def held(times, values, hold, begin):
    """Return u(t) on the piece that starts at `begin`: the last value before it, or the line to the next one."""
    i = max(np.searchsorted(times, begin, "right") - 1, 0)
    if hold == "zero" or i + 1 == len(times):
        return lambda t: values[i]
    return lambda t: values[i] + (values[i + 1] - values[i]) * (t - times[i]) / (times[i + 1] - times[i])


def moments(record, kind, hold, prior, coefficients, start=0.0):
    """Return the means (K, n), covariances (K, n, n) and log-evidence (K,) after each observation, y linear in between.

        dm = (L m + l) dt + K (dy - h dt),  dP = L P + P L' + G - K S K',  K = (P C' + D) S^-1,  h = C m + c,
        d log p = h'S^-1 dy - (h'S^-1 h + tr S^-1 C (P C' + D)) dt / 2

    `coefficients(t, u)` returns L, l, G, C, c, S and D = E dx dw' / dt; `values` of the record are increments, rates, a path or
    samples, NaN where nothing is observed.
    """
    times, values, inputs = record.times, record.values, record.inputs
    if kind == "path":
        values = np.diff(values, axis=0, prepend=0.0)
    n = len(prior[0])
    z = np.concatenate([prior[0], np.ravel(prior[1]), [0.0]])
    rows = []
    for stop, value in zip(times, values, strict=True):
        seen = ~np.isnan(value)
        inside = seen & (kind != "samples")
        rate = value[inside] / (1.0 if kind == "rates" else stop - start)
        cuts = [start, *inputs.times[(inputs.times > start) & (inputs.times < stop)], stop]
        for a, b in zip(cuts[:-1], cuts[1:]):
            u = held(inputs.times, inputs.values, hold, a)

            def slope(t, z, u=u, inside=inside, rate=rate):
                m, P = z[:n], z[n:-1].reshape(n, n)
                L, l, G, C, c, S, D = coefficients(t, u(t))
                C, c, S, D = C[inside], c[inside], S[np.ix_(inside, inside)], D[:, inside]
                h, joint = C @ m + c, P @ C.T + D
                gain = np.linalg.solve(S, joint.T).T
                evidence = np.linalg.solve(S, h) @ (rate - 0.5 * h) - 0.5 * np.trace(np.linalg.solve(S, C @ joint))
                dP = L @ P + P @ L.T + G - gain @ joint.T
                return np.concatenate([L @ m + l + gain @ (rate - h), dP.ravel(), [evidence]])

            z = solve_ivp(slope, (a, b), z, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        if kind == "samples" and seen.any():
            m, P = z[:n], z[n:-1].reshape(n, n)
            _, _, _, C, c, S, _ = coefficients(stop, held(inputs.times, inputs.values, hold, stop)(stop))
            C, rest = C[seen], value[seen] - C[seen] @ m - c[seen]
            spread = C @ P @ C.T + S[np.ix_(seen, seen)]
            gain = np.linalg.solve(spread, C @ P).T
            evidence = -0.5 * rest @ np.linalg.solve(spread, rest) - 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
            z = np.concatenate([m + gain @ rest, (P - gain @ C @ P).ravel(), [z[-1] + evidence]])
        rows.append(z)
        start = stop
    found = np.array(rows)
    return found[:, :n], found[:, n:-1].reshape(-1, n, n), found[:, -1]
