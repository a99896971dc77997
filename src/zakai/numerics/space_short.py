"""Compiled short substeps in two states on a grid that stays where it is: the splitting of `space_transport`, without its
linearised noise, with everything that depends on the grid and the length prepared once."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.compiled import kernel
from zakai.numerics.space_grid import PAD, Grid, gaussian_response
from zakai.numerics.space_transport import Dynamics, characteristics

Array = NDArray[Any]
PLAIN = 0.1  # largest tau |L| for which the noise is not that of the linearised system


class Tables(NamedTuple):
    """Matrices of half of the diffusion and of the spline's coefficients along both axes, the places and weights of the
    interpolation, the change of volume, and an estimate of the error of the plain splitting."""

    spread0: Array
    spread1: Array
    spline0: Array
    spline1: Array
    base: Array
    weights0: Array
    weights1: Array
    volume: Array
    closed0: bool
    closed1: bool
    error: float


def circulant(variance: float, size: int, spline: bool) -> Array:
    """Return the matrix of spreading by a variance in index units, or of the coefficients of a spline."""
    line = np.fft.irfft(gaussian_response(np.array([[variance]]), (size,), spline), size)
    return np.asarray(line[(np.arange(size)[:, None] - np.arange(size)) % size])


def bspline(t: Array) -> Array:
    """Return the weights (J, 6) of quintic B-splines at shares t (J,)."""
    s = 1.0 - t
    columns = [
        s**5 / 120,
        (26 + t * (-50 + t * (20 + t * (20 + t * (-20 + 5 * t))))) / 120,
        (66 + t**2 * (-60 + t**2 * (30 - 10 * t))) / 120,
        (66 + s**2 * (-60 + s**2 * (30 - 10 * s))) / 120,
        (26 + s * (-50 + s * (20 + s * (20 + s * (-20 + 5 * s))))) / 120,
        t**5 / 120,
    ]
    return np.ascontiguousarray(np.stack(columns, axis=1))


def tables(dynamics: Dynamics, grid: Grid, tau: float, periodic: tuple[bool, ...]) -> Tables | None:
    """Return the tables of a grid with aligned axes, or None where the plain splitting would not do."""
    step = np.diagonal(grid.basis)
    if np.any(grid.basis != np.diag(step)):
        return None
    G = dynamics.noise(0.0, tau)[0]
    if G[0, 1] != 0 or G[1, 0] != 0:
        return None
    jacobian = dynamics.jacobian(grid.centre, 0.0)
    rate = tau * np.abs(jacobian * step / step[:, None]).sum(axis=1).max() if np.isfinite(jacobian).all() else np.inf
    if not rate <= PLAIN:
        return None
    moved = characteristics(dynamics, grid, grid, 0.0, tau, 1, periodic)
    variances = 0.5 * tau * np.diagonal(G) / step**2
    matrices = [circulant(float(variances[d]), grid.sizes[d], False) for d in range(2)]
    splines = [circulant(0.0, grid.sizes[d], True) for d in range(2)]
    shares = moved.at.shares
    deviation = np.array(grid.sizes) / 11.0
    error = float(rate**2 / 6 * np.max(2 * variances / deviation**2))
    return Tables(
        matrices[0], matrices[1], splines[0], splines[1], moved.at.base, bspline(shares[:, 0]), bspline(shares[:, 1]),
        np.exp(moved.log_volume), grid.closed[0], grid.closed[1], error,
    )  # fmt: skip


@kernel(
    "float64(float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64, "
    "float64[:, ::1], float64[:, ::1])"
)
def increment_factors(u: Any, h: Any, slopes: Any, precision: Any, dy: Any, G: Any, tau: float, outer: Any, inner: Any) -> float:
    """Write exp((b - top) / 6) and exp((b - top) / 3 - tau g / 144); return top, the largest b where there is mass."""
    rows, columns = u.shape
    m = dy.size
    most = 0.0
    for i in range(rows):
        for j in range(columns):
            most = max(most, u[i, j])
    top = -1e300
    r = np.zeros(m)
    p = np.zeros(m)
    for i in range(rows):
        for j in range(columns):
            k = i * columns + j
            for a in range(m):
                r[a] = dy[a] - 0.5 * tau * h[k, a]
            b = 0.0
            for a in range(m):
                s = 0.0
                for c in range(m):
                    s += precision[a, c] * r[c]
                b += h[k, a] * s
            for a in range(m):
                r[a] = dy[a] - tau * h[k, a]
            for a in range(m):
                s = 0.0
                for c in range(m):
                    s += precision[a, c] * r[c]
                p[a] = s
            g0 = 0.0
            g1 = 0.0
            for a in range(m):
                g0 += slopes[k, a, 0] * p[a]
                g1 += slopes[k, a, 1] * p[a]
            if not math.isfinite(b):
                b = -1e6
            g = g0 * (G[0, 0] * g0 + G[0, 1] * g1) + g1 * (G[1, 0] * g0 + G[1, 1] * g1)
            outer[i, j] = b
            inner[i, j] = tau * g / 144.0 if math.isfinite(g) else 0.0
            if u[i, j] > 1e-14 * most and b > top:
                top = b
    for i in range(rows):
        for j in range(columns):
            b = outer[i, j] - top
            outer[i, j] = math.exp(min(b / 6.0, 30.0))
            inner[i, j] = math.exp(min(b / 3.0 - inner[i, j], 30.0))
    return top


@kernel("void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1])")
def both_axes(a: Any, left: Any, right: Any, work: Any, out: Any) -> None:
    """out = left a right', symmetric matrices."""
    rows, columns = a.shape
    for i in range(rows):
        for j in range(columns):
            work[i, j] = 0.0
        for k in range(rows):
            w = left[i, k]
            for j in range(columns):
                work[i, j] += w * a[k, j]
    for i in range(rows):
        for j in range(columns):
            out[i, j] = 0.0
        for k in range(columns):
            w = work[i, k]
            for j in range(columns):
                out[i, j] += w * right[k, j]


