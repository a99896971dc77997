"""The formulas of a model as JAX functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from zakai.peers import _float64  # noqa: F401  (sets double precision before JAX is used)

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np

from zakai.models._program import operations
from zakai.models.numeric import flattened, program_of

if TYPE_CHECKING:
    from zakai.models.model import Model

JaxFunction = Callable[[Any, Any, Any], jax.Array]
_JAX = operations(jnp, jax.scipy.special.erf)


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
