"""The ordinary differential equations of Wei and Norman (1964), from the structure constants of an estimation algebra.

For a basis E_0 = L_0, E_1, ..., E_d the solution of the Duncan-Mortensen-Zakai equation is sought as

    u = exp(r_d E_d) ... exp(r_1 E_1) exp(t L_0) sigma_0
    u_t = sum_k r_k' A_k u,      A_k = exp(r_d ad E_d) ... exp(r_k+1 ad E_k+1) E_k,      r_0 = t,

and the coordinates are compared with those of u_t = A u, where

    Stratonovich   u = sigma,                   A = L_0 + sum_j (S^-1 h)_j dy_j/dt
    robust         u = exp(-h'S^-1 y) sigma,    A = exp(-ad(h'S^-1 y)) L_0 = L_0 + [L_0, h'S^-1 y] + ...

Where every ad E_k, k >= 1, is nilpotent and every A_k, k >= 1, is E_k and later elements, r_1', ..., r_d' follow one after
another, as polynomials in r.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import sympy as sp
from sympy.polys.rings import ring

from zakai.algebra._readable import readable, times

Element = dict[int, Any]  # number of a basis element -> its coordinate, a polynomial in r and y that is not zero


class NoFactorisation(Exception):
    """Why a basis in its order gives no such product."""


@dataclass(frozen=True)
class WeiNorman:
    """u = exp(r_d E_d) ... exp(r_1 E_1) exp(t L_0) sigma_0 solves the Duncan-Mortensen-Zakai equation; r = y = 0 at the start.

        robust         u = exp(-h'S^-1 y) sigma,    r' a polynomial in r and y
        stratonovich   u = sigma,                   r' a polynomial in r, and affine in dy/dt (Stratonovich's integrals)

    `basis` is (L_0, E_1, ..., E_d), `statistics` the symbols (r_1, ..., r_d), `path` (y_1, ..., y_m) and `rates` the symbols of
    their derivatives; `robust` and `stratonovich` are {r_k: r_k'}.  `print` shows the formulas.

    Source: Wei and Norman (1964); Yau (1993), Theorem 6, and Dong, Chen and Yau (2021), Theorem 4.1, are special cases.

        >>> analysis = zakai.analyze(zakai.load_model("gallery:benes"))
        >>> print(list(analysis.algebra.wei_norman.robust.values()))
        [r2 + y, r1, r1**2/2 + r2**2/2 + r2*y + y**2/2]
    """

    basis: tuple[sp.Expr, ...]
    statistics: tuple[sp.Symbol, ...]
    path: tuple[sp.Symbol, ...]
    rates: tuple[sp.Symbol, ...]
    robust: Mapping[sp.Symbol, sp.Expr]
    stratonovich: Mapping[sp.Symbol, sp.Expr]

    @property
    def product(self) -> str:
        """u, factor by factor."""
        factors = [f"exp({_multiple(r, readable(e))})" for r, e in zip(self.statistics, self.basis[1:], strict=True)]
        return " ".join([*reversed(factors), f"exp(t*{self.basis[0]}) sigma_0"])

    def lines(self) -> list[str]:
        """What `print` shows."""
        return [
            f"u = {self.product}",
            "robust, u = exp(-h'S^-1 y) sigma:",
            *(f"  d{r}/dt = {rate}" for r, rate in self.robust.items()),
            "Stratonovich, u = sigma:",
            *(f"  d{r} = {self._differential(rate)}" for r, rate in self.stratonovich.items()),
        ]

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def _differential(self, rate: sp.Expr) -> str:
        """a dt + b dy."""
        terms = [times(rate.xreplace(dict.fromkeys(self.rates, sp.Integer(0))), "dt")]
        terms += [times(sp.diff(rate, z), f"d{y}") for z, y in zip(self.rates, self.path, strict=True)]
        return " + ".join(term for term in terms if term) or "0"


def wei_norman(
    basis: Sequence[sp.Expr],
    constants: Mapping[tuple[int, int], Sequence[sp.Expr]],
    observation: Sequence[Sequence[sp.Expr]],
    names: AbstractSet[str] = frozenset(),
) -> WeiNorman:
    """The equations of an algebra with [E_i, E_j] = sum_k constants[i, j][k] E_k, i < j, and L_0 first in its basis.

    observation: (m, d + 1), the coordinates of S^-1 h; names: what no new symbol may be called.  Raises NoFactorisation.
    """
    given = [entry for row in (*constants.values(), *observation) for entry in row]
    used_names = names | {symbol.name for part in (*basis, *given) for symbol in part.free_symbols}
    (r,) = _symbols(("r",), range(1, len(basis)), used_names)
    y, rates = path_symbols(len(observation), used_names)
    domain, _ = sp.construct_domain(given, field=True)
    polynomials, *variables = ring([*r, *y], domain)
    statistics, path = variables[: len(r)], variables[len(r) :]
    lie = _LieAlgebra({pair: _element(row, domain) for pair, row in constants.items()})

    generator: Element = {0: polynomials.one}
    energy: Element = {}  # h'S^-1 y
    for y_j, row in zip(path, observation, strict=True):
        _add(energy, _element(row, domain), y_j)
    columns = []
    for k in range(len(basis)):
        column: Element = {k: polynomials.one}
        for j in range(k + 1, len(basis)):
            column = lie.conjugated({j: statistics[j - 1]}, column)
        columns.append(column)
    robust = lie.conjugated({k: -c for k, c in energy.items()}, generator)
    driven = dict(generator)
    _add(driven, energy, polynomials.one)
    return WeiNorman(
        basis=tuple(basis),
        statistics=r,
        path=y,
        rates=rates,
        robust=dict(zip(r, [_expression(rate, (*r, *y)) for rate in _rates(columns, robust)], strict=True)),
        stratonovich=dict(zip(r, [_expression(rate, (*r, *rates)) for rate in _rates(columns, driven)], strict=True)),
    )


def _rates(columns: Sequence[Element], right: Element) -> list[Any]:
    """r' of sum_k r_k' columns[k] = right with r_0' = 1, by forward substitution."""
    rest, rates = dict(right), []
    for k, column in enumerate(columns):
        if min(column) < k or column[k] != 1:
            raise NoFactorisation(f"the exponentials of later elements move element {k} of the basis into itself or earlier ones")
        rate = rest.get(k, column[k] * 0)
        if k == 0 and rate != 1:
            raise NoFactorisation("an observation has a part along L_0")
        _add(rest, column, -rate)
        rates.append(rate)
    return rates[1:]


class _LieAlgebra:
    """Brackets and exponentials in coordinates."""

    def __init__(self, constants: Mapping[tuple[int, int], Element]):
        self._constants = dict(constants)
        self._constants |= {(j, i): {k: -c for k, c in row.items()} for (i, j), row in constants.items()}
        self._dimension = max((j for _, j in constants), default=0) + 1  # of which a nilpotent ad A has no higher power

    def bracket(self, a: Element, b: Element) -> Element:
        """[A, B]."""
        result: Element = {}
        for i, left in a.items():
            for j, right in b.items():
                if self._constants.get((i, j)):
                    _add(result, self._constants[i, j], left * right)
        return result

    def conjugated(self, a: Element, b: Element) -> Element:
        """exp(ad A) B, a finite sum where ad A is nilpotent."""
        result, term, power = dict(b), b, 0
        while term:
            if power == self._dimension:
                raise NoFactorisation("the brackets with an element after L_0 are not nilpotent")
            power += 1
            term = {k: c / power for k, c in self.bracket(a, term).items()}
            _add(result, term, 1)
        return result


def _element(row: Sequence[sp.Expr], domain: Any) -> Element:
    return {k: domain.from_sympy(c) for k, c in enumerate(row) if c != 0}


def _add(target: Element, element: Element, factor: Any) -> None:
    """target += factor * element."""
    for k, c in element.items():
        value = target[k] + c * factor if k in target else factor * c
        if value:
            target[k] = value
        else:
            target.pop(k, None)


def path_symbols(count: int, used_names: AbstractSet[str]) -> tuple[tuple[sp.Symbol, ...], tuple[sp.Symbol, ...]]:
    """y, or y1, ..., ym, and their rates ydot, with names that are not taken."""
    y, rates = _symbols(("y", "ydot"), [""] if count == 1 else range(1, count + 1), used_names)
    return y, rates


def _symbols(stems: tuple[str, ...], endings: Iterable[Any], used_names: AbstractSet[str]) -> tuple[tuple[sp.Symbol, ...], ...]:
    """A symbol of every stem for each ending; the stems begin with their letter twice, or more, where a name is taken."""
    endings, letter = list(endings), stems[0]
    while used_names & {f"{stem}{ending}" for stem in stems for ending in endings}:
        stems = tuple(f"{letter}{stem}" for stem in stems)
    return tuple(tuple(sp.Symbol(f"{stem}{ending}", real=True) for ending in endings) for stem in stems)


def _expression(polynomial: Any, symbols: Sequence[sp.Symbol]) -> sp.Expr:
    """With one factored coefficient for each monomial."""
    number = polynomial.ring.domain.to_sympy
    return sp.Add(
        *[sp.factor(number(c)) * sp.prod(z**k for z, k in zip(symbols, powers, strict=True)) for powers, c in polynomial.terms()]
    )


def _multiple(r: sp.Symbol, element: sp.Basic) -> str:
    return str(r) if element == 1 else f"{r}*({element})" if element.is_Add else f"{r}*{element}"
