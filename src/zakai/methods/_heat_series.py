"""The kernel of the Kolmogorov equation near its diagonal, for smooth f and h that do not depend on time.

    u_t = G : Hess u / 2 - f . grad u - (div f + V) u,         z = x - y,     V = h'S^-1 h / 2 or 0

    phi(t, x, y) = (2 pi t)^(-n/2) |G|^(-1/2) exp(-z'G^-1 z / (2 t) + a) (1 + A_1 t + ... + A_N t^N)               "sum"
                 = (2 pi t)^(-n/2) |G|^(-1/2) exp(-z'G^-1 z / (2 t) + a + L_1 t + ... + L_N t^N)                    "log"

with the recursion that `zakai.algebra.kolmogorov_series` writes out.  a, A_k and L_k are Taylor polynomials in z at y: they need
the jet of f at y alone.  As z is of the size of sqrt(t), the relative error near the diagonal is of order t^(N+1) if f is known
to degree 2 N or more.  The logarithmic form is positive for every x, y and t; the sum changes sign away from the diagonal, where
exp(a) is large, and must not be composed.

Yau (1993), Theorems 10 to 12 and Corollary 13.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.algebra.yau import eta, observation_energy
from zakai.errors import ConditionError
from zakai.methods._jets import Jet, jets
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import log_determinant

REACH = 7.0  # standard deviations of the Gaussian beyond which the kernel is zero: a Taylor polynomial may be anything there
FORMS = ("log", "sum")
Array = np.ndarray


@dataclass(frozen=True, eq=False)
class HeatSeries:
    """The series at the points `y` (count, n): a, A_1, ... and L_1, ... as Taylor polynomials in z; `covariance` is G.

    `rest` is what the next A would be the radial integral of.
    """

    y: Array
    covariance: Array
    exponent: Jet
    coefficients: tuple[Jet, ...]
    logarithms: tuple[Jet, ...]
    rest: Jet

    def kernel(self, x: Array, t: float, form: str = "log", order: int | None = None) -> Array:
        """Return phi(t, x, y), (..., count), for x (..., n)."""
        return self.offset(x[..., None, :] - self.y, t, form, order)

    def offset(self, z: Array, t: float, form: str = "log", order: int | None = None) -> Array:
        """Return phi(t, y + z, y) for z (..., count, n)."""
        powers = self.exponent.monomials.values(z)
        logs = self._log_gaussian(z, t) + self._sum(powers, self.exponent.coefficients)
        values = self._sum(powers, self._polynomial(t, form, order))
        return np.asarray(np.exp(logs + values) if form == "log" else np.exp(logs) * (1.0 + values))

    def banded(self, spacing: float, t: float, form: str = "log") -> Array:
        """Return spacing * phi(t, y + d spacing, y), (2 b + 1, count), for d = -b, ..., b within `REACH`; one state.

        `t` is positive; where a polynomial overflows the values are not finite.
        """
        variance = self.covariance[0, 0] * t
        reach = int(np.ceil(REACH * np.sqrt(variance.real) / spacing))
        z = spacing * np.arange(-reach, reach + 1)[:, None]
        a, values = self.exponent.coefficients, self._polynomial(t, form, None)
        with np.errstate(over="ignore", invalid="ignore"):
            exponent = _horner(a + values if form == "log" else a, z) - z**2 / (2 * variance)
            kernel = spacing / np.sqrt(2 * np.pi * variance) * np.exp(exponent)
            return np.asarray(kernel if form == "log" else kernel * (1 + _horner(values, z)))

    def _polynomial(self, t: float, form: str, order: int | None) -> Array:
        """Return the coefficients of L_1 t + ..., or of A_1 t + ...."""
        series = (self.logarithms if form == "log" else self.coefficients)[:order]
        total = np.zeros(self.exponent.coefficients.shape)
        for k, jet in enumerate(series, 1):
            total = total + jet.coefficients * t**k
        return total

    def _log_gaussian(self, z: Array, t: float) -> Array:
        white = np.sum((z @ np.linalg.inv(self.covariance)) * z, axis=-1)
        return np.asarray(-white / (2 * t) - 0.5 * (z.shape[-1] * np.log(2 * np.pi * t) + log_determinant(self.covariance)))

    @staticmethod
    def _sum(powers: Array, coefficients: Array) -> Array:
        return np.asarray(np.einsum("...yk,ky->...y", powers, coefficients))


def _horner(coefficients: Array, z: Array) -> Array:
    total = coefficients[-1] + np.zeros(np.broadcast_shapes(z.shape, coefficients[-1].shape))
    for row in coefficients[-2::-1]:
        total = total * z + row
    return np.asarray(total)


def heat_series(
    model: Model, y: Array, order: int, *, degree: int | None = None, theta: Any = None, potential: bool = True
) -> HeatSeries:
    """Return the series of a model up to t^`order` at the points `y` (count, n); theta may be complex.

    `degree` is that of the jets of f, by default 2 `order` + 4; those of V are one degree shorter. `potential` says whether
    V = h'S^-1 h / 2 is part of the equation; without it the kernel is the density of the transition.

        >>> model = zakai.Model(state=["x"], drift=["tanh(x)"], observation=["0"])
        >>> heat_series(model, np.zeros((1, 1)), 1).kernel(np.array([0.1]), 0.04)
        array([1.73410437])

    Source: Yau (1993), Theorems 10 and 11.
    """
    theta = model.theta() if theta is None else theta
    degree = 2 * order + 4 if degree is None else degree
    energy = observation_energy(model) / 2 if potential else 0
    *f, V = jets([*model.drift, energy], model, y, degree + 1, theta)
    return series(y, _covariance(model, theta), f, V, order, degree)


def _covariance(model: Model, theta: Any) -> Array:
    return numpy_function(model.covariance, model, (model.n, model.n))(np.zeros(model.n), model.start, theta)


def series(y: Array, G: Array, f: list[Jet], V: Jet, order: int, degree: int) -> HeatSeries:
    """Return the series from jets that hold monomials up to `degree` + 1 of f and V, correct up to `degree` or more."""
    n, precision, states = len(f), np.linalg.inv(G), range(len(f))
    unit = f[0] * 0.0
    places = [unit.monomials.place[tuple(row)] for row in np.eye(n, dtype=int)]
    z = [Jet(unit.coefficients + np.eye(len(unit.monomials.powers), 1, -place), unit.monomials) for place in places]
    a = sum((z[i] * f[j] * precision[i, j] for i in states for j in states), unit).radial(0)
    slope = [a.derivative(i) for i in states]
    transport = [(sum((slope[j] * G[i, j] for j in states), unit) - f[i]).truncated(degree) for i in states]

    def laplacian(p: Jet) -> Jet:
        return sum((p.derivative(i).derivative(j) * G[i, j] for i in states for j in states), unit)

    def moved(p: Jet) -> Jet:
        """G : Hess p / 2 + (G grad a - f) . grad p."""
        return laplacian(p) * 0.5 + sum((transport[i] * p.derivative(i) for i in states), unit)

    def weighted(p: Jet, q: Jet) -> Jet:
        """grad p'G grad q."""
        return sum((p.derivative(i) * q.derivative(j) * G[i, j] for i in states for j in states), unit)

    divergence = sum((f[i].derivative(i) for i in states), unit)
    W = (moved(a) - weighted(a, a) * 0.5 - divergence - V).truncated(degree - 1)
    coefficients: list[Jet] = [unit + 1.0]
    logarithms: list[Jet] = []
    for k in range(1, order + 2):
        # A Laplacian takes two degrees.
        known = degree + 1 - 2 * k
        last = (W * coefficients[-1] + moved(coefficients[-1])).truncated(known)
        if k > order:
            break
        coefficients.append(last.radial(k))
        rate = W if k == 1 else moved(logarithms[-1])
        rate = rate + sum((weighted(logarithms[i - 1], logarithms[k - 2 - i]) for i in range(1, k - 1)), unit) * 0.5
        logarithms.append(rate.truncated(known).radial(k))
    return HeatSeries(y, G, a, tuple(coefficients[1:]), tuple(logarithms), last)


