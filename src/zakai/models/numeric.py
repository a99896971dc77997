"""The formulas of a model as NumPy functions, and the reason in words when one of them is not finite."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.errors import InputError
from zakai.models._program import Program, operations

if TYPE_CHECKING:
    from zakai.models.model import Model

Array = NDArray[Any]
NumericFunction = Callable[..., Array]


def _erf(x: Array) -> Array:
    # Few models have one, and every command would wait for SciPy.
    from scipy.special import erf

    return erf(x)


REAL = operations(np, _erf)


def _inexact(values: Array) -> Array:
    values = np.asarray(values)
    return values if values.dtype == complex else np.asarray(values, dtype=float)


def _sign(values: Array) -> Array:
    return np.sign(np.real(values))


def _absolute(values: Array) -> Array:
    return np.where(np.real(values) < 0, -values, values)


def _complex_erf(values: Array) -> Array:
    slope = 2.0 / np.sqrt(np.pi) * np.exp(-(np.real(values) ** 2))
    return _erf(np.real(values)) + 1j * slope * np.imag(values)


def _complex_log_cosh(values: Array) -> Array:
    size = _absolute(values)
    return size + np.log1p(np.exp(-2.0 * size)) - np.log(2.0)


def _chosen(first: Array, second: Array, choose_first: Array) -> Array:
    return np.where(choose_first | np.isnan(np.real(first)), first, second)


def _complex_log1p(values: Array) -> Array:
    return np.log1p(np.real(values)) + 1j * np.imag(values) / (1.0 + np.real(values))


def _complex_atan2(y: Array, x: Array) -> Array:
    size = np.real(x) ** 2 + np.real(y) ** 2
    return np.arctan2(np.real(y), np.real(x)) + 1j * (np.imag(y) * np.real(x) - np.imag(x) * np.real(y)) / size


# Functions that keep a derivative by the complex step, to first order in the imaginary part.
COMPLEX = operations(
    np,
    _complex_erf,
    abs=_absolute,
    sign=_sign,
    logcosh=_complex_log_cosh,
    atan2=_complex_atan2,
    min=lambda a, b: _chosen(a, b, np.real(a) <= np.real(b)),
    max=lambda a, b: _chosen(a, b, np.real(a) >= np.real(b)),
    floor=lambda u: np.floor(np.real(u)),
    log1p=_complex_log1p,
    expm1=lambda u: np.expm1(np.real(u)) + 1j * np.exp(np.real(u)) * np.imag(u),
)


def flattened(expressions: Any, shape: Sequence[int] | None = None) -> tuple[list[sympy.Expr], tuple[int, ...]]:
    """The expressions of a list or Matrix in order, and the shape of their values ((k,) for a column)."""
    if isinstance(expressions, sympy.MatrixBase):
        natural: tuple[int, ...] = expressions.shape if expressions.shape[1] != 1 else (expressions.shape[0],)
        flat = expressions.flat()  # one entry after the other is slow for a million
    elif isinstance(expressions, sympy.Basic):
        natural, flat = (), [expressions]
    else:
        flat = list(expressions)
        natural = (len(flat),)
    shape = natural if shape is None else tuple(shape)
    if int(np.prod(shape, dtype=int)) != len(flat):
        raise ValueError(f"{len(flat)} expressions do not fill the shape {shape}")
    return flat, shape


def program_of(expressions: Sequence[sympy.Expr], model: Model, stable: bool = False) -> Program:
    """The program that computes the expressions from the model's x, t, parameters and inputs, and from its observations z."""
    return Program(expressions, (model.x, model.t, model.parameter_symbols, model.u, model.z), stable)


