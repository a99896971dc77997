"""The transitions of the equation of a Yau system by the power series of Chen, Luo and Yau (2017), Theorem 3.

With M = (I - 2 t A)^-1 and N = I + t B of the `Series` the kernel in z takes the unit mass at y to

    exp(-y'Omega_z y / 2 + (E + Psi'D).y + s + D'Gamma D / 2 + log det(M) / 2) N(z; Psi y + Gamma D, Gamma),
    Psi = M N,   Gamma = t M,   Omega_z = -2 C - B - B' - t B'B - 2 N'A M N,

in which nothing of the size of 1 / t cancels.  Intervals on which the series does not converge are divided.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy as sp

from zakai.errors import ConditionError
from zakai.methods.system.jets import Expansion
from zakai.methods.yau.power import Schroedinger, Series, power_series, schroedinger, taylor_data
from zakai.models.model import Model
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.flow import FlowResult
from zakai.numerics.series.power_series import apply, dot, value
from zakai.numerics.transition import Array, Transition, at, compose, identity, symmetric, transposed

TOLERANCE = 1e-13  # remainder above which an interval is divided
TERMS = 20  # of a series
MOST_PARTS = 1024  # of one interval
PROBES = 128  # times of an interval at which the Taylor polynomials are compared with the coefficients
RESOLVED = 1e-10  # difference at these times above which an interval is divided
BLOCK = 2048  # parts of intervals that are computed together, for memory


class PowerSeries:
    """The equation of a model as Taylor series in time, and its transitions.

    Args:
        model: the Yau system.
        blocks: the entries of L, l, G and of Q, p, r of the potential x'Q x + p.x + r without and with -h'S^-1 h / 2.
    """

    def __init__(self, model: Model, blocks: Sequence[sp.Expr]):
        self.n = model.n
        self.steady = not any(sp.sympify(entry, strict=True).has(model.t) for entry in blocks)
        own = 2 * model.n**2 + model.n
        size = (len(blocks) - own) // 2
        self._expansions = [
            Expansion([*blocks[:own], *blocks[own + i * size : own + (i + 1) * size]], model.t, model.parameter_symbols)
            for i in range(2)
        ]

    def integrate(self, starts: Array, lengths: Array, theta: Array, origin: Array, full: bool) -> FlowResult:
        """Return the transitions without inputs, and their errors; each depends on its own interval alone, to the last bit.

        Args:
            starts: start times (K,) of the intervals.
            lengths: lengths (K,) of the intervals.
            theta: parameters (p,), may be complex.
            origin: point (n,) to which x is relative.
            full: whether -h'S^-1 h / 2 is in the potential.

        Raises:
            ConditionError: G is singular or a coefficient not analytic at the start of a part of an interval, or the series does
                not converge on the shortest parts.
        """
        starts, lengths = np.asarray(starts, float), np.asarray(lengths, float)
        inverse = np.arange(len(lengths))
        if self.steady:
            lengths, inverse = np.unique(lengths, return_inverse=True)
            starts = np.zeros(len(lengths))
        whole = Transition(*(field.astype(theta.dtype) for field in identity(self.n, 1, len(lengths))))
        error = np.zeros(len(lengths))
        pending, parts = np.flatnonzero(lengths > 0), 1
        while len(pending):
            again = []
            size = max(1, BLOCK // (1 if self.steady else parts))
            for first in range(0, len(pending), size):
                rows = pending[first : first + size]
                found, errors = self._divided(starts[rows], lengths[rows], theta, origin, full, parts)
                good = errors <= TOLERANCE * parts
                if parts >= MOST_PARTS and not good.all():
                    raise ConditionError(
                        f"the power series leaves a remainder of {errors.max():.1e} on {parts} parts of an interval of length "
                        f'{lengths[rows[~good][0]]:g}; use kernel="flow"'
                    )
                for field, part in zip(whole, found, strict=True):
                    field[rows[good]] = part[good]
                error[rows[good]] = errors[good]
                again.append(rows[~good])
            pending, parts = np.concatenate(again), 2 * parts
        return FlowResult(at(whole, inverse), error[inverse])

    def _divided(
        self, starts: Array, lengths: Array, theta: Array, origin: Array, full: bool, parts: int
    ) -> tuple[Transition, Array]:
        """Return the transitions over intervals in `parts` equal parts, and their errors."""
        shares = np.zeros(1) if self.steady else np.arange(parts) / parts
        begins = (starts[:, None] + lengths[:, None] * shares).ravel()
        widths = np.repeat(lengths / parts, len(shares))
        expansion = self._expansions[full]
        taylor = expansion.taylor(begins, TERMS, theta)
        with np.errstate(all="ignore"):
            z = schroedinger(taylor_data(taylor, origin))
            series = power_series(z, widths, len(shares))
            found = transition_of(z, series, widths)
            mismatch = 0.0 * widths
            if not self.steady:
                mismatch = _mismatch(expansion, taylor, z.B[0].real, begins, widths, theta.real, origin, parts)
        errors = np.where(np.isfinite(series.remainder), series.remainder, np.inf)
        errors = np.where(mismatch > RESOLVED, np.maximum(errors, mismatch), errors).reshape(len(starts), -1)
        # The most that any part leaves, in each of them.
        error = errors.max(axis=1) * parts
        for _ in range(parts.bit_length() - 1):
            first, second = (found, found) if self.steady else (at(found, slice(0, None, 2)), at(found, slice(1, None, 2)))
            found = compose(first, second)
        return found, error


def _mismatch(
    expansion: Expansion, taylor: Array, B: Array, begins: Array, widths: Array, theta: Array, origin: Array, parts: int
) -> Array:
    """Return how far the Taylor polynomials of parts are from the coefficients, in units of the interval and of G = (B'B)^-1.

    A pulse that is flat at the start of a part does not appear in the series there.
    """
    count = max(PROBES // parts, 8)
    shares = (np.arange(count) + 0.7 + 0.25 * np.sin(7.0 * np.arange(count))) / count
    times = begins[:, None] + widths[:, None] * shares
    values = expansion.values(times, theta)
    difference = value(taylor.real[:, :, None], widths[:, None] * shares) - values
    # Neither the time nor a value is known better than to its rounding.
    steps = np.abs(np.diff(values, axis=1)).max(axis=1, keepdims=True) * (count / widths[:, None, None])
    noise = 8.0 * np.finfo(float).eps * (np.abs(times[:, :, None]) * steps + np.abs(values))
    difference = np.sign(difference) * np.maximum(np.abs(difference) - noise, 0.0)
    F, B, T = np.linalg.inv(B)[:, None], B[:, None], parts * widths[:, None]

    def sizes(entries: Array) -> Array:
        """Return the size of the terms in x'.x, in x and in 1, (3, J)."""
        G, L, l, Q, p, r = taylor_data(entries, origin)
        square, vector = T[..., None, None], T[..., None]
        squares = [B @ G @ transposed(B), square * (B @ L @ F), square**2 * (transposed(F) @ Q @ F)]
        groups = [squares, [np.sqrt(vector) * apply(B, l), vector**1.5 * apply(transposed(F), p)], [T * r]]
        return np.stack([np.max([np.abs(one).reshape(len(B), -1).max(axis=1) for one in group], axis=0) for group in groups])

    scales = np.maximum(sizes(values).reshape(3, -1, parts).max(axis=2), 1.0).repeat(parts, axis=1)
    found = (sizes(difference) / scales).max(axis=0)
    return np.where(np.isfinite(found), found, np.inf)


def transition_of(z: Schroedinger, series: Series, delta: Array) -> Transition:
    """Return the transition in x of a kernel in z, for intervals of the lengths `delta` (K,)."""
    A, B, C, D, E, s, _ = series
    one, t = np.eye(A.shape[-1]), delta[:, None, None]
    M = symmetric(np.linalg.inv(one - 2.0 * t * A))
    N = one + t * B
    map_, noise = M @ N, t * M
    information = -2.0 * C - B - transposed(B) - t * (transposed(B) @ B) - 2.0 * (transposed(N) @ (A @ map_))
    shift = apply(noise, D)
    constant = s + 0.5 * dot(D, shift) + 0.5 * log_determinant(M)
    start, end, b = z.B[0], value(z.B, delta), value(z.b, delta)
    F = np.linalg.inv(end)
    in_x = Transition(
        F @ map_ @ start,
        apply(F, shift - b)[..., None],
        symmetric(F @ noise @ transposed(F)),
        symmetric(transposed(start) @ information @ start + z.Omega[0]),
        apply(transposed(start), E + apply(transposed(map_), D))[..., None],
        (constant + log_determinant(start) - log_determinant(end))[..., None, None],
    )
    gauge = identity(len(one), 1, len(delta))
    return compose(in_x, gauge._replace(information=-value(z.Omega, delta)))
