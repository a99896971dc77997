"""SymPy expressions as programs for the kernels of the particle filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp

from zakai.errors import InputError
from zakai.models._program import Program as Instructions
from zakai.models.functions import _Real
from zakai.models.model import Model
from zakai.models.table import Table
from zakai.numerics.formula_kernel import BINARY, CLOCK, NEITHER, UNARY
from zakai.numerics.particles.formulas import GIVEN, LOGBESSEL, LOGGAMMA, SINC, TABLE, Program, table_rows

Array = Any
_OPERATIONS = (*BINARY, *UNARY)


class LogGamma(_Real):
    """log Gamma(a), in the laws of counts and of Student's t."""

    nargs = 1


class LogBessel(_Real):
    """log I_0(a), in the law of an angle."""

    nargs = 1


class _Instructions(Instructions):
    """Instructions that know the functions of this module, and symbols that stand for a formula."""

    def __init__(self, expressions: Sequence[sp.Expr], symbols: tuple[Any, ...], defined: Mapping[sp.Symbol, sp.Expr]):
        self._defined = defined
        # In the order of their definition, so that none is deep inside of another.
        super().__init__([*defined, *expressions], symbols)
        self.outputs = self.outputs[len(defined) :]

    def _slot(self, expr: sp.Expr) -> int:
        return super()._slot(self._defined.get(expr, expr))

    def _translate(self, expr: sp.Expr) -> tuple[str, Sequence[sp.Expr], Any]:
        special = {LogGamma: "loggamma", LogBessel: "logbessel"}
        if type(expr) in special:
            return special[type(expr)], expr.args, None
        if isinstance(expr, sp.Mul) and len(expr.args) > 2 and expr.args[0].is_Number:
            # What differs by a number alone is computed once.
            return "multiply", (expr.args[0], sp.Mul(*expr.args[1:])), None
        return super()._translate(expr)


class Expressions:
    """Expressions in the state, the time, parameters, inputs and further given numbers, as a program for given parameters.

    Args:
        expressions: k formulas.
        model: the model; its inputs are the first given numbers.
        given: the symbols of the given numbers after the inputs.
        more: symbols of coordinates after those of the state.
        defined: formulas for symbols that stand in others; without them a recursion grows exponentially.
    """

    def __init__(
        self,
        expressions: Sequence[sp.Expr],
        model: Model,
        given: Sequence[sp.Symbol] = (),
        more: Sequence[sp.Symbol] = (),
        defined: Mapping[sp.Symbol, sp.Expr] | None = None,
    ):
        symbols = ((*model.x, *more), model.t, model.parameter_symbols, model.u, tuple(given))
        program = _Instructions(list(expressions), symbols, defined or {})
        inputs = len(model.u)
        self.width = inputs + len(given)
        count = len(program.instructions)
        lines, constants, tables = list[tuple[int, ...]](), list[float](), dict[tuple[Table, tuple[int, ...]], int]()
        values, coordinates = [0.0] * count, [NEITHER] * count
        self._parameters: list[tuple[int, int]] = []
        for slot, instruction in enumerate(program.instructions):
            operation, operands, constant = instruction.operation, instruction.operands, instruction.constant
            if operation == "constant":
                values[slot] = float(constant)
            elif operation == "theta":
                self._parameters.append((slot, constant))
            elif operation in ("x", "t", "u", "z"):
                own = {"x": constant, "t": CLOCK, "u": GIVEN - (constant or 0), "z": GIVEN - inputs - (constant or 0)}
                coordinates[slot] = own[operation]
            elif operation == "table":
                number = tables.setdefault((constant.func, constant.keywords["orders"]), len(tables))
                lines.append((TABLE, slot, operands[0], operands[-1], number))
            elif operation == "lgamma":
                if constant:
                    raise InputError(f"{model.source}: the derivative of lgamma in the diffusion is not supported by particles")
                lines.append((LOGGAMMA, slot, operands[0], operands[0], 0))
            elif operation == "sinc":
                lines.append((SINC, slot, operands[0], operands[0], constant))
            elif operation == "power" and not (isinstance(constant, int) and 2 <= constant <= 64):
                constants.append(float(constant))
                lines.append((BINARY.index("general_power"), slot, operands[0], count + len(constants) - 1, 0))
            elif operation == "power":
                lines.append((BINARY.index("power"), slot, operands[0], operands[0], constant))
            elif len(operands) == 1:
                lines.append((_number_of(operation), slot, operands[0], operands[0], 0))
            else:
                first = operands[0]
                for place, other in enumerate(operands[1:], 2):
                    # A result in a slot of its own: where it overwrites an operand, the loop over a row is not vectorised.
                    constants.append(0.0)
                    result = slot if place == len(operands) else count + len(constants) - 1
                    lines.append((_number_of(operation), result, first, other, 0))
                    first = result
        rows, numbers = table_rows([_polynomials(table, orders) for table, orders in tables])
        self._program = Program(
            np.array(lines, np.int64).reshape(-1, 5), np.array(values + constants, float),
            np.array(coordinates + [NEITHER] * len(constants), np.int64), np.array(program.outputs, np.int64), rows, numbers,
        )  # fmt: skip

    def reads(self, place: int) -> bool:
        """Return whether the formulas contain a coordinate."""
        return bool((self._program.coordinates == place).any())

    def at(self, theta: Array) -> Program:
        """Return the program for the values (p,) of the parameters."""
        if not self._parameters:
            return self._program
        given = self._program.given.copy()
        for slot, index in self._parameters:
            given[slot] = theta[index]
        return self._program._replace(given=given)


def _number_of(operation: str) -> int:
    special = {"loggamma": LOGGAMMA, "logbessel": LOGBESSEL}
    return special[operation] if operation in special else _OPERATIONS.index(operation)


def _polynomials(table: Table, orders: tuple[int, ...]) -> tuple[Any, ...]:
    """Return the axes of a table, the polynomials of a derivative in its cells, and how it goes on beyond its range."""
    terms = table.degree + 1
    corners = np.stack(np.meshgrid(*[axis[:-1] for axis in table.axes], indexing="ij"), axis=-1)
    coefficients: Any = np.zeros((*corners.shape[:-1], *(terms,) * len(table.axes)))
    for powers in itertools.product(range(terms), repeat=len(table.axes)):
        derivative = tuple(power + order for power, order in zip(powers, orders, strict=True))
        if max(derivative) <= table.degree:
            factor = math.prod(map(math.factorial, powers))
            coefficients[(..., *powers)] = table._interpolant()(corners, nu=derivative) / factor
    return table.axes, coefficients, table.periodic, tuple(order > 0 for order in orders)
