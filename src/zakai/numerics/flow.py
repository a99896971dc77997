"""Transitions and flows of a linear-quadratic equation over many intervals at once.

    v_t = 1/2 G:Hess v - (L x + l e).grad v + (x'Q x + (p e).x + r.e) v,     e = (1, e_1, ...)

`zakai.numerics.transition` defines what comes out.  Usage:

    result = integrate(coefficients, starts, stops, autonomous)     # coefficients(times (J,), rows (J,)) -> Coefficients
    transition = at(result.transition, k)                           # of interval k
    flows = spread_first(result.transition)                         # of all intervals, for grids
    moved = motion(at(flows, k), centre, inputs)

An interval is cut by halves until its coefficients are polynomials of degree 7 on every panel, checked at irregular times
between the nodes.  There the characteristics are a power series about the middle of the panel; a panel whose series needs too
many terms is halved too.  The panels are composed in pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zakai.numerics.flow_series import NODES, STAGES, WEIGHTS, solve
from zakai.numerics.transition import Array, Coefficients, Flow, Motion, Transition, at, compose, motion, spread_first

__all__ = [
    "Coefficients", "Flow", "FlowResult", "Motion", "Transition", "at", "compose", "composed", "integrate", "motion",
    "spread_first",
]  # fmt: skip

RESOLVED = 1e-6  # pointwise error of these polynomials above which a panel is only accepted for its shortness
TOLERANCE = 1e-13  # error of a panel, as a share of the interval
PROBES = 128  # times at which an interval is checked: features wider than 1/128 of it are found
FEWEST_PROBES = 16
FEW = 16  # intervals that are solved at once, if they are resolved
MOST_PANELS = 4096  # of one interval
MOST_CUBES = 2**26  # the most panels times n^3, for time
MOST_LEVELS = 52
BLOCK = 1024  # intervals, or panels, that are integrated together, for memory
MOST_NUMBERS = 2**18  # in the generators of the panels that are solved together


class FlowResult(NamedTuple):
    """The transitions of K intervals, and for each an estimate (K,) of its relative error from unresolved coefficients."""

    transition: Transition
    error: Array


def _interpolation(places: Array) -> Array:
    """Return the matrix (P, STAGES) from values at Gauss' nodes to those at places (P,) in [-1, 1]."""
    legendre = np.polynomial.legendre.legvander(NODES, STAGES - 1)
    to_legendre = (legendre * WEIGHTS[:, None]).T * (np.arange(STAGES) + 0.5)[:, None]
    return np.asarray(np.polynomial.legendre.legvander(places, STAGES - 1) @ to_legendre)


def _irregular(count: int) -> Array:
    """Return increasing places (count,) in (-1, 1) at unequal distances, which meet every phase of a periodic function."""
    index = np.arange(count)
    places = 2.0 * (index + 0.5 + 0.4 * np.sin(7.0 * index)) / count - 1.0
    places[[0, -1]] = -1.0 + 2e-4, 1.0 - 2e-4  # a jump near an end is found as well
    return np.asarray(places)


# The nodes with the places between them, and the interpolation to these.
_CHECKS = {
    count: (np.concatenate([NODES, _irregular(count)]), _interpolation(_irregular(count))) for count in (128, 64, 32, 16)
}


class _Panels(NamedTuple):
    """Parts of intervals: `row` (J,) of the interval, and `begin` and `width` (J,) as shares of it."""

    row: Array
    begin: Array
    width: Array

    def take(self, which: Array) -> _Panels:
        return _Panels(self.row[which], self.begin[which], self.width[which])

    def halves(self) -> _Panels:
        half = np.repeat(0.5 * self.width, 2)
        begin = np.repeat(self.begin, 2)
        begin[1::2] += half[1::2]
        return _Panels(np.repeat(self.row, 2), begin, half)


Function = Callable[[Array, Array], Any]


class _Problem(NamedTuple):
    """The intervals, their coefficients, and the functions of time that are checked between nodes."""

    coefficients: Function
    features: Function
    starts: Array
    lengths: Array

    def times(self, panels: _Panels, places: Array) -> Array:
        """Return the times (J, P) at places (P,) in [-1, 1] of each panel."""
        shares = panels.begin[:, None] + panels.width[:, None] * (0.5 * (places + 1.0))
        return np.asarray(self.starts[panels.row, None] + self.lengths[panels.row, None] * shares)

    def values(self, panels: _Panels, times: Array) -> Array:
        """Return the features (J, F, P) at times (J, P), without derivatives."""
        found = np.asarray(self.features(times.ravel(), np.repeat(panels.row, times.shape[1]))).real
        return np.ascontiguousarray(np.reshape(found, (*times.shape, -1)).swapaxes(1, 2))

    def solve(self, panels: _Panels) -> tuple[Transition, Array]:
        """Return the transitions of panels, and which of them are too long for their series."""
        times = self.times(panels, NODES)
        c = self.coefficients(times.ravel(), np.repeat(panels.row, STAGES))
        return solve(c, self.lengths[panels.row] * panels.width)