def transition(
    heat: HeatSeries, spacing: float, t: float, *, substeps: int = 1, form: str = "log", order: int | None = None
) -> Array:
    """Return the matrix P (M, M) that carries the values of a density on the grid y (M, 1) of `heat` over a time t.

    The kernel of t / `substeps`, zero where |z| exceeds `REACH` of its standard deviations, times the spacing, to the power
    `substeps` (Theorem 12, in which K - 1 integrals and not K join K kernels).
    """
    part, z = t / substeps, heat.y[:, None] - heat.y
    near = np.abs(z[..., 0]) <= REACH * np.sqrt(heat.covariance[0, 0].real * part)
    # Far from the diagonal a polynomial may overflow; those values are not used.
    with np.errstate(over="ignore", invalid="ignore"):
        values = np.where(near, heat.offset(np.where(near[..., None], z, 0.0), part, form, order), 0.0)
        return np.linalg.matrix_power(values * spacing, substeps)


def parametrix(
    model: Model, x: Array, t: float, order: int, terms: int, *, nodes: int = 10, degree: int | None = None
) -> list[Array]:
    """Return the convergent series of Corollary 13 on a grid x (M,), for one state, cut after each of its first `terms` terms.

        phi = phi_N - phi_N * e_N + phi_N * e_N * e_N - ...,      e_N = (d/dt - L) phi_N,
        (p * q)(t, x, y) = int_0^t int p(t - s, x, r) q(s, r, y) dr ds

    in the gauge u = exp(F) v with G F' = f, in which v_t = G v'' / 2 - eta v / 2 and no exponent grows; phi_N is the sum up to
    t^N.  The kernel of u is exp(F(x) - F(y)) times that.  Time integrals have `nodes` Gauss nodes, space integrals are sums over
    the grid.  e_N is exact if eta is a polynomial whose degree, times N + 1, is at most `degree` - 2 N - 1; by default
    `degree` is 8 (N + 1).  The cost grows with nodes^terms: this verifies, it does not filter.

    Returns `terms` + 1 arrays (M, M), phi_N and the sums after 1, 2, ... terms. Raises ConditionError for more than one state.

    Source: Yau (1993), Theorem 12 and Corollary 13.
    """
    potential = eta(model)
    if model.n > 1 or potential is None:
        raise ConditionError(f"{model.source}: the series of Corollary 13 is for one state and positive G")
    y, theta = np.asarray(x, float)[:, None], model.theta()
    degree = 8 * (order + 1) if degree is None else degree
    zero, V = jets([0 * model.x[0], potential / 2], model, y, degree + 1, theta)
    heat, spacing = series(y, _covariance(model, theta), [zero], V, order, degree), x[1] - x[0]
    z = y[:, None] - y
    powers = heat.exponent.monomials.values(z)
    sums = [heat._sum(powers, jet.coefficients) for jet in (*heat.coefficients, heat.rest)]
    points, weights = np.polynomial.legendre.leggauss(nodes)
    points, weights = 0.5 * (points + 1.0), 0.5 * weights * spacing

    def main(t: float) -> Array:
        return np.asarray(np.exp(heat._log_gaussian(z, t)) * (1.0 + sum(p * t**k for k, p in enumerate(sums[:-1], 1))))

    def residual(t: float) -> Array:
        return np.asarray(-np.exp(heat._log_gaussian(z, t)) * t**order * sums[-1])

    def term(m: int, t: float) -> Array:
        """Return phi_N * e_N * ... * e_N with m factors e_N."""
        if m == 0:
            return main(t)
        parts = (w * (term(m - 1, t * (1.0 - s)) @ residual(t * s)) for s, w in zip(points, weights, strict=True))
        return np.asarray(t * sum(parts, start=np.zeros(())))

    found = [term(0, t)]
    for m in range(1, terms + 1):
        found.append(found[-1] + (-1) ** m * term(m, t))
    return found
