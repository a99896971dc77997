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

from zakai import _float64  # noqa: F401
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

    def lowered(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(from, to, factor) of d/dz_i."""
        used = np.flatnonzero(self.powers[:, i])
        unit = np.arange(self.n) == i
        return used, np.array([self.place[tuple(p)] for p in self.powers[used] - unit]), self.powers[used, i]

    def values(self, z: jax.Array) -> jax.Array:
        """All monomials (..., count) at z (..., n)."""
        ladders = [[jnp.ones(z.shape[:-1])] for _ in range(self.n)]
        for i, ladder in enumerate(ladders):
            for _ in range(self.degree):
                ladder.append(ladder[-1] * z[..., i])
        return jnp.stack([reduce(operator.mul, [ladders[i][k] for i, k in enumerate(p)]) for p in self.powers], axis=-1)


@cache
def monomials(n: int, degree: int) -> Monomials:
    """The monomials, listed once."""
    return Monomials(n, degree)


@partial(jax.tree_util.register_dataclass, data_fields=["coefficients"], meta_fields=["monomials"])
@dataclass(frozen=True, eq=False)
class Jet:
    """A truncated polynomial in z: `coefficients` (count, points) of the `monomials`."""

    coefficients: jax.Array
    monomials: Monomials

    __array_ufunc__ = None  # a NumPy number leaves arithmetic to this class

    def _like(self, coefficients: jax.Array) -> Jet:
        return Jet(coefficients, self.monomials)

    def constant(self, value: Any) -> Jet:
        """The jet of a function that is constant in z."""
        zeros = jnp.zeros_like(self.coefficients)
        return self._like(zeros.at[0].set(value))

    @property
    def first(self) -> jax.Array:
        """The values at z = 0."""
        return self.coefficients[0]

    def __add__(self, other: Any) -> Jet:
        if isinstance(other, Jet):
            return self._like(self.coefficients + other.coefficients)
        return self._like(self.coefficients.at[0].add(other))

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return self._like(self.coefficients * other)
        left, right, made = self.monomials.products
        pairs = self.coefficients[left] * other.coefficients[right]
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
        used, to, factor = self.monomials.lowered(i)
        zeros = jnp.zeros_like(self.coefficients)
        return self._like(zeros.at[to].set(self.coefficients[used] * factor[:, None]))

    def radial(self, k: int) -> Jet:
        """int_0^1 s^(k-1) p(s z) ds; for k = 0 of a polynomial without a constant."""
        return self._like(self.coefficients / np.maximum(k + self.monomials.degrees, 1)[:, None])

    def truncated(self, degree: int) -> Jet:
        """Without what is of a higher degree."""
        return self._like(self.coefficients * (self.monomials.degrees <= degree)[:, None])

    def solved(self, first: jax.Array, rate: Callable[[Jet], Jet]) -> Jet:
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


def _pair(u: Jet, sine: jax.Array, cosine: jax.Array, sign: float) -> tuple[Jet, Jet]:
    """The sine and the cosine (`sign` -1), or the hyperbolic ones (1)."""
    scaled = Jet(u.coefficients * u.monomials.degrees[:, None], u.monomials)
    s, c = u.constant(sine), u.constant(cosine)
    for _ in range(u.monomials.degree):
        s, c = (c * scaled).radial(0) + sine, (s * scaled).radial(0) * sign + cosine
    return s, c


def _circular(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, jnp.sin(u.first), jnp.cos(u.first), -1.0)


def _hyperbolic(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, jnp.sinh(u.first), jnp.cosh(u.first), 1.0)


def _tanh(u: Jet) -> Jet:
    return u.solved(jnp.tanh(u.first), lambda w: 1.0 - w * w)


def _known(first: Callable[[Any], Any], rate: Callable[[Jet], Jet]) -> Callable[[Jet], Jet]:
    """The rule of a function from its value and its derivative, a function of u."""
    return lambda u: u.solved(first(u.first), partial(lambda slope, _: slope, rate(u)))


def _erf_rate(u: Jet) -> Jet:
    return (2.0 / np.sqrt(np.pi)) * _RULES["exp"](-(u * u))


_RULES: dict[str, Callable[[Jet], Jet]] = {
    "exp": lambda u: u.solved(jnp.exp(u.first), lambda w: w),
    "log": _known(jnp.log, _reciprocal),
    "sqrt": lambda u: _power(u, 0.5),
    "sin": lambda u: _circular(u)[0],
    "cos": lambda u: _circular(u)[1],
    "tan": lambda u: u.solved(jnp.tan(u.first), lambda w: 1.0 + w * w),
    "sinh": lambda u: _hyperbolic(u)[0],
    "cosh": lambda u: _hyperbolic(u)[1],
    "tanh": _tanh,
    "logcosh": _known(lambda u: jnp.logaddexp(u, -u) - np.log(2.0), _tanh),
    "asin": _known(jnp.arcsin, lambda u: _power(1.0 - u * u, -0.5)),
    "acos": _known(jnp.arccos, lambda u: -_power(1.0 - u * u, -0.5)),
    "atan": _known(jnp.arctan, lambda u: _reciprocal(1.0 + u * u)),
    "erf": _known(jax.scipy.special.erf, _erf_rate),
    "abs": lambda u: u * jnp.sign(u.first),
    "sign": lambda u: u.constant(jnp.sign(u.first)),
}


def _rule(name: str, plain: Callable) -> Callable:
    return lambda u: _RULES[name](u) if isinstance(u, Jet) else plain(u)


_PLAIN = operations(jnp, jax.scipy.special.erf)
_OPERATIONS = _PLAIN | {name: _rule(name, _PLAIN[name]) for name in _RULES} | {"power": _power}


class _States:
    """What a program takes its states from."""

    def __init__(self, points: jax.Array, of: Monomials):
        count, n = points.shape
        zeros = jnp.zeros((len(of.powers), count))
        units = [of.place[tuple(row)] for row in np.eye(n, dtype=int)]
        self.jets = [Jet(zeros.at[0].set(points[:, i]).at[units[i]].set(1.0), of) for i in range(n)]

    def __getitem__(self, key: Any) -> Jet:
        return self.jets[key[-1]]


def jets(expressions: Sequence[Any], model: Model, points: jax.Array, degree: int, theta: Any) -> list[Jet]:
    """The Taylor polynomials of expressions without time about `points` (count, n), up to `degree` >= 1; theta may be traced.

        >>> model = zakai.Model(state=["x"], drift=["exp(x)"], observation=["x"])
        >>> jets(model.drift, model, jnp.zeros((1, 1)), 3, model.theta())[0].coefficients[:, 0].round(3)
        Array([1.   , 1.   , 0.5  , 0.167], dtype=float64)
    """
    of = monomials(model.n, degree)
    states = _States(jnp.asarray(points, float), of)
    program = program_of(list(expressions), model)
    values = program.run(states, jnp.zeros(()), jnp.asarray(theta, float), _OPERATIONS)
    zero = states.jets[0] * 0.0
    return [v if isinstance(v := values[slot], Jet) else zero.constant(v) for slot in program.outputs]
