"""The density of one state after an interval: by modes, by an exponential of the operator, or by Magnus' series in substeps.

    u_t = (G u)'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u

Where the drift carries a density far within an interval, as of growth and of motion with little noise, its grid moves with it.
In x = z + v (t - t0) the equation is the same with the drift f(z + v (t - t0), t) - v, which is small near the density where v
is its speed.  The speed is a whole number of spacings in a substep, so that a density ends on the points of a grid;
coefficients depend on time then, whether those of the system do or not.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import (
    GROWTH,
    Coefficients,
    coefficients,
    offset_of,
    on_grid_for_drift,
    resolved_parts,
    spectral,
    speed_of,
)
from zakai.methods.line.modal import coarsened
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.update import refitted
from zakai.numerics.arrays import Array, Number
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS
from zakai.numerics.line.grid_choice import DECAYED
from zakai.numerics.line.operator import FourierOperator, Generator, exponential_of
from zakai.numerics.line.product import finer
from zakai.numerics.line.resolution import (
    GROSS,
    LOST_ALIASING,
    LOST_MASS,
    MAGNUS,
    NOISE,
    SPECTRUM_FACTOR,
    TRANSITION_SHARE,
    edge_bound,
    noise_bound,
    rounding_bound,
    spectrum_bound,
)

PARTS_OF_SUBSTEP = (1, 4, 16)  # of a substep with six nodes each, where the grid moves


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


class Trial(NamedTuple):
    """The density after a substep, times exp(-offset); its error; whether a shorter substep is needed.

    `substep` tells how exponentials of the operator gave it, None where its decomposition did; the potential multiplies what is
    not density by up to exp(lift).
    """

    values: Array
    offset: Number
    error: float
    split: bool
    substep: Substep | None = None
    lift: float = 0.0


class Exponents(NamedTuple):
    """The generators whose exponentials act in turn, each by its G, f and V, less an `offset` and a `constant` of V."""

    generators: list[Generator]
    offset: float
    constant: Number
    lift: float  # nats by which V is larger where there is no mass, infinite where G is negative


def trial_substep(prepared: Prepared, values: Array, window: lw.Window, substep: Substep, adjoint: bool = False) -> Trial:
    """Return the density after a substep; the `adjoint` of the transition takes a message from its end to its start."""
    moving = bool(substep.speed)
    if not (prepared.system.varying or moving or adjoint or substep.inside.any()):
        modes = by_modes(prepared, values, window, substep.length)
        if modes is not None:
            return Trial(modes[0], 0.0, modes[1], False)
    return magnus(prepared, values, window, substep, _at_points(prepared, values, window, substep), adjoint, moving)


def parts_of_split(prepared: Prepared, first: float, last: float, error: float) -> list[tuple[float, float]]:
    """Return the parts of a substep whose error by Magnus' series, which falls as the fifth power of the length, is too large."""
    count = int(np.clip(np.ceil(1.1 * (error / (MAGNUS * prepared.tolerance)) ** 0.2), 2, 16))
    cuts = first + (last - first) * np.arange(1, count) / count
    return list(zip([first, *cuts], [*cuts, last], strict=True))


def _acted(
    prepared: Prepared, values: Array, window: lw.Window, substep: Substep, exponents: Exponents, adjoint: bool, keeps: bool
) -> Trial:
    """Return a density after the exponentials, or a message after their transposes in reverse order; `keeps` the exponential."""
    if exponents.lift > GROWTH:
        return Trial(values, 0.0, 0.0, True)
    matrices, result, error = [window.generator(*one) for one in exponents.generators], values, 0.0
    # A coarser grid serves where no short wave is left of a large one.
    if any(isinstance(one, FourierOperator) and one.decay > DECAYED for one in matrices):
        return Trial(values, 0.0, 0.0, True)
    if adjoint:
        matrices = [one.T for one in matrices[::-1]]
    if len(matrices) == 2:
        # The part of third order that two exponentials contain; they omit one of fifth order, with a factor that was measured.
        early, late = exponents.generators
        difference = window.generator(*(b - a for a, b in zip(early, late, strict=True)))
        (first, _), difference, now = matrices, difference.T if adjoint else difference, values.real
        commutator = 0.5 * (first @ (difference @ now) - difference @ (first @ now)).real
        error = 5.0 * float(np.sum(np.abs(commutator))) ** (5.0 / 3.0)
        if error > MAGNUS * prepared.tolerance:
            return Trial(values, 0.0, error, True)
    for matrix in matrices:
        key = window, substep.length, adjoint
        transition = prepared.once(Derived.EXPONENTIAL, key, partial(exponential_of, matrix)) if keeps else exponential_of(matrix)
        result, rounding = transition(result)
        error += rounding
    return Trial(result, exponents.offset + exponents.constant, error, False, substep, exponents.lift)


