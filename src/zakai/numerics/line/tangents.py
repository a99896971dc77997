"""Derivatives of the transition of an interval, with respect to several parameters at once.

With u = s v, v_t = -H v and the decomposition H = U diag(lambda) U', the derivative of exp(-tau H) in the direction dH is

    U (Q o (U' dH U)) U',   Q_ij = (exp(-tau lambda_i) - exp(-tau lambda_j)) / (lambda_i - lambda_j),

exact for every tau (Daleckii and Krein 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.complex_step import STEP
from zakai.numerics.line.operator import Spectral, quotients
from zakai.numerics.line.polynomial import local_polynomial
from zakai.numerics.line.window import CUT, Window, gathered

Array = NDArray[Any]


class Varied(NamedTuple):
    """A decomposition, and its derivatives in p directions: of log s (p, N) and of H in the basis of the modes (p, N, N)."""

    modes: Spectral
    scales: Array
    operators: Array

    @classmethod
    def of(cls, modes: Spectral, shifted: Sequence[Spectral]) -> Varied:
        """Return it from the decompositions at parameters with infinitesimal imaginary parts."""
        scales = np.array([one.scale.imag / np.where(one.scale.real > 0, one.scale.real, 1.0) for one in shifted]) / STEP
        still = np.zeros((len(modes.rates), len(modes.rates)))
        return cls(modes, scales, np.array([still if one.change is None else one.change / STEP for one in shifted]))

    def through(
        self, values: Array, tangents: Array, length: float, window: Window | None = None, own: Window | None = None
    ) -> Array:
        """Return the derivatives (p, N) of a density after a time.

        Args:
            values: the density (J,); its derivatives count where it is positive.
            tangents: its derivatives (p, J).
            length: the time.
            window, own: the grid of the density and that of the decomposition, where they differ.
        """
        U, used, scale, scales = self.modes.modes, values > 0, self.modes.scale, self.scales
        if window is not None and own is not None and window != own:
            logs, points, used = np.log(np.maximum(scale, 1e-300)), window.offsets, values > CUT * np.max(values)
            top = float(local_polynomial(logs, own, points[[int(np.argmax(values))]])[0])
            scale, at = np.exp(logs - top), np.exp(local_polynomial(logs, own, points) - top)
            scales = np.array([local_polynomial(one, own, points) for one in scales])
        else:
            at = scale = scale / scale[int(np.argmax(values))]
        inner = np.where(used, values / at, 0.0)
        changes = np.where(used, (tangents - values * scales) / at, 0.0)
        if at is not scale and window is not None and own is not None:
            inner = gathered(inner, window.offsets, own)
            changes = np.array([gathered(one, window.offsets, own) for one in changes])
        decay, coefficients = np.exp(-length * self.modes.rates), inner @ U
        turned = (self.operators * quotients(self.modes.rates, decay, length)) @ coefficients
        after = scale * (U @ (decay * coefficients))
        return scale * (((changes @ U) * decay + turned) @ U.T) + after * self.scales
