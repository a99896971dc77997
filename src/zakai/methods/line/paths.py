"""Draws of the state at the start of an interval given that at its end, for one state on a grid.

A step of the filter is linear in the density p at the start.  It turns p (1 + i h phi) into q (1 + i h E[phi(x) | z, y]), where
q is the density at the end z: the conditional mean of any function phi of the state at the start is the derivative that the step
carries (`numerics/complex_step.py`), for every equation, observation and grid.  Four powers, on the circle two waves, give the
conditional mean, variance, skewness and kurtosis at every z, and a draw is their Cornish-Fisher expansion

    x = m + s (e + g1 (e^2 - 1) / 6 + g2 (e^3 - 3 e) / 24 - g1^2 (2 e^3 - 5 e) / 36),   e ~ N(0, 1),

whose error falls with the length of the interval.

References:
    Cornish and Fisher 1938, Moments and cumulants in the specification of distributions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.densities._values import wrap
from zakai.methods.line import filter as line_filter
from zakai.methods.line.domain import variable_of
from zakai.methods.line.prepared import Prepared, State
from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import STEP
from zakai.numerics.line import window as lw
from zakai.numerics.line.resolution import RESOLVED
from zakai.numerics.line.window import local_polynomial

NARROW_LAW = 0.02  # ratio of deviations below which skewness and kurtosis are zero but for rounding
WIDEST_ANGLE = 0.5  # conditional deviation of an angle for which two waves do not suffice


class Law(NamedTuple):
    """The conditional law at the points z of a grid (N,): mean less z, deviation, skewness, excess kurtosis."""

    shift: Array
    deviation: Array
    skewness: Array
    kurtosis: Array


@np.errstate(all="ignore")
def draw(prepared: Prepared, k: int, draws: Array, values: Array, state: State, rng: np.random.Generator) -> tuple[Array, float]:
    """Return draws (P, 1) of the state at the start of interval k given those at its end, and how far the law is from normal.

    The second is the root mean square of skewness and kurtosis, which falls with the length of the interval.
    """
    if prepared.lengths[k] == 0:
        return draws, 0.0
    variable = variable_of(prepared.model)
    z = (draws if variable is None else variable.w(draws))[:, 0]
    law, window, ends = _law(prepared, k, values, state)
    offsets = z - window.origin
    offsets = window.centre + wrap(offsets - window.centre) if window.closed else np.clip(offsets, *ends)
    shift, deviation, skewness, kurtosis = (local_polynomial(part, window, offsets) for part in law)
    departure = float(np.sqrt(np.mean(skewness**2 + kurtosis**2)))
    if not np.isfinite(departure) or (window.closed and np.max(deviation) > WIDEST_ANGLE):
        departure = np.inf
    e = rng.standard_normal(len(z))
    skewness, kurtosis = np.clip(skewness, -1.0, 1.0), np.clip(kurtosis, -1.0, 2.0)
    e = e + skewness * (e**2 - 1) / 6 + kurtosis * (e**3 - 3 * e) / 24 - skewness**2 * (2 * e**3 - 5 * e) / 36
    x = z + shift + np.maximum(deviation, 0.0) * e
    x = wrap(x) if window.closed else x
    return (x if variable is None else variable.x(x))[:, None], departure


def _law(prepared: Prepared, k: int, values: Array, state: State) -> tuple[Law, lw.Window, tuple[float, float]]:
    """Return the conditional law of the state at the start, the grid of z, and the offsets between which it is reliable."""
    own, density = state.window, np.asarray(state.values).real
    mean, variance = lw.moments(density, own)
    scale, means = float(np.sqrt(variance)), []
    t = own.points if own.closed else (own.offsets - mean) / scale
    functions = [np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)] if own.closed else [t, t**2, t**3, t**4]
    for function in functions:
        result = line_filter.single(prepared, k, state._replace(values=density * (1.0 + 1j * STEP * function)), values)
        propagated, info = result.state, result.info
        ratio = propagated.values.imag / propagated.values.real
        means.append((ratio + np.imag(info.log_likelihood_increment)) / STEP)
    window, q = propagated.window, propagated.values.real
    reliable = np.flatnonzero(q > RESOLVED * np.max(q))
    ends = float(window.offsets[reliable[0]]), float(window.offsets[reliable[-1]])
    if own.closed:
        return _of_waves(means[0] + 1j * means[1], means[2] + 1j * means[3], window), window, ends
    first, second, third, fourth = means
    spread = np.maximum(second - first**2, 1e-300)
    deviation = np.sqrt(spread)
    narrow = deviation < NARROW_LAW
    skewness = (third - 3 * first * second + 2 * first**3) / deviation**3
    kurtosis = (fourth - 4 * first * third + 6 * first**2 * second - 3 * first**4) / spread**2 - 3.0
    shift = mean + scale * first - window.offsets
    return Law(shift, scale * deviation, np.where(narrow, 0, skewness), np.where(narrow, 0, kurtosis)), window, ends


def _of_waves(first: Array, second: Array, window: lw.Window) -> Law:
    """Return the law of an angle from E exp(i x) and E exp(2 i x): cumulants of the deviation from the mean direction."""
    direction = np.angle(first)
    turned = second * np.exp(-2j * direction)
    one, two = np.log(np.abs(first)), np.log(np.abs(turned))
    fourth = 2.0 * (two - 4.0 * one)
    spread = np.maximum(-2.0 * one + fourth / 12.0, 1e-300)
    deviation = np.sqrt(spread)
    narrow = deviation < NARROW_LAW
    skewness, kurtosis = -np.angle(turned) / deviation**3, fourth / spread**2
    return Law(wrap(direction - window.points), deviation, np.where(narrow, 0, skewness), np.where(narrow, 0, kurtosis))
