"""The smallest part of the state that is observed and moves by itself, in linear coordinates.

    z = W x,      h a function of z,      W f a function of z:      dz = b(z) dt + W g dv,    dy = h(z) dt + dw

The conditional density of z needs no other coordinate, and the rest of the state is not observed but through z.  A function
u is one of W x if its gradients everywhere are combinations of the rows of W; so W is the span of the gradients of the h_i, and
with a row w that of the gradients of w'f.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import sympy as sp

from zakai.algebra._readable import tidy
from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.generators import Unreadable
from zakai.algebra.linear_span import Span, Vector
from zakai.algebra.operators import JetTowerEnds, Symbol
from zakai.algebra.ratios import TooLarge
from zakai.algebra.systems import affine_parts
from zakai.models.model import Model


@dataclass(frozen=True)
class ObservedBlock:
    """`coordinates` W x, (k,); `drift` b and `observation` h as functions of the `symbols` z, (k,); `covariance` W G W', (k, k).

    `linear`: whether b and h are affine, so that the Kalman-Bucy filter is that of z, if its prior is normal.
    """

    coordinates: tuple[sp.Expr, ...]
    symbols: tuple[sp.Symbol, ...]
    drift: tuple[sp.Expr, ...]
    observation: tuple[sp.Expr, ...]
    covariance: sp.ImmutableMatrix
    linear: bool


def observed_block(model: Model) -> ObservedBlock | str:
    """The smallest autonomous block W x that h is a function of; or why it is not known.

    It holds at the model's parameters.  W is the reduced echelon form.

        >>> block = observed_block(zakai.load_model("gallery:passive-drift"))
        >>> print(block.coordinates, block.drift)
        (x1, x2 + x3) (z1 + z2, 2*z1 - z2 + 1/10)
    """
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    try:
        operators = DmzOperators(model, values)
        rows = _closed(operators)
    except JetTowerEnds:
        return "higher derivatives of an undetermined function are needed than are kept"
    except (Unreadable, TooLarge) as reason:
        return f"not explored: {reason}"
    W = sp.Matrix(len(rows), model.n, [entry for row in rows for entry in row])
    f, h, G = (m.xreplace(values) for m in (model.drift, model.observation, model.covariance))
    z = _symbols(len(rows), {symbol.name for symbol in (*model.x, *model.parameter_symbols)})
    # On the rows of an echelon form x is z at the pivots and, as nothing depends on it, anything elsewhere.
    pivots = {model.x[next(j for j, c in enumerate(row) if c != 0)]: z_k for row, z_k in zip(rows, z, strict=True)}
    drift, seen = _at(W * f, model, pivots), _at(h, model, pivots)
    if drift is None or seen is None:
        return "the formulas have no value at the points that were tried"
    return ObservedBlock(
        coordinates=tuple(W * sp.Matrix(model.x)),
        symbols=z,
        drift=drift,
        observation=seen,
        covariance=sp.ImmutableMatrix((W * G * W.T).applyfunc(tidy)),
        linear=all(affine_parts(sp.Matrix(len(part), 1, part), z) is not None for part in (drift, seen)),
    )


def _closed(operators: DmzOperators) -> list[list[sp.Expr]]:
    """W: the gradients of h, and with each row those of its part of the drift."""
    ring, numbers = operators.ring, operators.numbers
    slopes = [_gradient(operators, f_i) for f_i in operators.f]
    span, fresh = Span(numbers.one), [row for h_i in operators.h for row in _gradient(operators, h_i).values()]
    count = 0
    while fresh:
        row = fresh.pop()
        count += 1
        if span.add(row, count):
            combined: dict[Any, Vector] = {}
            for i, c in row.items():
                for key, slope in slopes[-i].items():
                    target = combined.setdefault(key, {})
                    for j, value in slope.items():
                        target[j] = target[j] + c * value if j in target else c * value
            fresh += [{j: c for j, c in new.items() if c} for new in combined.values()]
    return [
        [numbers.expression(row[-j]) if -j in row else sp.Integer(0) for j in range(ring.n)]
        for _, (row, _) in sorted(span.rows.items(), reverse=True)
    ]


def _gradient(operators: DmzOperators, p: Symbol) -> dict[Any, Vector]:
    """The gradient of a function: a vector for each monomial.  Coordinate j has the key -j, so that the first is the pivot."""
    result: dict[Any, Vector] = {}
    for j in range(operators.ring.n):
        for key, c in operators.numbers.vector(operators.ring.total_derivative(p, j)).items():
            result.setdefault(key, {})[-j] = c
    return result


def _at(field: sp.MatrixBase, model: Model, pivots: Mapping[sp.Symbol, sp.Symbol]) -> tuple[sp.Expr, ...] | None:
    """A function of W x as one of z."""
    for value in (sp.Integer(0), sp.Rational(1, 2), sp.Rational(7, 5)):
        substituted = field.xreplace({x: pivots.get(x, value) for x in model.x}).doit()
        if not substituted.has(sp.nan, sp.zoo, sp.oo):
            return tuple(tidy(sp.expand(entry)) for entry in substituted)
    return None


def _symbols(count: int, used_names: AbstractSet[str]) -> tuple[sp.Symbol, ...]:
    letter = "z"
    while used_names & {f"{letter}{k + 1}" for k in range(count)}:
        letter += "_"
    return tuple(sp.Symbol(f"{letter}{k + 1}", real=True) for k in range(count))
