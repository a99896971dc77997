"""The log-likelihood of a row of samples at the points of a grid, for the law of any model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.models.model import Model

Array = NDArray[Any]


def log_likelihood(
    model: Model, values: Array, seen: Array, points: Array, t: float, theta: Array, u: Array | None = None
) -> Array:
    """Return log p(z | x, u, t) of the observed coordinates of a row of samples at points of the state.

        N(h, S), student-t, poisson, bernoulli, von-mises, or the model's `observation_log_density`

    The constants that normalise the law over z are included, so that the log-likelihood of a record is that of its data.

    Args:
        model: a model that observes samples.
        values: (m,), what was observed.
        seen: (m,), which coordinates were; the others are left out.
        points: (N, n).
        t: the time of the samples.
        theta: (p,), complex for a derivative by the complex step.
        u: (number of inputs,) at t, for a model with inputs.

    Returns:
        (N,), zero where nothing is observed; -inf where the data are impossible; NaN where the model has no law, as for counts
        with a negative mean.
    """
    row = np.where(seen, values, np.nan)
    with np.errstate(all="ignore"):
        result = model.observation_law.log_density(row, points, t, theta, u)
    return np.broadcast_to(result, points.shape[:-1])
