"""Trees of formulas to SymPy, with constants that do not exist refused where they stand."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction

import sympy

from zakai.models._cost import MAX_EXPONENT, MAX_ROOT, Cost, cost_of_call, cost_of_product, cost_of_sum
from zakai.models._errors import did_you_mean, echo, listing
from zakai.models._other_names import instead_of
from zakai.models.expressions import (
    ARGUMENTS,
    FUNCTIONS,
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
from zakai.models.functions import ComplementaryError, Floor, LogGamma, Maximum, Minimum, Sinc, pairwise, table_function
from zakai.models.table import Table

MAX_CONSTANT_BITS = 2_200  # of a numerator or denominator: twice what a double's exponent can hold

_ELEMENTARY = FUNCTIONS[: FUNCTIONS.index("abs")]
_SYMPY: dict[str, Callable[..., sympy.Expr]] = {name: getattr(sympy, name) for name in _ELEMENTARY if name != "sqrt"} | {
    "abs": sympy.Abs,
    "sign": sympy.sign,
}
# Functions that SymPy may not simplify, from their arguments.
_PLAIN: dict[str, Callable[..., sympy.Expr]] = {
    "atan2": lambda y, x: sympy.atan2(y, x, evaluate=False),
    "min": lambda *parts: pairwise(Minimum, list(parts)),
    "max": lambda *parts: pairwise(Maximum, list(parts)),
    "floor": Floor,
    "heaviside": lambda u: (1 + sympy.sign(u, evaluate=False)) / 2,
    "log1p": lambda u: sympy.log(1 + u, evaluate=False),
    "expm1": lambda u: sympy.exp(u, evaluate=False) - 1,
    "sinc": lambda u: Sinc(u, 0),
    "lgamma": lambda u: LogGamma(u, 0),
    "erfc": ComplementaryError,
}
_LEVELS = {"heaviside": 2, "log1p": 1, "expm1": 1}  # of the expression that stands for the function, beyond one
_FLOAT: dict[str, Callable[..., float]] = {name: getattr(math, name) for name in _ELEMENTARY} | {
    "abs": abs,
    "atan2": math.atan2,
    "min": min,
    "max": max,
    "sign": lambda u: float((u > 0) - (u < 0)),
    "floor": lambda u: float(math.floor(u)),
    "heaviside": lambda u: 0.5 * (1 + (u > 0) - (u < 0)),
    "log1p": math.log1p,
    "expm1": math.expm1,
    "sinc": lambda u: math.sin(u) / u if u else 1.0,
    "lgamma": math.lgamma,
    "erfc": math.erfc,
}
_DOMAINS = {
    "log": "log of a number that is not positive",
    "log1p": "log1p of a number that is not above -1",
    "sqrt": "square root of a negative number",
    "lgamma": "lgamma of a whole number that is not positive",
    "asin": "asin outside [-1, 1]",
    "acos": "acos outside [-1, 1]",
}
_NOT_NUMBERS = (sympy.zoo, sympy.nan, sympy.oo, -sympy.oo)


@dataclass(frozen=True, slots=True)
class _Part:
    """A converted node, its value if it is a constant, and what working with it can cost."""

    expr: sympy.Expr
    value: float | None
    cost: Cost


def to_sympy(
    tree: Node, symbols: Mapping[str, sympy.Expr], functions: Collection[str] = (), tables: Mapping[str, Table] | None = None
) -> sympy.Expr:
    """The SymPy expression of a tree; `symbols`, `functions` and `tables` as in `parse_expression`."""
    return _Converter(symbols, functions, tables or {}).convert(tree).expr


class _Converter:
    def __init__(self, symbols: Mapping[str, sympy.Expr], functions: Collection[str], tables: Mapping[str, Table]):
        self._symbols = symbols
        self._tables = tables
        self._functions = functions

    def convert(self, node: Node) -> _Part:
        match node:
            case Number():
                part = _constant(node.value)
            case Name():
                part = self._name(node)
            case Negative():
                inside = self.convert(node.operand)
                value = None if inside.value is None else -inside.value
                part = _Part(-inside.expr, value, cost_of_sum([inside.cost]).checked(node.position))
            case Sum():
                part = self._sum(node)
            case Product():
                part = self._product(node)
            case Power():
                part = self._power(node)
            case Call():
                part = self._call(node)
        return _finite(part, node.position)

    def _name(self, node: Name) -> _Part:
        if node.name == "pi":
            return _Part(sympy.pi, math.pi, Cost())
        if node.name in self._symbols:
            return _Part(self._symbols[node.name], None, Cost(degree=Fraction(1)))
        if node.name in (*FUNCTIONS, *self._functions, *self._tables):
            raise ExpressionError(f"the function {node.name} needs an argument in parentheses", node.position)
        known = [*self._symbols, "pi", *FUNCTIONS, *self._functions, *self._tables]
        hint = instead_of(node.name) or did_you_mean(node.name, known)
        hint = hint or f"; the names are {listing([*self._symbols, 'pi'])[:200]}"
        raise ExpressionError(f"unknown name {echo(node.name)}{hint}", node.position)

    def _sum(self, node: Sum) -> _Part:
        parts = [self.convert(term) for _, term in node.terms]
        cost = cost_of_sum([part.cost for part in parts]).checked(node.position)
        signs = [1 if positive else -1 for positive, _ in node.terms]
        values = [sign * part.value for sign, part in zip(signs, parts) if part.value is not None]
        total = math.fsum(values) if len(values) == len(parts) else None
        return _Part(sympy.Add(*(sign * part.expr for sign, part in zip(signs, parts))), total, cost)

    def _product(self, node: Product) -> _Part:
        parts = [self.convert(factor) for _, factor in node.factors]
        cost = cost_of_product([part.cost for part in parts]).checked(node.position)
        value: float | None = 1.0
        factors = []
        for (multiply, factor), part in zip(node.factors, parts):
            if not multiply and (part.value == 0 or part.expr == 0):
                raise ExpressionError("division by zero", factor.position)
            if value is not None:
                value = None if part.value is None else value * part.value if multiply else value / part.value
            factors.append(part.expr if multiply else _raised(part, sympy.S.NegativeOne))
        constant = sympy.Mul(*(factor for factor in factors if factor.is_Rational))
        _finite(_Part(constant, None, Cost()), node.position)
        return _Part(sympy.Mul(*factors, evaluate=cost.small), value, cost)

    def _power(self, node: Power) -> _Part:
        base, exponent = self.convert(node.base), self.convert(node.exponent)
        where = node.exponent.position
        if not exponent.expr.is_Rational:
            raise ExpressionError("the exponent of ** must be a number like 2, -1 or 1/2, not a formula", where)
        power = Fraction(int(exponent.expr.p), int(exponent.expr.q))
        if abs(power) > MAX_EXPONENT:
            raise ExpressionError(f"the exponent of ** is larger than {MAX_EXPONENT} in magnitude", where)
        if power.denominator > MAX_ROOT:
            raise ExpressionError(
                f"the exponent of ** must be whole, or a fraction with a denominator of at most {MAX_ROOT}",
                where,
            )
        if power < 0 and (base.value == 0 or base.expr == 0):
            raise ExpressionError("division by zero (0 to a negative power)", node.position)
        if power.denominator > 1 and base.value is not None and base.value < 0:
            raise ExpressionError("fractional power of a negative number", node.position)
        cost = base.cost.power(power).checked(node.position)
        if base.value is not None and cost.bits > MAX_CONSTANT_BITS:
            raise ExpressionError("its exact numbers grow too large", node.position)
        try:
            value = None if base.value is None else base.value ** float(power)
        except OverflowError:
            raise ExpressionError("the number is too large for double precision", node.position) from None
        expr = _raised(base, exponent.expr)
        if expr.has(sympy.I):
            raise ExpressionError("fractional power of a negative number", node.position)
        return _Part(expr, value, cost)

    def _call(self, node: Call) -> _Part:
        undetermined = node.name in self._functions
        table = self._tables.get(node.name)
        if not undetermined and table is None and node.name not in FUNCTIONS:
            if node.name in self._symbols or node.name == "pi":
                raise ExpressionError(f"{node.name!r} is not a function; write * to multiply", node.position)
            known = [*FUNCTIONS, *self._functions, *self._tables]
            hint = instead_of(node.name) or did_you_mean(node.name, known) or f"; the functions are {listing(known[::-1])[:200]}"
            raise ExpressionError(f"unknown function {echo(node.name)}{hint}", node.position)
        least, largest = ARGUMENTS.get(node.name, (1, 1)) if table is None else (len(table.axes),) * 2
        if not undetermined and not least <= len(node.arguments) <= largest:
            count = f"{least} argument{'s' * (least > 1)}" if least == largest else f"{least} to {largest} arguments"
            raise ExpressionError(f"{node.name} takes {count}, got {len(node.arguments)}", node.position)
        parts = [self.convert(argument) for argument in node.arguments]
        cost = cost_of_call([part.cost for part in parts])
        levels = _LEVELS.get(node.name, len(parts) - 2 if node.name in ("min", "max") else 0)
        cost = replace(cost, height=cost.height + levels).checked(node.position)
        if undetermined:
            function = sympy.Function(node.name, real=True)
            return _Part(function(*(part.expr for part in parts), evaluate=cost.small), None, cost)
        if table is not None:
            return _Part(table_function(table)(*(part.expr for part in parts), evaluate=False), None, cost)
        constants = [part.value for part in parts if part.value is not None]
        value = _float_call(node, *constants) if len(constants) == len(parts) else None
        (part, *_) = parts
        if node.name in _PLAIN:
            expr = _PLAIN[node.name](*(part.expr for part in parts))
        elif node.name == "sqrt":
            expr = _raised(part, sympy.S.Half)
        else:
            # SymPy may only simplify the absolute value of what is real: it would make |sqrt(x)| of sqrt(|x|).
            simplify = cost.tiny and (node.name != "abs" or _always_real(part.expr))
            expr = _SYMPY[node.name](part.expr, evaluate=simplify)
        if expr.has(sympy.I):
            raise ExpressionError(_DOMAINS.get(node.name, f"{node.name} has no real value here"), node.position)
        return _Part(expr, value, cost)


def _float_call(node: Call, *arguments: float) -> float:
    try:
        return float(_FLOAT[node.name](*arguments))
    except ValueError:
        words = _DOMAINS.get(node.name, f"{node.name} has no value here")
    except OverflowError:
        words = "the number is too large for double precision"
    raise ExpressionError(words, node.position)


def _raised(base: _Part, exponent: sympy.Rational) -> sympy.Expr:
    if exponent == 1:
        return base.expr
    return sympy.Pow(base.expr, exponent, evaluate=base.cost.tiny or exponent == 0)


def _always_real(expr: sympy.Expr) -> bool:
    """Whether nothing in the expression can leave the real numbers; a walk, for SymPy's own answer can be slow."""
    partial = (sympy.log, sympy.asin, sympy.acos)
    parts = sympy.preorder_traversal(expr)
    return not any(isinstance(part, partial) or part.is_Pow and not part.exp.is_Integer for part in parts)


def _constant(value: Fraction) -> _Part:
    bits = value.numerator.bit_length() + value.denominator.bit_length()
    expr = sympy.Rational(value.numerator, value.denominator)
    return _Part(expr, _as_float(value), Cost(bits=bits))


def _as_float(value: Fraction) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _finite(part: _Part, position: int) -> _Part:
    """The part, with its value exact where SymPy found one, if it is not a number or double precision holds it."""
    expr, value = part.expr, part.value
    if expr in _NOT_NUMBERS:
        raise ExpressionError("division by zero, or a value that is not finite", position)
    if expr.is_Rational:
        if max(int(expr.p).bit_length(), int(expr.q).bit_length()) > MAX_CONSTANT_BITS:
            raise ExpressionError("its exact numbers grow too large", position)
        value = _as_float(Fraction(int(expr.p), int(expr.q)))
        if value == 0 and expr != 0:
            raise ExpressionError("the number is too small for double precision", position)
    if value is not None and not math.isfinite(value):
        raise ExpressionError("the number is too large for double precision", position)
    return _Part(expr, value, part.cost)
