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
SOURCES = ("x", "t", "theta", "u")


def point_function(expressions: Sequence[sympy.Expr], model: Model, shape: tuple[int, ...]) -> Callable[..., Array]:
    """Return the expressions as a function f(x, t, theta, u) of many points.

    x (J, n) are points, t is one time (or times that broadcast with the points), theta (p,), and u (..., number of inputs) the
    inputs at these times. The result is (J, *shape), with the values of one expression contiguous; an undefined value is NaN.
    """
    program = program_of(list(expressions), model)
    outputs = program.outputs
    fixed: list[Any] = [None] * len(program.instructions)
    sources: list[tuple[int, int, int]] = []
    steps: list[tuple[int, str, tuple[int, ...], Any]] = []
    for slot, (operation, operands, constant) in enumerate((i.operation, i.operands, i.constant) for i in program.instructions):
        if operation == "constant":
            fixed[slot] = constant
        elif operation in SOURCES:
            sources.append((slot, SOURCES.index(operation), constant))
        else:
            steps.append((slot, operation, operands, constant))
    real, derived = (
        [(slot, constant if name == "table" else functions[name], operands, None if name == "table" else constant)
         for slot, name, operands, constant in steps]
        for functions in (REAL, COMPLEX)
    )  # fmt: skip

    def function(x: Array, t: Any, theta: Array, u: Array | None = None) -> Array:
        derivative = np.iscomplexobj(x) or np.iscomplexobj(theta)
        values = fixed.copy()
        for slot, source, index in sources:
            given: Any = (x, t, theta, u)[source]
            values[slot] = given if source == 1 else given[..., index]
        for slot, operation, operands, constant in derived if derivative else real:
            if constant is not None:
                values[slot] = operation(values[operands[0]], constant)
            else:
                values[slot] = operation(*[values[operand] for operand in operands])
        batch = x.shape[:-1] if np.ndim(t) == 0 else np.broadcast_shapes(x.shape[:-1], np.shape(t))
        result = np.empty((len(outputs), *batch), complex if derivative else float)
        for row, slot in enumerate(outputs):
            result[row] = values[slot]
        result = result.transpose((*range(1, result.ndim), 0))
        return result.reshape((*batch, *shape)) if len(shape) > 1 else result

    return function
