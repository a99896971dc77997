"""The posterior of one state on a fine graded grid: conservative differences, implicit Euler steps, extrapolated."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import solve_banded

Function = Callable[..., np.ndarray]
_STEPS = (1, 2, 4, 8)


def posterior(
    drift: Function, log_prior: Function, times: Sequence[float], log_likelihoods: Sequence[Function], faces: np.ndarray,
    first: float, stages: int = 60, potentials: Sequence[Function] | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return means, variances and log-likelihood for dx = f dt + dv, with a potential in every interval where there is one.

    `first` is the first stage of an interval; stages become longer by equal factors.
    """
    x, widths, inner = 0.5 * (faces[1:] + faces[:-1]), np.diff(faces), faces[1:-1]
    apart, f = np.diff(x), drift(inner)
    out = (0.5 * f + 0.5 / apart) / widths[:-1]
    back = (0.5 / apart - 0.5 * f) / widths[1:]
    diagonal = np.zeros(len(x))
    diagonal[:-1] -= out
    diagonal[1:] -= back
    p = np.exp(log_prior(x) - np.max(log_prior(x))) * widths
    p, start, total, rows = p / p.sum(), 0.0, 0.0, []
    for k, stop in enumerate(times):
        ends = np.concatenate([[0.0], first * ((stop - start) / first) ** np.linspace(0, 1, stages)])
        rate = diagonal if potentials is None else diagonal + potentials[k](x)
        for step in np.diff(ends):
            table = []
            for count in _STEPS:
                h, q = step / count, p
                bands = np.zeros((3, len(x)))
                bands[0, 1:], bands[1], bands[2, :-1] = -h * back, 1 - h * rate, -h * out
                for _ in range(count):
                    q = solve_banded((1, 1), bands, q)
                table.append(q)
            for k_ in range(1, len(table)):
                table = [b + (b - a) / (2.0**k_ - 1) for a, b in zip(table[:-1], table[1:], strict=True)]
            p = table[-1]
        logs = np.log(np.maximum(p, 1e-300)) + log_likelihoods[k](x)
        top = logs.max()
        p = np.exp(logs - top)
        total, p = total + top + np.log(p.sum()), p / p.sum()
        mean = p @ x
        rows.append((mean, p @ (x - mean) ** 2))
        start = stop
    means, variances = np.array(rows).T
    return means, variances, float(total)


def sinh_faces(low: float, high: float, scale: float, count: int) -> np.ndarray:
    """Return faces of cells that are `scale` wide around zero and grow with the distance."""
    return scale * np.sinh(np.linspace(np.arcsinh(low / scale), np.arcsinh(high / scale), count + 1))
