"""Trees of formulas as text with as few parentheses as the grammar allows, and what they say without their positions."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from zakai.models.expressions import Call, Name, Negative, Node, Number, Power, Product, Sum


def printed(node: Node) -> str:
    """A formula whose tree is this one."""
    match node:
        case Number():
            return decimal(node.value)
        case Name():
            return node.name
        case Call():
            return f"{node.name}({', '.join(printed(argument) for argument in node.arguments)})"
        case Negative():
            return "-" + _within(node.operand, (Number, Name, Call, Power))
        case Power():
            return f"{_within(node.base, (Number, Name, Call))}**{_within(node.exponent, (Number, Name, Call, Power, Negative))}"
        case Sum():
            return _chain(node.terms, " + ", " - ", (Number, Name, Call, Power, Negative, Product))
        case Product():
            return _chain(node.factors, "*", "/", (Number, Name, Call, Power, Negative))
    raise AssertionError(node)


def _within(node: Node, allowed: tuple[type, ...]) -> str:
    return printed(node) if isinstance(node, allowed) else f"({printed(node)})"


def _chain(parts: tuple[tuple[bool, Node], ...], forward: str, backward: str, allowed: tuple[type, ...]) -> str:
    (_, first), *rest = parts
    return _within(first, allowed) + "".join((forward if sign else backward) + _within(node, allowed) for sign, node in rest)


def decimal(value: Fraction) -> str:
    """The decimal of a rational whose denominator divides a power of ten."""
    places = 0
    while (value * 10**places).denominator != 1:
        places += 1
    digits = str((value * 10**places).numerator)
    stripped = digits.rstrip("0") or "0"
    return f"{stripped}e{len(digits) - len(stripped) - places}"


def without_positions(node: Node) -> tuple[Any, ...]:
    """The tree as nested tuples: the kinds of its nodes and what they hold."""
    match node:
        case Number():
            return ("number", node.value)
        case Name():
            return ("name", node.name)
        case Call():
            return ("call", node.name, *map(without_positions, node.arguments))
        case Negative():
            return ("negative", without_positions(node.operand))
        case Power():
            return ("power", without_positions(node.base), without_positions(node.exponent))
        case Sum():
            return ("sum", *((sign, without_positions(term)) for sign, term in node.terms))
        case Product():
            return ("product", *((sign, without_positions(factor)) for sign, factor in node.factors))
    raise AssertionError(node)