class _Averages(NamedTuple):
    """The nodes (T,) of a substep, their weights, and the coefficients there."""

    nodes: Array
    weights: Array
    coefficients: Coefficients


def _at_points(prepared: Prepared, values: Array, window: lw.Window, substep: Substep) -> Callable[[Array], Coefficients]:
    """Return the function that gives the coefficients at parts of a substep, from zero to one, on a grid that moves with it."""

    def at(nodes: Array) -> Coefficients:
        times, shifts = substep.start + substep.length * nodes, substep.speed * substep.length * nodes if substep.speed else None
        known = coefficients(prepared, window, times, substep.inside, substep.rates, values, shifts)
        return known._replace(drift=known.drift - substep.speed)

    return at


def _averaged(substep: Substep, at: Callable[[Array], Coefficients], steady: bool = False) -> _Averages:
    if steady:  # one node serves
        middle = np.full(1, 0.5)
        return _Averages(middle, np.full(1, substep.length), at(middle))
    nodes = ((np.arange(substep.parts)[:, None] + GAUSS_NODES) / substep.parts).reshape(-1)
    return _Averages(nodes, substep.length / substep.parts * np.tile(GAUSS_WEIGHTS, substep.parts), at(nodes))


def _of_magnus(prepared: Prepared, values: Array, averages: _Averages, moving: bool) -> Exponents:
    """Return the generators of the commutator-free Magnus integrator of order four.

    exp(B0 / 2 + 2 B1 / tau) exp(B0 / 2 - 2 B1 / tau),   B0 = int L dt,   B1 = int (t - middle) L dt.
    """
    nodes, zeroth, (drift, covariance, potential, constant) = averages
    offset, lift = offset_of(zeroth @ potential, values)
    if prepared.system.steady and not moving:
        generator = Generator(zeroth @ covariance, zeroth @ drift, zeroth @ potential - offset)
        return Exponents([generator], offset, np.dot(zeroth, constant), lift)
    moment = 2.0 * zeroth * (nodes - 0.5)
    weights = 0.5 * zeroth - moment, 0.5 * zeroth + moment
    halves = [Generator(w @ covariance, w @ drift, w @ potential - 0.5 * offset) for w in weights]
    lift = np.inf if any(np.any(half.covariance.real < 0) for half in halves) else lift
    return Exponents(halves, offset, np.dot(zeroth, constant), lift)


def magnus(
    prepared: Prepared, values: Array, window: lw.Window, substep: Substep, at: Callable[[Array], Coefficients], adjoint: bool,
    moving: bool,
) -> Trial:  # fmt: skip
    """Advance a substep by the exponentials of `_of_magnus`, with as many nodes as they need.

    Args:
        values, window: the density and its grid.
        at: a function that returns f, G, V and a constant, as `coefficients`, at parts of the substep from zero to one.
        adjoint: whether a message is taken from the end to the start.
        moving: whether the grid moves.
    """
    for parts in PARTS_OF_SUBSTEP if moving else PARTS_OF_SUBSTEP[:1]:
        substep = substep._replace(parts=parts)
        steady = not prepared.system.varying and not moving
        averages, error, length = _averaged(substep, at, steady), 0.0, substep.length
        if moving:
            known = averages.coefficients
            error = _unresolved(window, values, length * known.drift, length * known.potential)
        if error <= MAGNUS * prepared.tolerance:
            exponents, keeps = _of_magnus(prepared, values, averages, moving), steady and not substep.inside.any()
            return _acted(prepared, values, window, substep, exponents, adjoint, keeps)
    return Trial(values, 0.0, error, True)


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
    result, error = decomposed(values, length)
    # Tails that were cut off are jumps in the gauge of the decomposition, which show at the highest frequencies, as does a
    # density that reaches the ends of the grid: that one needs another grid, not another transition.
    check = lw.grid_check(result, window.closed, prepared.negligible)
    aliased = check.aliasing > spectrum_bound(prepared.negligible, prepared.tolerance)
    ended = max(check.left, check.right) > edge_bound(check.aliasing)
    return (result, error) if error < rounding_bound(prepared.tolerance) and (ended or not aliased) else None


