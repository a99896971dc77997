"""The formulas of a model at many points, with as little work for each evaluation as NumPy allows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.methods.system.formula_arrays import translated
from zakai.models.model import Model
from zakai.models.numeric import COMPLEX, REAL, program_of
from zakai.numerics.complex_step import is_complex
from zakai.numerics.formula_kernel import FIRST_INPUT, Formulas

Array = NDArray[Any]
SOURCES = ("x", "t", "theta", "u")


class PointFunction:
    """Expressions as a function of many points.

    Args:
        expressions: formulas in the state, the time, the parameters and the inputs of a model.
        model: the model.
        shape: the shape of the values at one point.
    """

    def __init__(self, expressions: Sequence[sympy.Expr], model: Model, shape: tuple[int, ...]):
        program = program_of(list(expressions), model)
        self._shape, self._outputs, self._program = shape, program.outputs, program
        self._fixed: list[Any] = [i.constant if i.operation == "constant" else None for i in program.instructions]
        self._sources = [
            (slot, SOURCES.index(i.operation), i.constant)
            for slot, i in enumerate(program.instructions)
            if i.operation in SOURCES
        ]
        steps = [(s, i) for s, i in enumerate(program.instructions) if i.operation not in ("constant", *SOURCES)]
        self._real, self._derived = (
            [
                (s, i.constant, i.operands, None) if i.operation == "table"
                else (s, functions[i.operation], i.operands, i.constant)
                for s, i in steps
            ]
            for functions in (REAL, COMPLEX)
        )  # fmt: skip
        self._formulas = self._translated()

    def __call__(self, x: Array, t: Any, theta: Array, u: Array | None = None) -> Array:
        """Return the values (J, *shape), with those of one expression contiguous; an undefined value is NaN.

        Args:
            x: points (J, n).
            t: one time, or times that broadcast with the points.
            theta: parameters (p,).
            u: the inputs at these times (..., number of inputs).
        """
        derivative = np.iscomplexobj(x) or np.iscomplexobj(theta)
        if not derivative and np.ndim(t) == 0 and x.ndim == 2:
            formulas = self.formulas(theta)
            if formulas is not None and formulas.fast(len(x)):
                result = formulas.at(x, float(t))
                return result.reshape((len(x), *self._shape)) if len(self._shape) > 1 else result
        values = self._fixed.copy()
        for slot, source, index in self._sources:
            given: Any = (x, t, theta, u)[source]
            values[slot] = given if source == 1 else given[..., index]
        for slot, operation, operands, constant in self._derived if derivative else self._real:
            if constant is not None:
                values[slot] = operation(values[operands[0]], constant)
            else:
                values[slot] = operation(*[values[operand] for operand in operands])
        batch = x.shape[:-1] if np.ndim(t) == 0 else np.broadcast_shapes(x.shape[:-1], np.shape(t))
        result = np.empty((len(self._outputs), *batch), complex if derivative else float)
        for row, slot in enumerate(self._outputs):
            result[row] = values[slot]
        result = result.transpose((*range(1, result.ndim), 0))
        return result.reshape((*batch, *self._shape)) if len(self._shape) > 1 else result

    def formulas(self, theta: Array) -> Formulas | None:
        """Return the formulas as arrays for some parameters, or None where they have tables, inputs or derivatives."""
        found = self._formulas
        if found is None or is_complex(theta):
            return None
        parameters = [(slot, index) for slot, source, index in self._sources if source == 2]
        if not parameters:
            return found
        given = found.given.copy()
        for slot, index in parameters:
            given[slot] = theta[index]
        return Formulas(found.code, given, found.coordinates, found.outputs)

    def _translated(self) -> Formulas | None:
        """Return the program as arrays, without parameters; None where it has tables, sinc or inputs."""
        found = translated(self._program)
        if found is None or len(found.data) or (found.formulas.coordinates <= FIRST_INPUT).any():
            return None
        return found.formulas
