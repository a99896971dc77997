"""Formulas to our own tree; a tree that is printed is read as the same tree again."""

from fuzz.oracle import value_or_one_line
from fuzz.trees import printed, without_positions
from zakai.errors import InputError
from zakai.models.expressions import ExpressionError, parse


def one_input(data: bytes) -> None:
    text = data.decode("utf-8", errors="replace")
    tree = value_or_one_line(lambda: parse(text))
    if isinstance(tree, InputError):
        assert isinstance(tree, ExpressionError) and 1 <= tree.position <= len(text) + 1
        return
    again = parse(printed(tree))
    assert without_positions(again) == without_positions(tree)