def numpy_function(expressions: Any, model: Model, shape: Sequence[int] | None = None) -> NumericFunction:
    """The expressions as one function f(x, t, theta, u=None, z=None) of NumPy arrays.

    `expressions` is a list or Matrix in the model's state, t, parameters and inputs; `shape` is the shape of one
    value (the Matrix' own by default). f takes x (..., n), t (...), theta (p,), the inputs u (..., number of inputs) at t and,
    for `observation_log_density`, the observations z (..., m), and broadcasts them; what does not exist is nan. Complex
    arguments give complex values, for derivatives by the complex step. Raises InputError for an undetermined function, and f if
    u is needed and None.

        >>> from zakai.models import load_model
        >>> model = load_model("gallery:benes")
        >>> f = numpy_function(model.drift, model)
        >>> f(np.zeros((5, model.n)), 0.0, model.theta()).shape
        (5, 1)
    """
    flat, shape = flattened(expressions, shape)
    program = program_of(flat, model, stable=True)
    needs_inputs = program.needs_inputs

    def function(x: Any, t: Any, theta: Any, u: Any = None, z: Any = None) -> np.ndarray:
        if needs_inputs and u is None:
            raise InputError(f"{model.source}: inputs: the values of {', '.join(model.inputs)} are missing")
        x, t, theta = _inexact(x), _inexact(t), _inexact(theta)
        shapes = {x.shape[:-1], t.shape, theta.shape[:-1]}
        if u is not None or z is not None:
            u, z = (None if a is None else np.asarray(a, dtype=float) for a in (u, z))
            shapes |= {a.shape[:-1] for a in (u, z) if a is not None}
        shapes.discard(())
        batch = shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)
        derivative = complex in (x.dtype, t.dtype, theta.dtype)
        with np.errstate(all="ignore"):
            values = program.run(x, t, theta, COMPLEX if derivative else REAL, u, z)
        result = np.empty((*batch, len(flat)), complex if derivative else float)
        for column, slot in enumerate(program.outputs):
            result[..., column] = values[slot]
        return result.reshape((*batch, *shape))

    return function


_DOMAINS = {
    "log": lambda u: "log of a negative number" if u < 0 else "log of zero",
    "sqrt": lambda u: "square root of a negative number",
    "asin": lambda u: "asin outside [-1, 1]",
    "acos": lambda u: "acos outside [-1, 1]",
    "power": lambda u: "division by zero" if u == 0 else "fractional power of a negative number",
    "general_power": lambda u: "power of a negative number",
}


def explain_nonfinite(model: Model, key: str, expressions: Any, x: Any, t: float, u: Any = None) -> str:
    """Say which innermost part of the expressions is not finite at a point, and why, in one line.

    `key` is the name of the expressions in the model file; `x` has shape (n,). The empty string if all are
    finite.

        >>> from zakai.models import Model
        >>> model = Model(state=["x"], drift=["0"], observation=["log(x)"])
        >>> explain_nonfinite(model, "observation", model.observation, [-0.3], 0.2)
        'observation[0] = log(x): log of a negative number at x = -0.3, t = 0.2'
    """
    flat, shape = flattened(expressions)
    x = np.asarray(x, dtype=float)
    point = ", ".join(
        [
            *(f"{name} = {value:.6g}" for name, value in zip(model.state, x, strict=True)),
            f"t = {float(t):.6g}",
            *(f"{name} = {value:.6g}" for name, value in zip(model.inputs, [] if u is None else u)),
        ]
    )
    for index, expr in enumerate(flat):
        program = program_of([expr], model)
        with np.errstate(all="ignore"):
            values = program.run(x, np.float64(t), model.theta(), REAL, u)
        if np.isfinite(values[program.outputs[0]]):
            continue
        place = key + "".join(f"[{i}]" for i in np.unravel_index(index, shape))
        for instruction, value in zip(program.instructions, values, strict=True):
            if not np.isfinite(value):
                arguments = [float(values[slot]) for slot in instruction.operands]
                inner = "" if instruction.expr == expr else f" in {str(instruction.expr)[:60]}"
                reason = _reason(instruction.operation, arguments, float(value))
                return f"{place} = {str(expr)[:80]}: {reason}{inner} at {point}"
    return ""


def _reason(operation: str, arguments: list[float], value: float) -> str:
    if operation in ("x", "t", "theta", "u"):
        return "the point itself is not finite"
    if operation == "divide" and arguments[1] == 0:
        return "division by zero"
    if operation in _DOMAINS and (np.isnan(value) or arguments[0] == 0):
        return _DOMAINS[operation](arguments[0])
    return "larger than double precision can hold" if np.isinf(value) else "no numerical value"
