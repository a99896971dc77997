"""What a user may write for a key: formulas as text, numbers, lists of a required shape, names."""

from __future__ import annotations

import keyword
import math
import numbers
import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import sympy
from sympy.printing.str import StrPrinter

from zakai.errors import InputError
from zakai.models._errors import did_you_mean, echo, listing, named
from zakai.models.expressions import RESERVED
from zakai.models.formulas import parse_expression

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}\Z")


class _GrammarPrinter(StrPrinter):
    """SymPy to a formula in the grammar of model files."""

    def _print_Abs(self, expr: sympy.Abs) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_Minimum(self, expr: sympy.Expr) -> str:
        return f"min({self.stringify(expr.args, ', ')})"

    def _print_Maximum(self, expr: sympy.Expr) -> str:
        return f"max({self.stringify(expr.args, ', ')})"

    _print_Min, _print_Max = _print_Minimum, _print_Maximum

    def _print_Floor(self, expr: sympy.Expr) -> str:
        return f"floor({self._print(expr.args[0])})"

    def _print_Heaviside(self, expr: sympy.Expr) -> str:
        return f"heaviside({self._print(expr.args[0])})"

    def _print_Sinc(self, expr: sympy.Expr) -> str:
        return f"sinc({self._print(expr.args[0])})"

    def _print_LogGamma(self, expr: sympy.Expr) -> str:
        return f"lgamma({self._print(expr.args[0])})"

    def _print_ComplementaryError(self, expr: sympy.Expr) -> str:
        return f"erfc({self._print(expr.args[0])})"

    _print_loggamma, _print_erfc = _print_LogGamma, _print_ComplementaryError

    def _print_Exp1(self, expr: sympy.Expr) -> str:
        return "exp(1)"

    def _print_Float(self, expr: sympy.Float) -> str:
        return self._print(sympy.Rational(str(expr)))


def kind_of(value: Any) -> str:
    """What a value is, in the user's words."""
    if isinstance(value, bool | np.bool_):
        return "a boolean"
    if isinstance(value, str):
        return f"the text {echo(value)}"
    if isinstance(value, numbers.Number | Decimal | sympy.Number):
        return f"the number {echo(value)}"
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list | tuple | np.ndarray | sympy.MatrixBase):
        return "a list"
    if isinstance(value, type(print) | type(kind_of) | np.ufunc):
        return "a function; write its formula as text, as in '-x', which is also read by the analysis"
    return "nothing" if value is None else f"a {type(value).__name__}"


