"""Derivatives of a transition by the modes of an operator, with respect to several parameters at once.

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
from zakai.numerics.line_operator import Spectral, quotients

Array = NDArray[Any]


class Varied(NamedTuple):
    """A decomposition, and its derivatives in p directions: of log s (p, N) and of H in the basis of the modes (p, N, N)."""

    modes: Spectral
    scales: Array
    operators: Array

    @classmethod
    def of(cls, modes: Spectral, shifted: Sequence[Spectral]) -> Varied:
        """Return it from the decompositions at parameters with infinitesimal imaginary parts."""
        scales = np.array([one.scale.imag / one.scale.real for one in shifted]) / STEP
        still = np.zeros((len(modes.rates), len(modes.rates)))
        return cls(modes, scales, np.array([still if one.change is None else one.change / STEP for one in shifted]))

    def through(self, values: Array, tangents: Array, length: float) -> tuple[Array, Array]:
        """Return a density (N,) and its derivatives (p, N) after a time.

        Args:
            values: the density; its derivatives count where it is positive.
            tangents: its derivatives (p, N).
            length: the time.
        """
        U, used = self.modes.modes, values > 0
        scale = self.modes.scale / self.modes.scale[int(np.argmax(values))]
        inner = np.where(used, values / scale, 0.0)
        changes = np.where(used, (tangents - values * self.scales) / scale, 0.0)
        decay, coefficients = np.exp(-length * self.modes.rates), inner @ U
        turned = (self.operators * quotients(self.modes.rates, decay, length)) @ coefficients
        after = scale * (U @ (decay * coefficients))
        return after, scale * (((changes @ U) * decay + turned) @ U.T) + after * self.scales
