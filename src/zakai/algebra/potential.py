"""phi with G grad phi = r: a combination of candidates with coefficients that are free of the state, by linear algebra.

The candidates follow from r in a tower, as in the parallel algorithm of Risch and Norman: for each monomial m of r_i and the
variables v, w that m, or the derivatives of what is in m, contain: m, m x_i, m v, m / v and m v / w over the same denominator;
log cosh u for a generator tanh u; and the logarithms of the denominators of r and of the derivatives of its generators.
G^-1 is not needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import sympy as sp

from zakai.algebra.reading import Reader
from zakai.algebra.tower import Element

MOST_CANDIDATES = 1000
Monomial = tuple[int, ...]


class Candidate(NamedTuple):
    """A function of the state: as a formula or in the tower, and its derivatives in the states and in t."""

    formula: sp.Expr | None
    element: Element | None
    slopes: tuple[Element, ...]
    rate: Element


class Potential(NamedTuple):
    """phi as a formula, its gradient in the tower, and its derivative in t in the tower, or None."""

    formula: sp.Expr
    gradient: list[Element]
    rate: Element | None


def potential(reader: Reader, field: Sequence[Element], G: Sequence[Sequence[Element]], t: sp.Symbol) -> Potential | None:
    """Return phi with G grad phi equal to the field, or None where no combination of the candidates is one.

    Raises:
        OutOfBounds: the work is beyond its bound.
    """
    candidates = list(islice(_candidates(reader, field, G, t), MOST_CANDIDATES + 1))
    if not candidates or len(candidates) > MOST_CANDIDATES:
        return None
    n = len(reader.x)
    columns = [[reader.sum(g * d for g, d in zip(G[i], c.slopes) if g and d) for i in range(n)] for c in candidates]
    coefficients = _solved(_rows(reader, [*columns, field]), len(candidates))
    if coefficients is None:
        return None
    terms, rate, known = [], reader.zero, True
    gradient = [reader.zero] * n
    for j, c in coefficients.items():
        one = candidates[j]
        terms.append(reader.expression(c) * (reader.expression(one.element) if one.element is not None else one.formula))
        gradient = [p + c * d if d else p for p, d in zip(gradient, one.slopes)]
        moving, rate = reader.diff(c, t), rate + c * one.rate
        if one.element is not None:
            rate = rate + moving * one.element
        known = known and (one.element is not None or not moving)
    return Potential(sp.Add(*terms), gradient, rate if known else None)


def _candidates(
    reader: Reader, field: Sequence[Element], G: Sequence[Sequence[Element]], t: sp.Symbol
) -> Iterator[Candidate]:
    used = _closure(reader, {k for e in field for p in (e.numerator, e.denominator) for k in reader.used(p)})
    for u, T in reader.log_cosh:
        inner = reader(u)
        slopes = tuple(T * d if d else d for d in (reader.diff(inner, s) for s in (*reader.x, t)))
        if any(slopes[:-1]) and set(reader.used(T.numerator)) <= used:
            yield Candidate(sp.log(sp.cosh(u)), None, slopes[:-1], slopes[-1])
    for D in _denominators(reader, field, used):
        below = D.inverse()
        slopes = tuple(d * below if d else d for d in (reader.diff(D, s) for s in (*reader.x, t)))
        yield Candidate(sp.log(reader.expression(D)), None, slopes[:-1], slopes[-1])
    for element in _monomials(reader, field, G):
        yield Candidate(None, element, tuple(reader.diff(element, s) for s in reader.x), reader.diff(element, t))


def _closure(reader: Reader, used: set[int]) -> set[int]:
    """Return generators that depend on the state, with those of their derivatives."""
    found: set[int] = set()
    pending = {k for k in used if reader.moving(reader.generated(k))}
    while pending:
        found |= pending
        slopes = [reader.slope(k, s) for k in pending for s in reader.x]
        more = {k for e in slopes for p in (e.numerator, e.denominator) if e for k in reader.used(p)}
        pending = {k for k in more - found if reader.moving(reader.generated(k))}
    return found


def _denominators(reader: Reader, field: Sequence[Element], used: set[int]) -> Iterator[Element]:
    """Yield the irreducible factors of denominators that depend on the state."""
    seen: set[str] = set()
    for e in (*field, *(reader.slope(k, s) for k in sorted(used) for s in reader.x)):
        for factor, _ in () if e.denominator.is_constant() else e.denominator.factor()[1]:
            D = reader.of(factor)
            if str(factor) not in seen and reader.moving(D) and (len(factor) > 1 or not reader.is_exponential(factor)):
                seen.add(str(factor))
                yield D


def _monomials(reader: Reader, field: Sequence[Element], G: Sequence[Sequence[Element]]) -> Iterator[Element]:
    """Yield products of variables over the denominators of the field."""
    n, count = len(reader.x), reader.count
    width = count + len(reader.base)
    units = [tuple(int(i == place) for i in range(width)) for place in range(width)]
    moving = [reader.depends(place) for place in range(width)]
    related: dict[int, list[int]] = {}
    seen: set[tuple[Monomial, str]] = set()
    for i in range(n):
        for e in (field[j] for j in range(n) if G[i][j] or i == j):
            below = _moving_part(reader, e.denominator)
            own = {_state_part(moving, monomial) for monomial in e.numerator.to_dict()}
            found = {units[count + i]}
            for m in own:
                near = _near(reader, m, related)
                down = [(v, _minus(m, units[v])) for v in (*near, *range(count, width)) if m[v]]
                found |= {m, _plus(m, units[count + i])}
                found |= {_plus(m, units[v]) for v in near} | {lower for _, lower in down} | {units[v] for v in near}
                found |= {_plus(lower, units[w]) for v, lower in down for w in near if w != v}
            for m in sorted(found):
                if (m, str(below)) not in seen:
                    seen.add((m, str(below)))
                    element = Element(reader, reader.ring.from_dict({m: 1}), below)
                    if reader.moving(element):
                        yield element


def _near(reader: Reader, m: Monomial, related: dict[int, list[int]]) -> list[int]:
    """Return the places of the generators in a monomial, and in their derivatives."""
    found: set[int] = set()
    for place, k in enumerate(m[: reader.count]):
        if k:
            if place not in related:
                used = _closure(reader, {reader.count - 1 - place})
                related[place] = [reader.count - 1 - number for number in used]
            found.update(related[place])
    return sorted(found)


def _moving_part(reader: Reader, denominator: Any) -> Any:
    """Return the factors of a denominator that depend on the state, to a power less where there is one."""
    result = reader.unit
    if denominator.is_constant():
        return result
    for factor, k in denominator.factor()[1]:
        if reader.moving(reader.of(factor)):
            single = len(factor) == 1
            result = result * factor ** (int(k) if single else max(int(k) - 1, 0))
    return result


def _state_part(moving: Sequence[bool], monomial: Monomial) -> Monomial:
    return tuple(k if depends else 0 for k, depends in zip(monomial, moving))


def _plus(a: Monomial, b: Monomial) -> Monomial:
    return tuple(i + j for i, j in zip(a, b))


def _minus(a: Monomial, b: Monomial) -> Monomial:
    return tuple(i - j for i, j in zip(a, b))


def _rows(reader: Reader, columns: Sequence[Sequence[Element]]) -> list[dict[int, Element]]:
    """Return the equations that the coefficients of the columns obey: one for each monomial of the state in each derivative."""
    rows: list[dict[int, Element]] = []
    moving = [reader.depends(place) for place in range(reader.count + len(reader.base))]
    for i in range(len(reader.x)):
        below = reader.unit
        for column in columns:
            denominator = column[i].denominator
            below = reader.times(below, denominator / reader.gcd(below, denominator))
        table: dict[tuple[int, ...], dict[int, dict[tuple[int, ...], Any]]] = {}
        for j, column in enumerate(columns):
            if not column[i]:
                continue
            numerator = reader.reduced(reader.times(column[i].numerator, below / column[i].denominator))
            for monomial, c in numerator.to_dict().items():
                key = _state_part(moving, monomial)
                table.setdefault(key, {}).setdefault(j, {})[_minus(monomial, key)] = c
        rows += [{j: reader.of(terms) for j, terms in row.items()} for row in table.values()]
    return rows


def _solved(rows: list[dict[int, Element]], last: int) -> dict[int, Element] | None:
    """Return coefficients {column: element} with sum_j c_j column_j = column `last`, the others zero, or None."""
    pivots: dict[int, dict[int, Element]] = {}
    for row in sorted(_needed(rows, last), key=len):
        row = _eliminated(row, pivots)
        places = [j for j in row if j != last]
        if not places:
            if row:
                return None
            continue
        pivot = min(places, key=lambda j: (len(row[j].numerator) + len(row[j].denominator), j))
        scale = row[pivot].inverse()
        row = {j: e * scale for j, e in row.items()}
        for j, other in pivots.items():
            if pivot in other:
                pivots[j] = _eliminated(other, {pivot: row})
        pivots[pivot] = row
    return {j: row[last] for j, row in pivots.items() if last in row}


def _needed(rows: list[dict[int, Element]], last: int) -> list[dict[int, Element]]:
    """Return the rows that share columns, directly or not, with one that has a right side; the others are solved by zero."""
    by_column: dict[int, list[int]] = {}
    for k, row in enumerate(rows):
        for j in row:
            if j != last:
                by_column.setdefault(j, []).append(k)
    found, pending = set[int](), [k for k, row in enumerate(rows) if last in row]
    while pending:
        k = pending.pop()
        if k not in found:
            found.add(k)
            pending += [other for j in rows[k] if j != last for other in by_column[j]]
    return [rows[k] for k in sorted(found)]


def _eliminated(row: dict[int, Element], pivots: dict[int, dict[int, Element]]) -> dict[int, Element]:
    for j in [j for j in row if j in pivots]:
        factor = row[j]
        row = dict(row)
        for k, e in pivots[j].items():
            value = row[k] - factor * e if k in row else -(factor * e)
            if value:
                row[k] = value
            else:
                row.pop(k, None)
    return row
