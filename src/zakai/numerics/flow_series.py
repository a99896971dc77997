"""Transitions of short panels, on which the coefficients are polynomials in time, as power series about the middle.

The characteristics of `zakai.numerics.transition` are a linear system whose generator is sum_j A_j tau^j, tau in [-1, 1]:

    (i + 1) Y_{i+1} = sum_j A_j Y_{i-j},     P = Y(1) Y(-1)^-1,

where the inverse is a transpose, since the system is Hamiltonian.  The number of terms is known beforehand from a bound that does
not depend on the units of the coordinates.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from zakai.numerics.complex_step import log_determinant
from zakai.numerics.transition import Array, Transition, symmetric, transposed

STAGES = 8  # Gauss nodes of a panel: the coefficients are polynomials of degree 7 on it
MOST_TERMS = 32  # of the power series of a panel
_LEAST_RATE = 0.05  # so that the variation of the coefficients counts however short a panel is
_NEGLIGIBLE = 2e-14  # share of a power of tau in the coefficients
_LOG_NEGLIGIBLE_TERM = np.log(1e-16)
_RADII = 2.0 ** np.arange(-2.0, 11.0)  # of the circles on which the terms of a series are bounded
_ORDERS = np.arange(MOST_TERMS + 1)
_EXPONENTS = _ORDERS[:, None] * np.log(_RADII)
_CIRCLES = np.stack([_RADII ** (j + 1) / (j + 1) for j in range(STAGES)])


class Coefficients(NamedTuple):
    """The coefficients of equation (1) at J times, for n states and k inputs.

    `matrix` L (J, n, n), `offset` l (J, n, k), `covariance` G (J, n, n), `quadratic` Q (J, n, n), `linear` p (J, n, k),
    `constant` r (J, k).
    """

    matrix: Array
    offset: Array
    covariance: Array
    quadratic: Array
    linear: Array
    constant: Array


def _gauss(stages: int) -> tuple[Array, Array, Array]:
    """Return Gauss' nodes and weights on [-1, 1] and the matrix from values at the nodes to the coefficients of 1, tau, ..."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    legendre = np.polynomial.legendre.legvander(nodes, stages - 1)
    to_legendre = (legendre * weights[:, None]).T * (np.arange(stages) + 0.5)[:, None]
    to_powers = np.zeros((stages, stages))
    for degree in range(stages):
        to_powers[: degree + 1, degree] = np.polynomial.legendre.leg2poly(np.eye(stages)[degree])
    return nodes, weights, to_powers @ to_legendre


NODES, WEIGHTS, _TO_POWERS = _gauss(STAGES)


class Series(NamedTuple):
    """Of J panels: the coefficients of the generators (J, STAGES, 2n + k, 2n) and the forcings (J, STAGES, 2n, k)
    in powers of tau in [-1, 1], times half the length, the integrals (J, k) of r and (J,) of tr L / 2, and the numbers (J,) of
    terms and of powers that are needed."""

    generators: Array
    forcings: Array
    growth: Array
    trace: Array
    terms: Array
    powers: Array


def series_of(c: Coefficients, lengths: Array) -> Series:
    """Return the series of panels of `lengths` (J,) from coefficients at Gauss' nodes (J STAGES, ...) or at one time (J, ...)."""
    count = len(lengths)
    size = len(c.constant) // count if count else 1
    autonomous = size == 1
    weights = np.full(1, 2.0) if autonomous else WEIGHTS
    n, k = c.offset.shape[-2:]
    half = (0.5 * lengths)[:, None, None]
    top = np.concatenate([c.matrix, -2.0 * c.covariance], axis=-1)
    middle = np.concatenate([c.quadratic, -transposed(c.matrix)], axis=-1)
    bottom = np.concatenate([0.5 * transposed(c.linear), -transposed(c.offset)], axis=-1)
    generators = np.concatenate([top, middle, bottom], axis=-2).reshape(count, size, (2 * n + k) * 2 * n)
    forcings = np.concatenate([c.offset, 0.5 * c.linear], axis=-2).reshape(count, size, 2 * n * k)
    growth = half[:, 0] * (weights @ c.constant.reshape(count, size, k))
    traces = np.trace(c.matrix, axis1=-2, axis2=-1).reshape(count, size, 1)
    trace = (0.5 * half[:, 0] * (weights @ traces))[:, 0]
    if not autonomous:
        generators, forcings = _TO_POWERS @ generators, _TO_POWERS @ forcings
    generators = (half * generators).reshape(count, size, 2 * n + k, 2 * n)
    forcings = (half * forcings).reshape(count, size, 2 * n, k)
    return Series(generators, forcings, growth, trace, *_terms(np.abs(generators.real)))


