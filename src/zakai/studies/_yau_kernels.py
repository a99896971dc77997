"""The kernel of Yau (1993) by Theorem 12 and Corollary 13, to compare the series of `kolmogorov-series` with."""

from __future__ import annotations

import numpy as np

from zakai.algebra.yau import eta
from zakai.errors import ConditionError
from zakai.methods.series.heat import REACH, HeatSeries, covariance_of, series
from zakai.methods.system.jets import jets
from zakai.models.model import Model
from zakai.numerics.series.power_series import value

Array = np.ndarray


def transition(
    heat: HeatSeries, spacing: float, t: float, *, substeps: int = 1, form: str = "log", order: int | None = None
) -> Array:
    """Return the matrix P (M, M) that carries the values of a density on the grid y (M,) of `heat` over a time t.

    The kernel of t / `substeps`, zero where |z| exceeds `REACH` of its standard deviations, times the spacing, to the power
    `substeps` (Theorem 12, in which K - 1 integrals and not K join K kernels).
    """
    part, z = t / substeps, heat.y[:, None] - heat.y
    near = np.abs(z) <= REACH * np.sqrt(heat.G.real * part)
    # Far from the diagonal a polynomial may overflow; those values are not used.
    values = np.where(near, heat.offset(np.where(near, z, 0.0), part, form, order), 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
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
    theta = model.theta()
    zero, V = jets([0 * model.x[0], potential / 2], model, x, 8 * (order + 1) if degree is None else degree, theta)
    heat, z = series(x, covariance_of(model, theta), zero, V, order), x[:, None] - x
    *sums, rest = (value(terms_, z) for terms_ in (*heat.coefficients, heat.rest))
    points, weights = np.polynomial.legendre.leggauss(nodes)
    points, weights = 0.5 * (points + 1.0), 0.5 * weights * (x[1] - x[0])

    def main(t: float) -> Array:
        return np.asarray(heat.gaussian(z, t, heat.exponent) * (1.0 + sum(p * t**k for k, p in enumerate(sums, 1))))

    def term(m: int, t: float) -> Array:
        """Return phi_N * e_N * ... * e_N with m factors -e_N."""
        if m == 0:
            return main(t)
        parts = (
            w * (term(m - 1, t * (1.0 - s)) @ (heat.gaussian(z, t * s, heat.exponent) * (t * s) ** order * rest))
            for s, w in zip(points, weights, strict=True)
        )
        return np.asarray(t * sum(parts, start=np.zeros(())))

    found = [term(0, t)]
    for m in range(1, terms + 1):
        found.append(found[-1] + term(m, t))
    return found
