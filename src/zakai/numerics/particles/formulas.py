"""Formulas as data in compiled loops: a program of the operations of `formula_kernel`, with tables, sinc and known numbers.

A program is a tuple of arrays: the lines (operation, result, operand, operand, number), the values of all slots before the first
line, what each slot holds, the slots of the outputs, and the tables.  A slot holds a coordinate of the point (0, 1, ...), the
time (CLOCK), a constant (NEITHER), or a number that is given for the whole block, such as an input or an observation (GIVEN,
GIVEN - 1, ...).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BINARY, BLOCK, CLOCK, NEITHER, UNARY, _binary, _unary
from zakai.numerics.particles.elementary import (
    abs_row,
    atan2_row,
    atan_row,
    exp_row,
    floor_row,
    log_row,
    sin_row,
    sqrt_row,
    square_row,
    tanh_row,
)

Array = Any
F1, F2, F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
I1, I2 = types.int64[::1], types.int64[:, ::1]
PROGRAM = types.Tuple((I2, F1, I1, I1, I2, F1))
BOX = types.Tuple((F1, F1))
SIMPLE = len(BINARY) + len(UNARY)  # operations from here on are the ones below
SINC, TABLE, LOGGAMMA, LOGBESSEL = SIMPLE, SIMPLE + 1, SIMPLE + 2, SIMPLE + 3
_BINARIES, _POWER, _ATAN2 = len(BINARY), BINARY.index("power"), BINARY.index("atan2")
_SIN, _COS, _EXP, _LOG, _SQRT, _TANH, _ATAN, _ABS, _FLOOR = (
    len(BINARY) + UNARY.index(name) for name in ("sin", "cos", "exp", "log", "sqrt", "tanh", "atan", "abs", "floor")
)
GIVEN = NEITHER - 1
_NEAR = 8.0  # |x| up to which the derivatives of sinc are integrals
_NODES, _WEIGHTS = (np.ascontiguousarray(part) for part in np.polynomial.legendre.leggauss(24))


class Program(NamedTuple):
    """Formulas as arrays.

    `code` (L, 5), `given` (S,), `coordinates` (S,), `outputs` (k,); `tables` (T, 9) and `numbers`: the tables that `table_rows`
    makes.
    """

    code: Array
    given: Array
    coordinates: Array
    outputs: Array
    tables: Array
    numbers: Array


@helper
def _sinc(x: float, order: int) -> float:
    """Return the derivative of some order of sin(x) / x."""
    if abs(x) <= _NEAR + 2 * order:
        total = 0.0
        for node in range(_NODES.size):
            s = 0.5 * (_NODES[node] + 1.0)
            total += 0.5 * _WEIGHTS[node] * s**order * math.cos(x * s + order * 0.5 * math.pi)
        return total
    result = math.sin(x) / x
    for k in range(1, order + 1):
        result = (math.sin(x + k * 0.5 * math.pi) - k * result) / x
    return result


@helper
def _log_bessel(x: float) -> float:
    """Return log I_0(x) of the modified Bessel function, x >= 0."""
    if x < 30.0:
        term, total, k = 1.0, 1.0, 1
        while term > 1e-17 * total:
            term *= 0.25 * x * x / (k * k)
            total += term
            k += 1
        return math.log(total)
    term, total = 1.0, 1.0
    for k in range(1, 20):
        term *= (2.0 * k - 1.0) ** 2 / (8.0 * k * x)
        total += term
    return x - 0.5 * math.log(2.0 * math.pi * x) + math.log(total)


@helper
def _cell(numbers: Array, first: int, size: int, x: float) -> int:
    """Return the number of the cell of an increasing axis in which x lies."""
    low, high = 0, size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if numbers[first + middle] <= x:
            low = middle
        else:
            high = middle
    return low


@helper
def _table(row: Array, numbers: Array, x: float, y: float) -> float:
    """Return the value of a table at (x, y), constant beyond its range; y is not used by a table of one argument."""
    nx, ny, terms, periodic, at_x, at_y, at, flat_x, flat_y = row
    if x != x or y != y:
        return math.nan
    low, high = numbers[at_x], numbers[at_x + nx - 1]
    if periodic:
        x = low + (x - low) - (high - low) * math.floor((x - low) / (high - low))
    if (flat_x and (x < low or x > high)) or (flat_y and (y < numbers[at_y] or y > numbers[at_y + ny - 1])):
        return 0.0
    x = min(max(x, low), high)
    i = _cell(numbers, at_x, nx, x)
    x -= numbers[at_x + i]
    if ny == 0:
        at += i * terms
        total = 0.0
        for a in range(terms - 1, -1, -1):
            total = total * x + numbers[at + a]
        return total
    y = min(max(y, numbers[at_y]), numbers[at_y + ny - 1])
    j = _cell(numbers, at_y, ny, y)
    y -= numbers[at_y + j]
    at += (i * (ny - 1) + j) * terms * terms
    total = 0.0
    for a in range(terms - 1, -1, -1):
        inner = 0.0
        for b in range(terms - 1, -1, -1):
            inner = inner * y + numbers[at + a * terms + b]
        total = total * x + inner
    return total


@helper
def _row(operation: int, a: Array, b: Array, number: int, out: Array) -> None:
    """Write the result of an operation on rows; `number` is the exponent of a whole power."""
    if operation == _POWER and number <= 4:
        square_row(a, number, out)
    elif operation == _ATAN2:
        atan2_row(a, b, out)
    elif operation < _BINARIES:
        _binary(operation, a, b, out, number)
    elif operation == _SIN or operation == _COS:
        sin_row(a, int(operation == _COS), out)
    elif operation == _EXP:
        exp_row(a, out)
    elif operation == _LOG:
        log_row(a, out)
    elif operation == _SQRT:
        sqrt_row(a, out)
    elif operation == _TANH:
        tanh_row(a, out)
    elif operation == _ATAN:
        atan_row(a, out)
    elif operation == _ABS:
        abs_row(a, out)
    elif operation == _FLOOR:
        floor_row(a, out)
    else:
        _unary(operation - _BINARIES, a, out)


@helper
def run_program(program: Any, values: Array, size: int) -> None:
    """Compute the slots (S, BLOCK) that the lines write, at the first points of a block."""
    code, tables, numbers = program[0], program[4], program[5]
    for line in range(code.shape[0]):
        operation, result, a, b, number = code[line, 0], code[line, 1], code[line, 2], code[line, 3], code[line, 4]
        if operation < SIMPLE:
            _row(operation, values[a, :size], values[a if operation == _POWER else b, :size], number, values[result, :size])
        elif operation == SINC:
            for i in range(size):
                values[result, i] = _sinc(values[a, i], number)
        elif operation == TABLE:
            for i in range(size):
                values[result, i] = _table(tables[number], numbers, values[a, i], values[b, i])
        elif operation == LOGGAMMA:
            for i in range(size):
                values[result, i] = math.lgamma(values[a, i])
        else:
            for i in range(size):
                values[result, i] = _log_bessel(values[a, i])


@helper
def block_of(program: Any) -> Any:
    """Return the values of all slots at the points of a block (S, BLOCK)."""
    given = program[1]
    values = np.empty((given.size, BLOCK))
    for s in range(given.size):
        for i in range(BLOCK):
            values[s, i] = given[s]
    return values


@helper
def mirrored(x: float, lower: float, upper: float) -> float:
    """Return x, mirrored at the ends of an interval until it is inside."""
    if lower <= x <= upper or x != x:
        return x
    if math.isfinite(lower) and math.isfinite(upper):
        width = upper - lower
        place = (x - lower) - 2.0 * width * math.floor((x - lower) / (2.0 * width))
        return lower + (place if place <= width else 2.0 * width - place)
    return 2.0 * lower - x if x < lower else 2.0 * upper - x


@helper
def load_point(program: Any, values: Array, x: Array, box: Any, time: float, given: Array, size: int) -> None:
    """Write a point (rows, size), the time and the given numbers into their slots."""
    coordinates, (lower, upper) = program[2], box
    for s in range(coordinates.size):
        d = coordinates[s]
        if d >= 0:
            if d < lower.size and (lower[d] > -np.inf or upper[d] < np.inf):
                for i in range(size):
                    values[s, i] = mirrored(x[d, i], lower[d], upper[d])
            else:
                for i in range(size):
                    values[s, i] = x[d, i]
        elif d == CLOCK:
            for i in range(size):
                values[s, i] = time
        elif d <= GIVEN:
            number = given[GIVEN - d]
            for i in range(size):
                values[s, i] = number


@kernel(types.void(PROGRAM, BOX, F2, types.float64, F1, types.int64, types.int64, F2))
def evaluate(program: Any, box: Any, x: Array, time: float, given: Array, low: int, high: int, out: Array) -> None:
    """Write the outputs (k, N) at the points x (n, N) from `low` to `high`."""
    values, outputs = block_of(program), program[3]
    for first in range(low, high, BLOCK):
        size = min(BLOCK, high - first)
        load_point(program, values, x[:, first : first + size], box, time, given, size)
        run_program(program, values, size)
        for k in range(outputs.size):
            for i in range(size):
                out[k, first + i] = values[outputs[k], i]


def table_rows(parts: list[tuple[Any, ...]]) -> tuple[Array, Array]:
    """Return tables as arrays.

    Args:
        parts: of each table the axes, the coefficients of the polynomials in each cell, whether it is periodic, and of each axis
            whether the value beyond its range is zero.

    Returns:
        (T, 9): sizes of both axes, coefficients of an axis, periodic, places of the axes and of the coefficients in the numbers,
        and the two last arguments; and the numbers.
    """
    rows, numbers, place = [], [np.zeros(1)], 1
    for axes, coefficients, periodic, flat in parts:
        x, y = axes[0], axes[1] if len(axes) > 1 else np.zeros(0)
        at_x, at_y, at = place, place + len(x), place + len(x) + len(y)
        flags = (*map(int, flat), 0)[:2]
        rows.append([len(x), len(y), coefficients.shape[-1], int(periodic), at_x, at_y, at, *flags])
        numbers += [x, y, coefficients.ravel()]
        place = at + coefficients.size
    return np.array(rows, np.int64).reshape(-1, 9), np.concatenate(numbers).astype(float)
