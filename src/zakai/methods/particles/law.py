"""The law of a sample given the state, as formulas in the state and in numbers that are known when it is observed.

The numbers are z (m,), the precision P of the observed Gaussian coordinates, the constants c (m,) that normalise the laws, and
the marks e (m,) of what is observed.  P and c are computed once for an observation where the noise does not depend on the state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.methods.particles.programs import Array, Expressions, LogBessel, LogGamma
from zakai.models.angles import observed_angles
from zakai.models.functions import Floor, Maximum
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.particles.formulas import Program

# Deviation of an angle above which the law sums over its images; the next image of a deviation of pi / 2 is at 3 pi / 2, where
# the Gaussian is e^-27 of that at pi / 2.
_WRAPPED_ONLY = 0.6
_REACH = 8.6  # deviations beyond which a Gaussian is negligible
_IMAGES = 6  # on each side, of Student's law and where the noise is not known


class Numbers(NamedTuple):
    """The symbols of the given numbers of a law, and the order in which the kernels receive them."""

    z: tuple[sp.Symbol, ...]
    P: sp.Matrix
    c: tuple[sp.Symbol, ...]
    e: tuple[sp.Symbol, ...]

    @classmethod
    def of(cls, m: int, coupled: bool) -> Numbers:
        """Return symbols for m observations."""
        P = sp.zeros(m, m)
        for i in range(m):
            for j in range(i + 1):
                if coupled or i == j:
                    P[i, j] = P[j, i] = sp.Dummy(f"P{i}_{j}", real=True)
        z, c, e = (tuple(sp.Dummy(f"{name}{j}", real=True) for j in range(m)) for name in "zce")
        return cls(z, P, c, e)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The entries of P that are not zero, without those above the diagonal."""
        return [(i, j) for i in range(len(self.z)) for j in range(i + 1) if self.P[i, j] != 0]

    @property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """All symbols in order."""
        return (*self.z, *(self.P[pair] for pair in self.pairs), *self.c, *self.e)


