"""Formulas as data, evaluated at points, with tables of one argument and sinc: an extension of `formula_kernel.py`.

A program is a tuple of the code, the given values, the coordinates and the outputs, and of the data of tables and sinc.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.formula_kernel import BINARY, CLOCK, FIRST_INPUT, UNARY, _binary, _unary
from zakai.numerics.transition import Array

# Operations whose data stand in the array of a program, from the place on that is the second operand.
TABLE, SINC = len(BINARY) + len(UNARY), len(BINARY) + len(UNARY) + 1
_FIRST_UNARY, _POWER = len(BINARY), len(BINARY) - 1


@helper
def table(data: Array, x: float) -> float:  # pragma: no cover
    """Return a piecewise polynomial, constant outside of its range.

    `data`: the order of the derivative that it is, whether it repeats itself, the number of pieces P and of coefficients C, the
    P + 1 ends of the pieces, and the coefficients of each in the distance from its start, that of the highest power first.
    """
    order, periodic, pieces, count = data[0], data[1], int(data[2]), int(data[3])
    ends = data[4 : 5 + pieces]
    low, high = ends[0], ends[pieces]
    if periodic > 0.0:
        x -= (high - low) * np.floor((x - low) / (high - low))
    if x != x:
        return x
    if order > 0.0 and (x < low or x > high):
        return 0.0
    x = min(max(x, low), high)
    first, last = 0, pieces - 1
    while first < last:
        middle = (first + last + 1) // 2
        if ends[middle] <= x:
            first = middle
        else:
            last = middle - 1
    value, begin = 0.0, 5 + pieces + first * count
    for i in range(count):
        value = value * (x - ends[first]) + data[begin + i]
    return value


@helper
def sinc(data: Array, x: float) -> float:  # pragma: no cover
    """Return a derivative of sin(x) / x; `data`: its order, the range of the integral, the number of nodes, and the rule."""
    order, count = int(data[0]), int(data[2])
    if not abs(x) > data[1]:
        total = 0.0
        for i in range(count):
            total += np.cos(x * data[3 + i] + order * np.pi / 2) * data[3 + count + i]
        return total
    value = np.sin(x) / x
    for k in range(1, order + 1):
        value = (np.sin(x + k * np.pi / 2) - k * value) / x
    return value


# A kernel of its own, as are the next two: a part of `segment` would be compiled again for each call.
@kernel("void(Tuple((i8[:, ::1], f8[::1], i8[::1], i8[::1], f8[::1])), f8[:, ::1], f8[:, ::1], i8, f8, f8[::1])")
def evaluate(program: Any, slots: Array, x: Array, count: int, t: float, u: Array) -> None:  # pragma: no cover
    """Set the slots (S, W) of a program at the first `count` points x (W, n), a time and inputs (p,)."""
    code, given, coordinates, _, data = program
    for s in range(given.size):
        d = coordinates[s]
        if d >= 0:
            for i in range(count):
                slots[s, i] = x[i, d]
        elif d == CLOCK:
            slots[s, :count] = t
        elif d <= FIRST_INPUT:
            slots[s, :count] = u[FIRST_INPUT - d]
    for line in range(code.shape[0]):
        operation, result, a, b = code[line]
        if operation < _FIRST_UNARY:
            _binary(operation, slots[a, :count], slots[a if operation == _POWER else b, :count], slots[result, :count], b)
        elif operation < TABLE:
            _unary(operation - _FIRST_UNARY, slots[a, :count], slots[result, :count])
        else:
            for i in range(count):
                slots[result, i] = table(data[b:], slots[a, i]) if operation == TABLE else sinc(data[b:], slots[a, i])


@helper
def slots_of(program: Any, width: int) -> Array:  # pragma: no cover
    """Return the slots (S, width) of a program with its constants."""
    _, given, _, _, _ = program
    slots = np.empty((given.size, width))
    for s in range(given.size):
        slots[s] = given[s]
    return slots


@helper
def read(program: Any, slots: Array, first: int, out: Array) -> None:  # pragma: no cover
    """Set a matrix to the outputs of the first point, from an output on."""
    _, _, _, outputs, _ = program
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = slots[outputs[first + i * out.shape[1] + j], 0]
