"""The formulas of a model at many points, with as little work for each evaluation as NumPy allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.models.model import Model
from zakai.models.numeric import COMPLEX, REAL, program_of

Array = NDArray[Any]


def point_function(expressions: Sequence[sympy.Expr], model: Model, shape: tuple[int, ...]) -> Callable[..., Array]:
    """Return f(x, t, theta, u) of points x (J, n), one time (or times that broadcast with the points), theta (p,) and the inputs
    u (..., number of inputs) at these times.

    The result is (J, *shape), with the values of one expression contiguous; what does not exist is not a number.
    """
    program = program_of(list(expressions), model)
    outputs = program.outputs

    def function(x: Array, t: Any, theta: Array, u: Array | None = None) -> Array:
        derivative = np.iscomplexobj(x) or np.iscomplexobj(theta)
        values = program.run(x, t, theta, COMPLEX if derivative else REAL, u)
        batch = np.broadcast_shapes(x.shape[:-1], np.shape(t))
        result = np.empty((len(outputs), *batch), complex if derivative else float)
        for row, slot in enumerate(outputs):
            result[row] = values[slot]
        return np.moveaxis(result, 0, -1).reshape((*batch, *shape)) if len(shape) > 1 else np.moveaxis(result, 0, -1)

    return function
