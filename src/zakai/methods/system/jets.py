"""Taylor polynomials of formulas in one variable, by automatic differentiation in Taylor mode.

A `Jet` is the Taylor polynomial in z of a function u(y + z), for many expansion points y at once.  A function w = g(u) obeys
w' = g'(u) u': each pass of

    w <- w(0) + int g'(u) u'

makes one more degree correct.  No difference quotient or symbolic derivative is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy

from zakai.errors import ConditionError, InputError
from zakai.models._program import Program
from zakai.models.functions import log_gamma, sinc
from zakai.models.model import Model
from zakai.models.numeric import COMPLEX, REAL, program_of
from zakai.numerics.series.power_series import cauchy, derivative, integral

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Jet:
    """A truncated power series: `coefficients` (terms, points), real or complex."""

    coefficients: Array

    __array_ufunc__ = None  # a NumPy number leaves arithmetic to this class

    def constant(self, value: Any) -> Jet:
        """Return the jet of a function that is constant in z."""
        return Jet(np.eye(len(self.coefficients), 1) * value + np.zeros(self.first.shape))

    @property
    def first(self) -> Array:
        """The values at z = 0."""
        return np.asarray(self.coefficients[0])

    def __add__(self, other: Any) -> Jet:
        added = other if isinstance(other, Jet) else self.constant(other)
        return Jet(self.coefficients + added.coefficients)

    def __mul__(self, other: Any) -> Jet:
        return Jet(cauchy(self.coefficients, other.coefficients) if isinstance(other, Jet) else self.coefficients * other)

    def __neg__(self) -> Jet:
        return self * -1.0

    def __sub__(self, other: Any) -> Jet:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Jet:
        return self.__neg__().__add__(other)

    def __truediv__(self, other: Any) -> Jet:
        return self.__mul__(_reciprocal(other) if isinstance(other, Jet) else 1.0 / other)

    def __rtruediv__(self, other: Any) -> Jet:
        return _reciprocal(self).__mul__(other)

    def __pow__(self, power: Any) -> Jet:
        result: Jet = _power(self, power)
        return result

    def __rpow__(self, base: Any) -> Jet:
        return _exp(self * np.log(base))

    __radd__, __rmul__ = __add__, __mul__

    def solved(self, first: Any, rate: Callable[[Jet], Jet]) -> Jet:
        """Return the w with w(0) = `first` and w' = rate(w) u', where u is this jet."""
        w, slope = self.constant(first), derivative(self.coefficients)
        for _ in slope:
            w = Jet(integral(cauchy(rate(w).coefficients, slope), w.first))
        return w


def _reciprocal(u: Jet) -> Jet:
    return u.solved(1.0 / u.first, lambda w: w * w * -1.0)


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
    return u.solved(u.first**p, lambda w: w * inverse * p)


def _plain(name: str, u: Any) -> Any:
    return (COMPLEX if np.iscomplexobj(u) else REAL)[name](u)


def _value(name: str, u: Jet) -> Any:
    """Return the value of a function at z = 0."""
    return _plain(name, u.first)


def _pair(names: tuple[str, str], sign: float, u: Jet) -> tuple[Jet, Jet]:
    """Return the sine and the cosine (`sign` -1), or the hyperbolic ones (1)."""
    (s, c), slope = (u.constant(_value(name, u)) for name in names), derivative(u.coefficients)
    for _ in slope:
        one, other = cauchy(c.coefficients, slope), sign * cauchy(s.coefficients, slope)
        s, c = Jet(integral(one, s.first)), Jet(integral(other, c.first))
    return s, c


def _solution(name: str, rate: Callable[[Jet], Jet]) -> Callable[[Jet], Jet]:
    """Return the rule of a function w = g(u) from its derivative as a function of w."""
    return lambda u: u.solved(_value(name, u), rate)


def _primitive(name: str, rate: Callable[[Jet], Jet]) -> Callable[[Jet], Jet]:
    """Return the rule of a function from its derivative as a function of u."""
    return lambda u: Jet(integral(cauchy(rate(u).coefficients, derivative(u.coefficients)), _value(name, u)))


def _nonzero_sign(u: Jet) -> Any:
    sign = _value("sign", u)
    return np.where(sign == 0, np.nan, sign)


_exp = _solution("exp", lambda w: w)
_tanh = _solution("tanh", lambda w: 1.0 - w * w)
_RULES: dict[str, Callable[[Jet], Jet]] = {
    "exp": _exp,
    "log": _primitive("log", _reciprocal),
    "sqrt": lambda u: _power(u, 0.5),
    "sin": lambda u: _pair(("sin", "cos"), -1.0, u)[0],
    "cos": lambda u: _pair(("sin", "cos"), -1.0, u)[1],
    "tan": _solution("tan", lambda w: 1.0 + w * w),
    "sinh": lambda u: _pair(("sinh", "cosh"), 1.0, u)[0],
    "cosh": lambda u: _pair(("sinh", "cosh"), 1.0, u)[1],
    "tanh": _tanh,
    "logcosh": _primitive("logcosh", _tanh),
    "asin": _primitive("asin", lambda u: _power(1.0 - u * u, -0.5)),
    "acos": _primitive("acos", lambda u: -_power(1.0 - u * u, -0.5)),
    "atan": _primitive("atan", lambda u: _reciprocal(1.0 + u * u)),
    "erf": _primitive("erf", lambda u: _exp(-(u * u)) * (2.0 / np.sqrt(np.pi))),
    "erfc": _primitive("erfc", lambda u: _exp(-(u * u)) * (-2.0 / np.sqrt(np.pi))),
    "abs": lambda u: u * _nonzero_sign(u),
    "sign": lambda u: u.constant(_nonzero_sign(u)),
}


def _rule(name: str) -> Callable[[Any], Any]:
    return lambda u: _RULES[name](u) if isinstance(u, Jet) else _plain(name, u)


def _composed(function: Callable[[Any, int], Any]) -> Callable[[Any, int], Any]:
    """Return the rule of a function whose derivative of order k is `function(u, k)`: its Taylor polynomial about u(0)."""

    def rule(u: Any, order: int) -> Any:
        if not isinstance(u, Jet):
            return function(u, order)
        rest, degree = u - u.first, len(u.coefficients) - 1
        w = u.constant(0.0)
        for k in range(degree, -1, -1):
            w = w * rest + function(u.first, order + k) / math.factorial(k)
        return w

    return rule


def _refused(name: str) -> Callable[..., Any]:
    """Return the rule of a function whose series is not known here."""

    def rule(*operands: Any) -> Any:
        if any(isinstance(operand, Jet) for operand in operands):
            raise ConditionError(f'the power series of {name} is not known; use kernel="flow", or the method yau-yau')
        return REAL[name](*operands)

    return rule


_ARITHMETIC = {"add", "multiply", "divide", "power", "general_power"}
_OPERATIONS = {name: function if name in _ARITHMETIC else _refused(name) for name, function in REAL.items()}
_OPERATIONS |= {name: _rule(name) for name in _RULES} | {"power": _power, "general_power": _power}
_OPERATIONS |= {"lgamma": _composed(log_gamma), "sinc": _composed(sinc)}


class _Variable:
    """What a program of one state takes its state from."""

    def __init__(self, points: Array, terms: int):
        self.jet = Jet(np.eye(terms, 1) * points + np.eye(terms, 1, -1))

    def __getitem__(self, key: Any) -> Jet:
        return self.jet


def _jets_of(program: Program, points: Array, terms: int, theta: Any) -> Array:
    variable = _Variable(points, max(terms, 2))
    with np.errstate(all="ignore"):
        values = program.run(variable, 0.0, theta, _OPERATIONS)
    found = [v if isinstance(v := values[slot], Jet) else variable.jet.constant(v) for slot in program.outputs]
    return np.stack([jet.coefficients[:terms] for jet in found])


def jets(expressions: Sequence[Any], model: Model, points: Array, degree: int, theta: Any) -> Array:
    """Return the coefficients (expressions, `degree` + 1, count) of Taylor polynomials in the state about `points` (count,).

    The expressions are those of a model of one state, without time; `theta` (p,) may be complex, for derivatives by the complex
    step.

        >>> model = zakai.Model(state=["x"], drift=["exp(x)"], observation=["x"])
        >>> jets(model.drift, model, np.zeros(1), 3, model.theta())[0, :, 0].round(3)
        array([1.   , 1.   , 0.5  , 0.167])
    """
    return _jets_of(program_of(list(expressions), model), points, degree + 1, theta)


class Expansion:
    """Expressions in t and other symbols, for many expansion points and values of the symbols.

    Args:
        entries: the expressions.
        t: time.
        symbols: the other symbols.

    Raises:
        ConditionError: a function whose series is not known here.
    """

    def __init__(self, entries: Sequence[sympy.Expr], t: sympy.Symbol, symbols: Sequence[sympy.Symbol]):
        self.entries, self.t = list(entries), t
        try:
            self._program = Program(self.entries, ((t,), sympy.Dummy(), tuple(symbols)))
        except InputError as error:
            raise ConditionError(
                f"the power series of {sympy.Matrix(self.entries)} in {t} is not known ({error}), and "
                'kernel="power-series" needs it; use kernel="flow"'
            ) from None

    def values(self, times: Any, theta: Array) -> Array:
        """Return the values (*times.shape, entries)."""
        times = np.asarray(times, float)
        with np.errstate(all="ignore"):
            found = self._program.run(times[..., None], 0.0, theta, COMPLEX if np.iscomplexobj(theta) else REAL)
        return np.stack([found[slot] + np.zeros(times.shape) for slot in self._program.outputs], axis=-1)

    def taylor(self, points: Any, terms: int, theta: Array) -> Array:
        """Return the first `terms` coefficients (terms, *points.shape, entries); theta may be complex.

        Raises:
            ConditionError: an expression is not analytic at one of the points.
        """
        points = np.asarray(points, float)
        found = _jets_of(self._program, points.reshape(-1), terms, theta)
        for expression, coefficients in zip(self.entries, found, strict=True):
            finite = np.isfinite(coefficients).all(axis=0)
            if not finite.all():
                raise ConditionError(
                    f"{expression} has no power series about {self.t} = {points.reshape(-1)[~finite][0]:g}, and "
                    'kernel="power-series" needs one; use kernel="flow"'
                )
        return np.moveaxis(found, 0, -1).reshape(terms, *points.shape, len(self.entries))
