"""Exponentials of the Kolmogorov operator on Gauss-Lobatto panels by rational functions.

    u_t = (G u)'' / 2 - (f u)' + V u,      (G u)' / 2 - f u = 0 at the ends

With u = r v, where v is continuous and the number r of each panel is such that r G is continuous, the weak form with lumped
masses m = M v at the points is m_t = A m,

    A = sum over panels r (D' W (f - D G / 2) + W V) M^-1,      M = sum over panels r W.

The transposed A takes functions of the state backward.  A rational function of A with simple poles is a sum of (A - z)^-1.  The
inner points of each panel are eliminated first (static condensation), for all panels and poles side by side; the rest is a
tridiagonal system for the ends of the panels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import complex128, float64, types

from zakai.numerics.arrays import Array
from zakai.numerics.compiled import kernel
from zakai.numerics.lobatto import Element, rule

BATCH = 24  # systems that are eliminated side by side: they fit into the cache of a core


class Poles(NamedTuple):
    """The poles (K,) of a rational function above the real axis, and their residues."""

    values: Array
    residues: Array


# The best approximation on the negative axis, with an error of 4e-14 (Trefethen, Weideman and Schmelzer 2006).
CONTRACTION = Poles(
    np.array([
        5.62317153474907 + 1.1940664287035054j, 5.089374564868055 + 3.5888160956106345j, 3.993400429645279 + 6.004818060147936j,
        2.269816525848304 + 8.461717806887696j, -0.20872377765454347 + 10.991232026342253j,
        -3.7032391601860652 + 13.656333463723643j, -8.897735413193399 + 16.63093520843589j,
    ]),
    np.array([
        -27.876162290790504 - 102.15000629233164j, 46.93490458646216 + 45.64454383897618j,
        -23.498979418912768 - 5.808219208520475j, 4.807233308888861 - 1.3211122031058917j,
        -0.37636336735203735 + 0.33520468313172247j, 0.009438720569245423 - 0.01718573631108834j,
        -7.153878175282853e-05 + 0.00014361901758410176j,
    ]),
)  # fmt: skip


class Collocation(NamedTuple):
    """Radau IIA collocation of order 11 (Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.5).

    Its six `nodes` in [0, 1] end with one, `integrals` (6, 6) are the Runge-Kutta matrix.  The eigenvalues of that above the real
    axis are one over the `poles` (3,), with eigenvectors `vectors` (6, 3) and the rows `inverse` (3, 6) of their inverse.
    """

    nodes: Array
    integrals: Array
    poles: Array
    vectors: Array
    inverse: Array


def _collocation(count: int) -> Collocation:
    legendre = np.polynomial.legendre.Legendre
    roots = np.sort((legendre.basis(count) - legendre.basis(count - 1)).roots().real)
    nodes, orders = np.append(0.5 * (roots[:-1] + 1.0), 1.0), np.arange(1, count + 1)
    integrals = (nodes[:, None] ** orders / orders) @ np.linalg.inv(nodes[:, None] ** (orders - 1))
    values, vectors = np.linalg.eig(integrals)
    upper, inverse = values.imag > 0, np.linalg.inv(vectors)
    return Collocation(nodes, integrals, 1.0 / values[upper], vectors[:, upper], inverse[upper])


COLLOCATION = _collocation(6)
ITERATIONS = 24  # of the equations of collocation
ITERATED = 1e-10  # change of an iteration, relative to the maximum, after which it ends
DIVERGED = 10.0  # the same, of one that does not converge


def weak_form(element: Element, covariance: Array, drift: Array, potential: Array, scale: Array) -> Array:
    """Return the parts of A (..., P, n, n) of panels for G, f and V at their points (..., P n), and r (..., P)."""
    own, inner = rule(element.size), np.arange(element.size)
    transport, shape = own.derivative.T * own.weights, (*drift.shape[:-1], len(element.halves), 1, element.size)
    noise = 0.5 * covariance.reshape(shape) / element.halves[:, None, None]
    result = transport * drift.reshape(shape) - (transport @ own.derivative) * noise
    result[..., inner, inner] += (element.weights * potential).reshape(shape)[..., 0, :]
    return result * (scale[..., None, None] / separated(element, masses(element, scale)).reshape(shape))


def masses(element: Element, scale: Array) -> Array:
    """Return M (..., P (n - 1) + 1) for r (..., P)."""
    return joined(element, element.weights * np.repeat(scale, element.size, axis=-1))


def joined(element: Element, values: Array) -> Array:
    """Return the sums (..., P (n - 1) + 1) over panels of values (..., P n) at their points."""
    last, count = element.size - 1, len(element.halves)
    parts = values.reshape(*values.shape[:-1], count, element.size)
    result = np.zeros((*values.shape[:-1], count * last + 1), values.dtype)
    result[..., :-1] = parts[..., :-1].reshape(*values.shape[:-1], -1)
    result[..., last::last] += parts[..., -1]
    return result


def separated(element: Element, values: Array) -> Array:
    """Return values at the points of panels (..., P n) from those of a continuous function (..., P (n - 1) + 1)."""
    count, size = len(element.halves), element.size
    places = (np.arange(count)[:, None] * (size - 1) + np.arange(size)).reshape(-1)
    return np.asarray(values[..., places])


class Factors(NamedTuple):
    """The factors of A - z for each pole.

    `inner` (2, C, n, n, BATCH) are the real and imaginary parts of those of panels, `ends` (K, P + 1, 3) of the ends of panels.
    """

    element: Element
    inner: Array
    ends: Array
    blocks: Array

    @classmethod
    def of(cls, element: Element, blocks: Array, poles: Array) -> Factors:
        """Return the factors for the parts of A (P, n, n) and poles (K,)."""
        return cls(element, *_factors(np.ascontiguousarray(blocks.real), poles), blocks)

    def exponential(self, values: Array) -> Array:
        """Return exp(A) m for m (..., P (n - 1) + 1) and the poles of contraction; complex arguments carry derivatives."""
        x = _solutions(self.inner, self.ends, values.real.reshape(-1, 1, values.shape[-1]).astype(complex))
        result = 2.0 * np.einsum("k,rkj->rj", CONTRACTION.residues, x).real.reshape(values.shape)
        if np.iscomplexobj(self.blocks) or np.iscomplexobj(values):  # of one m
            change = values.imag - applied(self.element, self.blocks.imag, x[0])
            result = result + 2.0j * (CONTRACTION.residues @ _solutions(self.inner, self.ends, change[None])[0]).real
        return np.asarray(result)


def applied(element: Element, blocks: Array, values: Array) -> Array:
    """Return A m for the parts of A (..., P, n, n) of panels and m (..., P (n - 1) + 1)."""
    at = separated(element, values)
    return joined(element, (blocks @ at.reshape(*at.shape[:-1], -1, element.size, 1)).reshape(at.shape))


def collocated(element: Element, blocks: Array, values: Array) -> Array | None:
    """Return m after a step with an A that depends on time, None where the iteration with its mean does not converge.

    Complex arguments carry derivatives.

    Args:
        element: the panels.
        blocks: the parts of A, times the step, at the nodes of `COLLOCATION` (6, P, n, n), or one (1, P, n, n) that holds at all.
        values: m (P (n - 1) + 1,).
    """
    rule, mean = COLLOCATION, np.mean(blocks.real, axis=0)
    factors, changes = Factors.of(element, mean, rule.poles), blocks - mean
    carries = np.iscomplexobj(blocks) or np.iscomplexobj(values)
    begin = np.tile(values, (len(rule.nodes), 1))
    stages, right = begin, begin
    for _ in range(ITERATIONS):
        parts = np.stack([right.real, right.imag]) if carries else right[None]
        solved = _solutions(factors.inner, factors.ends, -rule.poles[:, None] * (rule.inverse @ parts))
        solved = 2.0 * (rule.vectors @ solved).real
        new = solved[0] + 1j * solved[1] if carries else solved[0]
        change = max(_relative((new - stages).real, new.real), _relative((new - stages).imag, new.imag) if carries else 0.0)
        stages = new
        if change < ITERATED or (len(blocks) == 1 and not carries):
            return np.asarray(stages[-1])
        if not change < DIVERGED:
            return None
        right = begin + rule.integrals @ applied(element, changes, stages)
    return None


def _relative(change: Array, values: Array) -> float:
    return float(np.max(np.abs(change)) / max(np.max(np.abs(values)), 1e-300))


_FACTORS = types.Tuple((float64[:, :, :, :, ::1], complex128[:, :, ::1]))  # type: ignore[no-untyped-call]


@kernel(_FACTORS(float64[:, :, ::1], complex128[::1]))
def _factors(blocks: Array, poles: Array) -> tuple[Array, Array]:
    """Return the factors of all panels and poles, whose points are in the order inner ones, first, last; and of the ends."""
    P, n = blocks.shape[:2]
    K, total = poles.size, P * poles.size
    chunks = (total + BATCH - 1) // BATCH
    inner, ends = np.empty((2, chunks, n, n, BATCH)), np.zeros((K, P + 1, 3), np.complex128)
    order = np.empty(n, np.int64)
    for a in range(n):
        order[a] = a + 1 if a < n - 2 else (0 if a == n - 2 else n - 1)
    for k in range(K):
        for q in range(P + 1):
            ends[k, q, 1] = -poles[k]
    for c in range(chunks):
        re, im = inner[0, c], inner[1, c]
        for entry in range(BATCH):
            system = min(c * BATCH + entry, total - 1)
            k, q = system // P, system % P
            for a in range(n):
                for b in range(n):
                    re[a, b, entry], im[a, b, entry] = blocks[q, order[a], order[b]], 0.0
            for a in range(n - 2):
                re[a, a, entry] -= poles[k].real
                im[a, a, entry] = -poles[k].imag
        for k in range(n - 2):
            for entry in range(BATCH):
                inverse = 1.0 / (re[k, k, entry] * re[k, k, entry] + im[k, k, entry] * im[k, k, entry])
                re[k, k, entry], im[k, k, entry] = re[k, k, entry] * inverse, -im[k, k, entry] * inverse
            for i in range(k + 1, n):
                for entry in range(BATCH):
                    real = re[i, k, entry] * re[k, k, entry] - im[i, k, entry] * im[k, k, entry]
                    im[i, k, entry] = re[i, k, entry] * im[k, k, entry] + im[i, k, entry] * re[k, k, entry]
                    re[i, k, entry] = real
                for j in range(k + 1, n):
                    for entry in range(BATCH):
                        re[i, j, entry] -= re[i, k, entry] * re[k, j, entry] - im[i, k, entry] * im[k, j, entry]
                        im[i, j, entry] -= re[i, k, entry] * im[k, j, entry] + im[i, k, entry] * re[k, j, entry]
        for entry in range(min(BATCH, total - c * BATCH)):
            k, q = (c * BATCH + entry) // P, (c * BATCH + entry) % P
            a, b = n - 2, n - 1
            ends[k, q, 1] += complex(re[a, a, entry], im[a, a, entry])
            ends[k, q, 2] += complex(re[a, b, entry], im[a, b, entry])
            ends[k, q + 1, 0] += complex(re[b, a, entry], im[b, a, entry])
            ends[k, q + 1, 1] += complex(re[b, b, entry], im[b, b, entry])
    for k in range(K):
        for q in range(1, P + 1):
            ends[k, q, 0] /= ends[k, q - 1, 1]
            ends[k, q, 1] -= ends[k, q, 0] * ends[k, q - 1, 2]
    return inner, ends


@kernel(complex128[:, :, ::1](float64[:, :, :, :, ::1], complex128[:, :, ::1], complex128[:, :, ::1]))
def _solutions(inner: Array, ends: Array, right: Array) -> Array:
    """Return x (R, K, N) for right-hand sides (R, K, N), or (R, 1, N) of all poles."""
    R, n, (K, P) = right.shape[0], inner.shape[2], (ends.shape[0], ends.shape[1] - 1)
    last, total = n - 1, P * K
    x, y = np.zeros((R, K, P * last + 1), np.complex128), np.empty((2, inner.shape[1], n, BATCH))
    for row in range(R):
        for c in range(inner.shape[1]):
            re, im, yr, yi = inner[0, c], inner[1, c], y[0, c], y[1, c]
            for entry in range(BATCH):
                system = min(c * BATCH + entry, total - 1)
                k, q = system // P, system % P
                own = right[row, min(k, right.shape[1] - 1)]
                for a in range(n - 2):
                    yr[a, entry], yi[a, entry] = own[q * last + a + 1].real, own[q * last + a + 1].imag
                first = own[0] if q == 0 else 0.0j  # the ends of panels count once
                yr[n - 2, entry], yi[n - 2, entry] = first.real, first.imag
                yr[n - 1, entry], yi[n - 1, entry] = own[(q + 1) * last].real, own[(q + 1) * last].imag
            for k in range(n - 2):
                for i in range(k + 1, n):
                    for entry in range(BATCH):
                        yr[i, entry] -= re[i, k, entry] * yr[k, entry] - im[i, k, entry] * yi[k, entry]
                        yi[i, entry] -= re[i, k, entry] * yi[k, entry] + im[i, k, entry] * yr[k, entry]
            for entry in range(min(BATCH, total - c * BATCH)):
                k, q = (c * BATCH + entry) // P, (c * BATCH + entry) % P
                x[row, k, q * last] += complex(yr[n - 2, entry], yi[n - 2, entry])
                x[row, k, (q + 1) * last] += complex(yr[n - 1, entry], yi[n - 1, entry])
        for k in range(K):
            for q in range(1, P + 1):
                x[row, k, q * last] -= ends[k, q, 0] * x[row, k, (q - 1) * last]
            x[row, k, P * last] /= ends[k, P, 1]
            for q in range(P - 1, -1, -1):
                x[row, k, q * last] = (x[row, k, q * last] - ends[k, q, 2] * x[row, k, (q + 1) * last]) / ends[k, q, 1]
        for c in range(inner.shape[1]):
            re, im, yr, yi = inner[0, c], inner[1, c], y[0, c], y[1, c]
            for entry in range(BATCH):
                system = min(c * BATCH + entry, total - 1)
                k, q = system // P, system % P
                left, other = x[row, k, q * last], x[row, k, (q + 1) * last]
                yr[n - 2, entry], yi[n - 2, entry] = left.real, left.imag
                yr[n - 1, entry], yi[n - 1, entry] = other.real, other.imag
            for i in range(n - 3, -1, -1):
                for j in range(i + 1, n):
                    for entry in range(BATCH):
                        yr[i, entry] -= re[i, j, entry] * yr[j, entry] - im[i, j, entry] * yi[j, entry]
                        yi[i, entry] -= re[i, j, entry] * yi[j, entry] + im[i, j, entry] * yr[j, entry]
                for entry in range(BATCH):
                    real = yr[i, entry] * re[i, i, entry] - yi[i, entry] * im[i, i, entry]
                    yi[i, entry] = yr[i, entry] * im[i, i, entry] + yi[i, entry] * re[i, i, entry]
                    yr[i, entry] = real
            for entry in range(min(BATCH, total - c * BATCH)):
                k, q = (c * BATCH + entry) // P, (c * BATCH + entry) % P
                for a in range(n - 2):
                    x[row, k, q * last + a + 1] = complex(yr[a, entry], yi[a, entry])
    return x
