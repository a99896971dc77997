"""Trees of formulas to SymPy; powers and exact numbers are measured before they are computed."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from fractions import Fraction

import sympy

from zakai.models._errors import did_you_mean, echo, listing
from zakai.models.expressions import (
    FUNCTIONS,
    MAX_DEPTH,
    Call,
    ExpressionError,
    Name,
    Negative,
    Node,
    Number,
    Power,
    Product,
    Sum,
)

MAX_EXPONENT = 64
MAX_ROOT = 12
MAX_DEGREE = 256
MAX_CONSTANT_BITS = 2_200  # of a numerator or denominator: twice what a double's exponent can hold
MAX_TOTAL_BITS = 65_536  # of all numbers that one sub-expression multiplies out

_SYMPY: dict[str, Callable[..., sympy.Expr]] = {
    "sin": sympy.sin,
    "cos": sympy.cos,
    "tan": sympy.tan,
    "asin": sympy.asin,
    "acos": sympy.acos,
    "atan": sympy.atan,
    "sinh": sympy.sinh,
    "cosh": sympy.cosh,
    "tanh": sympy.tanh,
    "exp": sympy.exp,
    "log": sympy.log,
    "sqrt": sympy.sqrt,
    "erf": sympy.erf,
    "abs": lambda u: sympy.Abs(u, evaluate=bool(u.is_extended_real)),
}
_FLOAT: dict[str, Callable[[float], float]] = {
    name: getattr(math, name) for name in _SYMPY if name != "abs"
} | {"abs": abs}
_DOMAINS = {
    "log": "log of a number that is not positive",
    "sqrt": "square root of a negative number",
    "asin": "asin outside [-1, 1]",
    "acos": "acos outside [-1, 1]",
}
_BROKEN = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


@dataclass(frozen=True, slots=True)
class _Part:
    """A converted node: `value` if it is a constant, and the bounds of what expanding it can cost."""

    expr: sympy.Expr
    value: float | None
    degree: Fraction
    bits: int
    height: int


def to_sympy(tree: Node, symbols: Mapping[str, sympy.Expr], functions: Collection[str] = ()) -> sympy.Expr:
    """The SymPy expression of a tree; `symbols` and `functions` as in `parse_expression`."""
    return _Converter(symbols, functions).convert(tree).expr


class _Converter:
    def __init__(self, symbols: Mapping[str, sympy.Expr], functions: Collection[str]):
        self._symbols = symbols
        self._functions = functions

    def convert(self, node: Node) -> _Part:
        match node:
            case Number():
                part = _constant(node.value, 1)
            case Name():
                part = self._name(node)
            case Negative():
                inside = self.convert(node.operand)
                value = None if inside.value is None else -inside.value
                part = _Part(-inside.expr, value, inside.degree, inside.bits, inside.height + 1)
            case Sum():
                part = self._sum(node)
            case Product():
                part = self._product(node)
            case Power():
                part = self._power(node)
            case Call():
                part = self._call(node)
        return _checked(part, node)

    def _name(self, node: Name) -> _Part:
        if node.name == "pi":
            return _Part(sympy.pi, math.pi, Fraction(0), 0, 1)
        if node.name in self._symbols:
            return _Part(self._symbols[node.name], None, Fraction(1), 0, 1)
        if node.name in FUNCTIONS or node.name in self._functions:
            raise ExpressionError(
                f"the function {node.name} needs its argument in parentheses", node.position
            )
        known = [*self._symbols, "pi", *FUNCTIONS, *self._functions]
        hint = did_you_mean(node.name, known) or f"; the names are {listing([*self._symbols, 'pi'])[:200]}"
        raise ExpressionError(f"unknown name {echo(node.name)}{hint}", node.position)

    def _sum(self, node: Sum) -> _Part:
        parts = [self.convert(term) for _, term in node.terms]
        signed = [
            (1 if positive else -1, part) for (positive, _), part in zip(node.terms, parts, strict=True)
        ]
        bits = _within(
            MAX_TOTAL_BITS, sum(part.bits for part in parts), node, "its exact numbers grow too large"
        )
        values = [sign * part.value for sign, part in signed if part.value is not None]
        return _Part(
            sympy.Add(*(sign * part.expr for sign, part in signed)),
            math.fsum(values) if len(values) == len(parts) else None,
            max(part.degree for part in parts),
            bits,
            1 + max(part.height for part in parts),
        )

    def _product(self, node: Product) -> _Part:
        parts = [self.convert(factor) for _, factor in node.factors]
        bits = _within(
            MAX_TOTAL_BITS, sum(part.bits for part in parts), node, "its exact numbers grow too large"
        )
        degree = _bounded_degree(sum((part.degree for part in parts), Fraction(0)), node)
        value: float | None = 1.0
        factors = []
        for (multiply, factor), part in zip(node.factors, parts, strict=True):
            if not multiply and (part.value == 0 or part.expr.is_zero):
                raise ExpressionError("division by zero", factor.position)
            if value is not None:
                value = None if part.value is None else value * part.value if multiply else value / part.value
            factors.append(part.expr if multiply else part.expr**-1)
        constants = [factor for factor in factors if factor.is_Rational]
        _checked(_Part(sympy.Mul(*constants), None, Fraction(0), 0, 1), node)
        return _Part(sympy.Mul(*factors), value, degree, bits, 1 + max(part.height for part in parts))

    def _power(self, node: Power) -> _Part:
        base, exponent = self.convert(node.base), self.convert(node.exponent)
        where = node.exponent.position
        if not exponent.expr.is_Rational:
            raise ExpressionError(
                "the exponent of ** must be a number like 2, -1 or 1/2, not a formula", where
            )
        power = Fraction(int(exponent.expr.p), int(exponent.expr.q))
        if abs(power) > MAX_EXPONENT:
            raise ExpressionError(f"the exponent of ** is larger than {MAX_EXPONENT} in magnitude", where)
        if power.denominator > MAX_ROOT:
            raise ExpressionError(
                f"the exponent of ** must be whole, or a fraction with a denominator of at most {MAX_ROOT}",
                where,
            )
        if power < 0 and (base.value == 0 or base.expr.is_zero):
            raise ExpressionError("division by zero (0 to a negative power)", node.position)
        if power.denominator > 1 and base.value is not None and base.value < 0:
            raise ExpressionError("fractional power of a negative number", node.position)
        size = max(1, math.ceil(abs(power)))
        limit = MAX_TOTAL_BITS if base.value is None else MAX_CONSTANT_BITS
        bits = _within(limit, base.bits * size, node, "its exact numbers grow too large")
        degree = _bounded_degree(base.degree * max(Fraction(1), abs(power)), node)
        try:
            value = None if base.value is None else base.value ** float(power)
        except OverflowError:
            raise ExpressionError("the number is too large for double precision", node.position) from None
        height = 1 + max(base.height, exponent.height)
        return _Part(
            base.expr ** sympy.Rational(power.numerator, power.denominator), value, degree, bits, height
        )

    def _call(self, node: Call) -> _Part:
        undetermined = node.name in self._functions
        if not undetermined and node.name not in FUNCTIONS:
            if node.name in self._symbols or node.name == "pi":
                raise ExpressionError(f"{node.name!r} is not a function; write * to multiply", node.position)
            hint = did_you_mean(node.name, [*FUNCTIONS, *self._functions])
            hint = hint or f"; the functions are {listing([*FUNCTIONS, *self._functions])[:200]}"
            raise ExpressionError(f"unknown function {echo(node.name)}{hint}", node.position)
        if not undetermined and len(node.arguments) != 1:
            raise ExpressionError(f"{node.name} takes 1 argument, got {len(node.arguments)}", node.position)
        parts = [self.convert(argument) for argument in node.arguments]
        bits = _within(
            MAX_TOTAL_BITS, sum(part.bits for part in parts), node, "its exact numbers grow too large"
        )
        height = 1 + max(part.height for part in parts)
        if undetermined:
            function = sympy.Function(node.name, real=True)
            return _Part(function(*(part.expr for part in parts)), None, Fraction(1), bits, height)
        (part,) = parts
        value = None
        if part.value is not None:
            try:
                value = float(_FLOAT[node.name](part.value))
            except ValueError:
                raise ExpressionError(
                    _DOMAINS.get(node.name, f"{node.name} has no value here"), node.position
                ) from None
            except OverflowError:
                raise ExpressionError("the number is too large for double precision", node.position) from None
        expr = _SYMPY[node.name](part.expr)
        if expr.has(sympy.I):
            raise ExpressionError(
                _DOMAINS.get(node.name, f"{node.name} has no real value here"), node.position
            )
        return _Part(expr, value, Fraction(0) if value is not None else Fraction(1), bits, height)


def _constant(value: Fraction, height: int) -> _Part:
    bits = value.numerator.bit_length() + value.denominator.bit_length()
    return _Part(
        sympy.Rational(value.numerator, value.denominator), _as_float(value), Fraction(0), bits, height
    )


def _as_float(value: Fraction) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _checked(part: _Part, node: Node) -> _Part:
    """The part itself, with an exact value where SymPy found one, if double precision can hold it."""
    if part.height > MAX_DEPTH:
        raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels", node.position)
    expr, value = part.expr, part.value
    if expr in _BROKEN:
        raise ExpressionError("division by zero, or a number that does not exist", node.position)
    if isinstance(node, Power | Product) and expr.has(sympy.I):
        raise ExpressionError("fractional power of a negative number", node.position)
    if expr.is_Rational:
        if max(int(expr.p).bit_length(), int(expr.q).bit_length()) > MAX_CONSTANT_BITS:
            raise ExpressionError("its exact numbers grow too large", node.position)
        value = _as_float(Fraction(int(expr.p), int(expr.q)))
        if value == 0 and expr != 0:
            raise ExpressionError("the number is too small for double precision", node.position)
    if value is not None and not math.isfinite(value):
        raise ExpressionError("the number is too large for double precision", node.position)
    return _Part(expr, value, part.degree, part.bits, part.height)


def _within(limit: int, size: int, node: Node, message: str) -> int:
    if size > limit:
        raise ExpressionError(message, node.position)
    return size


def _bounded_degree(degree: Fraction, node: Node) -> Fraction:
    if degree > MAX_DEGREE:
        raise ExpressionError(f"its powers multiply to a degree above {MAX_DEGREE}", node.position)
    return degree
