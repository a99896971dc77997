"""The transition of a linear-quadratic equation of one state (`numerics/transition.py`) as a Gaussian kernel.

It takes the unit mass at y to

    exp(k0 + k1 y + k2 y^2) N(x; a y + b, V),

where b and k1 are linear in the inputs e = (1, e_1, ...) of the equation, and k0 is a quadratic form.  Rates of observation enter
in this way after the transitions have been computed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.transition import Array, Transition


class Channel(NamedTuple):
    """The kernel for given inputs: a, b, V, k0, k1, k2."""

    scale: Any
    shift: Any
    variance: Any
    constant: Any
    slope: Any
    curvature: Any


def chosen(transitions: Transition, k: int, inputs: Array) -> Channel:
    """Return the kernel of interval k for the inputs (k,)."""
    scale, shift, variance, information, slope, constant = (part[k] for part in transitions)
    return Channel(
        scale[0, 0], shift[0] @ inputs, variance[0, 0], inputs @ constant @ inputs, slope[0] @ inputs, -0.5 * information[0, 0]
    )


def packed(transitions: Transition, rows: Array) -> Array:
    """Return the parameters (R, .) of the kernels of some intervals for all inputs, as `filters.kernel_of` reads them."""
    scale, shift, variance, information, slope, constant = (part[rows].reshape(len(rows), -1) for part in transitions)
    return np.concatenate([scale, shift, variance, constant, slope, -0.5 * information], axis=1)


def around(channel: Channel, origin: float) -> Channel:
    """Return the kernel for x and y relative to `origin`."""
    return channel._replace(
        shift=channel.shift + (channel.scale - 1.0) * origin,
        constant=channel.constant + (channel.slope + channel.curvature * origin) * origin,
        slope=channel.slope + 2.0 * channel.curvature * origin,
    )
