"""Formulas to SymPy: states x and y, the time, a parameter and an undetermined function."""

import sympy

from fuzz.oracle import value_or_one_line
from zakai.models.formulas import parse_expression

_NAMES = {name: sympy.Symbol(name, real=True) for name in ("x", "y", "t", "a")}


def one_input(data: bytes) -> None:
    text = data.decode("utf-8", errors="replace")
    value_or_one_line(lambda: parse_expression(text, _NAMES, ("gamma",)))
