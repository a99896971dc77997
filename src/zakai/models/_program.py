"""SymPy expressions as a straight-line program for NumPy, JAX or plain floats; no code is generated.

Every distinct sub-expression is one instruction, so that common parts are computed once, and the first
instruction whose value is not finite is the innermost cause of a value that is not finite.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from types import SimpleNamespace
from typing import Any

import sympy
from sympy.core.function import AppliedUndef

from zakai.errors import InputError
from zakai.models.functions import (
    ComplementaryError,
    Floor,
    LogGamma,
    Maximum,
    Minimum,
    Sinc,
    TableFunction,
    complementary_error,
    log_gamma,
    sinc,
)

_ELEMENTARY = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log")
_UNARY: dict[type, str] = {getattr(sympy, name): name for name in (*_ELEMENTARY, "erf", "sign")}
_UNARY |= {sympy.Abs: "abs", Floor: "floor", ComplementaryError: "erfc"}
_BINARY: dict[type, str] = {sympy.atan2: "atan2", Minimum: "min", Maximum: "max"}
# SymPy makes these of the grammar's functions: tan(x + pi/2) becomes -cot(x), and derivatives hold others.
_QUOTIENTS: dict[type, tuple[Callable, Callable]] = {
    sympy.cot: (sympy.cos, sympy.sin),
    sympy.sec: (lambda u: sympy.S.One, sympy.cos),
    sympy.csc: (lambda u: sympy.S.One, sympy.sin),
    sympy.coth: (lambda u: sympy.S.One, sympy.tanh),
    sympy.sech: (lambda u: sympy.S.One, sympy.cosh),
    sympy.csch: (lambda u: sympy.S.One, sympy.sinh),
}


@dataclass(frozen=True, slots=True)
class Instruction:
    """`operation` on the values in the slots `operands`; `constant` is a constant, index or exponent."""

    operation: str
    operands: tuple[int, ...]
    constant: Any
    expr: sympy.Expr


class Program:
    """A list of instructions that computes `expressions` from x (..., n), t and theta (..., p).

    `symbols` are the coordinates of x, then t, then the parameters; after these, where there are any, those of known inputs
    u (..., p) and of observations z (..., m). With `stable`, exp(u) - 1 and log(1 + u) keep their digits for small u. Raises
    InputError for what has no numerical value.
    """

    def __init__(self, expressions: Sequence[sympy.Expr], symbols: tuple[Any, ...], stable: bool = False):
        state, time, parameters, *others = symbols
        self._stable = stable
        self._inputs: dict[sympy.Symbol, tuple[str, int]] = {s: ("x", i) for i, s in enumerate(state)}
        self._inputs |= {time: ("t", 0)} | {s: ("theta", i) for i, s in enumerate(parameters)}
        self._inputs |= {s: (kind, i) for kind, group in zip("uz", others) for i, s in enumerate(group)}
        self._slots: dict[sympy.Expr, int] = {}
        self.instructions: list[Instruction] = []
        self.outputs = [self._slot(sympy.sympify(e, strict=True)) for e in expressions]

    def _slot(self, expr: sympy.Expr) -> int:
        if expr not in self._slots:
            operation, operands, constant = self._translate(expr)
            slots = tuple(self._slot(operand) for operand in operands)
            self.instructions.append(Instruction(operation, slots, constant, expr))
            self._slots[expr] = len(self.instructions) - 1
        return self._slots[expr]

    def _translate(self, expr: sympy.Expr) -> tuple[str, Sequence[sympy.Expr], Any]:
        if expr in self._inputs:
            kind, index = self._inputs[expr]
            return kind, (), index
        if expr.is_Number or expr.is_NumberSymbol:
            return "constant", (), _number(expr)
        if isinstance(expr, sympy.Add):
            return self._sum(expr)
        if isinstance(expr, sympy.Mul):
            above: list[sympy.Expr] = []
            below: list[sympy.Expr] = []
            for factor in expr.args:
                divides = isinstance(factor, sympy.Pow) and factor.exp.is_Rational and factor.exp < 0
                (below if divides else above).append(_reciprocal(factor) if divides else factor)
            if below:
                return "divide", (_product(above), _product(below)), None
            return "multiply", expr.args, None
        if isinstance(expr, sympy.Pow):
            return self._power(expr)
        if isinstance(expr, sympy.log) and isinstance(expr.args[0], sympy.cosh):
            return "logcosh", expr.args[0].args, None  # cosh overflows at 710; its logarithm does not
        if self._stable and isinstance(expr, sympy.log) and sympy.S.One in expr.args[0].args and expr.args[0].is_Add:
            return "log1p", (expr.args[0] - 1,), None
        if type(expr) in _UNARY:
            return _UNARY[type(expr)], expr.args, None
        if type(expr) in _BINARY:
            return _BINARY[type(expr)], expr.args, None
        if isinstance(expr, Sinc):
            return "sinc", expr.args[:1], int(expr.args[1])
        if isinstance(expr, LogGamma):
            return "lgamma", expr.args[:1], int(expr.args[1])
        if isinstance(expr, TableFunction):
            return "table", expr.args, partial(expr.table, orders=expr.orders)
        if type(expr) in _QUOTIENTS:
            above_function, below_function = _QUOTIENTS[type(expr)]
            return "divide", (above_function(expr.args[0]), below_function(expr.args[0])), None
        if isinstance(expr, AppliedUndef | sympy.Derivative):
            raise InputError(f"{str(expr)[:60]} is an undetermined function: the model can be analysed, not computed with")
        if expr.is_Symbol:
            raise InputError(f"{expr} is neither a state, nor t, nor a parameter, nor an input")
        raise InputError(f"{str(expr)[:60]} has no real numerical value")

    def _sum(self, expr: sympy.Add) -> tuple[str, Sequence[sympy.Expr], Any]:
        if self._stable and len(expr.args) == 2 and expr.args[0].is_Rational:
            coefficient, factors = expr.args[1].as_coeff_mul()
            if coefficient == -expr.args[0] and len(factors) == 1 and isinstance(factors[0], sympy.exp):
                if coefficient == 1:
                    return "expm1", factors[0].args, None
                return "multiply", (coefficient, sympy.Add(-1, factors[0], evaluate=False)), None
        return "add", expr.args, None

    @staticmethod
    def _power(expr: sympy.Pow) -> tuple[str, Sequence[sympy.Expr], Any]:
        base, power = expr.as_base_exp()
        if power == sympy.S.Half:
            return "sqrt", (base,), None
        if power.is_Rational and power < 0:
            return "divide", (sympy.S.One, _reciprocal(expr)), None
        if power.is_Integer:
            return "power", (base,), int(power)
        if power.is_Rational:
            return "power", (base,), _number(power)
        return "general_power", (base, power), None

    @property
    def constant_outputs(self) -> bool:
        """Whether every output is a plain number."""
        return all(self.instructions[slot].operation == "constant" for slot in self.outputs)

    @property
    def needs_inputs(self) -> bool:
        """Whether a value depends on the inputs u."""
        return any(instruction.operation == "u" for instruction in self.instructions)

    def run(
        self, x: Any, t: Any, theta: Any, functions: Mapping[str, Callable], u: Any = None, z: Any = None
    ) -> list[Any]:
        """The value of every instruction; `functions` holds the operations of the array library."""
        sources = {"x": x, "theta": theta, "u": u, "z": z}
        values: list[Any] = []
        for instruction in self.instructions:
            operation, constant = instruction.operation, instruction.constant
            operands = [values[slot] for slot in instruction.operands]
            if operation in sources:
                value = sources[operation][..., constant]
            elif operation == "t":
                value = t
            elif operation == "constant":
                value = constant
            elif operation == "table":
                value = functions["table"](constant, *operands) if "table" in functions else constant(*operands)
            elif constant is None:
                value = functions[operation](*operands)
            else:
                value = functions[operation](*operands, constant)
            values.append(value)
        return values

    def scalar(self, theta: Sequence[float]) -> Callable[..., list[float]]:
        """The program as a function of plain floats (x, t) or (x, t, u), for loops over time.

        What does not exist raises ValueError or ArithmeticError.
        """
        steps, fixed, moving = [], [0.0] * len(self.instructions), []
        for slot, instruction in enumerate(self.instructions):
            if instruction.operation == "constant":
                fixed[slot] = instruction.constant
            elif instruction.operation == "theta":
                fixed[slot] = float(theta[instruction.constant])
            elif instruction.operation in ("x", "t", "u"):
                moving.append((slot, "xtu".index(instruction.operation), instruction.constant))
            elif instruction.operation == "table":
                steps.append((slot, _float_table(instruction.constant), instruction.operands, None))
            else:
                steps.append((slot, SCALAR[instruction.operation], instruction.operands, instruction.constant))

        def call(x: Sequence[float], t: float, u: Sequence[float] = ()) -> list[float]:
            values = fixed.copy()
            sources = (x, (t,), u)
            for slot, source, index in moving:
                values[slot] = sources[source][index]
            for slot, function, operands, constant in steps:
                if constant is not None:
                    values[slot] = function(values[operands[0]], constant)
                elif len(operands) == 1:
                    values[slot] = function(values[operands[0]])
                else:
                    values[slot] = function(*[values[operand] for operand in operands])
            return [values[slot] for slot in self.outputs]

        return call


def _reciprocal(expr: sympy.Pow) -> sympy.Expr:
    return expr.base if expr.exp == -1 else sympy.Pow(expr.base, -expr.exp, evaluate=False)


def _product(factors: list[sympy.Expr]) -> sympy.Expr:
    if len(factors) < 2:
        return factors[0] if factors else sympy.S.One
    return sympy.Mul(*factors, evaluate=False)


def _number(expr: sympy.Expr) -> float:
    """The nearest double to an exact number of any size."""
    if not expr.is_Rational:
        return float(expr)
    try:
        return int(expr.p) / int(expr.q)
    except OverflowError:
        return math.inf if expr > 0 else -math.inf


def _float_table(table: Callable[..., Any]) -> Callable[..., float]:
    return lambda *arguments: float(table(*arguments))


def operations(xp: Any, erf: Callable, **special: Callable) -> dict[str, Callable]:
    """The operations of an array library with NumPy's names."""
    names = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "min": "minimum", "max": "maximum"}
    plain = (*_ELEMENTARY, "abs", "sign", "sqrt", "atan2", "min", "max", "floor", "log1p", "expm1")
    return (
        {name: getattr(xp, names.get(name, name)) for name in plain}
        | {
            "erf": erf,
            "sinc": sinc,
            "lgamma": log_gamma,
            "erfc": complementary_error,
            "add": lambda *terms: reduce(operator.add, terms),
            "multiply": lambda *factors: reduce(operator.mul, factors),
            "divide": operator.truediv,
            "power": _power,
            "general_power": operator.pow,
            "logcosh": lambda u: xp.logaddexp(u, -u) - math.log(2),
        }
        | special
    )


