"""Whether one state reaches the ends of its domain, by the tests of Feller.

Near an end, at the distance d, let the drift away from it be f and G = g^2 ~ d^k.  With kappa = 2 f d / G at d -> 0 the end is
reached if kappa < 1 and G / d^2 -> oo, or without noise to speak of if f / d -> -oo.  Where it is reached, a process can be
reflected if its speed measure is finite, kappa > k - 1; elsewhere it is absorbed, and part of its law is a point mass at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

Array = Any
NEAR = 1e-9  # distance from an end other than zero, relative to it and to the length of the domain
NEAR_ZERO = 1e-40  # distance from zero, near which numbers have no rounding of their own
APART = 1e3  # ratio of the two distances that show a power
GROWS = 1.5  # ratio of values there that have no finite limit
EXACT = 1e-5  # by which kappa may miss its limit


def check_ends(model: Model, theta: Array, inputs: Array | None) -> None:
    """Raise InputError where the law of the state has no density between the ends of its domain.

    Args:
        model: One state, with or without a domain.
        theta: The parameters (p,).
        inputs: The values (T, number of inputs) of the known inputs, None where there are none.
    """
    interval = model.domain.get(model.state[0])
    if interval is None or (model.inputs and inputs is None):
        return
    u = None if inputs is None else np.unique(inputs, axis=0)

    def formulas() -> Callable[..., Array]:
        return numpy_function([model.drift[0], model.covariance[0, 0]], model)

    function = kept(model, check_ends, formulas)
    for end, side in ((interval.lower, 1.0), (interval.upper, -1.0)):
        if not np.isfinite(end):
            continue
        scale = abs(end) if not interval.bounded else max(abs(end), interval.upper - interval.lower)
        near = end + side * np.array([APART, 1.0]) * (NEAR_ZERO if end == 0 else NEAR * scale)
        d = np.abs(near - end)
        with np.errstate(all="ignore"):
            values = function(near[:, None], model.start, theta.real, None if u is None else u[:, None]).reshape(-1, 2, 2)
            f, G = side * values[..., 0].real, values[..., 1].real
            if not (np.isfinite(values).all() and (G > 0).all()):
                continue
            kappa, k = 2 * f * d / G, np.log(G[:, 0] / G[:, 1]) / np.log(d[0] / d[1])
            noisy, driven = (np.abs(a[:, 1]) > GROWS * np.abs(a[:, 0]) for a in (G / d**2, f / d))
        # A drift towards the end whose kappa grows without limit outweighs the noise.
        reached = (noisy & (kappa[:, 1] < 1 - EXACT)) | (driven & (f[:, 1] < 0))
        absorbed = reached & ((kappa[:, 1] < k - 1 + EXACT) | ~noisy)
        name = f"{model.source}: domain: the process reaches the end {end:g} of {model.state[0]!r}"
        if absorbed.any():
            raise InputError(
                f"{name} and is absorbed there, so that its law has no density; a drift away from that end keeps it inside"
            )
        if reached.any() and not interval.reflecting:
            raise InputError(
                f'{name}; give boundary = "reflecting", by which it returns at once'
                + (f": 2 f / (g^2)' = {kappa[:, 1].min():.3g} there is less than 1" if k[0] > 0.5 else "")
            )
