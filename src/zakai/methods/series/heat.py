"""The kernel of the Kolmogorov equation near its diagonal, for one state and smooth f and h that do not depend on time.

    u_t = G u'' / 2 - f u' - (f' + V) u,         z = x - y,     V = h'S^-1 h / 2 or 0

    phi(t, x, y) = (2 pi G t)^(-1/2) exp(-z^2 / (2 G t) + a) (1 + A_1 t + ... + A_N t^N)               "sum"
                 = (2 pi G t)^(-1/2) exp(-z^2 / (2 G t) + a + L_1 t + ... + L_N t^N)                    "log"

with the recursion that `zakai.algebra.kolmogorov_series` writes out.  In one state G a' = f, and with W = -f'/2 - f^2/(2 G) - V

    (z d/dz + k) A_k = W A_(k-1) + G A_(k-1)'' / 2,
    (z d/dz + k) L_k = G L_(k-1)'' / 2 + G sum_i L_i' L_(k-1-i)' / 2,         (z d/dz + 1) L_1 = W.

a, A_k and L_k are Taylor polynomials in z at y: they need the jet of f at y alone.  As z is of the size of sqrt(t), the relative
error near the diagonal is of order t^(N+1) if f is known to degree 2 N or more.  The logarithmic form is positive for every x, y
and t; the sum changes sign away from the diagonal, where exp(a) is large, and must not be composed.

Yau (1993), Theorems 10 to 12 and Corollary 13.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zakai.algebra.yau import observation_energy
from zakai.methods.system.jets import jets
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.series.power_series import cauchy, derivative, integral, value

REACH = 7.0  # standard deviations of the Gaussian beyond which the kernel is zero: a Taylor polynomial may be anything there
FORMS = ("log", "sum")
Array = np.ndarray


@dataclass(frozen=True, eq=False)
class HeatSeries:
    """The series at the points `y` (count,): a, A_1, ... and L_1, ... as power series (terms, count) in z; `G` is a number.

    `rest` is W A_N + G A_N'' / 2.
    """

    y: Array
    G: Any
    exponent: Array
    coefficients: tuple[Array, ...]
    logarithms: tuple[Array, ...]
    rest: Array

    def kernel(self, x: Array, t: float, form: str = "log", order: int | None = None) -> Array:
        """Return phi(t, x, y), (..., count), for x (...)."""
        return self.offset(x[..., None] - self.y, t, form, order)

    def offset(self, z: Array, t: float, form: str = "log", order: int | None = None) -> Array:
        """Return phi(t, y + z, y) for z (..., count); where a polynomial overflows the values are not finite."""
        polynomial = np.zeros(self.exponent.shape, self.exponent.dtype)
        for k, terms in enumerate((self.logarithms if form == "log" else self.coefficients)[:order], 1):
            polynomial[: len(terms)] += terms * t**k
        with np.errstate(over="ignore", invalid="ignore"):
            if form == "log":
                return self.gaussian(z, t, self.exponent + polynomial)
            return np.asarray(self.gaussian(z, t, self.exponent) * (1 + value(polynomial, z)))

    def gaussian(self, z: Array, t: float, exponent: Array) -> Array:
        """Return the density N(z; 0, G t) times exp of a series (terms, count) in z."""
        variance = self.G * t
        return np.asarray(np.exp(value(exponent, z) - z**2 / (2 * variance)) / np.sqrt(2 * np.pi * variance))

    def banded(self, spacing: float, t: float, form: str = "log") -> Array:
        """Return spacing * phi(t, y + d spacing, y), (2 b + 1, count), for d = -b, ..., b within `REACH`; t is positive."""
        reach = int(np.ceil(REACH * np.sqrt(self.G.real * t) / spacing))
        return spacing * self.offset(spacing * np.arange(-reach, reach + 1)[:, None], t, form)


def heat_series(
    model: Model, y: Array, order: int, *, degree: int | None = None, theta: Any = None, potential: bool = True
) -> HeatSeries:
    """Return the series of a model of one state up to t^`order` at the points `y` (count,); theta may be complex.

    `degree` is that of the jets of f, by default 2 `order` + 4; those of V are one degree shorter. `potential` says whether
    V = h'S^-1 h / 2 is part of the equation; without it the kernel is the density of the transition.

        >>> model = zakai.Model(state=["x"], drift=["tanh(x)"], observation=["0"])
        >>> heat_series(model, np.zeros(1), 1).kernel(np.array(0.1), 0.04)
        array([1.73410437])

    Source: Yau (1993), Theorems 10 and 11.
    """
    theta = model.theta() if theta is None else theta
    energy = observation_energy(model) / 2 if potential else 0
    f, V = jets([*model.drift, energy], model, y, 2 * order + 4 if degree is None else degree, theta)
    return series(y, covariance_of(model, theta), f, V, order)


def covariance_of(model: Model, theta: Any) -> Any:
    """Return G, a number (1,)."""
    return numpy_function(model.covariance, model)(np.zeros(1), model.start, theta)[0]


def series(y: Array, G: Any, f: Array, V: Array, order: int) -> HeatSeries:
    """Return the series from the power series (terms, count) of f and V."""
    slope = derivative(f)
    W = -0.5 * (slope + cauchy(f, f)[:-1] / G) - V[:-1]

    def radial(p: Array, k: int) -> Array:
        """Return int_0^1 s^(k-1) p(s z) ds."""
        return np.asarray(p / (k + np.arange(len(p)))[:, None])

    def diffused(p: Array) -> Array:
        return np.asarray(0.5 * G * derivative(derivative(p)))

    rest, coefficients, logarithms = W, [radial(W, 1)], [radial(W, 1)]
    for k in range(2, order + 2):
        rest = diffused(coefficients[-1])
        rest = rest + cauchy(W, coefficients[-1])[: len(rest)]
        coefficients.append(radial(rest, k))
        rate, slopes = diffused(logarithms[-1]), [derivative(L) for L in logarithms[:-1]]
        for one, other in zip(slopes, slopes[::-1], strict=True):
            rate = rate + 0.5 * G * cauchy(one, other)[: len(rate)]
        logarithms.append(radial(rate, k))
    return HeatSeries(y, G, integral(f / G), tuple(coefficients[:order]), tuple(logarithms[:order]), rest)
