"""Formulas of model files: text -> our own immutable tree (`parse`) -> SymPy, with bounds on everything.

    sum      = product (("+" | "-") product)*
    product  = unary (("*" | "/") unary)*
    unary    = ("+" | "-")* power
    power    = atom ["**" unary]                    as in Python: -x**2 = -(x**2), 2**-1 = 1/2, 2**3**2 = 2**9
    atom     = number | "pi" | name | name "(" sum ("," sum)* ")" | "(" sum ")"

Nothing is ever evaluated as Python; an untrusted formula can be nothing but a formula.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

from zakai.errors import InputError
from zakai.models._errors import echo

MAX_LENGTH = 10_000
MAX_DEPTH = 100
MAX_DIGITS = 40
MAX_DECIMAL_EXPONENT = 308

FUNCTIONS = (
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "exp",
    "log",
    "sqrt",
    "erf",
    "abs",
    "atan2",
    "min",
    "max",
    "sign",
    "floor",
    "heaviside",
    "log1p",
    "expm1",
    "sinc",
    "lgamma",
    "erfc",
)
ARGUMENTS = {"atan2": (2, 2), "min": (2, 64), "max": (2, 64)}  # the least and the largest number; one for all others
RESERVED = ("t", "pi", *FUNCTIONS)


class ExpressionError(InputError):
    """A formula that cannot be read, with the 1-based column where it goes wrong in `position`."""

    def __init__(self, message: str, position: int):
        super().__init__(f"column {position}: {message}")
        self.position = position


# ---- the tree; `position` is the 1-based column where the node begins


@dataclass(frozen=True, slots=True)
class Number:
    """An exact number."""

    value: Fraction
    position: int


@dataclass(frozen=True, slots=True)
class Name:
    """A state, a parameter, t or a constant."""

    name: str
    position: int


@dataclass(frozen=True, slots=True)
class Call:
    """A function of its arguments."""

    name: str
    arguments: tuple[Node, ...]
    position: int


@dataclass(frozen=True, slots=True)
class Negative:
    """The negative of its operand."""

    operand: Node
    position: int


@dataclass(frozen=True, slots=True)
class Power:
    """A base to an exponent."""

    base: Node
    exponent: Node
    position: int


@dataclass(frozen=True, slots=True)
class Sum:
    """The sum of the terms, those with sign False subtracted: long sums stay flat."""

    terms: tuple[tuple[bool, Node], ...]
    position: int


@dataclass(frozen=True, slots=True)
class Product:
    """The product of the factors, those with sign False divided by."""

    factors: tuple[tuple[bool, Node], ...]
    position: int


Node = Number | Name | Call | Negative | Power | Sum | Product


# ---- text -> tree

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?:\*\*|[-+*/(),])"
)
_CONDITION = re.compile(r"(?<![\w.])(if|else|elif)(?!\w)")
_NO_COMPARISON = "there are no comparisons: write heaviside(a - b) for a > b, or max(a, b) and min(a, b)"
_HINTS = {
    "^": "; write ** for a power",
    "%": "; there is no modulo: write a - b*floor(a/b)",
    "[": "; there is no indexing",
    ".": "; there are no attributes",
    "=": "; write one formula, not an equation",
    "<": f"; {_NO_COMPARISON}",
    ">": f"; {_NO_COMPARISON}",
}


class _Token(NamedTuple):
    kind: str  # number, name, end, or the symbol itself
    text: str
    position: int


def _tokens(text: str) -> Iterator[_Token]:
    end = 0
    for match in _TOKEN.finditer(text):
        if match.start() != end:  # something between two words that is none
            break
        end = match.end()
        kind = match.lastgroup
        if kind != "space":
            word = match.group()
            yield _Token(word if kind is None else kind, word, match.start() + 1)
    if end < len(text):
        hint = _HINTS.get(text[end], "")
        raise ExpressionError(f"unexpected character in {echo(text[end : end + 21])}{hint}", end + 1)
    yield _Token("end", "", len(text) + 1)


def parse(text: str) -> Node:
    """Read a formula into a tree.

    `text` is one formula in the grammar above. Raises `ExpressionError`, with the column, for anything that
    is not in the grammar, longer than 10,000 characters or nested deeper than 100 levels.

        >>> parse("-2*x")
        Product(factors=((True, Negative(operand=Number(value=Fraction(2, 1), position=2), position=1)), ...
    """
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"the formula has {len(text)} characters; at most {MAX_LENGTH} are read", MAX_LENGTH + 1)
    if (word := _CONDITION.search(text)) is not None:
        what = "write heaviside(a - b), which is 1 where a > b and else 0, or max and min"
        raise ExpressionError(f"there is no {word.group()}: {what}", word.start() + 1)
    parser = _Parser(text)
    if parser.token.kind == "end":
        raise ExpressionError("the formula is empty", 1)
    tree = parser.sum(0)
    if parser.token.kind != "end":
        raise parser.unexpected("an operator")
    return tree


class _Parser:
    """Recursive descent; `depth` counts open parentheses and exponents and bounds Python's own stack."""

    def __init__(self, text: str):
        self._rest = _tokens(text)
        self.token = next(self._rest)

    def advance(self) -> _Token:
        token, self.token = self.token, next(self._rest, self.token)
        return token

    def unexpected(self, wanted: str) -> ExpressionError:
        token = self.token
        if token.kind == "end":
            return ExpressionError(f"the formula ends where {wanted} was expected", token.position)
        hint = "; write * to multiply" if wanted == "an operator" and token.kind in ("name", "number", "(") else ""
        return ExpressionError(f"expected {wanted}, got {echo(token.text)}{hint}", token.position)

    def expect(self, kind: str) -> None:
        if self.token.kind != kind:
            raise self.unexpected(f"'{kind}'")
        self.advance()

    def sum(self, depth: int) -> Node:
        position = self.token.position
        terms = [(True, self.product(depth))]
        while self.token.kind in ("+", "-"):
            terms.append((self.advance().kind == "+", self.product(depth)))
        return terms[0][1] if len(terms) == 1 else Sum(tuple(terms), position)

    def product(self, depth: int) -> Node:
        position = self.token.position
        factors = [(True, self.unary(depth))]
        while self.token.kind in ("*", "/"):
            factors.append((self.advance().kind == "*", self.unary(depth)))
        return factors[0][1] if len(factors) == 1 else Product(tuple(factors), position)

    def unary(self, depth: int) -> Node:
        position, negative = self.token.position, False
        while self.token.kind in ("+", "-"):
            negative ^= self.advance().kind == "-"
        base_position, base = self.token.position, self.atom(depth)
        if self.token.kind == "**":
            self.advance()
            base = Power(base, self.unary(self.deeper(depth)), base_position)
        return Negative(base, position) if negative else base

    def atom(self, depth: int) -> Node:
        token = self.token
        if token.kind == "number":
            return Number(_number(self.advance()), token.position)
        if token.kind == "name":
            self.advance()
            if self.token.kind != "(":
                return Name(token.text, token.position)
            self.advance()
            arguments = [self.sum(self.deeper(depth))]
            while self.token.kind == ",":
                self.advance()
                arguments.append(self.sum(self.deeper(depth)))
            self.expect(")")
            return Call(token.text, tuple(arguments), token.position)
        if token.kind == "(":
            self.advance()
            inside = self.sum(self.deeper(depth))
            self.expect(")")
            return inside
        raise self.unexpected("a number, a name or '('")

    def deeper(self, depth: int) -> int:
        if depth >= MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels", self.token.position)
        return depth + 1


def _number(token: _Token) -> Fraction:
    """The decimal as an exact rational; its size is checked before any large integer is made."""
    mantissa, _, exponent = token.text.lower().partition("e")
    whole, _, decimals = mantissa.partition(".")
    digits = (whole + decimals).strip("0")
    if len(digits) > MAX_DIGITS:
        raise ExpressionError(f"the number {echo(token.text)} has more than {MAX_DIGITS} significant digits", token.position)
    if not digits:
        return Fraction(0)
    magnitude = exponent.lstrip("+-").lstrip("0")
    leading = len(whole.lstrip("0")) or -(len(decimals) - len(decimals.lstrip("0")))
    if len(magnitude) > 3 or abs(int(exponent or "0") + leading - 1) > MAX_DECIMAL_EXPONENT:
        raise ExpressionError(f"the number {echo(token.text)} is outside 1e-308 to 1e308", token.position)
    return Fraction(int(digits)) * Fraction(10) ** (int(exponent or "0") + leading - len(digits))
