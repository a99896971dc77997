"""Is an expression identically zero, affine or quadratic in the state?

Values come first: a ball that excludes zero refutes, and is rigorous (`balls`).  A proof is exact arithmetic in a tower of
generators (`tower`, `reading`), at first with independent arguments, then over a basis of them.  Where neither ends, an
expression that is analytic on the whole line and vanishes to 40 digits at a dozen random points is taken to be zero: that is
evidence.  Everything else is undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import sympy as sp

from zakai.algebra.balls import LINES, POINTS, Test, concrete, differences, sampled
from zakai.algebra.reading import Reader
from zakai.algebra.tower import Element, OutOfBounds
from zakai.models.functions import Floor, Maximum, Minimum, TableFunction

_ENTIRE = (sp.sin, sp.cos, sp.sinh, sp.cosh, sp.tanh, sp.sech, sp.exp, sp.erf, sp.atan)
NOT_ZERO = "it does not reduce to zero"


class Answer(NamedTuple):
    """`holds`; `how` it was decided: "value", "proof", "evidence" or "undecided"; and `why`: a witness, or what has no proof."""

    holds: bool | None
    how: str
    why: str


def is_zero(expression: sp.Expr) -> bool | None:
    """Return True if the expression is identically zero, False if it is not, None if neither was shown."""
    if expression.is_Rational:
        return bool(expression == 0)
    test = differences([concrete(expression)], 0)
    return answer(test, [expression], [], lambda reader: not reader(expression)).holds


def all_zero(expressions: Iterable[sp.Expr]) -> bool | None:
    """Return `is_zero` for several expressions at once: False wins over None, None over True."""
    every: bool | None = True
    for expression in expressions:
        holds = is_zero(expression)
        if holds is False:
            return False
        every = every if holds else None
    return every


def is_quadratic(q: sp.Expr, x: Sequence[sp.Symbol]) -> bool | None:
    """Return whether q is a polynomial of degree two at most in x, its coefficients being functions of the other symbols.

    Its third differences along random lines refute; its derivatives, which are affine, prove.
    """
    x = [s for s in x if q.has(s)]
    one_piece = is_in_one_piece(q, x)

    def proof(reader: Reader) -> bool:
        element = reader(q)
        return all(is_affine(reader, reader.diff(element, s), one_piece) for s in x)

    return answer(differences([concrete(q)], 3), [q], x, proof, everywhere=True).holds


def is_affine(reader: Reader, e: Element, one_piece: bool) -> bool:
    """Return whether an element is affine, as an identity or, where one formula holds everywhere, by zero derivatives."""
    if not reader.affine_part(e)[2]:
        return True
    x = reader.x
    return one_piece and all(not reader.diff(reader.diff(e, a), b) for i, a in enumerate(x) for b in x[i:])


def answer(
    test: Test, formulas: Sequence[sp.Expr], x: Sequence[sp.Symbol], proof: Callable[[Reader], bool], everywhere: bool = False
) -> Answer:
    """Decide a statement about formulas: by values, by a proof, else by evidence.

    Args:
        test: returns a ball that contains zero wherever the statement holds.
        formulas: those that the statement is about.
        x: the state.
        proof: whether the statement reduces to zero in a tower.
        everywhere: whether a state without a real value refutes.
    """
    symbols = symbols_of(formulas, x)
    refuted = sampled(test, symbols, x, LINES, everywhere)
    if refuted.holds is False:
        return Answer(False, "value", refuted.witness)
    proved, why = prove(formulas, x, proof)
    return Answer(True, "proof", "") if proved else evidence(test, formulas, x, why, everywhere)


def evidence(
    test: Test, formulas: Sequence[sp.Expr], x: Sequence[sp.Symbol], why: str, everywhere: bool = False
) -> Answer:
    """Return what values alone say where there is no proof."""
    found = sampled(test, symbols_of(formulas, x), x, POINTS, everywhere)
    if found.holds is False:
        return Answer(False, "value", found.witness)
    if found.count >= POINTS and all(map(is_analytic, formulas)):
        return Answer(True, "evidence", f"zero to 40 digits on {found.count} random lines; no proof: {why}")
    return Answer(None, "undecided", f"zero to 40 digits on {found.count} random lines; no proof: {why}")


def symbols_of(formulas: Sequence[sp.Expr], x: Sequence[sp.Symbol]) -> list[sp.Symbol]:
    """Return what needs a value, in the order of the names."""
    return sorted(set(x).union(*(e.free_symbols for e in formulas)), key=lambda s: s.name)


def prove(formulas: Sequence[sp.Expr], x: Sequence[sp.Symbol], proof: Callable[[Reader], bool]) -> tuple[bool, str]:
    """Return whether a statement is proved, with independent arguments or over a basis of them, and why not."""
    try:
        reader = Reader(formulas, x)
        if proof(reader):
            return True, ""
        joint = reader.joint_arguments()
        if joint and proof(Reader(formulas, x, joint)):
            return True, ""
    except OutOfBounds as bound:
        return False, str(bound)
    return False, NOT_ZERO


def is_analytic(expression: sp.Expr) -> bool:
    """Return whether the form of the expression shows that it is analytic on the real line, except at isolated points.

    A path through the complex plane goes around such points: an identity that holds somewhere holds everywhere.
    """
    for e in sp.preorder_traversal(expression):
        if isinstance(e, sp.Function):
            inside = isinstance(e, sp.log) and isinstance(e.args[0], sp.cosh)
            if not (isinstance(e, _ENTIRE) or inside) or isinstance(e, sp.atan | sp.log) and _has_poles(e.args[0]):
                return False
        elif isinstance(e, sp.Pow) and not (e.exp.is_Integer or not e.base.free_symbols):
            return False
    return True


def is_in_one_piece(expression: sp.Expr, x: Sequence[sp.Symbol]) -> bool:
    """Return whether the form of the expression shows that one analytic formula in x holds wherever it exists.

    asin(sin(x)), atan(tan(x)), atan(1/x) and sqrt(x**2) have different formulas on different intervals, each of them smooth.
    """
    for e in sp.preorder_traversal(expression):
        if not e.has(*x):
            continue
        if isinstance(e, sp.Abs | sp.sign | sp.asin | sp.acos | sp.atan2 | Floor | Minimum | Maximum | TableFunction):
            return False
        if isinstance(e, sp.atan) and _has_poles(e.args[0]):
            return False
        root = e.base if isinstance(e, sp.Pow) and not e.exp.is_Integer else e.args[0] if isinstance(e, sp.log) else None
        # A domain that is a half-space or everything is connected.
        if root is not None and not root.is_positive and any(sp.diff(root, s).has(*x) for s in x):
            return False
    return True


def _has_poles(expression: sp.Expr) -> bool:
    """Return whether the form of the expression allows that it has no value at some real point."""
    return any(
        isinstance(e, sp.tan | sp.cot | sp.sec | sp.csc | sp.coth | sp.csch)
        or (isinstance(e, sp.Pow) and e.exp.is_negative is not False and not (e.base.is_positive or e.base.is_negative))
        for e in sp.preorder_traversal(expression)
    )