class Law:
    """log p(z | x, u, t) as a program whose outputs are the terms of a sum, and the numbers that it needs.

    `more` are the symbols of coordinates after those of the state, `defined` formulas for symbols that stand in others.
    """

    more: tuple[sp.Symbol, ...] = ()
    defined: Mapping[sp.Symbol, sp.Expr] | None = None

    def __init__(self, model: Model):
        self.model, m = model, model.m
        noise, self.angles = model.observation_noise, np.array(observed_angles(model))
        self.coupled = not noise.is_diagonal()
        self.fixed = not noise.free_symbols & set(model.x)  # whether S is known without the state
        shapes = [next((model.family_parameters[key] for key in model.family_parameters if key[1] == j), sp.S.Zero)
                  for j in range(m)]  # fmt: skip
        self.fixed_shapes = [not shape.free_symbols & set(model.x) for shape in shapes]
        self.constant = not {*noise.free_symbols}.union(*(shape.free_symbols for shape in shapes)) & {*model.x, model.t, *model.u}
        self.numbers = Numbers.of(m, self.coupled)
        self._noise, self._shapes = numpy_function(noise, model, (m, m)), numpy_function(shapes, model)
        self.joint = model.log_density is None and self.coupled and self.fixed
        self._logarithmic = np.array([family == "log-normal" for family in model.observation_family])
        self._gaussian = [j for j in range(m) if model.observation_family[j] == "gaussian"]
        terms, self._terms = self._formulas(shapes)
        self._expressions = Expressions(terms, model, self.numbers.symbols, self.more, self.defined)
        self.reads = np.array([self._expressions.reads(place) for place in range(model.n)])
        self.is_gaussian = model.log_density is None and set(model.observation_family) == {"gaussian"}

    @property
    def width(self) -> int:
        """The number of given numbers, the inputs among them."""
        return self._expressions.width

    def program(self, theta: Array) -> Program:
        """Return the law as a program."""
        return self._expressions.at(theta)

    def noise(self, x: Array, t: float, theta: Array, u: Array | None) -> Array:
        """Return S (m, m) at a state."""
        return np.asarray(self._noise(x, t, theta, u))

    def spread(self, x: Array, t: float, theta: Array, u: Array | None) -> Any:
        """Return the covariance (m, m) of h at a point whose linear states are known by their mean and covariance."""
        return 0.0

    def parameters(self, t: float, theta: Array, u: Array | None) -> tuple[Array, Array]:
        """Return S (m, m) and the parameters (m,) of the families at a time, where they do not depend on the state."""
        m, nowhere = self.model.m, np.zeros(self.model.n)
        if self.model.log_density is not None:
            return np.eye(m), np.zeros(m)
        with np.errstate(all="ignore"):
            S = self.noise(nowhere, t, theta, u) if self.fixed else np.eye(m)
            return S, self._shapes(nowhere, t, theta, u)

    def given(self, values: Array, seen: Array, parameters: tuple[Array, Array], u: Array | None) -> tuple[Array, Array]:
        """Return the given numbers (width,) of one observation, and which terms of the law count (terms,) as 1 or 0.

        Args:
            values: (m,), zero where nothing is observed.
            seen: (m,).
            parameters: those of the law at that time.
            u: the inputs then.
        """
        m, numbers, (S, shape) = self.model.m, self.numbers, parameters
        P, c = np.zeros((m, m)), np.zeros(m)
        if self.model.log_density is None:
            which = np.flatnonzero(seen)
            if self.coupled:
                P[np.ix_(which, which)] = np.linalg.inv(S[np.ix_(which, which)])
            else:
                P[which, which] = 1.0 / S[which, which]
            for j in which:
                if not (self.joint and j in self._gaussian):
                    known = shape[j] if self.fixed_shapes[j] else math.nan
                    spread = S[j, j] if self.fixed else math.nan
                    c[j] = _constant(self.model.observation_family[j], values[j], spread, known)
            own = [j for j in which if j in self._gaussian]
            if self.joint and own:
                block = 2 * np.pi * S[np.ix_(own, own)]
                c[self._gaussian[0]] = -0.5 * np.linalg.slogdet(block)[1]
        pairs = [P[pair] for pair in numbers.pairs]
        if self._logarithmic.any():
            positive = self._logarithmic & seen
            values = np.where(positive, np.log(np.where(positive, values, 1.0)), values)
        row = np.concatenate([[] if u is None else u, values, pairs, c, seen.astype(float)])
        return row, np.array([float(seen[places].any()) for places in self._terms])

    def _formulas(self, shapes: list[sp.Expr]) -> tuple[list[sp.Expr], list[list[int]]]:
        """Return the terms of the law, and the observations on which each depends."""
        model, numbers, m = self.model, self.numbers, self.model.m
        if model.log_density is not None:
            return [model.log_density.subs(dict(zip(model.z, numbers.z, strict=True)))], [list(range(m))]
        d = [z - h for z, h in zip(numbers.z, model.observation, strict=True)]
        d = [_wrapped(one) if angle else one for one, angle in zip(d, self.angles, strict=True)]
        own = self._gaussian
        terms: list[sp.Expr] = []
        places: list[list[int]] = []
        if self.joint:
            form = sum((numbers.P[i, j] * d[i] * d[j] * (1 if i == j else 2) for i in own for j in own if j <= i), sp.S.Zero)
            terms, places = [numbers.c[own[0]] - form / 2], [own]
        elif self.coupled:
            terms, places = _sequential(model, numbers, d, own), [[j] for j in own]
        for j in range(m):
            if j in own and self.coupled:
                continue
            terms.append(self._term(j, d[j], shapes[j]))
            places.append([j])
        return terms, places

    def _term(self, j: int, d: sp.Expr, shape: sp.Expr) -> sp.Expr:
        """Return the log density of one coordinate."""
        model, numbers = self.model, self.numbers
        family, z, h, c = model.observation_family[j], numbers.z[j], model.observation[j], numbers.c[j]
        S = model.observation_noise[j, j]
        precision = numbers.P[j, j] if self.fixed else 1 / S
        if family in ("gaussian", "student-t"):
            power = (shape + 1) / 2

            def law(v: sp.Expr) -> sp.Expr:
                return -precision * v**2 / 2 if family == "gaussian" else -power * sp.log(1 + precision * v**2 / shape)

            result = law(d)
            if self.angles[j]:
                result += self._images(family, d, S, law)
            if family == "gaussian":
                return result + (c if self.fixed else -sp.log(2 * sp.pi * S) / 2)
            if self.fixed and self.fixed_shapes[j]:
                return result + c
            return result + LogGamma(power) - LogGamma(shape / 2) - sp.log(shape * sp.pi / precision) / 2
        if family == "poisson":
            return z * sp.log(Maximum(h, sp.Float(1e-300))) - h - sp.Float(1e300) * Maximum(-h, 0) + c
        if family == "bernoulli":
            outside = Maximum(-h, 0) + Maximum(h - 1, 0)
            return sp.log(z * h + (1 - z) * (1 - h)) - sp.Float(1e300) * outside
        if family == "binomial":
            outside = Maximum(-h, 0) + Maximum(h - 1, 0)
            chance, other = (Maximum(part, sp.Float(1e-300)) for part in (h, 1 - h))
            return z * sp.log(chance) + (shape - z) * sp.log(other) - sp.Float(1e300) * outside + c
        if family == "negative-binomial":
            ratio = z * sp.log(Maximum(h, sp.Float(1e-300))) - (z + 1 / shape) * sp.log(1 + shape * h)
            return ratio - sp.Float(1e300) * Maximum(-h, 0) + (c if self.fixed_shapes[j] else c + _of_dispersion(z, shape))
        if family == "log-normal":
            # The given number is log z.
            return -precision * d**2 / 2 + (c if self.fixed else c - sp.log(2 * sp.pi * S) / 2)
        if family == "exponential":
            return -z / h - sp.log(h)
        angle = shape * sp.cos(z - h)
        return angle + c if self.fixed_shapes[j] else angle - LogBessel(shape) - sp.log(2 * sp.pi)

    def _images(self, family: str, d: sp.Expr, S: sp.Expr, law: Callable[[sp.Expr], sp.Expr]) -> sp.Expr:
        """Return the logarithm of the sum over the images of an angle, relative to the nearest."""
        values = dict(zip(self.model.parameter_symbols, self.model.parameters.values(), strict=True))
        number, count = S.subs(values).subs(self.model.t, sp.Float(self.model.start)), _IMAGES
        if family == "gaussian" and number.is_number:
            spread = math.sqrt(float(number))
            count = math.ceil(_REACH * spread / (2 * math.pi) + 0.5) if spread >= _WRAPPED_ONLY else 0
        shifts = [2 * sp.pi * k for k in range(-count, count + 1) if k]
        return sp.log(1 + sum((sp.exp(law(d + shift) - law(d)) for shift in shifts), sp.S.Zero))