@kernel(
    "void(float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], int64[::1], float64[:, ::1], "
    "float64[:, ::1], float64[::1], boolean, boolean, boolean, float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1])"
)
def short_step(
    u: Any, spread0: Any, spread1: Any, spline0: Any, spline1: Any, base: Any, weights0: Any, weights1: Any, volume: Any,
    closed0: bool, closed1: bool, factors: bool, outer: Any, inner: Any, out: Any, sums: Any,
) -> None:  # fmt: skip
    """Write the density after a substep, and its sums: 1, i, j, i^2, i j, j^2; edges and tails of both axes; the minimum."""
    rows, columns = u.shape
    a = np.empty((rows, columns))
    b = np.empty((rows, columns))
    work = np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            a[i, j] = u[i, j] * outer[i, j] if factors else u[i, j]
    both_axes(a, spread0, spread1, work, b)
    if factors:
        for i in range(rows):
            for j in range(columns):
                b[i, j] *= inner[i, j]
    both_axes(b, spline0, spline1, work, a)
    wide = columns + 2 * PAD
    c = np.zeros((rows + 2 * PAD) * wide)
    for i in range(-PAD, rows + PAD):
        if not closed0 and (i < 0 or i >= rows):
            continue
        for j in range(-PAD, columns + PAD):
            if not closed1 and (j < 0 or j >= columns):
                continue
            c[(i + PAD) * wide + j + PAD] = a[i % rows, j % columns]
    for k in range(base.size):
        total = 0.0
        o = base[k]
        if o >= 0:
            for s in range(6):
                q = o + s * wide
                line = (
                    c[q] * weights1[k, 0] + c[q + 1] * weights1[k, 1] + c[q + 2] * weights1[k, 2]
                    + c[q + 3] * weights1[k, 3] + c[q + 4] * weights1[k, 4] + c[q + 5] * weights1[k, 5]
                )  # fmt: skip
                total += weights0[k, s] * line
            total *= volume[k]
        i = k // columns
        j = k - i * columns
        b[i, j] = total * inner[i, j] if factors else total
    both_axes(b, spread0, spread1, work, a)
    smallest = 0.0
    most = 0.0
    for i in range(rows):
        for j in range(columns):
            x = a[i, j] * outer[i, j] if factors else a[i, j]
            smallest = min(smallest, x)
            most = max(most, x)
            out[i, j] = x
    floor = 1e-40 * most
    for k in range(11):
        sums[k] = 0.0
    marginal0 = np.zeros(rows)
    marginal1 = np.zeros(columns)
    wave0 = np.zeros((3, columns))
    wave1 = np.zeros((3, rows))
    k0 = 2 * math.pi * (rows // 2 - 1) / rows
    k1 = 2 * math.pi * (columns // 2 - 1) / columns
    cosine1 = np.empty(columns)
    sine1 = np.empty(columns)
    for j in range(columns):
        cosine1[j] = math.cos(k1 * j)
        sine1[j] = math.sin(k1 * j)
    for i in range(rows):
        z0 = i - rows // 2
        sign0 = 1.0 - 2.0 * (i % 2)
        cos0 = math.cos(k0 * i)
        sin0 = math.sin(k0 * i)
        line = 0.0
        first = 0.0
        second = 0.0
        w0 = 0.0
        w1 = 0.0
        w2 = 0.0
        for j in range(columns):
            x = out[i, j]
            if x < floor:
                x = 0.0
                out[i, j] = 0.0
            z1 = j - columns // 2
            line += x
            first += x * z1
            second += x * z1 * z1
            w0 += x * (1.0 - 2.0 * (j % 2))
            w1 += x * cosine1[j]
            w2 += x * sine1[j]
            marginal1[j] += x
            wave0[0, j] += sign0 * x
            wave0[1, j] += cos0 * x
            wave0[2, j] += sin0 * x
        marginal0[i] = line
        wave1[0, i] = w0
        wave1[1, i] = w1
        wave1[2, i] = w2
        sums[0] += line
        sums[1] += line * z0
        sums[2] += first
        sums[3] += line * z0 * z0
        sums[4] += first * z0
        sums[5] += second
    for j in range(columns):
        wave0[1, j] = math.sqrt(wave0[1, j] ** 2 + wave0[2, j] ** 2)
    for i in range(rows):
        wave1[1, i] = math.sqrt(wave1[1, i] ** 2 + wave1[2, i] ** 2)
    sums[6] = 0.0 if closed0 else max(max(marginal0[0], marginal0[1]), max(marginal0[-1], marginal0[-2])) / marginal0.max()
    sums[7] = 0.0 if closed1 else max(max(marginal1[0], marginal1[1]), max(marginal1[-1], marginal1[-2])) / marginal1.max()
    sums[8] = max(np.abs(wave0[0]).sum(), wave0[1].sum()) / sums[0]
    sums[9] = max(np.abs(wave1[0]).sum(), wave1[1].sum()) / sums[0]
    sums[10] = smallest / most
