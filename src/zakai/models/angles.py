"""Observed angles: which observations are angles, and the law of a Gaussian or Student's t variable modulo 2 pi.

An angle z with location h has the density  sum over k of p(z - h + 2 pi k)  on (-pi, pi], where p is that of the family.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.densities._values import wrap
from zakai.models.families import Family, Gaussian, StudentT, Symmetric

if TYPE_CHECKING:
    from zakai.models.model import Model

Array = NDArray[Any]
TURN = 2.0 * np.pi
ZERO: Array = np.zeros(())
LINEAR = ("gaussian", "student-t")  # the families that an observed angle wraps
_WIDE = 4.0  # variance from which a Fourier series is shorter than the images
_HARMONICS = 5  # of that series: the next is exp(-36 * 4 / 2)
_REACH = 8.6  # standard deviations beyond which a Gaussian is negligible
_IMAGES = 4  # of Student's law on each side; the rest is their integral, by the midpoint rule with its first correction


def observed_angles(model: Model) -> tuple[bool, ...]:
    """Return for every observation (m) whether it is an angle whose differences z - h are taken modulo 2 pi.

    That is a sample with a Gaussian or Student's law whose observation is an `atan2(...)`, or a sum with one, such as a bearing
    from a heading, or whose name stands in the model key `observed_angles`.
    """
    if model.observation_kind != "samples" or model.log_density is not None:
        return (False,) * model.m
    return tuple(
        family in LINEAR and (bool(_directions(formula)) or name in model.observed_angles)
        for family, formula, name in zip(model.observation_family, model.observation, model.observation_names, strict=True)
    )


def _directions(formula: sympy.Expr) -> list[sympy.Expr]:
    """Return the terms of a sum that are an atan2, with either sign."""
    return [term for term in sympy.Add.make_args(formula) if isinstance(term, sympy.atan2) or isinstance(-term, sympy.atan2)]


def without_branch(model: Model) -> list[sympy.Expr]:
    """Return formulas that are as smooth as the law of the observations: of an angle the arguments of atan2, without its jump."""
    found: list[sympy.Expr] = []
    for formula, angle in zip(model.observation, observed_angles(model), strict=True):
        directions = _directions(formula) if angle else []
        found.extend(part for term in directions for part in (term if isinstance(term, sympy.atan2) else -term).args)
        found.extend([] if formula in directions else [formula - sum(directions)])
    return found


def nearest(values: Array, expected: Array, angles: Array | Sequence[bool]) -> Array:
    """Return values (..., m) with each of the `angles` (m,) replaced by its image nearest to what is expected (..., m)."""
    angles = np.asarray(angles, bool)
    return np.where(angles, expected + wrap(values - expected), values) if angles.any() else values


def other_image(apart: Array, variance: Array) -> float:
    """Return the largest weight of another image of angles at differences in (-pi, pi], relative to the nearest.

        exp(-((r + 2 pi k)^2 - r^2) / 2 s),    s the variance with which z - h is expected
    """
    weights = np.exp(-TURN * np.maximum(TURN - 2.0 * np.abs(np.real(apart)), 0.0) / (2.0 * np.real(variance)))
    return float(np.max(weights, initial=0.0))


ONE_IMAGE = (
    1e-6,
    "weight of another image of an observed angle (z + 2 pi) relative to the nearest, the only one that is taken; take "
    "yau-yau or guided-particles, which add up all images",
)


class Wrapped(Symmetric):
    """The law of an angle whose difference from its location is a variable of `family` modulo 2 pi."""

    def __init__(self, family: Family):
        self._family = family
        self.parameter: str | None = family.parameter
        self.noise, self.support = family.noise, "angles in radians"

    def log_density(self, z: Array, h: Array, s: Array, shape: Array) -> Array:
        """Return the log density on (-pi, pi]."""
        apart = wrap(np.asarray(z) - h)
        if isinstance(self._family, StudentT):
            return _wrapped_student(apart, s, shape)
        return _wrapped_gaussian(apart, s)

    def sample(self, rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        """Return one draw for each h, in (-pi, pi]."""
        return wrap(self._family.sample(rng, h, s, shape))

    def cdf(self, z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        """Return (twice) the probability of the angles from -pi to z."""
        z, h = wrap(np.asarray(z, float)), wrap(np.asarray(h, float))
        spread = np.sqrt(np.asarray(s, float))
        count = int(np.clip(np.ceil(_REACH * np.max(spread, initial=0.0) / TURN + 0.5), 1, 64))
        if isinstance(self._family, StudentT):
            count = 64
        value: Array = np.zeros(np.broadcast_shapes(z.shape, h.shape, spread.shape))
        for k in range(-count, count + 1):
            upper, lower = (self._family.cdf(end + TURN * k, h, s, shape)[0] for end in (z, np.full_like(z, -np.pi)))
            value = value + (upper - lower)
        # What lies beyond the images is almost uniform.
        beyond = 1.0 - (
            self._family.cdf(np.full_like(z, np.pi) + TURN * count, h, s, shape)[0]
            - self._family.cdf(np.full_like(z, -np.pi) - TURN * count, h, s, shape)[0]
        )
        value = np.clip(value + beyond * (z + np.pi) / TURN, 0.0, 1.0)
        return value, value


def _wrapped_gaussian(apart: Array, s: Array) -> Array:
    """Return the log density of N(0, s) modulo 2 pi at differences in (-pi, pi]."""
    s = np.asarray(s)
    wide = np.real(s) >= _WIDE
    if np.all(wide):
        return _harmonics(apart, s)
    narrow = np.where(wide, 1.0, s)
    widest = float(np.max(np.real(narrow), initial=0.0))
    count = int(np.ceil(_REACH * np.sqrt(widest) / TURN + 0.5)) if np.isfinite(widest) else 1
    # The images relative to the nearest one: exp(-(2 pi k)^2 / 2 s - 2 pi k r / s).
    others: Array = np.zeros(np.broadcast_shapes(apart.shape, s.shape))
    for k in range(1, count + 1):
        for turn in (TURN * k, -TURN * k):
            others = others + np.exp(-turn * (turn + 2.0 * apart) / (2.0 * narrow))
    found = np.asarray(Gaussian.log_density(apart, ZERO, narrow, ZERO)) + np.log1p(others)
    return np.where(wide, _harmonics(apart, s), found) if np.any(wide) else found


def _harmonics(apart: Array, s: Array) -> Array:
    total: Array = np.zeros(np.broadcast_shapes(apart.shape, np.shape(s)))
    for k in range(1, _HARMONICS + 1):
        total = total + 2.0 * np.exp(-0.5 * k * k * s) * np.cos(k * apart)
    return np.asarray(np.log1p(total) - np.log(TURN))


def _wrapped_student(apart: Array, s: Array, shape: Array) -> Array:
    """Return the log density of Student's law with squared scale s modulo 2 pi at differences in (-pi, pi]."""
    nearest_one = np.asarray(StudentT.log_density(apart, ZERO, s, shape))
    others: Array = np.zeros(np.broadcast_shapes(apart.shape, np.shape(s), np.shape(shape)))
    for k in range(1, _IMAGES + 1):
        for turn in (TURN * k, -TURN * k):
            others = others + np.exp(StudentT.log_density(apart + turn, ZERO, s, shape) - nearest_one)
    edge = TURN * (_IMAGES + 0.5)
    tails = _tail(edge + apart, s, shape) + _tail(edge - apart, s, shape)
    return nearest_one + np.log1p(others + tails * np.exp(-nearest_one))


