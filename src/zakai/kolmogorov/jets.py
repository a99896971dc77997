"""Taylor polynomials in n variables by automatic differentiation in Taylor mode, of the formulas of a model.

A `Jet` is the Taylor polynomial in z of a function u(y + z), for many expansion points y at once.  A function w = g(u) of one
obeys E w = g'(u) E u with E = z . grad, which multiplies what is of degree j by j: each pass of

    w <- w(0) + E^-1 (g'(u) E u)

makes one more degree right, and no difference quotient or symbolic derivative is taken.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models._program import operations
from zakai.models.model import Model
from zakai.models.numeric import program_of


@dataclass(frozen=True)
class Monomials:
    """The monomials in n variables up to a degree, and how they multiply."""

    n: int
    degree: int

    @cached_property
    def powers(self) -> np.ndarray:
        """The exponents (count, n), by degree."""
        found = [p for p in itertools.product(range(self.degree + 1), repeat=self.n) if sum(p) <= self.degree]
        return np.array(sorted(found, key=lambda p: (sum(p), p)))

    @cached_property
    def place(self) -> dict[tuple[int, ...], int]:
        return {tuple(p): i for i, p in enumerate(self.powers)}

    @cached_property
    def degrees(self) -> np.ndarray:
        return self.powers.sum(axis=1)

    @cached_property
    def products(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pairs (left, right) of monomials and what they make, which is sorted."""
        pairs = [
            (self.place[tuple(a + b)], i, j)
            for i, a in enumerate(self.powers)
            for j, b in enumerate(self.powers)
            if self.degrees[i] + self.degrees[j] <= self.degree
        ]
        made, left, right = np.array(sorted(pairs)).T
        return left, right, made

    def lowered(self, i: int) -> np.ndarray:
        """The matrix (count, count) of d/dz_i."""
        matrix = np.zeros((len(self.powers), len(self.powers)))
        for column, power in enumerate(self.powers):
            if power[i]:
                matrix[self.place[tuple(power - (np.arange(self.n) == i))], column] = power[i]
        return matrix

    @cached_property
    def first_of(self) -> np.ndarray:
        """Where the pairs of `products` that make each monomial begin."""
        return np.searchsorted(self.products[2], np.arange(len(self.powers)))

    def values(self, z: Any) -> Any:
        """All monomials (..., count) at z (..., n)."""
        xp = numpy_or_jax(z)
        ladders = [[xp.ones(z.shape[:-1])] for _ in range(self.n)]
        for i, ladder in enumerate(ladders):
            for _ in range(self.degree):
                ladder.append(ladder[-1] * z[..., i])
        return xp.stack([reduce(operator.mul, [ladders[i][k] for i, k in enumerate(p)]) for p in self.powers], axis=-1)


@cache
def monomials(n: int, degree: int) -> Monomials:
    """The monomials, listed once."""
    return Monomials(n, degree)


@partial(jax.tree_util.register_dataclass, data_fields=["coefficients"], meta_fields=["monomials"])
@dataclass(frozen=True, eq=False)
class Jet:
    """A truncated polynomial in z: `coefficients` (count, points) of the `monomials`, of NumPy or of JAX."""

    coefficients: Any
    monomials: Monomials

    __array_ufunc__ = None  # a NumPy number leaves arithmetic to this class

    def _like(self, coefficients: Any) -> Jet:
        return Jet(coefficients, self.monomials)

    @property
    def _first_only(self) -> np.ndarray:
        return np.eye(len(self.monomials.powers), 1)

    def constant(self, value: Any) -> Jet:
        """The jet of a function that is constant in z."""
        return self._like(self._first_only * value + 0.0 * self.first)

    @property
    def first(self) -> Any:
        """The values at z = 0."""
        return self.coefficients[0]

    def __add__(self, other: Any) -> Jet:
        if isinstance(other, Jet):
            return self._like(self.coefficients + other.coefficients)
        return self._like(self.coefficients + self._first_only * other)

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return self._like(self.coefficients * other)
        left, right, made = self.monomials.products
        pairs = self.coefficients[left] * other.coefficients[right]
        if isinstance(pairs, np.ndarray):
            return self._like(np.add.reduceat(pairs, self.monomials.first_of, axis=0))
        return self._like(jax.ops.segment_sum(pairs, made, len(self.monomials.powers), indices_are_sorted=True))

    def __neg__(self) -> Jet:
        return self * -1.0

    def __sub__(self, other: Any) -> Jet:
        return self + -other

    def __rsub__(self, other: Any) -> Jet:
        return -self + other

    def __truediv__(self, other: Any) -> Jet:
        return self * (_reciprocal(other) if isinstance(other, Jet) else 1.0 / other)

    def __rtruediv__(self, other: Any) -> Jet:
        return _reciprocal(self) * other

    __radd__, __rmul__ = __add__, __mul__

    def derivative(self, i: int) -> Jet:
        """d/dz_i; the highest degree is lost."""
        return self._like(self.monomials.lowered(i) @ self.coefficients)

    def radial(self, k: int) -> Jet:
        """int_0^1 s^(k-1) p(s z) ds; for k = 0 of a polynomial without a constant."""
        return self._like(self.coefficients / np.maximum(k + self.monomials.degrees, 1)[:, None])

    def truncated(self, degree: int) -> Jet:
        """Without what is of a higher degree."""
        return self._like(self.coefficients * (self.monomials.degrees <= degree)[:, None])

    def solved(self, first: Any, rate: Callable[[Jet], Jet]) -> Jet:
        """The w with w(0) = `first` and E w = rate(w) E u, u this one."""
        w, scaled = self.constant(first), self._like(self.coefficients * self.monomials.degrees[:, None])
        for _ in range(self.monomials.degree):
            w = (rate(w) * scaled).radial(0) + first
        return w


