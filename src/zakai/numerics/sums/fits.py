"""Another way to fit a Gaussian sum again, kept for comparison: the papers' Algorithm 1.

It fits a Gaussian to each peak of a density, then to the negative peaks of the residual.  A peak below alpha times the
maximum is not fitted: what lies there is deleted, and a filter cannot get it back.
"""

from __future__ import annotations

import numpy as np

from zakai.numerics.sums.mixture import Components, shares

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
