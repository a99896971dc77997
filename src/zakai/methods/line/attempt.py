"""One substep of the density of one state on one grid: by modes, by an exponential of the operator, or by Magnus' series."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.coarse import EDGE
from zakai.methods.line.coefficients import GROWTH, coefficients, offset_of, potential_of, precision_of
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import spectral, tables
from zakai.numerics.line import window as lw
from zakai.numerics.line.fourier import FourierOperator, exponential_of
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS

Array = Any
Coefficients = tuple[Array, Array, Array, Array]  # f (T, N), G (T,) or (T, N), V (T, N) and a constant (T,)

PARTS = (1, 4, 16)  # of a substep with six nodes each, where the grid moves
SMOOTHED = 100.0  # decay of the shortest wave of a large grid, as a logarithm, after which a coarser grid serves
MAGNUS = 0.02  # of the tolerance that one substep of Magnus' series may leave


class Substep(NamedTuple):
    """A part of an interval: when it begins, its length, and which increments act inside at which rates.

    `speed` is that of the grid.  The coefficients in time have six nodes in each of so many `parts`.
    """

    start: float
    length: float
    inside: np.ndarray
    rates: np.ndarray
    speed: float = 0.0
    parts: int = 1


class Attempt(NamedTuple):
    """The density after a substep, times exp(-offset); its error; whether a shorter substep is needed.

    `substep` tells how exponentials of the operator gave it, None where its decomposition did; the potential multiplies what is
    not density by up to exp(lift).
    """

    values: Array
    offset: Any
    error: float
    split: bool
    substep: Substep | None = None
    lift: float = 0.0


class Exponents(NamedTuple):
    """The generators whose exponentials act in turn, each by its G, f and V, less an `offset` and a `constant` of V."""

    generators: list[tuple[Any, Array, Array | None]]
    offset: float
    constant: Any
    lift: float  # nats by which V is larger where there is no mass, infinite where G is negative


def attempted(prepared: Prepared, values: Array, window: lw.Window, substep: Substep, adjoint: bool = False) -> Attempt:
    """Return the density after a substep; the `adjoint` of the transition takes a message from its end to its start."""
    inside, moving = substep.inside, bool(substep.speed)
    if prepared.system.varying or moving:
        return magnus(prepared, values, window, substep, _at_points(prepared, values, window, substep), adjoint, moving)
    modes = None if adjoint or inside.any() else by_modes(prepared, values, window, substep.length)
    if modes is not None:
        return Attempt(modes[0], 0.0, modes[1], False)
    exponents = exponents_of(prepared, values, window, substep)
    return _acted(prepared, values, window, substep, exponents, adjoint, not inside.any())


def parts_of_split(prepared: Prepared, first: float, last: float, error: float) -> list[tuple[float, float]]:
    """Return the parts of a substep whose error by Magnus' series, which falls as the fifth power of the length, is too large."""
    count = int(np.clip(np.ceil(1.1 * (error / (MAGNUS * prepared.tolerance)) ** 0.2), 2, 16))
    cuts = first + (last - first) * np.arange(1, count) / count
    return list(zip([first, *cuts], [*cuts, last], strict=True))


def exponents_of(prepared: Prepared, values: Array, window: lw.Window, substep: Substep) -> Exponents:
    """Return the generators of a substep: one where no coefficient depends on t, else those of Magnus' integrator."""
    if prepared.system.varying or substep.speed:
        averages = _averaged(substep, _at_points(prepared, values, window, substep))
        return _of_magnus(prepared, values, averages, bool(substep.speed))
    known, length = tables(prepared, window), substep.length
    if not substep.inside.any():
        return Exponents([(length * known.covariance, length * known.drift, None)], 0.0, 0.0, 0.0)
    precision = precision_of(prepared, substep.start, substep.inside)
    potential, constant = potential_of(known.observation, precision, substep.rates, values)
    potential = length * potential
    offset, lift = offset_of(potential, values)
    generator = length * known.covariance, length * known.drift, potential - offset
    return Exponents([generator], offset, length * constant, lift)


def _acted(
    prepared: Prepared, values: Array, window: lw.Window, substep: Substep, exponents: Exponents, adjoint: bool, keeps: bool
) -> Attempt:
    """Return a density after the exponentials, or a message after their transposes in reverse order; `keeps` the exponential."""
    if exponents.lift > GROWTH:
        return Attempt(values, 0.0, 0.0, True)
    matrices, found, error = [window.generator(*one) for one in exponents.generators], values, 0.0
    if any(isinstance(one, FourierOperator) and one.decay > SMOOTHED for one in matrices):
        return Attempt(values, 0.0, 0.0, True)
    if adjoint:
        matrices = [one.T for one in matrices[::-1]]
    if len(matrices) == 2:
        # The part of third order that two exponentials contain; they omit one of fifth order, with a factor that was measured.
        difference = window.generator(*(late - early for early, late in zip(*exponents.generators, strict=True)))
        (first, _), difference, now = matrices, difference.T if adjoint else difference, values.real
        commutator = 0.5 * (first @ (difference @ now) - difference @ (first @ now)).real
        error = 5.0 * float(np.sum(np.abs(commutator))) ** (5.0 / 3.0)
        if error > MAGNUS * prepared.tolerance:
            return Attempt(values, 0.0, error, True)
    for matrix in matrices:
        key = ("exponential", window, substep.length, adjoint)
        transition = prepared.once(key, partial(exponential_of, matrix)) if keeps else exponential_of(matrix)
        found, rounding = transition(found)
        error += rounding
    return Attempt(found, exponents.offset + exponents.constant, error, False, substep, exponents.lift)


