"""Families of laws of one coordinate of a sample.

A family is a class of functions of z, the location h, the variance or squared scale s and the shape of the family (degrees of
freedom, concentration, trials or dispersion), all of which broadcast.  What is no law (a negative mean of counts) is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Family(Protocol):
    """One family of laws of one coordinate."""

    @property
    def parameter(self) -> str | None:
        """The key of the shape."""

    @property
    def noise(self) -> bool:
        """Whether observation_noise enters."""

    @property
    def support(self) -> str:
        """The values that it has, in words."""

    @staticmethod
    def inside(z: Array) -> Array:
        """Return where z is a possible value."""

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        """Return the most probable value."""

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        """Return the mean, or the mean direction of an angle."""

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        """Return the log density, or the log mass of a count."""

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        """Return one draw for each h."""

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        """Return P(Z < z) and P(Z <= z)."""


class Symmetric:
    """A law of any number, or of angles, symmetric about its location: possible values, most probable one and mean."""

    @staticmethod
    def inside(z: Array) -> Array:
        return np.isfinite(z)

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return h

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return h


class Gaussian(Symmetric):
    """N(h, s)."""

    parameter, noise, support = None, True, "numbers"

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        return np.asarray(-0.5 * ((z - h) ** 2 / s + np.log(2 * np.pi * s)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return h + np.sqrt(s) * rng.standard_normal(h.shape)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.special import ndtr

        value = ndtr((z - h) / np.sqrt(s))
        return value, value


class StudentT(Symmetric):
    """Location h, squared scale s, `degrees_of_freedom`."""

    parameter, noise, support = "degrees_of_freedom", True, "numbers"

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        from scipy.special import loggamma

        constant = _loggamma(loggamma, (shape + 1) / 2) - _loggamma(loggamma, shape / 2) - 0.5 * np.log(shape * np.pi * s)
        return np.asarray(constant - (shape + 1) / 2 * np.log(1 + (z - h) ** 2 / (shape * s)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return h + np.sqrt(s) * rng.standard_t(shape, h.shape)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.special import stdtr

        value = stdtr(shape, (z - h) / np.sqrt(s))
        return value, value


class Poisson:
    """Counts with mean h >= 0."""

    parameter, noise, support = None, False, "whole numbers of at least 0"

    @staticmethod
    def inside(z: Array) -> Array:
        return (z >= 0) & (z == np.floor(z)) & (z <= 2.0**53)

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.floor(h)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return h

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        from scipy.special import gammaln

        rate = _where_law(h, np.real(h) >= 0)
        term = z * np.log(np.where(np.real(rate) == 0, 1.0, rate)) if np.any(z) else 0.0
        impossible = (np.real(rate) == 0) & (z > 0)
        return np.asarray(np.where(impossible, -np.inf, term - rate - gammaln(np.asarray(z) + 1.0)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return rng.poisson(h).astype(float)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.special import pdtr

        return np.where(np.asarray(z) > 0, pdtr(np.maximum(z - 1.0, 0.0), h), 0.0), pdtr(z, h)


class Bernoulli:
    """0 or 1; h is the probability of 1."""

    parameter, noise, support = None, False, "0 or 1"

    @staticmethod
    def inside(z: Array) -> Array:
        return (z == 0) | (z == 1)

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.round(h)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return h

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        chance = _where_law(h, (np.real(h) >= 0) & (np.real(h) <= 1))
        return np.log(np.where(np.asarray(z) == 1, chance, 1.0 - chance))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return (rng.uniform(size=h.shape) < h).astype(float)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        z = np.asarray(z)
        upto = np.where(z >= 1, 1.0, np.where(z >= 0, 1.0 - h, 0.0))
        return np.where(z > 1, 1.0, np.where(z > 0, 1.0 - h, 0.0)), upto


class VonMises(Symmetric):
    """An angle with mean direction h and `concentration`; distribution functions count from -pi."""

    parameter, noise, support = "concentration", False, "angles in radians"

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        from scipy.special import ive

        size = np.real(shape)
        log_bessel = np.log(ive(0, size)) + size
        if np.iscomplexobj(shape):
            log_bessel = log_bessel + 1j * np.imag(shape) * ive(1, size) / ive(0, size)
        return np.asarray(shape * np.cos(z - h) - log_bessel - np.log(2 * np.pi))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return rng.vonmises(np.mod(h + np.pi, 2 * np.pi) - np.pi, shape)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.stats import vonmises

        angle = np.pi - np.mod(np.pi - np.asarray(z), 2 * np.pi)
        mean = np.pi - np.mod(np.pi - h, 2 * np.pi)
        value = vonmises.cdf(angle - mean, shape) - vonmises.cdf(-np.pi - mean, shape)
        return value, value


class Binomial:
    """Successes among `trials`; h is the probability of one success."""

    parameter, noise, support = "trials", False, "whole numbers from 0 to the number of trials"

    @staticmethod
    def inside(z: Array) -> Array:
        return Poisson.inside(z)

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.minimum(np.floor((shape + 1.0) * h), shape)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return shape * h

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        from scipy.special import gammaln, xlogy

        chance = _where_law(h, (np.real(h) >= 0) & (np.real(h) <= 1))
        trials, z = np.real(shape), np.asarray(z, float)
        possible = (z <= trials) & (trials == np.round(trials))
        failures = np.where(possible, trials - z, 0.0)
        if np.iscomplexobj(chance):
            some, other = np.where(z == 0, 1.0, chance), np.where(failures == 0, 1.0, 1.0 - chance)
            found = z * np.log(some) + failures * np.log(other)
        else:
            found = xlogy(z, chance) + xlogy(failures, 1.0 - chance)
        ways = gammaln(trials + 1.0) - gammaln(z + 1.0) - gammaln(failures + 1.0)
        return np.asarray(np.where(possible, found + ways, -np.inf + 0.0 * np.real(chance)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return rng.binomial(np.round(shape).astype(int), h).astype(float)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.stats import binom

        return binom.cdf(np.asarray(z) - 1.0, shape, h), binom.cdf(z, shape, h)


class NegativeBinomial:
    """Counts with mean h >= 0 and variance h + `dispersion` h^2."""

    parameter, noise, support = "dispersion", False, "whole numbers of at least 0"

    @staticmethod
    def inside(z: Array) -> Array:
        return Poisson.inside(z)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return h

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.floor(np.maximum(h * (1.0 - shape), 0.0))

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        from scipy.special import gammaln, loggamma

        mean = _where_law(h, np.real(h) >= 0)
        size, excess = 1.0 / shape, 1.0 + shape * mean
        term = z * np.log(np.where(np.real(mean) == 0, 1.0, shape * mean / excess)) if np.any(z) else 0.0
        ways = _loggamma(loggamma, z + size) - _loggamma(loggamma, size) - gammaln(np.asarray(z) + 1.0)
        return np.asarray(np.where((np.real(mean) == 0) & (z > 0), -np.inf, ways + term - size * np.log(excess)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return rng.poisson(h * shape * rng.gamma(1.0 / shape, 1.0, h.shape)).astype(float)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        from scipy.stats import nbinom

        law = 1.0 / shape, 1.0 / (1.0 + shape * h)
        return nbinom.cdf(np.asarray(z) - 1.0, *law), nbinom.cdf(z, *law)


class _Positive:
    """A law of positive numbers."""

    @staticmethod
    def inside(z: Array) -> Array:
        return np.isfinite(z) & (z > 0)


class LogNormal(_Positive):
    """log z ~ N(h, s)."""

    parameter, noise, support = None, True, "positive numbers"

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.exp(h - s)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return np.exp(h + 0.5 * s)

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        log_z = np.log(np.where(z > 0, z, 1.0))
        return np.asarray(np.where(z > 0, Gaussian.log_density(log_z, h, s, shape) - log_z, -np.inf + 0.0 * np.real(h)))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return np.exp(Gaussian.sample(rng, h, s, shape))

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        with np.errstate(divide="ignore"):
            return Gaussian.cdf(np.log(np.maximum(z, 0.0)), h, s, shape)


class Exponential(_Positive):
    """Waiting times with mean h > 0."""

    parameter, noise, support = None, False, "numbers of at least 0"

    @staticmethod
    def inside(z: Array) -> Array:
        return np.isfinite(z) & (z >= 0)

    @staticmethod
    def mode(h: Array, s: Array, shape: Array) -> Array:
        return np.zeros_like(h)

    @staticmethod
    def mean(h: Array, s: Array, shape: Array) -> Array:
        return h

    @staticmethod
    def log_density(z: Array, h: Array, s: Array, shape: Array) -> Array:
        mean = _where_law(h, np.real(h) > 0)
        return np.asarray(np.where(np.asarray(z) >= 0, -z / mean - np.log(mean), -np.inf))

    @staticmethod
    def sample(rng: np.random.Generator, h: Array, s: Array, shape: Array) -> Array:
        return h * rng.standard_exponential(h.shape)

    @staticmethod
    def cdf(z: Array, h: Array, s: Array, shape: Array) -> tuple[Array, Array]:
        value = -np.expm1(-np.maximum(z, 0.0) / h)
        return value, value


FAMILIES: dict[str, Family] = {
    "gaussian": Gaussian(),
    "student-t": StudentT(),
    "poisson": Poisson(),
    "bernoulli": Bernoulli(),
    "von-mises": VonMises(),
    "binomial": Binomial(),
    "negative-binomial": NegativeBinomial(),
    "log-normal": LogNormal(),
    "exponential": Exponential(),
}

PARAMETERS = tuple(dict.fromkeys(family.parameter for family in FAMILIES.values() if family.parameter is not None))  # the keys
COUNTS = ("poisson", "bernoulli", "binomial", "negative-binomial")


def _where_law(values: Array, good: Array) -> Array:
    return np.where(good, values, np.nan)


def _loggamma(loggamma: Callable[[Array], Array], values: Array) -> Array:
    """Return log Gamma; complex values keep a derivative."""
    from scipy.special import digamma

    real = np.real(loggamma(np.real(values)))
    return real + 1j * np.imag(values) * digamma(np.real(values)) if np.iscomplexobj(values) else real