def _unresolved(problem: _Problem, panels: _Panels, probes: int, scales: Array | None) -> tuple[Array, Array]:
    """Return how far the features of panels are from polynomials, (J,), relative to `scales` (K, F), and the scales."""
    places, interpolation = _CHECKS[probes]
    times = problem.times(panels, places)
    values = problem.values(panels, times)
    times, at_nodes, at_probes = times[:, STAGES:], values[:, :, :STAGES], values[:, :, STAGES:]
    with np.errstate(all="ignore"):
        if scales is None:
            scales = np.abs(values).max(axis=2)
        difference = np.abs(at_probes - at_nodes @ interpolation.T)
        # The time is known to its rounding only, and so are the values.
        span = (problem.lengths[panels.row] * panels.width)[:, None, None]
        steps = np.abs(at_probes[:, :, 1:] - at_probes[:, :, :-1]).max(axis=2, keepdims=True) * (probes / span)
        difference -= 8.0 * np.finfo(float).eps * np.abs(times[:, None]) * steps
        worst = np.maximum(difference.max(axis=2), 0.0)
        mismatch = (worst / np.maximum(scales[panels.row], 1e-290)).max(axis=1, initial=0.0)
    mismatch = np.where(np.isfinite(mismatch), mismatch, np.inf)
    return np.where(problem.lengths[panels.row] > 0, mismatch, 0.0), scales


