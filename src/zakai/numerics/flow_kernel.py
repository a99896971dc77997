"""Power series of the characteristics over panels, compiled: the inner loop of `zakai.numerics.flow_series`."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.numerics.compiled import helper, kernel
from zakai.numerics.transition import Array

MOST_TERMS = 32  # of the power series of a panel, after all of its entries have appeared
_LARGEST = 8.0  # sum of the sizes of the terms relative to the first, so that little cancels
_NEGLIGIBLE = 2e-15  # share of a Legendre polynomial in a coefficient
_NEGLIGIBLE_TERM = 1e-14  # of the series, of two in a row, relative to the sum of the sizes of those before


@helper
def _powers(values: Array, half: float, to_legendre: Array, to_powers: Array) -> Array:  # pragma: no cover
    """Return the coefficients (D, R) of 1, tau, ... of functions from their values (S, R) at the nodes, times `half`.

    Legendre's polynomials of negligible size are left out at the end: they are found sooner than powers of tau.
    """
    size, count = values.shape
    found = np.zeros((size, count), values.dtype)
    for s in range(size):
        for a in range(size):
            for c in range(count):
                found[s, c] += half * to_legendre[s, a] * values[a, c]
    degree = 1
    for c in range(count):
        most = 0.0
        for s in range(size):
            most = max(most, abs(found[s, c].real))
        for s in range(degree, size):
            if abs(found[s, c].real) > _NEGLIGIBLE * most:
                degree = s + 1
    powers = np.zeros((degree, count), values.dtype)
    for s in range(degree):
        for a in range(degree):
            if to_powers[s, a] != 0.0:
                for c in range(count):
                    powers[s, c] += to_powers[s, a] * found[a, c]
    return powers


@helper
def _ends(powers: Array, twice: int, depth: int, ahead: Array, back: Array) -> bool:  # pragma: no cover
    """Set the solutions at the ends of a panel from the powers (D, rows^2) of its generator; return whether the terms suffice.

    `ahead` and `back` (rows, rows) are [Y r; c s]: the solution, its response to the inputs, and the integrals of the functionals
    of both, which are zero in the middle of the panel.
    """
    degree, rows = len(powers), len(ahead)
    wide = np.empty((rows, degree * twice), powers.dtype)
    for s in range(degree):
        for r in range(rows):
            for c in range(twice):
                wide[r, s * twice + c] = powers[s, r * rows + c]
    # The orders are stacked from the last to the first, so that those of a convolution are one block.
    most = MOST_TERMS + depth
    begin = (most - 1) * twice
    stack = np.zeros((begin + degree * twice, rows), powers.dtype)
    sizes = np.zeros((rows, rows))
    for r in range(rows):
        for c in range(rows):
            ahead[r, c] = back[r, c] = sizes[r, c] = 1.0 if r == c and r < twice else 0.0
    for i in range(twice):
        stack[begin + i, i] = 1.0
    settled = 0
    for order in range(1, most):
        value = np.dot(wide, stack[begin : begin + degree * twice])
        begin -= twice
        if order <= degree:
            for r in range(twice):
                for c in range(twice, rows):
                    value[r, c] += powers[order - 1, r * rows + c]
        large, sign, share = 0, 1.0 - 2.0 * (order % 2), 1.0 / order
        for r in range(rows):
            for c in range(rows):
                part = value[r, c] * share
                term = abs(part.real)
                sizes[r, c] += term
                large += int(term > _NEGLIGIBLE_TERM * sizes[r, c])
                ahead[r, c] += part
                back[r, c] += sign * part
                if r < twice:
                    stack[begin + r, c] = part
        settled = settled + 1 if large == 0 else 0
        if settled == 2 and order > depth:
            break
    # The sizes on the diagonal do not depend on the units of the states.
    for i in range(twice):
        if sizes[i, i] > _LARGEST:
            return False
    return settled >= 2


def _signature(number: str) -> str:
    stack = f"{number}[:, :, ::1]"
    return f"void({stack}, f8[::1], UniTuple(f8[:, ::1], 2), i8, i8[::1], UniTuple({stack}, 2), b1[::1])"


@kernel(_signature("f8"), _signature("c16"))
def panels(
    values: Array, lengths: Array, polynomials: Any, twice: int, depths: Array, solutions: Any, coarse: Array
) -> None:  # pragma: no cover
    """Solve J panels.

    Args:
        values: The generators [A f; c 0] (J, S, (2n + k)^2) at the nodes.
        lengths: The lengths (J,) of the panels.
        polynomials: The matrix (S, S) from values at the nodes to coefficients of Legendre's polynomials, and that from these to
            the coefficients of the powers of tau in [-1, 1].
        twice: 2n.
        depths: The orders (J,) by which every entry of the solution has appeared.
        solutions: The solutions [Y r; c s] (J, 2n + k, 2n + k) at the ends, see `_ends`, and those at the beginnings.
        coarse: Whether the terms of the series do not suffice (J,).
    """
    for j in range(len(values)):
        powers = _powers(values[j], 0.5 * lengths[j], polynomials[0], polynomials[1])
        coarse[j] = not _ends(powers, twice, depths[j], solutions[0][j], solutions[1][j])
