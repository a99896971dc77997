"""Evaluation of formulas that are given as arrays, at many points, in one kernel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import helper, kernel

Array = NDArray[Any]
# Operations of two operands, then of one; `power` has an integer exponent as its second operand.
BINARY = ("add", "multiply", "divide", "general_power", "atan2", "min", "max", "power")
UNARY = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "erf", "sign", "abs", "floor", "sqrt",
    "log1p", "expm1", "erfc", "logcosh",
)  # fmt: skip
BLOCK = 256  # points that are evaluated together
LARGE = 4096  # points for which NumPy is as fast
CLOCK, NEITHER, FIRST_INPUT = -1, -2, -3  # what a slot holds that holds no coordinate; the input i has FIRST_INPUT - i


@helper
def _binary(operation: int, a: Any, b: Any, out: Any, exponent: int) -> None:
    """Write the result of an operation on rows; the last argument is the exponent of a whole power."""
    if operation == 0:
        for i in range(out.size):
            out[i] = a[i] + b[i]
    elif operation == 1:
        for i in range(out.size):
            out[i] = a[i] * b[i]
    elif operation == 2:
        for i in range(out.size):
            out[i] = a[i] / b[i]
    elif operation == 3:
        for i in range(out.size):
            out[i] = a[i] ** b[i]
    elif operation == 4:
        for i in range(out.size):
            out[i] = math.atan2(a[i], b[i])
    elif operation == 5:
        for i in range(out.size):
            out[i] = a[i] if a[i] < b[i] or a[i] != a[i] else b[i]
    elif operation == 6:
        for i in range(out.size):
            out[i] = a[i] if a[i] > b[i] or a[i] != a[i] else b[i]
    else:
        for i in range(out.size):
            result, factor, rest = 1.0, a[i], exponent
            while rest > 0:
                if rest & 1:
                    result *= factor
                factor *= factor
                rest >>= 1
            out[i] = result


@helper
def _unary(operation: int, a: Any, out: Any) -> None:
    """Write the result of a function of a row."""
    for i in range(out.size):
        u = a[i]
        if operation == 0:
            out[i] = math.sin(u)
        elif operation == 1:
            out[i] = math.cos(u)
        elif operation == 2:
            out[i] = math.tan(u)
        elif operation == 3:
            out[i] = math.asin(u)
        elif operation == 4:
            out[i] = math.acos(u)
        elif operation == 5:
            out[i] = math.atan(u)
        elif operation == 6:
            out[i] = math.sinh(u)
        elif operation == 7:
            out[i] = math.cosh(u)
        elif operation == 8:
            out[i] = math.tanh(u)
        elif operation == 9:
            out[i] = math.exp(u)
        elif operation == 10:
            out[i] = math.log(u)
        elif operation == 11:
            out[i] = math.erf(u)
        elif operation == 12:
            out[i] = 0.0 * u if u == 0.0 or u != u else math.copysign(1.0, u)
        elif operation == 13:
            out[i] = abs(u)
        elif operation == 14:
            out[i] = math.floor(u) if math.isfinite(u) else u
        elif operation == 15:
            out[i] = math.sqrt(u)
        elif operation == 16:
            out[i] = math.log1p(u)
        elif operation == 17:
            out[i] = math.expm1(u)
        elif operation == 18:
            out[i] = math.erfc(u)
        else:
            out[i] = abs(u) + math.log1p(math.exp(-2.0 * abs(u))) - math.log(2.0)


@helper
def _run(code: Any, values: Any, size: int) -> None:
    """Compute the slots (S, BLOCK) that operations write, at the first points of a block."""
    for line in range(code.shape[0]):
        operation, result, a, b = code[line]
        if operation < 8:
            second = a if operation == 7 else b
            _binary(operation, values[a, :size], values[second, :size], values[result, :size], b)
        else:
            _unary(operation - 8, values[a, :size], values[result, :size])


@helper
def _block(given: Any) -> Any:
    """Return the values of all slots at the points of a block (S, BLOCK)."""
    values = np.empty((given.size, BLOCK))
    for s in range(given.size):
        for i in range(BLOCK):
            values[s, i] = given[s]
    return values


@kernel(
    "void(Tuple((int64[:, ::1], float64[::1], int64[::1], int64[::1])), float64[:, ::1], float64, float64, int64,"
    " Tuple((float64[::1], float64[:, ::1], float64[::1])), float64[:, ::1])"
)
def _flow(program: Any, x: Any, t0: float, t1: float, steps: int, box: Any, out: Any) -> None:
    """Write the change (k, J) of points x (n, J), the first n outputs being their velocity: Runge-Kutta steps of order four.

    `program` has the arrays of `Formulas`.  `box` has a centre (n,), the inverse (n, n) of a basis, and limits (n,): a point that
    after a step has an index beyond a limit, relative to the centre, is given up: its change is NaN.  Without steps the outputs
    at t0 are written.
    """
    code, given, coordinates, outputs = program
    centre, inverse, limits = box
    n, count = x.shape
    values = _block(given)
    slopes, total = np.zeros((outputs.size, BLOCK)), np.zeros((outputs.size, BLOCK))
    h = (t1 - t0) / max(steps, 1)
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        change = out[:, first : first + size]
        for k in range(outputs.size):
            for i in range(size):
                change[k, i] = slopes[k, i] = 0.0
        for step in range(max(steps, 1)):
            for stage in range(4 if steps else 1):
                share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                for s in range(given.size):
                    d = coordinates[s]
                    if d >= 0 and steps == 0:
                        for i in range(size):
                            values[s, i] = x[d, first + i]
                    elif d >= 0:
                        for i in range(size):
                            values[s, i] = x[d, first + i] + change[d, i] + share * h * slopes[d, i]
                    elif d == CLOCK:
                        for i in range(size):
                            values[s, i] = t0 + (step + share) * h
                _run(code, values, size)
                weight = h / 6 if stage == 0 or stage == 3 else h / 3
                for k in range(outputs.size):
                    for i in range(size):
                        slopes[k, i] = values[outputs[k], i]
                        total[k, i] = weight * slopes[k, i] + (total[k, i] if stage else 0.0)
            if steps == 0:
                for k in range(outputs.size):
                    for i in range(size):
                        change[k, i] = slopes[k, i]
                break
            for k in range(outputs.size):
                for i in range(size):
                    change[k, i] += total[k, i]
            alive = 0
            for i in range(size):
                inside = True
                for d in range(n):
                    index = 0.0
                    for e in range(n):
                        index += inverse[d, e] * (x[e, first + i] + change[e, i] - centre[e])
                    inside = inside and abs(index) < limits[d]
                if inside:
                    alive += 1
                else:
                    for k in range(outputs.size):
                        change[k, i] = np.nan
            if alive == 0:
                break


class Formulas:
    """A program of formulas as arrays.

    Args:
        code: operation, slot of the result, and slots of the operands, the second an exponent for a whole power (L, 4).
        given: the values of all slots (S,), used where no operation writes them.
        coordinates: for each slot the coordinate of x that it holds, CLOCK for the time, or NEITHER (S,).
        outputs: the slots of the results (k,).
    """

    def __init__(self, code: Array, given: Array, coordinates: Array, outputs: Array):
        self.code, self.given, self.coordinates, self.outputs = code, given, coordinates, outputs

    def fast(self, count: int) -> bool:
        """Return whether the kernel is faster than NumPy for so many points: NumPy's sines and exponentials are vectorised."""
        return count <= LARGE or not (self.code[:, 0] >= len(BINARY)).any()

    def at(self, x: Array, t: float) -> Array:
        """Return the results (J, k) at points x (J, n) and one time, with the values of each result contiguous."""
        n = x.shape[1]
        return self.flow(x, t, t, 0, np.zeros(n), np.zeros((n, n)), np.zeros(n))

    def flow(self, x: Array, t0: float, t1: float, steps: int, centre: Array, inverse: Array, limits: Array) -> Array:
        """Return the change (J, k) of points x (J, n) from t0 to t1, the first n results being their velocity.

        Args:
            x: the points.
            t0: the first time.
            t1: the last time, before or after the first.
            steps: the number of Runge-Kutta steps of order four.
            centre: a point (n,).
            inverse: the inverse of a basis (n, n).
            limits: components in this basis, relative to the centre, beyond which a point is given up: its change is NaN (n,).
        """
        out = np.empty((self.outputs.size, len(x)))
        program = (self.code, self.given, self.coordinates, self.outputs)
        _flow(program, np.ascontiguousarray(x.T), t0, t1, steps, (centre, inverse, limits), out)
        return out.T