def _tail(x: Array, s: Array, shape: Array) -> Array:
    """Return the sum of the density at x + pi, x + 3 pi, ... for x > 0: int_x^oo p / 2 pi + 2 pi p'(x) / 24."""
    density = np.exp(StudentT.log_density(x, ZERO, s, shape))
    slope = -density * (shape + 1) * x / (shape * s + x**2)
    return np.asarray(_survival(x, s, shape) / TURN + TURN / 24.0 * slope)


def _survival(x: Array, s: Array, shape: Array) -> Array:
    """Return P(X > x); complex arguments keep their derivatives."""
    from scipy.special import stdtr

    real = [np.real(value) for value in (x, s, shape)]

    def at(x: Array, s: Array, shape: Array) -> Array:
        return np.asarray(stdtr(shape, -x / np.sqrt(s)))

    value = at(*real)
    if not any(np.iscomplexobj(part) for part in (x, s, shape)):
        return value
    density = np.exp(StudentT.log_density(real[0], ZERO, real[1], real[2]))
    step = 1e-5 * real[2]
    by_shape = (at(real[0], real[1], real[2] + step) - at(real[0], real[1], real[2] - step)) / (2.0 * step)
    change = density * (-np.imag(x) + np.imag(s) * real[0] / (2.0 * real[1])) + by_shape * np.imag(shape)
    return np.asarray(value + 1j * change)
