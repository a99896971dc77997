"""Taylor polynomials in n variables by automatic differentiation in Taylor mode.

A `Jet` is the Taylor polynomial in z of a function u(y + z), for many expansion points y at once.  A function w = g(u) obeys
E w = g'(u) E u with E = z . grad, which multiplies terms of degree j by j: each pass of

    w <- w(0) + E^-1 (g'(u) E u)

makes one more degree correct.  No difference quotient or symbolic derivative is taken.
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial, reduce
from typing import Any

import numpy as np

from zakai.models._program import Program
from zakai.models.model import Model
from zakai.models.numeric import COMPLEX, REAL, program_of

Array = np.ndarray


@dataclass(frozen=True)
class Monomials:
    """The monomials in n variables up to a degree, and how they multiply."""

    n: int
    degree: int

    @cached_property
    def powers(self) -> Array:
        """The exponents (count, n), ordered by degree."""
        found = [p for p in itertools.product(range(self.degree + 1), repeat=self.n) if sum(p) <= self.degree]
        return np.array(sorted(found, key=lambda p: (sum(p), p)))

    @cached_property
    def place(self) -> dict[tuple[int, ...], int]:
        """The row of each exponent."""
        return {tuple(p): i for i, p in enumerate(self.powers)}

    @cached_property
    def degrees(self) -> Array:
        """The total degree (count,) of each monomial."""
        return np.asarray(self.powers.sum(axis=1))

    @cached_property
    def products(self) -> tuple[Array, Array, Array]:
        """The pairs (left, right) of monomials sorted by their product, and the first pair of each product."""
        pairs = [
            (self.place[tuple(a + b)], i, j)
            for i, a in enumerate(self.powers)
            for j, b in enumerate(self.powers)
            if self.degrees[i] + self.degrees[j] <= self.degree
        ]
        product, left, right = np.array(sorted(pairs)).T
        return left, right, np.searchsorted(product, np.arange(len(self.powers)))

    def lowered(self, i: int) -> Array:
        """The matrix (count, count) of d/dz_i."""
        matrix = np.zeros((len(self.powers), len(self.powers)))
        for column, power in enumerate(self.powers):
            if power[i]:
                matrix[self.place[tuple(power - (np.arange(self.n) == i))], column] = power[i]
        return matrix

    def values(self, z: Array) -> Array:
        """All monomials (..., count) at z (..., n)."""
        ladders = [[np.ones(z.shape[:-1])] for _ in range(self.n)]
        for i, ladder in enumerate(ladders):
            for _ in range(self.degree):
                ladder.append(ladder[-1] * z[..., i])
        return np.stack([reduce(operator.mul, [ladders[i][k] for i, k in enumerate(p)]) for p in self.powers], axis=-1)


@cache
def monomials(n: int, degree: int) -> Monomials:
    """Return the monomials in n variables up to a degree, made once."""
    return Monomials(n, degree)


@dataclass(frozen=True, eq=False)
class Jet:
    """A truncated polynomial in z: `coefficients` (count, points) of the `monomials`, real or complex."""

    coefficients: Array
    monomials: Monomials

    __array_ufunc__ = None  # a NumPy number leaves arithmetic to this class

    def _like(self, coefficients: Array) -> Jet:
        return Jet(coefficients, self.monomials)

    @property
    def _unit(self) -> Array:
        return np.eye(len(self.monomials.powers), 1)

    def constant(self, value: Any) -> Jet:
        """Return the jet of a function that is constant in z."""
        return self._like(self._unit * value + np.zeros(self.first.shape))

    @property
    def first(self) -> Array:
        """The values at z = 0."""
        return np.asarray(self.coefficients[0])

    def __add__(self, other: Any) -> Jet:
        if isinstance(other, Jet):
            return self._like(self.coefficients + other.coefficients)
        return self._like(self.coefficients + self._unit * other)

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return self._like(self.coefficients * other)
        left, right, first = self.monomials.products
        return self._like(np.add.reduceat(self.coefficients[left] * other.coefficients[right], first, axis=0))

    def __neg__(self) -> Jet:
        return self * -1.0

    def __sub__(self, other: Any) -> Jet:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Jet:
        return self.__neg__().__add__(other)

    def __truediv__(self, other: Any) -> Jet:
        result: Jet = self * (_reciprocal(other) if isinstance(other, Jet) else 1.0 / other)
        return result

    def __rtruediv__(self, other: Any) -> Jet:
        result: Jet = _reciprocal(self) * other
        return result

    def __pow__(self, power: Any) -> Jet:
        result: Jet = _power(self, power)
        return result

    def __rpow__(self, base: Any) -> Jet:
        return _exp(self * np.log(base))

    __radd__, __rmul__ = __add__, __mul__

    def derivative(self, i: int) -> Jet:
        """Return d/dz_i; the highest degree is lost."""
        return self._like(self.monomials.lowered(i) @ self.coefficients)

    def radial(self, k: int) -> Jet:
        """Return int_0^1 s^(k-1) p(s z) ds; for k = 0 of a polynomial without a constant."""
        return self._like(self.coefficients / np.maximum(k + self.monomials.degrees, 1)[:, None])

    def truncated(self, degree: int) -> Jet:
        """Return the terms up to a degree."""
        return self._like(self.coefficients * (self.monomials.degrees <= degree)[:, None])

    @property
    def scaled(self) -> Jet:
        """E u: every term times its degree."""
        return self._like(self.coefficients * self.monomials.degrees[:, None])

    def solved(self, first: Any, rate: Callable[[Jet], Jet]) -> Jet:
        """Return the w with w(0) = `first` and E w = rate(w) E u, where u is this jet."""
        w, scaled = self.constant(first), self.scaled
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
    if isinstance(p, Jet):
        return _exp(p * (_RULES["log"](u) if isinstance(u, Jet) else np.log(u)))
    if not isinstance(u, Jet):
        return u**p
    if np.ndim(p) == 0 and complex(p) == int(np.real(p)) and np.real(p) >= 0:
        w, count = u.constant(1.0), int(np.real(p))
        while count:
            w, u, count = (w * u if count % 2 else w), u * u, count // 2
        return w
    inverse = _reciprocal(u)
    return u.solved(u.first**p, lambda w: p * w * inverse)


def _pair(u: Jet, sine: Any, cosine: Any, sign: float) -> tuple[Jet, Jet]:
    """Return the sine and the cosine (`sign` -1), or the hyperbolic ones (1)."""
    scaled, s, c = u.scaled, u.constant(sine), u.constant(cosine)
    for _ in range(u.monomials.degree):
        s, c = (c * scaled).radial(0) + sine, (s * scaled).radial(0) * sign + cosine
    return s, c


def _plain(name: str, u: Any) -> Any:
    return (COMPLEX if np.iscomplexobj(u) else REAL)[name](u)


def _value(name: str, u: Jet) -> Any:
    """Return the value of a function at z = 0."""
    return _plain(name, u.first)


def _circular(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, _value("sin", u), _value("cos", u), -1.0)


def _hyperbolic(u: Jet) -> tuple[Jet, Jet]:
    return _pair(u, _value("sinh", u), _value("cosh", u), 1.0)


def _tanh(u: Jet) -> Jet:
    return u.solved(_value("tanh", u), lambda w: 1.0 - w * w)


def _known(name: str, rate: Callable[[Jet], Jet]) -> Callable[[Jet], Jet]:
    """Return the rule of a function from its derivative, a function of u."""
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
    "abs": lambda u: u * _nonzero_sign(u),
    "sign": lambda u: u.constant(_nonzero_sign(u)),
}


def _nonzero_sign(u: Jet) -> Any:
    sign = _value("sign", u)
    return np.where(sign == 0, np.nan, sign)


def _rule(name: str) -> Callable[[Any], Any]:
    return lambda u: _RULES[name](u) if isinstance(u, Jet) else _plain(name, u)


_OPERATIONS = REAL | {name: _rule(name) for name in _RULES} | {"power": _power, "general_power": _power}


class _States:
    """What a program takes its states from."""

    def __init__(self, points: Array, of: Monomials):
        count = len(of.powers)
        units = [of.place[tuple(row)] for row in np.eye(of.n, dtype=int)]
        self.jets: list[Jet] = [Jet(np.eye(count, 1) * points[:, i] + np.eye(count, 1, -u), of) for i, u in enumerate(units)]

    def __getitem__(self, key: Any) -> Jet:
        return self.jets[int(key[-1])]


def jets_of(program: Program, points: Array, degree: int, theta: Any) -> list[Jet]:
    """Return the Taylor polynomials of a program's outputs about `points` (count, n), up to `degree` >= 1; time is 0."""
    states = _States(points, monomials(points.shape[1], degree))
    with np.errstate(all="ignore"):
        values = program.run(states, 0.0, theta, _OPERATIONS)
    zero = states.jets[0] * 0.0
    return [v if isinstance(v := values[slot], Jet) else zero.constant(v) for slot in program.outputs]


def jets(expressions: Sequence[Any], model: Model, points: Array, degree: int, theta: Any) -> list[Jet]:
    """Return the Taylor polynomials of expressions without time about `points` (count, n), up to `degree` >= 1.

    `theta` (p,) may be complex, for derivatives by the complex step.

        >>> model = zakai.Model(state=["x"], drift=["exp(x)"], observation=["x"])
        >>> jets(model.drift, model, np.zeros((1, 1)), 3, model.theta())[0].coefficients[:, 0].round(3)
        array([1.   , 1.   , 0.5  , 0.167])
    """
    return jets_of(program_of(list(expressions), model), points, degree, theta)
