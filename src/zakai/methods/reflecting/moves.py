"""How a density between ends and kinks moves over an interval: by modes on Gauss-Lobatto points, or by finite volumes.

The modes of the symmetric operator serve every interval in which no coefficient depends on t and no increment acts:

    exp(tau L) = s U exp(-tau lambda) U' / s,      s'/s = (f - G'/2) / G.

A density on other points is projected onto the modes by the quadrature of its own points.  Finite volumes without flux at the
ends (`line/volumes.py`) take the other intervals.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.course import course_of
from zakai.methods.line.moves import Report
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at
from zakai.methods.line.volumes import SHARE, advanced_by
from zakai.methods.reflecting.elements import (
    CUT,
    SIZES,
    Operator,
    apart,
    decomposed,
    domain_of,
    element_of,
    reached,
    sampled,
    weighted,
    with_margin,
)
from zakai.numerics.lobatto import Element

Array = Any

COUNTS = 1e-14  # density relative to the maximum beyond which it is rounding
EDGE = 1e-12  # density at an end that is not one of the domain, relative to the maximum
REACH = 7.2  # standard deviations of the noise by which a density widens
ATTEMPTS = 24  # elements that are tried
MOST_PARTS = 64  # of an interval that the volumes do not take as a whole
PEAK = 1.5  # points in a standard deviation of the noise with which the first element begins


def propagated(
    prepared: Prepared, values: Array, element: Element, k: int, inside: Array, rates: Array, report: Report,
    negligible: float,
) -> tuple[Array, Element, Any]:  # fmt: skip
    """Return the density after interval k, its points, and the logarithm of its mass."""
    interval = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), inside, rates, report, negligible
    found = None if prepared.system.varying else _by_modes(prepared, values, element, *interval)
    values, element, gained = _by_volumes(prepared, values, element, *interval) if found is None else found
    report.aliasing = max(report.aliasing, element.unresolved(values))
    report.edge = max(report.edge, *reached(values, element, domain_of(prepared)))
    real = values.real
    report.negative = max(report.negative, float(-np.minimum(real, 0.0).sum() / np.abs(real).sum()))
    mass = np.sum(values)
    return values / mass, element, gained + np.log(mass)


def _by_modes(
    prepared: Prepared, values: Array, element: Element, start: float, length: float, inside: Array, rates: Array, report: Report,
    negligible: float,
) -> tuple[Array, Element, Any] | None:  # fmt: skip
    """Return the density after an interval, its points, and the logarithm of its mass; None where modes do not serve."""
    domain, allowed = domain_of(prepared), max(1e-11, 1e-5 * prepared.tolerance)
    G = covariance_at(prepared.system, element.points, start, prepared.theta).real
    noise = np.sqrt(np.maximum([np.min(G), np.max(G)], 0.0) * length)
    counts = np.flatnonzero((values / element.weights).real > COUNTS * np.max((values / element.weights).real))
    low, high = element.points[[max(counts[0] - 1, 0), min(counts[-1] + 1, len(values) - 1)]]
    lower, upper = apart(float(low - REACH * noise[1]), float(high + REACH * noise[1]), domain)
    longest = float(np.max(element_of(prepared, lower, upper, SIZES[0]).halves))
    needed = min(2.0 * PEAK * longest / max(noise[0], 1e-300), element.size * longest / float(np.max(element.halves)))
    size = next((size for size in SIZES if size >= min(needed, SIZES[4])), SIZES[-1])
    for _ in range(ATTEMPTS):
        new, offset = element_of(prepared, lower, upper, size), 0.0
        known = decomposed(prepared, new)
        if known is None:
            return None
        modes, inner = known.modes, _projected(values, element, new, known, negligible)
        if inside.any():
            modes, weight, offset = weighted(prepared, known, new, start, length, inside, rates, modes.scale * inner)
        found, error = modes.carried(inner, length)
        if not np.isfinite(found.real).all():
            return None
        unresolved, growth = new.unresolved(found), 0.0
        if inside.any():  # increments mix all waves of the density before, and may raise errors in its tails
            before = modes.scale * inner
            unresolved = max(unresolved, new.unresolved(before))
            raised = new.weights * np.exp((weight - offset).real) * float(np.max((before / new.weights).real))
            growth = float(np.sum(raised) / np.sum(found.real))
        coarse = unresolved > negligible
        # Oscillations of what is not resolved reach the ends as well.
        left, right = (float(end) > (unresolved if coarse else EDGE) for end in reached(found, new, domain))
        if coarse and size < SIZES[-1]:
            size = SIZES[SIZES.index(size) + 1]
        elif coarse:
            return None
        elif left or right:
            width = upper - lower
            lower, upper = apart(lower - 0.4 * width * left, upper + 0.4 * width * right, domain)
        elif error < allowed and (inside.any() or abs(np.sum(found.real) - 1.0) < 1e-3):
            report.time, report.growth = report.time + error, growth
            report.aliasing = max(report.aliasing, unresolved)
            return found, new, offset
        else:
            return None
    return None


def _projected(values: Array, element: Element, new: Element, known: Operator, negligible: float) -> Array:
    """Return a density on some points, divided by s, on those of an operator.

    Where the new points do not resolve it, it is its projection, by the quadrature of its own points.
    """
    if element == new:
        return np.asarray(values / known.modes.scale)
    found = element.at(values, new.points) * new.weights
    if new.unresolved(found) < negligible:
        return np.asarray(found / known.modes.scale)
    between = new.interpolation(element.points)
    s = np.exp(between @ known.logs - known.modes.top)
    return np.asarray((between.T @ (values / s)) / np.sqrt(new.weights))


def _by_volumes(
    prepared: Prepared, values: Array, element: Element, start: float, length: float, inside: Array, rates: Array, report: Report,
    negligible: float,
) -> tuple[Array, Element, Any]:  # fmt: skip
    """Return the density after an interval, its points, and the logarithm of its mass, in parts where volumes do not settle."""
    stack, gained, count = [(0.0, length)], 0.0 * values[0], 0
    while stack:
        first, last = stack.pop()
        count += 1
        found = _part(prepared, values, element, start + first, last - first, inside, rates, report, negligible)
        if found is not None:
            values, element, more = found
            gained = gained + more
        elif count + len(stack) < MOST_PARTS:
            middle = first + 0.25 * (last - first)
            stack += [(middle, last), (first, middle)]
        else:
            report.time = np.inf
            break
    return values, element, gained


def _part(
    prepared: Prepared, values: Array, element: Element, start: float, length: float, inside: Array, rates: Array, report: Report,
    negligible: float,
) -> tuple[Array, Element, Any] | None:  # fmt: skip
    """Return the density after a part of an interval from finite volumes, None where these do not settle."""
    domain, at = domain_of(prepared), element

    def before(offsets: Array) -> Array:
        return at.at(values, at.lower + offsets)

    ends = np.array([0.0, at.upper - at.lower])
    course = course_of(prepared, values, at, ends, start, length, inside)  # type: ignore[arg-type]  # by its points
    if course is None:
        return None
    found = advanced_by(prepared, before, course, start, inside, rates, SHARE * prepared.tolerance)
    if found is None:
        return None
    report.time += found.error + course.unresolved
    cells = found.cells
    density = np.log(np.maximum((found.values / cells.widths).real, 1e-300))
    here = np.flatnonzero(density > np.max(density) - CUT)
    faces, tiny = cells.origin + cells.faces, 1e-9 * (cells.faces[-1] - cells.faces[0])
    if faces[0] - domain.lower < tiny:
        faces[0] = domain.lower
    if domain.upper - faces[-1] < tiny:
        faces[-1] = domain.upper
    lower, upper = with_margin(float(faces[here[0]]), float(faces[here[-1] + 1]), domain)
    lower, upper = max(lower, float(faces[0])), min(upper, float(faces[-1]))
    interpolated = cells.density(found.values)

    def after(x: Array) -> Array:
        return interpolated(np.clip(x - cells.origin, *cells.faces[[0, -1]]))

    element, values = sampled(prepared, after, lower, upper, max(negligible, 1e-2 * found.error))
    return values / np.sum(values), element, found.log_scale
