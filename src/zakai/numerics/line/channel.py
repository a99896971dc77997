"""The transition of a linear-quadratic equation of one state, as a Gaussian kernel for any interval.

The equation, with every coefficient a function of time,

    v_t = G v'' / 2 - (L x + l) v' + (Q x^2 + p x + r) v,

takes the unit mass at y to exp(k0 + k1 y + k2 y^2) N(. ; a y + b, V).  For a short step the six numbers follow from the affine
Hamiltonian flow

    d/dt [xi; eta] = [[L, -2 G], [Q, -L]] [xi; eta] + [l; p / 2],

and kernels of consecutive steps are composed in closed form, which neither overflows nor cancels for Q <= 0.

The forcing may depend on inputs e = (1, e_1, ...): l, p and r then have an entry for each, b and k1 are linear in e, and k0 is
a quadratic form.  Rates of observation enter in this way after the kernels have been computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.line.collocation import NODES, STAGES, Channels, collocated
from zakai.numerics.transition import Coefficients

Array = NDArray[Any]

_LONGEST = 0.5  # norm of the Hamiltonian times the length of a step
_MOST = 1024  # steps of one interval that are computed together
_MOST_POWER = 20  # of two: steps of one interval
_PROBES = 65  # times of an interval at which coefficients are compared with their interpolants, at least
_RESOLVED = 1e-11


class Channel(NamedTuple):
    """One of them for given inputs: numbers."""

    scale: Any
    shift: Any
    variance: Any
    constant: Any
    slope: Any
    curvature: Any


def chosen(channels: Channels, k: int, inputs: Array) -> Channel:
    """Return the kernel of interval k for the inputs (k,)."""
    return Channel(
        channels.scale[k],
        channels.shift[k] @ inputs,
        channels.variance[k],
        inputs @ channels.constant[k] @ inputs,
        channels.slope[k] @ inputs,
        channels.curvature[k],
    )


def around(channel: Channel, origin: float) -> Channel:
    """Return the kernel for x and y relative to `origin`."""
    return channel._replace(
        shift=channel.shift + (channel.scale - 1.0) * origin,
        constant=channel.constant + (channel.slope + channel.curvature * origin) * origin,
        slope=channel.slope + 2.0 * channel.curvature * origin,
    )


def then(first: Channels, second: Channels) -> Channels:
    """Return the kernels of two consecutive intervals."""
    weigh = 1.0 - 2.0 * second.curvature * first.variance
    curvature, variance = second.curvature[:, None], first.variance[:, None]
    tilt = second.slope + 2.0 * curvature * first.shift
    middle = (first.shift + second.slope * variance) / weigh[:, None]
    exponent = _symmetric(second.slope, first.shift) + variance[:, None] * 0.5 * second.slope[:, :, None] * second.slope[:, None]
    exponent = exponent + curvature[:, None] * first.shift[:, :, None] * first.shift[:, None]
    constant = first.constant + second.constant + exponent / weigh[:, None, None]
    constant[:, 0, 0] -= 0.5 * np.log(weigh)
    return Channels(
        second.scale * first.scale / weigh,
        second.shift + second.scale[:, None] * middle,
        second.variance + second.scale**2 * first.variance / weigh,
        constant,
        first.slope + tilt * (first.scale / weigh)[:, None],
        first.curvature + second.curvature * first.scale**2 / weigh,
    )


def _symmetric(a: Array, b: Array) -> Array:
    outer = a[:, :, None] * b[:, None]
    return np.asarray(0.5 * (outer + np.swapaxes(outer, 1, 2)))


def channels(
    coefficients: Callable[[Array, Array], Coefficients], starts: Array, lengths: Array, steady: bool
) -> tuple[Channels, Array]:
    """Return the kernels of K intervals, and the relative errors (K,) of coefficients that could not be resolved.

    Args:
        coefficients: function of times (...) and of the rows (...) of the intervals that they belong to.
        starts, lengths: (K,), K > 0.
        steady: whether no coefficient depends on time.
    """
    count = len(starts)
    parts: list[Any] = [None] * count
    errors = np.zeros(count)
    waiting = np.arange(count)
    c = coefficients(starts[:, None] + lengths[:, None] * np.linspace(0.0, 1.0, 9), waiting[:, None])
    rate = np.max(np.abs(c.matrix.real) + np.sqrt(2.0 * np.abs(c.covariance.real * c.quadratic.real)), axis=1)
    power = np.maximum(0, np.ceil(np.log2(np.maximum(rate * lengths, 1e-300) / _LONGEST))).astype(int)
    # An interval of so many steps is given up: its error is infinite.
    hopeless = ~(power <= _MOST_POWER) & (not steady)
    power[hopeless] = int(np.log2(_MOST))
    errors[hopeless] = np.inf
    while len(waiting):
        level = int(power[waiting].min())
        rows = waiting[power[waiting] == level]
        if steady:
            c = coefficients(np.broadcast_to(starts[rows, None], (len(rows), STAGES)), rows[:, None])
            found = collocated(c, lengths[rows] * 0.5**level)
            for _ in range(level):
                found = then(found, found)
            good = np.ones(len(rows), bool)
        elif 2**level > _MOST:
            found, errors[rows] = _pieces(coefficients, starts[rows], lengths[rows], rows)
            good = np.ones(len(rows), bool)
        else:
            found, rest = _divided(coefficients, starts[rows], lengths[rows], rows, 2**level)
            good = (rest < _RESOLVED) | (2**level >= _MOST)
            errors[rows] = np.where(hopeless[rows], np.inf, np.where(rest < _RESOLVED, 0.0, rest))
        for i, row in enumerate(rows):
            if good[i]:
                parts[row] = tuple(part[i] for part in found)
        power[rows] += 1
        waiting = np.array([row for row in waiting if parts[row] is None], int)
    return Channels(*(np.array(part) for part in zip(*parts, strict=True))), errors


class Nodes(NamedTuple):
    """Coefficients at eight nodes of K intervals, a bound of their rates (K,), and whether the nodes resolve them (K,)."""

    values: Coefficients
    rate: Array
    resolved: Array

    def part(self, rows: slice) -> Nodes:
        """Return the nodes of some of the intervals."""
        return Nodes(Coefficients(*(value[rows] for value in self.values)), self.rate[rows], self.resolved[rows])


def nodes_of(coefficients: Callable[[Array, Array], Coefficients], starts: Array, lengths: Array) -> Nodes:
    """Return the coefficients of intervals at their nodes."""
    rows = np.arange(len(starts))
    times = starts[:, None] + lengths[:, None] * _CHECKED
    c = coefficients(times, rows[:, None])
    rate = (np.abs(c.matrix.real) + np.sqrt(2.0 * np.abs(c.covariance.real * c.quadratic.real))).max(axis=1)
    resolved = np.ones(len(rows), bool)
    for part in c:
        resolved &= _missed(np.ascontiguousarray(part.real, float).reshape(*times.shape, -1), _TO_PROBES) < _RESOLVED
    return Nodes(Coefficients(*(part[:, :STAGES] for part in c)), rate, resolved)


def parts(
    coefficients: Callable[[Array, Array], Coefficients], starts: Array, lengths: Array, count: int, known: Nodes | None = None
) -> tuple[Channels, Array]:
    """Return the kernels of `count` equal parts of K intervals, (K * count), and the relative errors (K,) of coefficients.

    Where eight nodes resolve the coefficients in the interval these are evaluated once for all parts.
    """
    known = nodes_of(coefficients, starts, lengths) if known is None else known
    nodes, good = known.values, known.resolved & (known.rate * lengths <= _LONGEST * count)
    if count > 1:
        ends = (np.arange(count)[:, None] + NODES).reshape(-1) / count
        matrix = np.polynomial.legendre.legvander(2 * ends - 1, STAGES - 1) @ _FROMNODES
        nodes = Coefficients(
            *(_interpolated(matrix, part).reshape(len(starts) * count, STAGES, *part.shape[2:]) for part in nodes)
        )
    found, errors = collocated(nodes, np.repeat(lengths / count, count)), np.zeros(len(starts))
    if not good.all():
        bad = np.flatnonzero(~good)
        length = lengths[bad] / count
        begins = (starts[bad, None] + length[:, None] * np.arange(count)).reshape(-1)
        each, own = np.repeat(length, count), np.repeat(bad, count)
        others, rest = channels(lambda times, inner: coefficients(times, own[inner]), begins, each, False)
        errors[bad] = rest.reshape(len(bad), count).sum(axis=1)
        place = (bad[:, None] * count + np.arange(count)).reshape(-1)
        for mine, other in zip(found, others, strict=True):
            mine[place] = other
    return found, errors


_FROMNODES = np.linalg.inv(np.polynomial.legendre.legvander(2 * NODES - 1, STAGES - 1))
_AT = np.linspace(0.0, 1.0, _PROBES)
_CHECKED = np.concatenate([NODES, _AT])
_TO_PROBES = np.polynomial.legendre.legvander(2 * _AT - 1, STAGES - 1) @ _FROMNODES


@kernel(float64[::1](float64[:, :, ::1], float64[:, ::1]))
def _missed(values: Array, matrix: Array) -> Array:
    """Return by how much (K,) the values at the last times differ from the interpolants of those at the first, relatively."""
    nodes = matrix.shape[1]
    worst = np.zeros(values.shape[0])
    for k in range(values.shape[0]):
        for e in range(values.shape[2]):
            scale, low, high, apart = 1e-300, values[k, 0, e], values[k, 0, e], 0.0
            for i in range(values.shape[1]):
                low, high = min(low, values[k, i, e]), max(high, values[k, i, e])
            if low == high:
                continue
            scale = max(scale, abs(low), abs(high))
            for i in range(matrix.shape[0]):
                total = 0.0
                for j in range(nodes):
                    total += matrix[i, j] * values[k, j, e]
                apart = max(apart, abs(total - values[k, nodes + i, e]))
            worst[k] = max(worst[k], apart / scale) if high - low < np.inf else np.inf
    return worst


def _interpolated(matrix: Array, values: Array) -> Array:
    """Return the interpolants at the rows of the matrix, in one order for any number of intervals; constants are kept exactly."""
    first = values[:, :1]
    total = np.repeat(first, len(matrix), axis=1)
    if (values == first).all():
        return total
    shape = (1, len(matrix)) + (1,) * (values.ndim - 2)
    for j in range(1, values.shape[1]):
        total += matrix[:, j].reshape(shape) * (values[:, j : j + 1] - first)
    return total


def _pieces(
    coefficients: Callable[[Array, Array], Coefficients], starts: Array, lengths: Array, rows: Array
) -> tuple[Channels, Array]:
    """Intervals of very many steps, one after another."""
    middle = 0.5 * lengths

    def half(begin: Array) -> tuple[Channels, Array]:
        return channels(lambda times, inner: coefficients(times, rows[inner]), begin, middle, False)

    (first, one), (second, two) = half(starts), half(starts + middle)
    return then(first, second), one + two


def _divided(
    coefficients: Callable[[Array, Array], Coefficients], starts: Array, lengths: Array, rows: Array, count: int
) -> tuple[Channels, Array]:
    """The kernels in `count` (a power of two) equal steps, and how far the coefficients are from their interpolants."""
    length = lengths / count
    begins = (starts[:, None] + lengths[:, None] * (np.arange(count) / count)).reshape(-1)
    each, own = np.repeat(length, count), np.repeat(rows, count)
    c = coefficients(begins[:, None] + each[:, None] * NODES, own[:, None])
    probes = np.linspace(0.0, 1.0, max(_PROBES // count, 9))
    basis = np.polynomial.legendre.legvander(2 * NODES - 1, STAGES - 1)
    to_probes = np.polynomial.legendre.legvander(2 * probes - 1, STAGES - 1) @ np.linalg.inv(basis)
    true = coefficients(begins[:, None] + each[:, None] * probes, own[:, None])
    rest = np.zeros(len(rows))
    for values, known in zip(true, c, strict=True):
        values, known = (part.real.reshape(len(each), part.shape[1], -1) for part in (values, known))
        apart = np.abs(to_probes @ known - values).max(axis=1).reshape(len(rows), count, -1).mean(axis=1)
        scale = np.abs(values).max(axis=1).reshape(len(rows), count, -1).max(axis=1)
        rest = np.maximum(rest, (apart / np.maximum(scale, 1e-300)).max(axis=1))
    found = collocated(c, each)
    while len(found.scale) > len(rows):
        found = then(Channels(*(part[0::2] for part in found)), Channels(*(part[1::2] for part in found)))
    return found, rest
