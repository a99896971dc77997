"""The density of one state after an interval: attempts on a grid, in substeps, until one is accurate.

    u_t = (G u)'' / 2 - (f u)' + (h'S^-1 dy/dt - h'S^-1 h / 2) u
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods.line.attempt import Substep, attempted, by_modes, parts_of_split
from zakai.methods.line.coarse import EDGE, coarsened
from zakai.methods.line.coefficients import resolved_parts
from zakai.methods.line.drift_grid import showing_drift
from zakai.methods.line.figures import refitted
from zakai.methods.line.leak import ALLOWED, lost
from zakai.methods.line.moving import speed_of
from zakai.methods.line.system import NOISE, Prepared
from zakai.numerics.line import window as lw
from zakai.numerics.line.posterior import finer

Array = Any

MOST_SUBSTEPS = 4000
FEW = 24  # substeps of an interval, after which no large grid is taken


class Report:
    """The worst health figures within one step."""

    def __init__(self) -> None:
        self.aliasing = self.edge = self.time = self.noise = self.depth = self.growth = self.negative = self.lawless = 0.0
        self.positive = True  # small values are accurate
        self.decomposed = True  # the operator has a decomposition on the grid that serves every interval

    def density(self, look: lw.Figures) -> None:
        """Note the figures of a density."""
        self.aliasing = max(self.aliasing, look.aliasing)
        self.negative = max(self.negative, look.negative)
        self.edge = max(self.edge, look.left, look.right)


class Passage(NamedTuple):
    """A transition: the density and the grid before it, its length, the logarithm of its mass, and the grid after it.

    It is by the modes of that grid, of which at the `margins`, in points, there is no density; or by the exponentials of a
    `substep`, times exp(-offset).
    """

    values: Array
    window: lw.Window
    length: float
    log_mass: Any
    after: lw.Window
    substep: Substep | None = None
    offset: Any = 0.0
    margins: tuple[int, int] = 0, 0


class Moved(NamedTuple):
    """The density after an interval, its grid, the logarithm of its mass, its figures, and how it was moved, where known."""

    values: Array
    window: lw.Window
    gained: Any
    look: lw.Figures | None
    passages: tuple[Passage, ...] = ()


def by_decomposition(prepared: Prepared, values: Array, window: lw.Window, length: float, report: Report) -> Moved | None:
    """Return the density after an interval without observations inside by modes of its operator, None where they do not serve."""
    negligible, rough = prepared.negligible, max(1e-10, 1e-3 * prepared.tolerance)
    carried = coarsened(prepared, values, window, length)
    if carried is not None:
        passage = Passage(values, window, length, 0.0, carried.window, margins=carried.margins)
        return _normalised(carried.values, carried.window, carried.error, report, negligible, passage)
    known, begin = lw.figures(values, window.closed, negligible).aliasing, window
    while window.size <= lw.LARGEST:
        found = by_modes(prepared, values, window, length)
        if found is None or not lost(float(np.sum(found[0].real))) < 1e-3:
            return None
        look = lw.figures(found[0], window.closed, negligible)
        if look.aliasing > 30.0 * negligible and (look.aliasing > rough or not look.rough):
            return None
        bound = max(EDGE, 4.0 * look.aliasing)
        left, right = look.left > bound, look.right > bound
        if not (left or right):
            missing = lost(float(np.sum(found[0].real)))
            if missing > ALLOWED * prepared.tolerance:
                return None
            report.time += missing
            if window != begin:  # noise that the new grid has brought, which the transition smooths before it is seen
                report.aliasing = max(report.aliasing, lw.figures(values, window.closed, negligible).aliasing - known)
            return _normalised(found[0], window, found[1], report, negligible, Passage(values, window, length, 0.0, window))
        new = lw.enlarged(window, left, right)
        if new == window:
            return None
        values, window = lw.resampled(values, window, new), new
    return None


def by_substeps(
    prepared: Prepared,
    values: Array,
    window: lw.Window,
    start: float,
    length: float,
    inside: np.ndarray,
    rates: np.ndarray,
    report: Report,
    moving: bool = False,
) -> Moved:
    """Return the density after an interval, by exponentials of its operator, on grids that move with it or stand."""
    interval = start, length, inside, rates
    found, tails = _by_substeps(prepared, values, window, *interval, report, moving)
    if NOISE * np.exp(min(tails, 690.0)) > 0.1 * prepared.tolerance:
        # Increments far from the density may multiply rounding errors in its tails: compare with a density that has more of them.
        noisy, _ = _by_substeps(prepared, values + NOISE * np.max(values.real), window, *interval, Report(), moving)
        (mean, variance), (other, another) = (lw.moments(one.values.real, one.window) for one in (found, noisy))
        report.time += float(np.nan_to_num(abs(mean - other) / np.sqrt(variance) + abs(another / variance - 1.0), nan=1.0))
    return found


def _by_substeps(
    prepared: Prepared,
    values: Array,
    window: lw.Window,
    start: float,
    length: float,
    inside: np.ndarray,
    rates: np.ndarray,
    report: Report,
    moving: bool,
) -> tuple[Moved, float]:
    """Return the same, and the logarithm of a bound on the growth of small values relative to the density."""
    system, negligible, look = prepared.system, prepared.negligible, None
    gained: Any = 0.0
    rough, resolved = max(1e-10, 1e-3 * prepared.tolerance), 30.0 * negligible
    report.positive = False
    bounds = [(0.0, length)]
    if system.varying:
        parts = resolved_parts(prepared, values, window, start, length, inside)
        bounds, report.time = parts.bounds, report.time + parts.error
    stack = bounds[::-1]
    substeps, passages, speed, tails = 0, [], 0.0, 0.0
    while stack:
        first, last = stack.pop()
        substeps += 1
        large = window.size > lw.LARGEST and substeps < FEW
        most = lw.SIZES[-1] if large else lw.LARGEST
        if not np.isfinite(values.real).all():
            return Moved(values, window, np.float64(np.nan), look), tails
        begin, grown = window, False
        known = lw.figures(values, window.closed, negligible).aliasing
        while True:
            if moving:
                speed = speed_of(prepared, values, window, start + first, last - first)
            attempt = attempted(prepared, values, window, Substep(start + first, last - first, inside, rates, speed))
            report.decomposed = attempt.substep is None
            total = float(np.sum(attempt.values.real))
            missing = 0.0 if inside.any() else lost(total)
            failed = not 1e-100 < total < 1e6 or missing > 1e-3
            split = (attempt.split or failed) and last - first > 1e-12 * length and substeps + len(stack) < MOST_SUBSTEPS
            if split:
                break
            look = lw.figures(attempt.values, window.closed, negligible)
            coarse = look.aliasing > resolved and (look.aliasing > rough or not look.rough)
            coarse = coarse and (not prepared.weak or known <= resolved)  # a finer grid has no more of the spectrum of a kink
            bound = max(EDGE, 4.0 * look.aliasing)
            left, right = look.left > bound, look.right > bound
            if not (left or right or coarse):
                break
            new = window
            smooth = lw.figures(values, window.closed, negligible).aliasing < 0.1 * rough
            if look.aliasing > lw.GROSS and smooth:
                new = window  # what such an attempt shows of the edges is not the density
            elif left or right:
                new, grown = lw.enlarged(new, left, right), True
            if coarse and window.size < most and not (look.aliasing > lw.GROSS and smooth):
                new = lw.refined(new) if grown else finer(values, window, look)
            if new.size <= most and new != window and not window.size == new.size == lw.SIZES[-1]:
                values = lw.resampled(values, window, new)
                window = new
                continue
            # The grid is as large as it may be: take a shorter substep, unless that does not help.
            helps = smooth and look.aliasing > rough and (not look.rough or look.aliasing > lw.GROSS)
            split = (left or right or helps) and last - first > 1e-12 * length
            split = split and substeps + len(stack) < MOST_SUBSTEPS
            break
        if split:
            if attempt.split and attempt.error > 0:
                stack += parts_of_split(prepared, first, last, attempt.error)[::-1]
            else:
                middle = first + (last - first) * (0.25 if last - first > 1e-3 * length else 0.0625)
                stack += [(middle, last), (first, middle)]
            look = lw.figures(values, window.closed, negligible)
            values, window = refitted(prepared, values, window, look, large=substeps < FEW)
            values, window = showing_drift(prepared, values, window, start + first, length - first)
            continue
        assert look is not None
        if prepared.smoothing and stack:  # what a kink leaves everywhere
            look = look._replace(aliasing=0.0, left=0.0, right=0.0)
        report.density(look)
        if window != begin:  # noise that the new grid has brought, which the transition smooths before it is seen
            brought = lw.figures(values, window.closed, negligible).aliasing
            report.aliasing = max(report.aliasing, brought - known)
        report.time += attempt.error + missing
        begin, after = window, lw.moved(window, speed * (last - first))
        before, values = values, np.where(attempt.values.real > 0, attempt.values, 0.0)
        mass = np.sum(values)
        passages.append(Passage(before, begin, last - first, np.log(mass), after, attempt.substep, attempt.offset))
        tails = max(tails + attempt.lift - float(np.log(mass.real)), 0.0)
        values, window = values / mass, after
        gained = gained + np.log(mass) + attempt.offset
        if stack:
            values, window = refitted(prepared, values, window, look, large=substeps < FEW)
            values, window = showing_drift(prepared, values, window, start + last, length - last)
    if substeps >= MOST_SUBSTEPS:
        report.time = np.inf
    return Moved(values, window, gained, look, tuple(passages)), tails


def _normalised(
    found: Array, window: lw.Window, error: float, report: Report, negligible: float, passage: Passage
) -> Moved:
    look = lw.figures(found, window.closed, negligible)
    report.density(look)
    report.time, report.decomposed = report.time + error, True
    found = np.where(found.real > 0, found, 0.0)
    mass = np.sum(found)
    return Moved(found / mass, window, np.log(mass), look, (passage._replace(log_mass=np.log(mass)),))
