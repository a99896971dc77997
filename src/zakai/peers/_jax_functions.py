"""The formulas of a model as JAX functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from zakai.peers import _float64  # noqa: F401  (sets double precision before JAX is used)

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np

from zakai.models._program import operations
from zakai.models.functions import NEAR, NODES, WEIGHTS
from zakai.models.numeric import flattened, program_of

if TYPE_CHECKING:
    from zakai.models.model import Model

JaxFunction = Callable[[Any, Any, Any], jax.Array]


def _sinc(x: Any, order: int) -> jax.Array:
    """Return the derivative of some order of sin(x) / x as `models/functions.py` computes it."""
    near = jnp.abs(x) <= NEAR + 2 * order
    nodes, weights = (NODES + 1) / 2, WEIGHTS / 2
    small = jnp.where(near, x, 0.0)
    integral = jnp.sum(jnp.cos(small * nodes + order * np.pi / 2) * (weights * nodes**order))
    large = jnp.where(near, 1.0, x)
    recursion = jnp.sin(large) / large
    for k in range(1, order + 1):
        recursion = (jnp.sin(large + k * np.pi / 2) - k * recursion) / large
    return jnp.where(near, integral, recursion)


def _table(evaluated: Any, *arguments: Any) -> jax.Array:
    """Return the value of a table, or of its derivative, at one point: a sum of products of the B-splines that are not zero."""
    table, orders = evaluated.func, evaluated.keywords["orders"]
    degree = table.degree
    pieces, coefficients = table.pieces()
    index, factors = [], []
    for axis, (knots, polynomials), x, order in zip(table.axes, pieces, arguments, orders, strict=True):
        if table.periodic:
            x = axis[0] + jnp.mod(x - axis[0], axis[-1] - axis[0])
        inside = jnp.clip(x, axis[0], axis[-1])
        place = jnp.clip(jnp.searchsorted(knots, inside, side="right") - 1, degree, len(knots) - degree - 2)
        own = jnp.asarray(polynomials)[place - degree]
        for _ in range(order):
            own = own[:, :-1] * np.arange(own.shape[1] - 1, 0, -1) if own.shape[1] > 1 else 0.0 * own
        value = jnp.zeros(own.shape[0])
        for column in own.T:
            value = value * (inside - jnp.asarray(knots)[place]) + column
        factors.append(jnp.where((x == inside) | (order == 0), value, 0.0))
        index.append(place - degree)
    for factor, first in zip(factors, index, strict=True):
        block = jax.lax.dynamic_slice_in_dim(jnp.asarray(coefficients), first, degree + 1, axis=0)
        coefficients = jnp.tensordot(factor, block, axes=1)
    return jnp.asarray(coefficients)


def _log_gamma(x: Any, order: int) -> jax.Array:
    return jax.scipy.special.gammaln(x) if order == 0 else jax.scipy.special.polygamma(order - 1, x)


_JAX = operations(
    jnp, jax.scipy.special.erf, sinc=_sinc, table=_table, erfc=jax.scipy.special.erfc, lgamma=_log_gamma
)


def jax_function(expressions: Any, model: Model, shape: Sequence[int] | None = None) -> JaxFunction:
    """Return the expressions as one pure function f(x, t, theta) for `jit`, `vmap` and `grad`.

    Args:
        expressions: a list or Matrix in the model's state, t and parameters.
        model: the model.
        shape: the shape of the value; by default that of the Matrix, and (k,) for a column.

    Returns:
        A function of x (n,), a scalar t and theta (p,), with float64 values.

    Raises:
        InputError: an undetermined function.

    Example:
        model = zakai.load_model("gallery:benes")
        jax_function(model.drift, model)(jnp.zeros(1), 0.0, model.theta())
    """
    flat, shape = flattened(expressions, shape)
    program = program_of(flat, model)

    if program.constant_outputs:
        constant = np.array([program.instructions[slot].constant for slot in program.outputs], dtype=float).reshape(shape)
        return lambda x, t, theta: jnp.asarray(constant)

    def function(x: Any, t: Any, theta: Any) -> jax.Array:
        x, t, theta = (jnp.asarray(a, dtype=jnp.float64) for a in (x, t, theta))
        values = program.run(x, t, theta, _JAX)
        return jnp.stack([jnp.asarray(values[slot], dtype=jnp.float64) for slot in program.outputs]).reshape(shape)

    return function
