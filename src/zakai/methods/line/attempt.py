"""One substep of the density of one state on one grid: by modes, by an exponential of the operator, or by Magnus' series."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.coarse import EDGE
from zakai.methods.line.coefficients import GROWTH, coefficients, offset_of, potential_of, precision_of
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import spectral, tables
from zakai.numerics.line import window as lw
from zakai.numerics.line.operator import Exponential, exponential_action
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS

Array = Any
Coefficients = tuple[Array, Array, Array, Array]  # f (T, N), G (T,) or (T, N), V (T, N) and a constant (T,)

PARTS = (1, 4, 16)  # of a substep with six nodes each, where the grid moves
MAGNUS = 0.02  # of the tolerance that one substep of Magnus' series may leave


class Attempt(NamedTuple):
    """The density after a substep, times exp(-offset); its error; whether a shorter substep is needed.

    `decomposed` tells whether the decomposition of the operator gave it; the potential multiplies what is not density by up to
    exp(lift).
    """

    values: Array
    offset: Any
    error: float
    split: bool
    decomposed: bool = False
    lift: float = 0.0


def attempted(
    prepared: Prepared,
    values: Array,
    window: lw.Window,
    start: float,
    first: float,
    last: float,
    inside: np.ndarray,
    rates: np.ndarray,
    adjoint: bool = False,
    speed: float = 0.0,
) -> Attempt:
    """Return the density after the part from start + first to start + last of an interval, on a grid that moves with a speed.

    The `adjoint` of the transition takes a message from the end of that part to its start.
    """
    system, length = prepared.system, last - first
    if not (system.varying or speed):
        known = tables(prepared, window)
        if not inside.any():
            modes = None if adjoint else by_modes(prepared, values, window, length)
            if modes is not None:
                return Attempt(modes[0], 0.0, modes[1], False, True)
            key = ("exponential", window, length, adjoint)
            generator = length * window.generator(known.covariance, known.drift)
            transition = prepared.once(key, lambda: Exponential(generator.T if adjoint else generator))
            found, error = transition(values)
            return Attempt(found, 0.0, error, False)
        potential, constant = potential_of(known.observation, precision_of(prepared, start, inside), rates, values)
        potential, constant = length * potential, length * constant
        offset, lift = offset_of(potential, values)
        if lift > GROWTH:
            return Attempt(values, 0.0, 0.0, True)
        matrix = window.generator(length * known.covariance, length * known.drift, potential - offset)
        found, error = exponential_action(matrix.T if adjoint else matrix, values)
        return Attempt(found, offset + constant, error, False, lift=lift)

    def at(nodes: Array) -> Coefficients:
        times, shifts = start + first + length * nodes, speed * length * nodes if speed else None
        drift, *others = coefficients(prepared, window, times, inside, rates, values, shifts)
        return drift - speed, *others

    return magnus(prepared, values, window, length, at, adjoint, bool(speed))


def parts_of_split(prepared: Prepared, first: float, last: float, error: float) -> list[tuple[float, float]]:
    """Return the parts of a substep whose error by Magnus' series, which falls as the fifth power of the length, is too large."""
    count = int(np.clip(np.ceil(1.1 * (error / (MAGNUS * prepared.tolerance)) ** 0.2), 2, 16))
    cuts = first + (last - first) * np.arange(1, count) / count
    return list(zip([first, *cuts], [*cuts, last], strict=True))


def magnus(
    prepared: Prepared, values: Array, window: lw.Window, length: float, at: Callable[[Array], Coefficients], adjoint: bool,
    moving: bool,
) -> Attempt:  # fmt: skip
    """Advance a substep by two exponentials: the commutator-free Magnus integrator of order four.

        exp(B0 / 2 + 2 B1 / tau) exp(B0 / 2 - 2 B1 / tau),   B0 = int L dt,   B1 = int (t - middle) L dt.

    Args:
        prepared: the system.
        values, window: the density and its grid.
        length: the length of the substep.
        at: a function that returns f, G, V and a constant, as `coefficients`, at parts of the substep from zero to one.
        adjoint: whether a message is taken from the end to the start.
        moving: whether the grid moves.
    """
    for parts in PARTS if moving else PARTS[:1]:
        nodes = ((np.arange(parts)[:, None] + GAUSS_NODES) / parts).reshape(-1)
        drift, covariance, potential, constant = at(nodes)
        error = _unresolved(window, values, length * drift, length * potential) if moving else 0.0
        if error <= MAGNUS * prepared.tolerance:
            break
    else:
        return Attempt(values, 0.0, error, True)
    zeroth = length / parts * np.tile(GAUSS_WEIGHTS, parts)
    moment = 2.0 * zeroth * (nodes - 0.5)
    early, late = 0.5 * zeroth - moment, 0.5 * zeroth + moment
    offset, lift = offset_of(zeroth @ potential, values)
    if lift > GROWTH or np.any((early @ covariance).real < 0) or np.any((late @ covariance).real < 0):
        return Attempt(values, 0.0, 0.0, True)
    if prepared.system.steady and not moving:
        matrix = window.generator(zeroth @ covariance, zeroth @ drift, zeroth @ potential - offset)
        found, error = exponential_action(matrix.T if adjoint else matrix, values)
        return Attempt(found, offset + zeroth @ constant, error, False, lift=lift)
    shift = np.full(window.size, offset / 2)
    first_half, second_half = (
        window.generator(w @ covariance, w @ drift, w @ potential - shift) for w in (early, late)
    )
    if adjoint:
        first_half, second_half = second_half.T, first_half.T
    total, difference = (first_half + second_half).real, (second_half - first_half).real
    now = values.real
    # The part of third order that two exponentials contain; what they omit is of fifth order, with a factor that was measured.
    commutator = 0.25 * (total @ (difference @ now) - difference @ (total @ now))
    error = 5.0 * float(np.sum(np.abs(commutator))) ** (5.0 / 3.0)
    if error > MAGNUS * prepared.tolerance:
        return Attempt(values, 0.0, error, True)
    middle, one = exponential_action(first_half, values)
    found, two = exponential_action(second_half, middle)
    return Attempt(found, offset + zeroth @ constant, error + one + two, False, lift=lift)


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