def _terms(sizes: Array) -> tuple[Array, Array]:
    """Return how many terms the power series of panels need, (J,), and how many powers of tau, (J,).

    `sizes` are |A_j| (J, STAGES, 2n + k, 2n).  MOST_TERMS + 1 terms stand for too many.

    The bound does not depend on the units of the coordinates: the trace of a power of a matrix does not.
    """
    count, degrees = sizes.shape[:2]
    with np.errstate(all="ignore"):
        total = sizes[:, 0].copy()
        for degree in range(1, degrees):
            total += sizes[:, degree]
        shares = np.max(np.where(total[:, None] > 0, sizes / total[:, None], 0.0), axis=(2, 3))
        square = total[:, : total.shape[2]]
        power, log_rate = square, np.zeros(count)
        for exponent in (1, 2, 4, 8, 16, 32):
            largest = np.maximum(power.max(axis=(1, 2)), 1e-300)
            log_rate += np.log(largest) / exponent
            power = power / largest[:, None, None]
            if exponent < 32:
                power = power @ power
        rate = np.exp(log_rate + np.log(np.maximum(np.trace(power, axis1=1, axis2=2), 1e-300)) / 32)
        rate = np.where(np.isfinite(rate), np.maximum(rate, _LEAST_RATE), np.inf)
        # Cauchy's bound of the coefficients of exp(rate sum_j shares_j R^(j + 1) / (j + 1)), with Hayman's factor.
        growth = rate[:, None] * (shares @ _CIRCLES[:degrees])
        logs = (growth[:, None, :] - _EXPONENTS).min(axis=2) - 0.5 * np.log(2 * np.pi * np.maximum(_ORDERS, 1))
        needed = np.count_nonzero(~(logs <= _LOG_NEGLIGIBLE_TERM), axis=1)
    patterns, which = square > 0, np.zeros(count, int)
    if count:
        keys = [pattern.tobytes() for pattern in patterns]
        depths = {key: _depth(key, patterns.shape[1]) for key in set(keys)}
        which = np.array([depths[key] for key in keys])
    needed = needed + which
    terms = np.where(needed > MOST_TERMS, MOST_TERMS + 1, 2 * np.ceil(needed / 2)).astype(int)
    degree = degrees - np.argmax((shares > _NEGLIGIBLE)[:, ::-1], axis=1)
    return terms, degree


@lru_cache(maxsize=256)
def _depth(pattern: bytes, size: int) -> int:
    """Return the order at which the last entry of the exponential of a matrix with this pattern appears, at least."""
    linked = np.frombuffer(pattern, bool).reshape(size, size)
    reached, depth = linked, 1
    while True:
        further = reached | ((reached.astype(float) @ linked) > 0)
        if np.array_equal(further, reached):
            break
        reached, depth = further, depth + 1
    # States on no cycle: what passes through all of them in a row has as many factors.
    free = ~np.diagonal(reached)
    passed = linked[np.ix_(free, free)]
    while passed.any():
        passed, depth = (passed.astype(float) @ linked[np.ix_(free, free)]) > 0, depth + 1
    return depth