class _Averages(NamedTuple):
    """The nodes (T,) of a substep, their weights, and there f (T, N), G (T,) or (T, N), V (T, N) and the constant of V (T,)."""

    nodes: Array
    weights: Array
    drift: Array
    covariance: Array
    potential: Array
    constant: Array


def _at_points(prepared: Prepared, values: Array, window: lw.Window, substep: Substep) -> Callable[[Array], Coefficients]:
    """Return the function that gives the coefficients at parts of a substep, from zero to one, on a grid that moves with it."""

    def at(nodes: Array) -> Coefficients:
        times, shifts = substep.start + substep.length * nodes, substep.speed * substep.length * nodes if substep.speed else None
        drift, *others = coefficients(prepared, window, times, substep.inside, substep.rates, values, shifts)
        return drift - substep.speed, *others

    return at


def _averaged(substep: Substep, at: Callable[[Array], Coefficients], steady: bool = False) -> _Averages:
    if steady:  # one node serves
        middle = np.full(1, 0.5)
        return _Averages(middle, np.full(1, substep.length), *at(middle))
    nodes = ((np.arange(substep.parts)[:, None] + GAUSS_NODES) / substep.parts).reshape(-1)
    return _Averages(nodes, substep.length / substep.parts * np.tile(GAUSS_WEIGHTS, substep.parts), *at(nodes))


def _of_magnus(prepared: Prepared, values: Array, averages: _Averages, moving: bool) -> Exponents:
    """Return the generators of the commutator-free Magnus integrator of order four.

    exp(B0 / 2 + 2 B1 / tau) exp(B0 / 2 - 2 B1 / tau),   B0 = int L dt,   B1 = int (t - middle) L dt.
    """
    nodes, zeroth, drift, covariance, potential, constant = averages
    offset, lift = offset_of(zeroth @ potential, values)
    if prepared.system.steady and not moving:
        generator = zeroth @ covariance, zeroth @ drift, zeroth @ potential - offset
        return Exponents([generator], offset, zeroth @ constant, lift)
    moment = 2.0 * zeroth * (nodes - 0.5)
    halves = [(w @ covariance, w @ drift, w @ potential - 0.5 * offset) for w in (0.5 * zeroth - moment, 0.5 * zeroth + moment)]
    lift = np.inf if any(np.any(half[0].real < 0) for half in halves) else lift
    return Exponents(halves, offset, zeroth @ constant, lift)


def magnus(
    prepared: Prepared, values: Array, window: lw.Window, substep: Substep, at: Callable[[Array], Coefficients], adjoint: bool,
    moving: bool,
) -> Attempt:  # fmt: skip
    """Advance a substep by the exponentials of `_of_magnus`, with as many nodes as they need.

    Args:
        prepared: the system.
        values, window: the density and its grid.
        substep: the substep.
        at: a function that returns f, G, V and a constant, as `coefficients`, at parts of the substep from zero to one.
        adjoint: whether a message is taken from the end to the start.
        moving: whether the grid moves.
    """
    for parts in PARTS if moving else PARTS[:1]:
        substep = substep._replace(parts=parts)
        averages, error, length = _averaged(substep, at, not prepared.system.varying and not moving), 0.0, substep.length
        if moving:
            error = _unresolved(window, values, length * averages.drift, length * averages.potential)
        if error <= MAGNUS * prepared.tolerance:
            return _acted(prepared, values, window, substep, _of_magnus(prepared, values, averages, moving), adjoint, False)
    return Attempt(values, 0.0, error, True)


def _unresolved(window: lw.Window, values: Array, drift: Array, potential: Array) -> float:
    """Return the error of a density, in its deviations, by integrals over time of coefficients whose nodes do not resolve them.

    It is that of the last two terms of the polynomials of time through each six of the nodes (T, N).
    """
    mass = values.real > 1e-6 * np.max(values.real)
    deviation, parts = float(np.sqrt(lw.moments(values, window)[1].real)), len(drift) // len(GAUSS_NODES)
    drift, potential = (part.real[:, mass].reshape(parts, len(GAUSS_NODES), -1) for part in (drift, potential))
    return float(np.abs(_LAST @ drift).max() / deviation + np.abs(_LAST @ potential).max()) / parts


_LAST = np.linalg.inv(np.polynomial.legendre.legvander(2.0 * GAUSS_NODES - 1.0, len(GAUSS_NODES) - 1))[-2:]


def by_modes(prepared: Prepared, values: Array, window: lw.Window, length: float) -> tuple[Array, float] | None:
    """Return the density after a time and its error by the decomposition on a grid, None where it does not serve."""
    decomposed = spectral(prepared, window)
    if decomposed is None:
        return None
    found, error = decomposed(values, length)
    # Tails that were cut off are jumps in the gauge of the decomposition, which show at the highest frequencies, as does a
    # density that reaches the ends of the grid: that one needs another grid, not another transition.
    allowed = 1e-5 * prepared.tolerance
    look = lw.figures(found, window.closed, prepared.negligible)
    aliased = look.aliasing > max(allowed, 30.0 * prepared.negligible)
    ended = max(look.left, look.right) > max(EDGE, 4.0 * look.aliasing)
    return (found, error) if error < max(1e-11, allowed) and (ended or not aliased) else None