def _power(base: Any, power: Any) -> Any:
    """Return base**power; whole powers by products, ten times faster on arrays."""
    if not isinstance(power, int) or not 2 <= power <= 64:
        return base**power
    result = None
    while power:
        if power & 1:
            result = base if result is None else result * base
        power >>= 1
        if power:
            base = base * base
    return result


def _float_power(base: float, power: float) -> float:
    result = base**power
    if isinstance(result, complex):
        raise ValueError("fractional power of a negative number")
    return result


_MATH = SimpleNamespace(
    **{name: getattr(math, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt")},
    arcsin=math.asin,
    arccos=math.acos,
    arctan=math.atan,
    arctan2=math.atan2,
    minimum=lambda a, b: b if b < a or b != b else a,
    maximum=lambda a, b: b if b > a or b != b else a,
    floor=math.floor,
    log1p=math.log1p,
    expm1=math.expm1,
    abs=abs,
    sign=lambda u: float(u > 0) - float(u < 0),
)
SCALAR = operations(
    _MATH,
    math.erf,
    sinc=lambda u, order: float(sinc(u, order)),
    lgamma=lambda u, order: math.lgamma(u) if order == 0 else float(log_gamma(u, order)),
    erfc=math.erfc,
    power=_float_power,
    general_power=_float_power,
    logcosh=lambda u: abs(u) + math.log1p(math.exp(-2 * abs(u))) - math.log(2),
)