MOST_SUBSTEPS = 4000
SUBSTEPS_OF_LARGE_GRID = 24  # substeps of an interval, after which no large grid is used


class Prediction(NamedTuple):
    """The density after an interval, its grid, the logarithm of its mass, and its grid check."""

    values: Array
    window: lw.Window
    gained: Number
    check: lw.GridCheck | None


def by_decomposition(prepared: Prepared, values: Array, window: lw.Window, length: float, report: Report) -> Prediction | None:
    """Return the density after an interval without observations inside by modes of its operator, None where they do not serve."""
    negligible, rough = prepared.negligible, noise_bound(prepared.tolerance)
    carried = coarsened(prepared, values, window, length)
    if carried is not None:
        return _normalised(*carried, report, negligible)
    known, begin = lw.grid_check(values, window.closed, negligible).aliasing, window
    while window.size <= lw.LARGEST:
        result = by_modes(prepared, values, window, length)
        if result is None:
            return None
        missing = abs(float(np.sum(result[0].real)) - 1.0)
        if not missing < LOST_MASS:
            return None
        check = lw.grid_check(result[0], window.closed, negligible)
        if check.unresolved(negligible, rough):
            return None
        bound = edge_bound(check.aliasing)
        left, right = check.left > bound, check.right > bound
        if not (left or right):
            if missing > TRANSITION_SHARE * prepared.tolerance:
                return None
            report.time += missing
            if window != begin:  # noise that the new grid has brought, which the transition smooths before it is seen
                report.aliasing = max(report.aliasing, lw.grid_check(values, window.closed, negligible).aliasing - known)
            return _normalised(result[0], window, result[1], report, negligible)
        new = lw.enlarged(window, left, right)
        if new == window:
            return None
        values, window = lw.resampled(values, window, new), new
    return None


def by_substeps(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, report: Report, moving: bool = False
) -> Prediction:
    """Return the density after an interval, by exponentials of its operator, on grids that move with it or are fixed."""
    result, tails = _by_substeps(prepared, values, window, interval, report, moving)
    if NOISE * np.exp(min(tails, 690.0)) > 0.1 * prepared.tolerance:
        # Increments far from the density may multiply rounding errors in its tails: compare with a density that has more of them.
        noisy, _ = _by_substeps(prepared, values + NOISE * np.max(values.real), window, interval, Report(), moving)
        (mean, variance), (other, another) = (lw.moments(one.values.real, one.window) for one in (result, noisy))
        report.time += float(np.nan_to_num(abs(mean - other) / np.sqrt(variance) + abs(another / variance - 1.0), nan=1.0))
    return result


def _by_substeps(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, report: Report, moving: bool
) -> tuple[Prediction, float]:
    """Return the same, and the logarithm of a bound on the growth of small values relative to the density."""
    start, length = interval.start, interval.length
    gained: Number = 0.0
    report.positive = False
    bounds = [(0.0, length)]
    if prepared.system.varying:
        parts = resolved_parts(prepared, values, window, interval)
        bounds, report.time = parts.bounds, report.time + parts.error
    stack, check = bounds[::-1], None
    substeps, tails = 0, 0.0

    def regridded(check: lw.GridCheck, first: float) -> tuple[Array, lw.Window]:
        """Return the density at a time of the interval on the grid for the next substep."""
        result = refitted(prepared, values, window, check, large=substeps < SUBSTEPS_OF_LARGE_GRID)
        return on_grid_for_drift(prepared, *result, start + first, length - first)

    while stack:
        first, last = stack.pop()
        substeps += 1
        if not np.isfinite(values.real).all():
            return Prediction(values, window, np.float64(np.nan), check), tails
        most = lw.SIZES[-1] if window.size > lw.LARGEST and substeps < SUBSTEPS_OF_LARGE_GRID else lw.LARGEST
        divisible = last - first > 1e-12 * length and substeps + len(stack) < MOST_SUBSTEPS
        part = interval.part(first, last)
        fitted = _on_fitting_grid(prepared, values, window, part, moving, most, divisible)
        trial, values, window, check = fitted.trial, fitted.values, fitted.window, fitted.check
        if fitted.split:
            if trial.split and trial.error > 0:
                stack += parts_of_split(prepared, first, last, trial.error)[::-1]
            else:
                middle = first + (last - first) * (0.25 if last - first > 1e-3 * length else 0.0625)
                stack += [(middle, last), (first, middle)]
            check = lw.grid_check(values, window.closed, prepared.negligible)
            values, window = regridded(check, first)
            continue
        assert check is not None
        if prepared.smoothing and stack:  # what a kink leaves everywhere
            check = check._replace(aliasing=0.0, left=0.0, right=0.0)
        report.density(check)
        if stack and check.aliasing > LOST_ALIASING:  # what follows means nothing, and may take many substeps
            return Prediction(np.full_like(values, np.nan), window, np.float64(np.nan), check), 0.0
        report.aliasing = max(report.aliasing, fitted.brought)
        report.time += trial.error + fitted.missing
        after = window if trial.substep is None else lw.translated(window, trial.substep.speed * part.length)
        values = np.where(trial.values.real > 0, trial.values, 0.0)
        mass = np.sum(values)
        tails = max(tails + trial.lift - float(np.log(mass.real)), 0.0)
        values, window = values / mass, after
        gained = gained + np.log(mass) + trial.offset
        if stack:
            values, window = regridded(check, last)
    if substeps >= MOST_SUBSTEPS:
        report.time = np.inf
    return Prediction(values, window, gained, check), tails