def _sequential(model: Model, numbers: Numbers, d: list[sp.Expr], own: list[int]) -> list[sp.Expr]:
    """Return the log densities of Gaussian coordinates, each given those before it, for noise that depends on the state.

    By Cholesky's factor F of S among the observed coordinates, w_j = (d_j - sum F_ji w_i) / F_jj.
    """
    S, e = model.observation_noise, numbers.e
    terms, factors, whitened = [], dict[tuple[int, int], sp.Expr](), dict[int, sp.Expr]()
    for place, j in enumerate(own):
        before = own[:place]
        for i in before:
            inner = sum((factors[j, k] * factors[i, k] for k in own[: own.index(i)]), sp.S.Zero)
            factors[j, i] = e[i] * e[j] * (S[j, i] - inner) / factors[i, i]
        variance = S[j, j] - sum((factors[j, k] ** 2 for k in before), sp.S.Zero)
        factors[j, j] = sp.sqrt(variance)
        mean = sum((factors[j, k] * whitened[k] for k in before), sp.S.Zero)
        whitened[j] = e[j] * (d[j] - mean) / factors[j, j]
        terms.append(-(whitened[j] ** 2) / 2 - sp.log(2 * sp.pi * variance) / 2)
    return terms


def _of_dispersion(z: sp.Expr, shape: sp.Expr) -> sp.Expr:
    return LogGamma(z + 1 / shape) - LogGamma(1 / shape) + z * sp.log(shape)


def _wrapped(d: sp.Expr) -> sp.Expr:
    return d - 2 * sp.pi * Floor(d / (2 * sp.pi) + sp.Rational(1, 2))


def _constant(family: str, z: float, S: float, shape: float) -> float:
    """Return what normalises the law of a coordinate, without what depends on the state."""
    if family == "gaussian" and S > 0:
        return -0.5 * math.log(2 * math.pi * S)
    if family == "student-t" and shape > 0 and S > 0:
        return math.lgamma((shape + 1) / 2) - math.lgamma(shape / 2) - 0.5 * math.log(shape * math.pi * S)
    if family == "poisson":
        return -math.lgamma(z + 1)
    if family == "binomial":
        return math.lgamma(shape + 1) - math.lgamma(z + 1) - math.lgamma(shape - z + 1) if 0 <= z <= shape else -math.inf
    if family == "negative-binomial":
        known = math.lgamma(z + 1 / shape) - math.lgamma(1 / shape) + z * math.log(shape) if shape > 0 else 0.0
        return known - math.lgamma(z + 1)
    if family == "log-normal":
        return (-0.5 * math.log(2 * math.pi * S) if math.isfinite(S) else 0.0) - math.log(z)
    if family == "von-mises" and shape > 0:
        from scipy.special import ive

        return -math.log(ive(0, shape)) - shape - math.log(2 * math.pi)
    return 0.0
