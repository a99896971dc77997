"""Which states are linear given the others: the split of a system for a Kalman filter inside of each particle.

    du = (a(u, t) + A(u, t) v) dt + g_u(u, t) dv,      dv = (b(u, t) + B(u, t) v) dt + g_v(u, t) dv,      h = c(u, t) + C(u, t) v

Drift and observation are affine in v = (v_1, ..., v_k) for all v if and only if their second derivatives by every pair of them
are zero.  A state is excluded by itself where its own second derivative is not zero, or the noise, a law that is not Gaussian, an
angle or a domain contains it; two states exclude each other where their mixed derivative is not zero.  The largest set in which
no pair is excluded is taken; of several the first that moves the others not at all, then the first in the order of the states.

References:
    Schön, Gustafsson and Nordlund 2005, Marginalized particle filters for mixed linear/nonlinear state-space models.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.identities import is_in_one_piece, is_zero
from zakai.models.angles import observed_angles
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

_MOST_SETS = 2**14  # subsets that are compared; above it the state in most pairs is given up, one after the other
_NEVER_ZERO = (sp.exp, sp.sin, sp.cos, sp.tan, sp.sinh, sp.cosh, sp.tanh, sp.log, sp.atan, sp.erf, sp.sign)


class ConditionallyLinear(tuple[str, ...]):
    """The names of the states that are linear given the others; `given` are the others, `reason` says why.

    Example:
        >>> model = zakai.Model(state=["x", "a"], drift=["a - x**3", "-a"], observation=["x"])
        >>> found = zakai.analyze(model).conditionally_linear
        >>> print(found, "given", found.given)
        ('a',) given ('x',)
    """

    given: tuple[str, ...]
    reason: str

    def __new__(cls, names: Iterable[str], given: tuple[str, ...], reason: str) -> ConditionallyLinear:
        """Return the names with what is said of them."""
        found = super().__new__(cls, names)
        found.given, found.reason = given, reason
        return found


class Formula(NamedTuple):
    """A formula of a model, what it is in words, and its symbols."""

    name: str
    formula: sp.Expr
    symbols: frozenset[sp.Symbol]

    @classmethod
    def of(cls, name: str, formula: sp.Expr) -> Formula:
        """Return the formula with its symbols."""
        return cls(name, formula, frozenset(formula.free_symbols))


@once_for_a_model
def conditionally_linear(model: Model) -> ConditionallyLinear:
    """Return the largest set of states that are linear given the others."""
    excluded = dict(_excluded(model))
    pairs = _pairs(model, [i for i in range(model.n) if i not in excluded])
    chosen = _largest(model, [i for i in range(model.n) if i not in excluded], set(pairs))
    linear = tuple(model.state[i] for i in chosen)
    given = tuple(name for name in model.state if name not in linear)
    reasons = [f"{model.state[i]} is not linear: {words}" for i, words in excluded.items()]
    for (i, j), words in pairs.items():
        if (i in chosen) != (j in chosen):
            reasons.append(f"{model.state[i]} and {model.state[j]} are not linear together: {words}")
    why = "; ".join(dict.fromkeys(reasons))
    if not linear:
        return ConditionallyLinear((), given, f"no state is linear given the others: {why}")
    if not given:
        return ConditionallyLinear(linear, (), "drift and observation are affine in all states, and the noise is free of them")
    names, others = ", ".join(linear), ", ".join(given)
    words = f"given {others}, drift and observation are affine in {names}, and the noise is free of {names}"
    return ConditionallyLinear(linear, given, f"{words}; {why}")


def gaussian_coordinates(model: Model) -> list[bool]:
    """Return for each observation whether it is its h with added Gaussian noise, and no angle."""
    if model.log_density is not None:
        return [False] * model.m
    angles = observed_angles(model)
    return [family == "gaussian" and not angle for family, angle in zip(model.observation_family, angles, strict=True)]


def _affine_formulas(model: Model) -> Iterator[Formula]:
    """Return what must be affine."""
    for name, formula in zip(model.state, model.drift, strict=True):
        yield Formula.of(f"the drift of {name}", formula)
    if model.log_density is None:
        for name, formula, linear in zip(model.observation_names, model.observation, gaussian_coordinates(model), strict=True):
            if linear:
                yield Formula.of(f"the observation {name}", formula)


def _free_formulas(model: Model) -> Iterator[Formula]:
    """Return what must be free of linear states."""
    for matrix, name in ((model.diffusion, "the diffusion"), (model.process_noise, "the process noise")):
        yield from (Formula.of(name, entry) for entry in matrix.todok().values())
    yield from (Formula.of("the cross noise", entry) for entry in model.cross_noise.todok().values())
    if model.log_density is not None:
        yield Formula.of("the log density of the observation", model.log_density)
        return
    yield from (Formula.of("the observation noise", entry) for entry in model.observation_noise.todok().values())
    yield from (Formula.of("a parameter of the law of the observations", entry) for entry in model.family_parameters.values())
    for name, formula, linear in zip(model.observation_names, model.observation, gaussian_coordinates(model), strict=True):
        if not linear:
            yield Formula.of(f"the observation {name}, which is an angle or not Gaussian,", formula)


def _excluded(model: Model) -> Iterator[tuple[int, str]]:
    """Return the states that are not linear whatever the others are, each with the first reason."""
    free, affine = list(_free_formulas(model)), list(_affine_formulas(model))
    for i, (name, symbol) in enumerate(zip(model.state, model.x, strict=True)):
        if name in model.periodic or name in model.domain:
            yield i, f"{name} is an angle" if name in model.periodic else f"{name} has a domain"
            continue
        dependent = next((one for one in free if symbol in one.symbols), None)
        if dependent is not None:
            yield i, f"{dependent.name} depends on {name}"
            continue
        curved = next((one for one in affine if symbol in one.symbols and not _is_affine(one.formula, symbol)), None)
        if curved is not None:
            yield i, f"{curved.name} contains {_part(curved.formula, symbol)}"


def _pairs(model: Model, states: list[int]) -> dict[tuple[int, int], str]:
    """Return the pairs of states that are linear each by itself and not together, with the reason."""
    found: dict[tuple[int, int], str] = {}
    for one in _affine_formulas(model):
        own = [i for i in states if model.x[i] in one.symbols]
        for i in own:
            slope = sp.diff(one.formula, model.x[i])
            for j in own:
                if i < j and (i, j) not in found and slope.has(model.x[j]) and not _vanishes(sp.diff(slope, model.x[j])):
                    found[i, j] = f"{one.name} contains {_part(one.formula, model.x[i], model.x[j])}"
    return found


def _is_affine(formula: sp.Expr, symbol: sp.Symbol) -> bool:
    """Return whether a formula is proved to be affine in one state for all its values."""
    slope = sp.diff(formula, symbol)
    return is_in_one_piece(formula, [symbol]) and (not slope.has(symbol) or _vanishes(sp.diff(slope, symbol)))


def _vanishes(formula: sp.Expr) -> bool:
    return formula == 0 or (not _is_no_zero(formula) and is_zero(formula) is True)


def _is_no_zero(formula: sp.Expr) -> bool:
    """Return whether the form of a formula shows that it is not identically zero."""
    if formula.is_Number or formula.is_Symbol:
        return formula != 0
    if formula.is_Mul:
        return all(map(_is_no_zero, formula.args))
    if formula.is_Pow:
        return _is_no_zero(formula.base)
    return isinstance(formula, _NEVER_ZERO) and bool(formula.free_symbols)


def _part(formula: sp.Expr, *symbols: sp.Symbol) -> str:
    """Return the first term of a sum that contains the states nonlinearly, in words."""
    for term in sp.Add.make_args(formula):
        if all(term.has(symbol) for symbol in symbols):
            second = sp.diff(term, symbols[0], symbols[-1])
            if second != 0 or not is_in_one_piece(term, list(symbols)):
                return short(str(term))
    return short(str(formula))


def _largest(model: Model, states: list[int], pairs: set[tuple[int, int]]) -> list[int]:
    """Return the largest set of states without a pair."""
    inside = sorted({i for pair in pairs for i in pair})
    outside = [i for i in states if i not in inside]
    while 2 ** len(inside) > _MOST_SETS and pairs:
        counts = {i: sum(i in pair for pair in pairs) for i in inside}
        worst = max(inside, key=lambda i: (counts[i], i))
        pairs = {pair for pair in pairs if worst not in pair}
        outside += [i for i in inside if i != worst and not any(i in pair for pair in pairs)]
        inside = sorted({i for pair in pairs for i in pair})
    for size in range(len(inside), -1, -1):
        sets = [
            sorted([*outside, *chosen])
            for chosen in itertools.combinations(inside, size)
            if not any(i in chosen and j in chosen for i, j in pairs)
        ]
        if sets:
            return min(sets, key=lambda linear: (moved_by(model, linear) != [], linear))
    return outside


def moved_by(model: Model, linear: Iterable[int]) -> list[int]:
    """Return the states outside of a set whose drift contains one of it."""
    own = {model.x[i] for i in linear}
    return [i for i in range(model.n) if model.x[i] not in own and model.drift[i].free_symbols & own]