class _Fitted(NamedTuple):
    """A substep on a grid that holds it, and the density before on this grid; whether it is to be `split` instead.

    `check` is that of the density after, `missing` the mass that was lost, and `brought` the spectrum at the highest frequencies
    that the grid has brought, which the transition smooths before it is seen.
    """

    trial: Trial
    values: Array
    window: lw.Window
    check: lw.GridCheck | None
    split: bool
    missing: float = 0.0
    brought: float = 0.0


def _on_fitting_grid(
    prepared: Prepared, values: Array, window: lw.Window, part: TimeInterval, moving: bool, most: int, divisible: bool
) -> _Fitted:
    """Return a substep on grids of at most so many points; where none serves it is to be split, if it is `divisible`."""
    negligible, rough, check = prepared.negligible, noise_bound(prepared.tolerance), None
    known, begin, grown = lw.grid_check(values, window.closed, negligible).aliasing, window, False
    while True:
        speed = speed_of(prepared, values, window, part.start, part.length) if moving else 0.0
        trial = trial_substep(prepared, values, window, Substep(part.start, part.length, part.inside, part.rates, speed))
        total = float(np.sum(trial.values.real))
        missing = 0.0 if part.inside.any() else abs(total - 1.0)
        failed = not 1e-100 < total < 1e6 or missing > LOST_MASS
        if (trial.split or failed) and divisible:
            return _Fitted(trial, values, window, check, True)
        check = lw.grid_check(trial.values, window.closed, negligible)
        coarse = check.unresolved(negligible, rough)
        # A finer grid has no more of the spectrum of a kink.
        coarse = coarse and (not prepared.weak or known <= SPECTRUM_FACTOR * negligible)
        bound = edge_bound(check.aliasing)
        left, right = check.left > bound, check.right > bound
        if not (left or right or coarse):
            break
        own = lw.grid_check(values, window.closed, negligible).aliasing
        smooth, new = own < 0.1 * rough, window
        if not (check.aliasing > GROSS and smooth):  # what such an attempt shows of the edges is not the density
            if left or right:
                new, grown = lw.enlarged(new, left, right), True
            if coarse and window.size < most:
                new = lw.refined(new) if grown else finer(values, window, check)
        if new.size <= most and new != window and not window.size == new.size == lw.SIZES[-1]:
            values, window = lw.resampled(values, window, new), new
            continue
        # The grid is as large as it may be: take a shorter substep, unless that does not help.
        helps = smooth and check.aliasing > rough and (not check.rough or check.aliasing > GROSS)
        if (left or right or helps) and divisible:
            return _Fitted(trial, values, window, check, True)
        break
    brought = 0.0 if window == begin else lw.grid_check(values, window.closed, negligible).aliasing - known
    return _Fitted(trial, values, window, check, False, missing, brought)


def _normalised(result: Array, window: lw.Window, error: float, report: Report, negligible: float) -> Prediction:
    check = lw.grid_check(result, window.closed, negligible)
    report.density(check)
    report.time += error
    result = np.where(result.real > 0, result, 0.0)
    mass = np.sum(result)
    return Prediction(result / mass, window, np.log(mass), check)