def solve(series: Series) -> Transition:
    """Return the transitions of panels, from power series about their middle, in groups of equal numbers of terms."""
    n, k = series.forcings.shape[-2] // 2, series.forcings.shape[-1]
    kind = series.generators.dtype
    parts = [np.zeros((len(series.terms), *shape), kind) for shape in ((n, n), (n, k), (n, n), (n, n), (n, k), (k, k))]
    for terms, powers in sorted(set(zip(series.terms.tolist(), series.powers.tolist(), strict=True))):
        rows = np.flatnonzero((series.terms == terms) & (series.powers == powers))
        solved = _solve_group(series.generators[rows, :powers], series.forcings[rows], min(terms, MOST_TERMS))
        found = _transition(*solved, series.growth[rows], series.trace[rows])
        for part, value in zip(parts, found, strict=True):
            part[rows] = value
    return Transition(*parts)


def _solve_group(generators: Array, forcings: Array, terms: int) -> tuple[Array, Array, Array, Array]:
    """Return P (J, 2n, 2n), the response (J, 2n, k) of (xi, eta) to the inputs, and the action's rows (J, k, n) and (J, k, k)."""
    count, degrees, rows, twice = generators.shape
    k = rows - twice
    wide = np.ascontiguousarray(np.moveaxis(generators, 1, 2)).reshape(count, rows, degrees * twice)
    # The orders are stacked from the last to the first, so that those of a convolution are one block.
    stack = np.zeros((count, terms * twice, twice + k), generators.dtype)
    begin = (terms - 1) * twice
    stack[:, begin:, :twice] = np.eye(twice)
    functional: list[Array] = []
    for order in range(1, terms):
        used = min(order, degrees)
        value = wide[:, :, : used * twice] @ stack[:, begin : begin + used * twice]
        if order <= forcings.shape[1]:
            value[:, :twice, twice:] += forcings[:, order - 1]
        value /= order
        begin -= twice
        stack[:, begin : begin + twice] = value[:, :twice]
        functional.append(value[:, twice:])
    orders = stack.reshape(count, terms, twice, twice + k)
    even, odd = _sums(orders[:, ::-1])
    functional_odd = functional[0].copy()
    for later in functional[2::2]:
        functional_odd += later
    forward, back = even + odd, even - odd
    inverse = _symplectic_inverse(back[:, :, :twice])
    whole = forward[:, :, :twice] @ inverse
    rows_of_action = 2.0 * functional_odd
    action = rows_of_action[:, :, :twice] @ inverse
    response = forward[:, :, twice:] - whole @ back[:, :, twice:]
    action_inputs = rows_of_action[:, :, twice:] - action @ back[:, :, twice:]
    return whole, response, action[:, :, : twice // 2], action_inputs


def _sums(orders: Array) -> tuple[Array, Array]:
    """Return the sums of the even and of the odd orders (J, terms, ...), from the last to the first."""
    terms = orders.shape[1]
    sums = []
    for parity in (0, 1):
        last = terms - 1 if (terms - 1) % 2 == parity else terms - 2
        total = orders[:, last].copy()
        for order in range(last - 2, -1, -2):
            total += orders[:, order]
        sums.append(total)
    return sums[0], sums[1]


def _symplectic_inverse(matrices: Array) -> Array:
    n = matrices.shape[-1] // 2
    a, b, c, d = matrices[:, :n, :n], matrices[:, :n, n:], matrices[:, n:, :n], matrices[:, n:, n:]
    top = np.concatenate([transposed(d), -transposed(b)], axis=-1)
    return np.concatenate([top, np.concatenate([-transposed(c), transposed(a)], axis=-1)], axis=-2)


def _transition(whole: Array, response: Array, action: Array, action_inputs: Array, growth: Array, trace: Array) -> Transition:
    """Return equation (2) from the characteristics."""
    n = whole.shape[-1] // 2
    inverse = np.linalg.inv(whole[:, n:, n:])
    noise = symmetric(-0.5 * whole[:, :n, n:] @ inverse)
    shift, push = response[:, :n], response[:, n:]
    offset = shift + 2.0 * noise @ push
    constant = symmetric(transposed(push) @ offset + action_inputs)
    constant[:, 0] += 0.5 * growth
    constant[:, :, 0] += 0.5 * growth
    constant[:, 0, 0] += trace + 0.5 * log_determinant(inverse)
    return Transition(
        transposed(inverse), offset, noise, symmetric(-2.0 * inverse @ whole[:, n:, :n]), 2.0 * inverse @ push, constant
    )