def composed(transitions: Transition, rows: Array, count: int) -> Transition:
    """Return the transition of each of `count` intervals from those of its parts in order of time, composed in pairs.

    Args:
        transitions: Of the parts (J,).
        rows: The interval (J,) of each part, in increasing order; every interval has a part.
        count: The number of intervals.
    """
    current = transitions
    while len(rows) > count:
        sizes = np.bincount(rows, minlength=count)
        place = np.arange(len(rows)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        first = np.flatnonzero((place % 2 == 0) & (place + 1 < sizes[rows]))
        alone = np.flatnonzero((place % 2 == 0) & (place + 1 >= sizes[rows]))
        pairs = compose(at(current, first), at(current, first + 1))
        merged = np.argsort(np.concatenate([first, alone]), kind="stable")
        current = Transition(*(np.concatenate([a, b[alone]])[merged] for a, b in zip(pairs, current, strict=True)))
        rows = np.concatenate([rows[first], rows[alone]])[merged]
    return current


def _integrate_autonomous(problem: _Problem) -> tuple[Transition, Array]:
    """Return the transitions of intervals whose coefficients do not vary: that of a part, doubled."""
    count = len(problem.starts)
    c = problem.coefficients(problem.starts, np.arange(count))
    finite = np.all([np.isfinite(field).all(axis=tuple(range(1, field.ndim))) for field in c], axis=0)
    found, pending = solve(c, problem.lengths)
    doublings = np.zeros(count, int)
    for level in range(1, 1100):
        rows = np.flatnonzero(pending & finite)
        if not len(rows):
            break
        doublings[rows] = level
        part, pending[rows] = solve(Coefficients(*(field[rows] for field in c)), np.ldexp(problem.lengths[rows], -level))
        for field, value in zip(found, part, strict=True):
            field[rows] = value
    for level in range(int(doublings.max(initial=0))):
        rows = np.flatnonzero(doublings > level)
        part = at(found, rows)
        for field, value in zip(found, compose(part, part), strict=True):
            field[rows] = value
    return found, np.where(finite, 0.0, np.inf)


def _integrate_varying(problem: _Problem) -> tuple[Transition, Array]:
    """Return the transitions of intervals, each cut by halves until its coefficients are polynomials on every panel."""
    count = len(problem.starts)
    error = np.zeros(count)
    panels = _Panels(np.arange(count), np.zeros(count), np.ones(count))
    if count == 0:
        return problem.solve(panels)[0], error
    latest = np.maximum(np.abs(problem.starts), np.abs(problem.starts + problem.lengths))
    checked = np.zeros(count, bool)
    number = np.ones(count, int)
    accepted: list[tuple[_Panels, Transition]] = []
    scales: Array | None = None
    size, most = 1, MOST_PANELS  # panels that are solved together, and of one interval
    for level in range(MOST_LEVELS):
        mismatch = np.zeros(len(checked))
        fresh = np.flatnonzero(~checked)
        if len(fresh):
            probes = max(FEWEST_PROBES, PROBES >> min(level, 8))
            pending_panels = panels if len(fresh) == len(checked) else panels.take(fresh)
            mismatch[fresh], scales = _unresolved(problem, pending_panels, probes, scales)
        estimate = panels.width * mismatch * np.minimum(1.0, 1e3 * mismatch)
        if level == 0 and count <= FEW and (estimate <= TOLERANCE).all():
            whole, coarse = problem.solve(panels)
            if not coarse.any():
                return whole, estimate
        if level == 4:
            states = problem.coefficients(problem.starts[:1], np.zeros(1, int)).matrix.shape[1]
            most = min(MOST_PANELS, MOST_CUBES // states**3)
        last = (number[panels.row] >= most) | (level == MOST_LEVELS - 1) | np.isinf(mismatch)
        resolved = checked | (estimate <= TOLERANCE) | last
        np.add.at(error, panels.row[~checked & resolved], estimate[~checked & resolved])
        # A panel that is too short to matter, or for its times to be known, needs no accurate series.
        short = problem.lengths[panels.row] * panels.width <= 256 * np.finfo(float).eps * latest[panels.row]
        final = (mismatch > RESOLVED) | last | short
        split = ~resolved
        begin, ready = 0, np.flatnonzero(resolved)
        while begin < len(ready):
            chunk = ready[begin : begin + size]
            part = panels.take(chunk)
            found, coarse = problem.solve(part)
            np.add.at(error, part.row[coarse & last[chunk] & checked[chunk]], 1.0)
            done = ~coarse | final[chunk]
            accepted.append((part, found) if done.all() else (part.take(done), at(found, done)))
            split[chunk[~done]] = True
            begin += size
            n, k = found.offset.shape[1:]
            size = int(np.clip(MOST_NUMBERS // (STAGES * (2 * n + k) ** 2), 1, BLOCK))
        again = np.flatnonzero(split)
        if not len(again):
            break
        panels, checked = panels.take(again).halves(), np.repeat(resolved[again], 2)
        np.add.at(number, panels.row[::2], 1)
    if len(accepted) == 1 and len(accepted[0][0].row) == count:
        return accepted[0][1], error
    every = _Panels(*(np.concatenate(fields) for fields in zip(*(part for part, _ in accepted), strict=True)))
    together = Transition(*(np.concatenate(fields) for fields in zip(*(found for _, found in accepted), strict=True)))
    order = np.lexsort((every.begin, every.row))
    return composed(at(together, order), every.row[order], count), error


def integrate(
    coefficients: Callable[[Array, Array], Coefficients],
    starts: Array,
    stops: Array,
    autonomous: bool,
    features: Callable[[Array, Array], Array] | None = None,
) -> FlowResult:
    """Integrate equation (1) over K intervals; the result of an interval depends on that interval alone, to the last bit.

    Args:
        coefficients: Returns the `Coefficients` at times (J,) in intervals `rows` (J,); it may be complex.
        starts: The beginnings (K,) of the intervals.
        stops: Their ends (K,); an interval of length zero has the transition that changes nothing.
        autonomous: Whether the coefficients do not depend on time (they may still depend on the interval).
        features: Returns the functions (J, F) of time that the coefficients are made of, where they cost less than the
            coefficients, which are checked by default.

    Returns:
        The transitions and an estimate of the relative error of each: above 1e-10 the coefficients are not resolved, and
        infinite where they are not finite.
    """
    starts, lengths = np.asarray(starts, float), np.asarray(stops, float) - np.asarray(starts, float)

    def entries(times: Array, rows: Array) -> Array:
        return np.concatenate([field.reshape(len(times), -1) for field in coefficients(times, rows)], axis=1)

    transitions, errors = [], []
    for first in range(0, max(len(starts), 1), BLOCK):
        rows = slice(first, first + BLOCK)

        def shifted(function: Function, first: int = first) -> Function:
            return lambda times, numbers: function(times, numbers + first)

        problem = _Problem(shifted(coefficients), shifted(features or entries), starts[rows], lengths[rows])
        with np.errstate(all="ignore"):
            found, error = (_integrate_autonomous if autonomous else _integrate_varying)(problem)
        if len(starts) <= BLOCK:
            return FlowResult(found, error)
        transitions.append(found)
        errors.append(error)
    return FlowResult(Transition(*(np.concatenate(fields) for fields in zip(*transitions, strict=True))), np.concatenate(errors))
