"""Sine and cosine that a compiler can vectorise.

JAX hands them to the C library one number at a time on a processor, ten times slower than its exponential; a filter that
evaluates them on a lattice would spend its time there.  Cody and Waite's (1980) reduction, r = x - k pi/2 with pi/2 in three
parts whose first two have 33 bits, is exact to rounding for |k| < 2^20; Taylor's polynomials on |r| <= pi/4 end below rounding.
Beyond that the result is that of a number within a rounding error of x.
"""

from __future__ import annotations

import math
from typing import Any

from zakai import _float64  # noqa: F401

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip

_PARTS = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)
_SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(1, 9))
_COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(2, 10))


def _reduced(x: Any) -> tuple[Any, Any]:
    """(r, k modulo 4), x = r + k pi / 2."""
    k = jnp.rint(x * (2 / math.pi))
    r = x
    for part in _PARTS:
        r = r - k * part
    # Where x is so large that k has lost its last digits, r stays where the polynomials are bounded.
    return jnp.clip(r, -1.0, 1.0), k - 4.0 * jnp.floor(0.25 * k)


def _horner(coefficients: tuple[float, ...], square: Any) -> Any:
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * square + coefficient
    return value


def _turned(x: Any, quarter: float) -> Any:
    """sin(x + quarter pi / 2)."""
    r, k = _reduced(x)
    square = r * r
    sine = r + r * square * _horner(_SINE, square)
    cosine = 1.0 - 0.5 * square + square * square * _horner(_COSINE, square)
    k = k + quarter
    k = jnp.where(k >= 4.0, k - 4.0, k)
    value = jnp.where((k == 1.0) | (k == 3.0), cosine, sine)
    return jnp.where(k >= 2.0, -value, value)


@jax.custom_jvp
def sin(x: Any) -> Any:
    """sin x, for real x in radians."""
    return _turned(x, 0.0)


@jax.custom_jvp
def cos(x: Any) -> Any:
    """cos x, for real x in radians."""
    return _turned(x, 1.0)


@sin.defjvp
def _sin_jvp(primals: tuple, tangents: tuple) -> tuple:
    return sin(*primals), cos(*primals) * tangents[0]


@cos.defjvp
def _cos_jvp(primals: tuple, tangents: tuple) -> tuple:
    return cos(*primals), -sin(*primals) * tangents[0]
