"""A program of formulas as arrays for `numerics/formula_kernel.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.models._program import Program
from zakai.models.functions import NEAR, NODES, WEIGHTS
from zakai.models.model import Model
from zakai.models.numeric import program_of
from zakai.numerics.formula_kernel import BINARY, CLOCK, FIRST_INPUT, NEITHER, UNARY, Formulas
from zakai.numerics.formula_points import SINC, TABLE

Array = NDArray[Any]


class Translation(NamedTuple):
    """A program as arrays, the slots of parameters (which hold zero) with their numbers, and the data of tables and sinc."""

    formulas: Formulas
    parameters: list[tuple[int, int]]
    data: Array


def translated(program: Program) -> Translation | None:
    """Return a program as arrays, None where it has an operation that kernels do not know, such as a table of two arguments."""
    operations, count = (*BINARY, *UNARY), len(program.instructions)
    code: list[tuple[int, int, int, int]] = []
    data: list[float] = []
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
        elif operation == "sinc" or (operation == "table" and len(operands) == 1):
            code.append((TABLE if operation == "table" else SINC, slot, operands[0], len(data)))
            data.extend(_table(constant) if operation == "table" else _sinc(constant))
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
    formulas = Formulas(lines, np.concatenate([given, more]), coordinates, np.array(program.outputs, np.int64))
    return Translation(formulas, parameters, np.array(data))


def _table(evaluated: Any) -> list[float]:
    """Return the data of a table of one argument, or of its derivative, for `numerics/formula_points.py`."""
    table, (order,) = evaluated.func, evaluated.keywords["orders"]
    (found,), weights = table.pieces()
    (knots, splines), degree = found, table.degree
    near = np.arange(len(splines))[:, None] + np.arange(degree + 1)
    polynomials = np.einsum("pi,pik->pk", weights[near], splines)
    for _ in range(order):
        polynomials = polynomials[:, :-1] * np.arange(polynomials.shape[1] - 1, 0, -1)
    header = [float(order), float(table.periodic), float(len(polynomials)), float(polynomials.shape[1])]
    return [*header, *knots[degree : len(knots) - degree].tolist(), *polynomials.ravel().tolist()]


def _sinc(order: int) -> list[float]:
    """Return the data of a derivative of sin(x) / x."""
    nodes = (NODES + 1) / 2
    return [float(order), NEAR + 2 * order, float(len(nodes)), *nodes.tolist(), *(WEIGHTS / 2 * nodes**order).tolist()]


def arrays_of(expressions: Sequence[sympy.Expr], model: Model, theta: Any) -> tuple[Any, ...] | None:
    """Return code, given values, coordinates, outputs and data of formulas for some parameters; None where `translated` is."""
    found = translated(program_of(list(expressions), model))
    if found is None:
        return None
    formulas, parameters, data = found
    given = formulas.given.copy()
    for slot, index in parameters:
        given[slot] = theta[index]
    return formulas.code, given, formulas.coordinates, formulas.outputs, data
