"""Two ways to fit a Gaussian sum again, kept for comparison: the papers' Algorithm 1, and non-negative least squares.

Algorithm 1 fits a Gaussian to each peak of a density, then to the negative peaks of the residual.  A peak below alpha times the
maximum is not fitted: what lies there is deleted, and a filter cannot get it back.
"""

from __future__ import annotations

import numpy as np

from zakai.numerics.sums.mixture import Array, Components, components, shares

POINTS = 512
_REACH = 6.0


def fit_peaks(sum_: Components, alpha: float, most: int) -> Components:
    """Return the survey's Algorithm 1 with threshold alpha max, in at most `most` Gaussians; one state.

    A Gaussian has a peak's place, height and curvature; its weight has the peak's sign.
    """
    variance = sum_.covs[:, 0, 0]
    deviation, centre = np.sqrt(variance.real), sum_.means[:, 0].real
    low, high = np.min(centre - _REACH * deviation), np.max(centre + _REACH * deviation)
    x = low + (high - low) * np.arange(POINTS) / (POINTS - 1)
    spacing = x[1] - x[0]
    z = (x[:, None] - sum_.means[:, 0]) ** 2 / variance
    residual = np.exp(-0.5 * z) @ (shares(sum_)[0] / np.sqrt(2 * np.pi * variance))
    threshold = alpha * np.max(residual.real)
    fitted, sign = [], 1.0
    for _ in range(most):
        if np.max(residual.real) <= threshold:
            sign = -1.0
        signed = sign * residual
        at = int(np.clip(np.argmax(signed.real), 1, POINTS - 2))
        height = signed[at]
        if not height.real > threshold:
            break
        three = signed[at - 1 : at + 2]
        logs = np.log(np.where(three.real > 1e-12 * height.real, three, 1e-12 * height))
        peak_curvature = 2 * logs[1] - logs[0] - logs[2]
        peak_curvature = peak_curvature if peak_curvature.real > 1e-4 else 1e-4
        width = spacing**2 / peak_curvature
        shift = 0.5 * (logs[2] - logs[0]) / peak_curvature
        place = x[at] + (shift if abs(shift.real) < 0.5 else 0.5 * np.sign(shift.real)) * spacing
        residual = residual - sign * height * np.exp(-0.5 * (x - place) ** 2 / width)
        fitted.append((np.log(height) + 0.5 * np.log(2 * np.pi * width), place, width, sign))
    weights, places, widths, signs = (np.array(column) for column in zip(*fitted, strict=True))
    return Components(weights, places[:, None], widths[:, None, None], signs.real)


def fit_dictionary(sum_: Components, share: Array, most: int, iterations: int = 300) -> Components:
    """Return non-negative least squares on a grid of at most `most` equal Gaussians; one or two states.

    Minimises the integrated square of the difference by multiplicative steps w <- w b / (A w).  The spacing is a power of
    2^(1/4), so that the nodes seldom change from step to step.
    """
    n = sum_.means.shape[1]
    count = int(round(most ** (1 / n) - 0.499))
    used = share.real > 1e-6
    deviation = np.sqrt(np.diagonal(sum_.covs.real, axis1=1, axis2=2))[used]
    low = (sum_.means.real[used] - 2.0 * deviation).min(axis=0)
    high = (sum_.means.real[used] + 2.0 * deviation).max(axis=0)
    spacing = 2.0 ** (np.ceil(4 * np.log2((high - low) / max(count - 2, 1))) / 4)
    first = np.round((low + high) / (2 * spacing)) - (count - 1) // 2
    index = np.stack(np.meshgrid(*[np.arange(count)] * n, indexing="ij"), axis=-1).reshape(-1, n)
    nodes = (first + index) * spacing
    cov = np.diag((0.8 * spacing) ** 2)

    def overlaps(means: Array, covs: Array) -> Array:
        apart = nodes[:, None] - means
        inner = cov + covs
        quadratic = np.einsum("kai,aij,kaj->ka", apart, np.linalg.inv(inner), apart)
        return np.asarray(np.exp(-0.5 * quadratic) / np.sqrt(np.linalg.det(2 * np.pi * inner)))

    wanted = overlaps(sum_.means, sum_.covs) @ shares(sum_)[0]
    wanted = np.where(wanted.real > 1e-300, wanted, 1e-300)
    gram = overlaps(nodes, np.broadcast_to(cov, (len(nodes), n, n)))
    w = wanted * np.prod(spacing)
    for _ in range(iterations):
        fit = gram @ w
        w = w * wanted / np.where(fit.real > 1e-300, fit, 1e-300)
    w = w / w.sum()
    kept = w.real > 1e-12
    return components(np.log(w[kept]), nodes[kept], np.broadcast_to(cov, (int(kept.sum()), n, n)).copy())