def formula(value: Any) -> str:
    """The text of one formula given as text, number or SymPy expression."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        raise InputError("expected a formula in quotes or a number, got a boolean")
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float | Decimal) and not math.isfinite(value):
        raise InputError(f"expected a finite number, got {value}")
    if isinstance(value, float | int | Decimal | Fraction):
        try:
            return str(value)
        except ValueError:  # Python refuses to print integers of more than 4,300 digits
            raise InputError("the number has more than 40 significant digits") from None
    if isinstance(value, sympy.Expr):
        return _GrammarPrinter().doprint(value)
    raise InputError(f"expected a formula in quotes or a number, got {kind_of(value)}")


def exact_number(value: Any) -> sympy.Rational:
    """Return a rational number that is given as a number or as a text like "1/3"."""
    text = formula(value)
    result = parse_expression(text, {})
    if not result.is_Rational:
        raise InputError(f"expected a rational number, got {echo(text)}")
    return result


def number(value: Any) -> float:
    """A finite number as a double."""
    if (
        isinstance(value, str)
        or not isinstance(value, numbers.Real | Decimal | sympy.Number)
        or isinstance(value, bool | np.bool_)
    ):
        raise InputError(f"expected a number, got {kind_of(value)}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise InputError(f"expected a finite number, got {echo(value)}")
    return result


def array(value: Any, shape: tuple[int, ...], expected: str) -> np.ndarray:
    """Numbers in nested lists of exactly this shape; `expected` says the shape in words."""
    if not shape:
        return np.array(number(value))
    entries = items(value, shape[0], expected)
    parts = []
    for index, entry in enumerate(entries):
        with named(f"entry {index + 1}"):
            parts.append(array(entry, shape[1:], expected))
    return np.array(parts, dtype=float).reshape(shape)


def items(value: Any, length: int | None, expected: str) -> list[Any]:
    """A list of the required length; `expected` says in words what it should be."""
    if isinstance(value, sympy.MatrixBase | np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        raise InputError(f"expected {expected}, got {kind_of(value)}")
    if length is not None and len(value) != length:
        raise InputError(f"expected {expected}, got a list of {len(value)}")
    return list(value)


def _is_formula(value: Any) -> bool:
    """Return whether a value is one formula or number."""
    return isinstance(value, str | int | float | Decimal | np.number | sympy.Expr) and not isinstance(
        value, bool | sympy.MatrixBase
    )


def vector_of_formulas(value: Any, length: int | None, expected: str) -> list[str]:
    """A list of formulas; a SymPy column is one too, and one formula is a list of one where that is allowed."""
    if _is_formula(value) and length in (1, None):
        value = [value]
    if isinstance(value, sympy.MatrixBase) and 1 in value.shape:
        value = list(value)
    texts = items(value, length, expected)
    for index, entry in enumerate(texts):
        if not isinstance(entry, str):
            with named(f"[{index}]"):
                texts[index] = formula(entry)
    return texts


def matrix_of_formulas(value: Any, rows: int, columns: int | None, expected: str) -> list[list[str]]:
    """Rows of formulas, all of one length; one formula is a matrix of size one where that is allowed, and so is a list of it."""
    if _is_formula(value) and rows == 1 and columns in (1, None):
        value = [[value]]
    table = items(value, rows, expected)
    if table and all(map(_is_formula, table)):
        if rows == 1:
            table = [table]
        else:
            entries = [[_written(entry) if i == j else "0" for j in range(rows)] for i, entry in enumerate(table)]
            diagonal = ", ".join(f"[{', '.join(row)}]" for row in entries)
            raise InputError(f"expected {expected}, got a list of {rows}; write [{diagonal}] for a diagonal matrix")
    for index, row in enumerate(table):
        with named(f"[{index}]"):
            row = items(row, None, expected)
            columns = columns if columns is not None else max(len(row), 1)
            if len(row) != columns:
                raise InputError(f"expected {expected}: {columns} in each row, got {len(row)}")
            table[index] = vector_of_formulas(row, columns, expected)
    return table


def _written(entry: Any) -> str:
    """Return a formula as it stands in a list."""
    return f'"{entry}"' if isinstance(entry, str) else str(entry)


def square_of_formulas(value: Any, size: int, expected: str) -> list[list[str]]:
    """Rows of formulas of a square matrix; a list of variances is its diagonal, and one formula the matrix of size one."""
    if isinstance(value, sympy.MatrixBase | np.ndarray):
        value = value.tolist()
    if size == 1 and not isinstance(value, list | tuple | Mapping) and value is not None:
        value = [[value]]
    if isinstance(value, list | tuple) and value and not any(isinstance(row, list | tuple | np.ndarray) for row in value):
        variances = vector_of_formulas(value, size, f"{expected}, or {size} variances")
        return [[variances[i] if i == j else "0" for j in range(size)] for i in range(size)]
    return matrix_of_formulas(value, size, size, expected)


def names(value: Any, expected: str) -> tuple[str, ...]:
    """A list of different, allowed names."""
    found: dict[str, None] = {}
    for index, name in enumerate(items(value, None, expected)):
        with named(f"[{index}]"):
            if not isinstance(name, str):
                raise InputError(f"expected a name in quotes, got {kind_of(name)}")
            allowed_name(name)
            if name in found:
                raise InputError(f"the name {name!r} is given twice")
            found[name] = None
    return tuple(found)


def allowed_name(name: str) -> None:
    """Raise InputError unless the name can stand in a formula."""
    if not _NAME.match(name):
        raise InputError(f"{echo(name)} is not a name; use ASCII letters, digits and _, a letter first, at most 64")
    if keyword.iskeyword(name):
        raise InputError(f"{name!r} is a keyword of Python and cannot be a name; try {name + '_'!r}")
    if name in RESERVED:
        raise InputError(f"{name!r} already has a meaning in formulas and cannot be a name")


def known_keys(keys: Iterable[str], allowed: Sequence[str]) -> None:
    """Raise InputError at the first key that is not allowed."""
    for key in keys:
        if key not in allowed:
            raise InputError(f"unknown key {echo(key, 40)}{did_you_mean(key, allowed)} (the keys are {listing(allowed)})")
