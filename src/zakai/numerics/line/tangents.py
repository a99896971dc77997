"""Derivatives of the transition of an interval, with respect to several parameters at once.

With u = s v, v_t = -H v and the decomposition H = U diag(lambda) U', the derivative of exp(-tau H) in the direction dH is

    U (Q o (U' dH U)) U',   Q_ij = (exp(-tau lambda_i) - exp(-tau lambda_j)) / (lambda_i - lambda_j),

exact for every tau (Daleckii and Krein 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import erfc

from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import STEP
from zakai.numerics.line.modes import FALL, gathered
from zakai.numerics.line.operator import Spectral, quotients
from zakai.numerics.line.resolution import ROUNDING
from zakai.numerics.line.window import CUT, SMALL, Window, density_at, interpolated, local_polynomial


@dataclass(eq=False)
class Varied:
    """A decomposition, and its derivatives in p directions: of log s (p, N) and of H in the basis of the modes (p, N, N).

    `turned` are those of exp(-tau H) in that basis, of the `length` for which they were computed last.
    """

    modes: Spectral
    scales: Array
    operators: Array
    length: float = np.nan
    turned: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, modes: Spectral, shifted: Sequence[Spectral]) -> Varied:
        """Return it from the decompositions at parameters with infinitesimal imaginary parts."""
        scales = np.array([one.scale.imag / np.where(one.scale.real > 0, one.scale.real, 1.0) for one in shifted]) / STEP
        still = np.zeros((len(modes.rates), len(modes.rates)))
        return cls(modes, scales, np.array([still if one.change is None else one.change / STEP for one in shifted]))

    def through(
        self,
        values: Array,
        tangents: Array,
        length: float,
        window: Window | None = None,
        own: Window | None = None,
        margin: int = 0,
    ) -> tuple[Array, Array]:
        """Return a density (N,) after a time, and its derivatives (p, N).

        Args:
            values: the density (J,).
            tangents: its derivatives (p, J).
            length: the time.
            window, own: the grid of the density and that of the decomposition, where they differ.
            margin: the number of points at either end of the latter at which there is no density after the time.
        """
        U, rates, top = self.modes.modes, self.modes.rates, int(np.argmax(values))
        if window is None or own is None or window == own:
            at = scale = self.modes.scale / self.modes.scale[top]
            scales = self.scales - self.scales[:, top : top + 1]
            inner = np.where(values > 0, values / at, 0.0)
            changes = np.where(values > 0, (extended(values, tangents) - values * scales) / at, 0.0)
        else:
            logs, points, used = np.log(np.maximum(self.modes.scale, 1e-300)), window.offsets, values > CUT * values[top]
            known, shifts = local_polynomial(logs, own, points), local_polynomial(self.scales, own, points)
            scale, at = np.exp(logs - known[top]), np.exp(known - known[top])
            scales, shifts = self.scales - shifts[:, top : top + 1], shifts - shifts[:, top : top + 1]
            result = np.where(used, np.concatenate([values[None], tangents - values * shifts]) / at, 0.0)
            # Interpolation leaves waves everywhere; where they end abruptly, the derivatives spread that.
            inner, *rest = np.array([gathered(one, points, own) for one in result]) * _faded(own.size, margin)
            changes = np.array(rest)
        decay, coefficients = np.exp(-length * rates), inner @ U
        if length != self.length:
            self.length, self.turned = length, self.operators * quotients(rates, decay, length)
        turned = self.turned @ coefficients
        after = U @ (decay * coefficients)
        # Beyond the support there is only rounding, which the scale must not amplify.
        noise = ROUNDING * np.sqrt(np.sum(inner * inner)) * max(1.0, decay[0])
        seen, place = np.flatnonzero(after[margin : len(after) - margin] > noise) + margin, np.arange(len(after))
        first, last = seen[[0, -1]] if len(seen) else (np.nan, np.nan)
        scale = np.where((place < first) | (place > last), 0.0, scale if len(seen) else np.nan)
        return scale * after, scale * (((changes @ U) * decay + turned) @ U.T + after * scales)


def extended(values: Array, tangents: Array) -> Array:
    """Return the derivatives (p, N) of a density (N,), by those of its logarithm where its values are small.

    Derivatives have rounding errors relative to their maximum, which transitions and likelihoods would amplify where the density
    is far smaller.  There the derivative of the logarithm is that of the nearest points at which the density counts.
    """
    used = np.flatnonzero(values > CUT * np.max(values))
    if len(used) in (0, len(values)):
        return tangents
    result, small = tangents.copy(), np.flatnonzero(~(values > CUT * np.max(values)))
    for one in result:
        one[small] = values[small] * np.interp(small, used, one[used] / values[used])
    return result


def resampled_tangents(values: Array, tangents: Array, window: Window, new: Window) -> Array:
    """Return the derivatives (p, N) of a density (N,) on another grid, by those of its logarithm where it is small."""
    if new == window:
        return tangents
    tangents = extended(values, tangents)
    result, density = interpolated(tangents, window, new.offsets), density_at(values, window, new.offsets)
    small = np.flatnonzero(density < SMALL * np.max(values))
    scores = tangents / np.where(values > 0, values, np.inf)
    result[:, small] = density[small] * local_polynomial(scores, window, new.offsets[small])
    return np.ascontiguousarray(result * (new.spacing / window.spacing))


def _faded(size: int, margin: int) -> Array:
    """Return factors (N,) that fall to zero at the two ends of a grid."""
    result, fall = np.ones(size), 0.5 * erfc(FALL * np.linspace(1.0, -1.0, margin, endpoint=False))
    result[:margin], result[size - margin :] = fall, fall[::-1]
    return result
