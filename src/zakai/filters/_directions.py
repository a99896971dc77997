"""Along which directions of the state functions vary."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from zakai.models.model import Model
from zakai.models.numeric import numpy_function

POINTS = 64


def directions_of(functions: Sequence[sp.Expr], model: Model) -> np.ndarray:
    """An orthonormal W (n, k) such that the functions depend on x through W'x alone, at every time and for all parameters.

    Found from the gradients at random states, times and parameters; a coordinate that no function has is never in the span.
    """
    n = model.n
    jacobian = sp.Matrix([[sp.diff(f, symbol) for symbol in model.x] for f in functions])
    used = np.array([any(entry != 0 for entry in jacobian[:, i]) for i in range(n)])
    if used.sum() <= 1:
        return np.eye(n)[:, used]
    rng = np.random.default_rng(0)
    x = rng.standard_normal((POINTS, n)) * np.geomspace(0.1, 10.0, POINTS)[:, None]
    times = model.start + rng.uniform(0.0, 3.0, POINTS)
    own = model.theta()
    theta = own * rng.uniform(0.7, 1.4, (POINTS, len(own))) + rng.uniform(0, 1e-2, (POINTS, len(own)))
    gradients = []
    for row in range(POINTS):
        values = numpy_function(jacobian, model, jacobian.shape)(x[row], times[row], theta[row])
        gradients.append(values[np.isfinite(values).all(axis=1)])
    rows = np.concatenate(gradients)
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = (rows / np.where(size > 0, size, 1.0))[size[:, 0] > 0]
    if not len(rows):
        return np.eye(n)[:, used]
    _, values, vectors = np.linalg.svd(rows, full_matrices=False)
    rank = int(np.sum(values > 1e-9 * values[0]))
    # As many directions as coordinates: the coordinates themselves.
    return np.eye(n)[:, used] if rank >= used.sum() else vectors[:rank].T
