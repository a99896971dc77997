"""Formulas of model files as SymPy expressions."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import sympy

from zakai.models._exact import to_sympy
from zakai.models.expressions import parse
from zakai.models.table import Table


def parse_expression(
    text: str, symbols: Mapping[str, sympy.Expr], functions: Collection[str] = (), tables: Mapping[str, Table] | None = None
) -> sympy.Expr:
    """Read a formula into SymPy, with decimals as exact rationals.

    `text` is one formula; `symbols` maps each name it may use to the symbol that stands for it; `functions`
    names the undetermined functions, `tables` holds the tables by name. Raises `ExpressionError` with the column for anything
    else, for a constant that does not exist (1/0, log(-1)) and for powers and numbers that grow beyond the bounds.

        >>> x = sympy.Symbol("x", real=True)
        >>> parse_expression("0.5*x**2", {"x": x})
        x**2/2
    """
    return to_sympy(parse(text), symbols, functions, tables or {})