def _reciprocal(u: Jet) -> Jet:
    first = 1.0 / u.first
    rest, w = (u - u.first) * first, u.constant(first)
    for _ in range(u.monomials.degree):
        w = first - rest * w
    return w


def _power(u: Any, p: Any) -> Any:
    if not isinstance(u, Jet):
        return u**p
    if float(p) == int(p) and p >= 0:
        w, count = u.constant(1.0), int(p)
        while count:
            w, u, count = (w * u if count % 2 else w), u * u, count // 2
        return w
    inverse = _reciprocal(u)
    return u.solved(u.first**p, lambda w: p * w * inverse)


def _pair(u: Jet, sine: Any, cosine: Any, sign: float) -> tuple[Jet, Jet]:
    """The sine and the cosine (`sign` -1), or the hyperbolic ones (1)."""
    scaled = Jet(u.coefficients * u.monomials.degrees[:, None], u.monomials)
    s, c = u.constant(sine), u.constant(cosine)
    for _ in range(u.monomials.degree):
        s, c = (c * scaled).radial(0) + sine, (s * scaled).radial(0) * sign + cosine
    return s, c


_NUMPY, _JAX = operations(np, scipy.special.erf), operations(jnp, jax.scipy.special.erf)


def _value(name: str, u: Jet) -> Any:
    """The value of a function at z = 0."""
    return _plain(name, u.first)


def _plain(name: str, u: Any) -> Any:
    return (_JAX if isinstance(u, jax.Array) else _NUMPY)[name](u)


def _circular(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, _value("sin", u), _value("cos", u), -1.0)


def _hyperbolic(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, _value("sinh", u), _value("cosh", u), 1.0)


def _tanh(u: Jet) -> Jet:
    return u.solved(_value("tanh", u), lambda w: 1.0 - w * w)


def _known(name: str, rate: Callable[[Jet], Jet]) -> Callable[[Jet], Jet]:
    """The rule of a function from its derivative, a function of u."""
    return lambda u: u.solved(_value(name, u), partial(lambda slope, _: slope, rate(u)))


def _exp(u: Jet) -> Jet:
    return u.solved(_value("exp", u), lambda w: w)


_RULES: dict[str, Callable[[Jet], Jet]] = {
    "exp": _exp,
    "log": _known("log", _reciprocal),
    "sqrt": lambda u: _power(u, 0.5),
    "sin": lambda u: _circular(u)[0],
    "cos": lambda u: _circular(u)[1],
    "tan": lambda u: u.solved(_value("tan", u), lambda w: 1.0 + w * w),
    "sinh": lambda u: _hyperbolic(u)[0],
    "cosh": lambda u: _hyperbolic(u)[1],
    "tanh": _tanh,
    "logcosh": _known("logcosh", _tanh),
    "asin": _known("asin", lambda u: _power(1.0 - u * u, -0.5)),
    "acos": _known("acos", lambda u: -_power(1.0 - u * u, -0.5)),
    "atan": _known("atan", lambda u: _reciprocal(1.0 + u * u)),
    "erf": _known("erf", lambda u: _exp(-(u * u)) * (2.0 / np.sqrt(np.pi))),
    "abs": lambda u: u * _value("sign", u),
    "sign": lambda u: u.constant(_value("sign", u)),
}


def _rule(name: str) -> Callable:
    return lambda u: _RULES[name](u) if isinstance(u, Jet) else _plain(name, u)


_OPERATIONS = _NUMPY | {name: _rule(name) for name in _RULES} | {"power": _power}


class _States:
    """What a program takes its states from."""

    def __init__(self, points: Any, of: Monomials):
        count = len(of.powers)
        units = [of.place[tuple(row)] for row in np.eye(of.n, dtype=int)]
        self.jets = [Jet(np.eye(count, 1) * points[:, i] + np.eye(count, 1, -unit), of) for i, unit in enumerate(units)]

    def __getitem__(self, key: Any) -> Jet:
        return self.jets[key[-1]]


def jets(expressions: Sequence[Any], model: Model, points: Any, degree: int, theta: Any) -> list[Jet]:
    """The Taylor polynomials of expressions without time about `points` (count, n), up to `degree` >= 1; theta may be traced.

        >>> model = zakai.Model(state=["x"], drift=["exp(x)"], observation=["x"])
        >>> jets(model.drift, model, np.zeros((1, 1)), 3, model.theta())[0].coefficients[:, 0].round(3)
        array([1.   , 1.   , 0.5  , 0.167])
    """
    states = _States(points, monomials(model.n, degree))
    program = program_of(list(expressions), model)
    # NumPy where nothing is traced: a few milliseconds against seconds of compilation.
    with np.errstate(all="ignore"):
        values = program.run(states, 0.0, theta, _OPERATIONS)
    zero = states.jets[0] * 0.0
    return [v if isinstance(v := values[slot], Jet) else zero.constant(v) for slot in program.outputs]
