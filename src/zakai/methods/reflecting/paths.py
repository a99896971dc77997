"""Draws of a state between ends and kinks at the start of an interval given that at its end.

    x ~ p(x) T(x, z),      T(x, z) = s(z) / s(x) sum_j psi_j(x) psi_j(z) exp(-tau lambda_j)

The transition T is that of the modes at Gauss-Lobatto points, in parts of the domain that resolve it.  Where coefficients
depend on t, it is a product of transitions with those at the middles of substeps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.coefficients import coefficients, resolved_parts
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import covariance_at
from zakai.methods.reflecting.elements import SIZES, domain_of, element_of, operator_at
from zakai.methods.reflecting.filter import State
from zakai.numerics.lobatto import Element

Array = Any

PIECE = 10.0  # standard deviations of the noise in which states at the end are taken together
REACH = 8.0  # of them around, between which the state at the start lies
RESOLVING = 3.7  # points in a standard deviation
RESOLVED = 1e-6  # Legendre coefficient of a density that the points of the transition resolve
FINE = 4  # points in a spacing between which a distribution is interpolated
SUBSTEPS = 4  # of a part in which the coefficients are polynomials of time


@np.errstate(all="ignore")
def draw(
    prepared: Prepared, k: int, later: Array, observed: np.ndarray, state: State, rng: np.random.Generator
) -> tuple[Array, float]:
    """Return draws (P, 1) of the state at the start of interval k given those at its end, and zero: their law is exact."""
    start, length = float(prepared.schedule.starts[k]), float(prepared.lengths[k])
    if length == 0:
        return later, 0.0
    z, uniform = later[:, 0], rng.uniform(size=len(later))
    element, middle, theta = state.element, start + 0.5 * length, prepared.theta.real
    x = element.points
    drift = prepared.system.drift(x[:, None], middle, theta)[:, 0]
    G = covariance_at(prepared.system, x, np.asarray(middle), theta) * np.ones(len(x))
    slope = float(np.max(np.abs(element.derivative(drift))))
    deviation = float(np.sqrt(np.min(G) * min(length, 0.5 / max(slope, 1e-300))))
    wide = REACH * float(np.sqrt(np.max(G) * length))
    low, high = min(element.lower, float(z.min())), max(element.upper, float(z.max()))
    found, order = np.empty(len(z)), np.argsort(z)
    pieces = np.floor((z[order] - low) / (PIECE * deviation)).astype(int)
    for places in np.split(order, np.flatnonzero(np.diff(pieces)) + 1):
        first, last = float(z[places].min()), float(z[places].max())
        near = np.abs(drift[(x >= first - wide) & (x <= last + wide)])
        reach = wide + length * float(np.max(near, initial=0.0))
        lower, upper = max(first - reach, low), min(last + reach, high)
        needed = RESOLVING * 2.0 * float(np.max(element_of(prepared, lower, upper, SIZES[0]).halves)) / deviation
        piece = element_of(prepared, lower, upper, next((size for size in SIZES if size >= needed), SIZES[-1]))
        found[places] = _drawn(prepared, k, piece, z[places], observed, state, uniform[places])
    return np.clip(found, domain_of(prepared).lower, domain_of(prepared).upper)[:, None], 0.0


def _drawn(prepared: Prepared, k: int, piece: Element, z: Array, observed: np.ndarray, state: State, uniform: Array) -> Array:
    """Return the quantiles (P,) of the law of the state at the start, given those at the end z (P,)."""
    own, values = state.element, np.asarray(state.values).real
    before = np.maximum(own.at(values, piece.points), 0.0)
    likely = piece.interpolation(z) @ _transition(prepared, k, piece, before, observed)
    fine = np.linspace(max(piece.lower, own.lower), min(piece.upper, own.upper), FINE * max(len(before), len(values)) + 1)
    middles = 0.5 * (fine[1:] + fine[:-1])
    if piece.unresolved(before * piece.weights) < RESOLVED:
        mass = (likely * before) @ piece.interpolation(middles).T
    else:
        mass = likely @ piece.interpolation(middles).T * own.at(values, middles)
    mass = np.maximum(mass, 0.0)
    total = np.concatenate([np.zeros((len(mass), 1)), np.cumsum(mass, axis=1)], axis=1)
    return np.array([np.interp(u * row[-1], row, fine) for u, row in zip(uniform, total, strict=True)])


def _transition(prepared: Prepared, k: int, piece: Element, before: Array, observed: np.ndarray) -> Array:
    """Return T (N, N) from the points of an element to the densities at them, weighted by what is observed inside."""
    start, length, inside = float(prepared.schedule.starts[k]), float(prepared.lengths[k]), prepared.inside[k]
    rates, bounds, found = np.where(inside, observed, 0.0) / length, [(0.0, length)], np.eye(len(piece.points))
    if prepared.system.varying:
        parts = resolved_parts(prepared, before, piece, start, length, inside).bounds  # type: ignore[arg-type]  # by its points
        cuts = [np.linspace(*part, SUBSTEPS + 1) for part in parts]
        bounds = [(float(a), float(b)) for cut in cuts for a, b in zip(cut[:-1], cut[1:], strict=True)]
    for first, last in bounds:
        middle = np.array([start + 0.5 * (first + last)])
        known = operator_at(prepared, piece, float(middle[0]))
        if known is None:
            return np.full_like(found, np.nan)
        _, _, potential, _ = coefficients(prepared, piece, middle, inside, rates, before)  # type: ignore[arg-type]
        modes = known.weighted(potential[0]) if inside.any() else known.modes
        s = modes.scale[:, None]
        found = s * (modes.modes @ (np.exp((first - last) * modes.rates)[:, None] * (modes.modes.T @ (found / s))))
    return np.asarray(found / piece.weights[:, None])
