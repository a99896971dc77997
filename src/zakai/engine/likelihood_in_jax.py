"""The log-likelihood as a function that JAX differentiates and maps over, without JAX in its code."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from zakai.engine.likelihood import LogLikelihood

DIFFERENCE = 1e-5  # relative step of the differences of gradients that give second derivatives


def traced(function: LogLikelihood) -> Callable[[Any], Any]:
    """Return a function with derivatives for JAX: the second ones are central differences of the gradient."""
    import jax
    import jax.numpy as jnp

    p = len(function.names)

    def called(host: Callable[..., Any], shape: tuple[int, ...], values: Any, *rest: Any) -> Any:
        # Single precision, unless jax_enable_x64 is set.
        result = jax.ShapeDtypeStruct(shape, values.dtype)  # type: ignore[no-untyped-call]
        return jax.pure_callback(lambda *v: np.asarray(host(*v), values.dtype), result, values, *rest, vmap_method="sequential")

    @jax.custom_jvp
    def gradient(values: Any) -> Any:
        return called(lambda v: function.value_and_gradient(v)[1], (p,), values)

    def difference(values: Any, direction: Any) -> Any:
        values, direction = np.asarray(values), np.asarray(direction)
        size = np.max(np.abs(direction))
        if size == 0:
            return np.zeros(p)
        step = DIFFERENCE * max(np.max(np.abs(values)), 1e-3) / size
        above = function.value_and_gradient(values + step * direction)[1]
        return (above - function.value_and_gradient(values - step * direction)[1]) / (2 * step)

    @gradient.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        # The Hessian is symmetric; what JAX asks for is linear in the tangent.
        (values,), (tangent,) = primals, tangents
        columns = jnp.stack([called(difference, (p,), values, direction) for direction in jnp.eye(p)])
        return gradient(values), tangent @ columns

    @jax.custom_jvp
    def value(values: Any) -> Any:
        return called(lambda v: function(np.asarray(v)), (), values)

    @value.defjvp
    def _(primals: Any, tangents: Any) -> Any:
        (values,), (tangent,) = primals, tangents
        return value(values), gradient(values) @ tangent

    def in_jax(values: Any) -> Any:
        return value(jnp.asarray(values, dtype=float))

    return in_jax
