"""A program of formulas as arrays for `numerics/formula_kernel.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sympy

from zakai.models._program import Program
from zakai.models.model import Model
from zakai.models.numeric import program_of
from zakai.numerics.formula_kernel import BINARY, CLOCK, FIRST_INPUT, NEITHER, UNARY, Formulas


def translated(program: Program) -> tuple[Formulas, list[tuple[int, int]]] | None:
    """Return a program as arrays, and the slots of parameters with their numbers; None where it has tables or sinc.

    The slots of parameters hold zero.
    """
    operations, count = (*BINARY, *UNARY), len(program.instructions)
    code: list[tuple[int, int, int, int]] = []
    given, more = np.zeros(count), list[float]()
    coordinates, parameters = np.full(count, NEITHER), list[tuple[int, int]]()
    for slot, instruction in enumerate(program.instructions):
        operation, operands, constant = instruction.operation, instruction.operands, instruction.constant
        if operation == "constant":
            given[slot] = constant
        elif operation == "theta":
            parameters.append((slot, constant))
        elif operation in ("x", "t", "u"):
            coordinates[slot] = {"x": constant, "t": CLOCK, "u": FIRST_INPUT - (constant or 0)}[operation]
        elif operation == "power" and not (isinstance(constant, int) and 2 <= constant <= 64):
            more.append(float(constant))
            code.append((operations.index("general_power"), slot, operands[0], count + len(more) - 1))
        elif operation == "power":
            code.append((operations.index("power"), slot, operands[0], constant))
        elif operation not in operations:
            return None
        elif len(operands) == 1:
            code.append((operations.index(operation), slot, operands[0], 0))
        else:
            first = operands[0]
            for other in operands[1:]:
                code.append((operations.index(operation), slot, first, other))
                first = slot
    coordinates = np.concatenate([coordinates, np.full(len(more), NEITHER)])
    lines = np.array(code, np.int64).reshape(-1, 4)
    return Formulas(lines, np.concatenate([given, more]), coordinates, np.array(program.outputs, np.int64)), parameters


def arrays_of(expressions: Sequence[sympy.Expr], model: Model, theta: Any) -> tuple[Any, ...] | None:
    """Return code, given values, coordinates and outputs of formulas for some parameters; None where they have tables or sinc."""
    found = translated(program_of(list(expressions), model))
    if found is None:
        return None
    formulas, parameters = found
    given = formulas.given.copy()
    for slot, index in parameters:
        given[slot] = theta[index]
    return formulas.code, given, formulas.coordinates, formulas.outputs
