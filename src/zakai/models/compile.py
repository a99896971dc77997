"""The formulas of a model as JAX functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from zakai import _float64  # noqa: F401  (sets double precision before JAX is used)

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
from jax.experimental.xla_metadata import set_xla_metadata  # isort: skip
import numpy as np

from zakai.models import _trigonometry
from zakai.models._program import operations
from zakai.models.numeric import flattened, program_of

if TYPE_CHECKING:
    from zakai.models.model import Model

JaxFunction = Callable[[Any, Any, Any], jax.Array]
_JAX = operations(jnp, jax.scipy.special.erf, sin=_trigonometry.sin, cos=_trigonometry.cos)


# Half of what a processor can do at once, unless it is asked for all.
WIDE = (("xla_cpu_prefer_vector_width", 512),)
# To hand a part of something small to another thread takes longer than the whole.
PART_BY_PART = (*WIDE, ("xla_cpu_scheduler_type", "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"))
ONE_THREAD = (*PART_BY_PART, ("xla_cpu_multi_thread_eigen", False))


@lru_cache(maxsize=3)
def _known(options: tuple[tuple[str, Any], ...]) -> dict[str, Any]:
    """These options of the CPU's compiler, or none where it is another's or they are those of another version."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=dict(options)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return dict(options)


def jit_small(function: Callable[..., Any], static_argnums: int | tuple[int, ...] = ()) -> Any:
    """`jax.jit` for what takes microseconds."""
    return jax.jit(function, static_argnums=static_argnums, compiler_options=_known(ONE_THREAD))


def jit_loop(function: Callable[..., Any], static_argnums: int | tuple[int, ...] = ()) -> Any:
    """`jax.jit` for loops over steps that take microseconds, in which products may yet be large."""
    return jax.jit(function, static_argnums=static_argnums, compiler_options=_known(PART_BY_PART))


def jit_large(function: Callable[..., Any], static_argnums: int | tuple[int, ...] = ()) -> Any:
    """`jax.jit` for loops over steps whose parts are worth a thread."""
    return jax.jit(function, static_argnums=static_argnums, compiler_options=_known(WIDE))


def one_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, which within `jax.jit` becomes one kernel on a CPU: for what takes little more time than it takes to
    start a kernel.

    Products are plain loops then, and what a library of linear algebra does is not to be had.
    """

    def within(*args: Any) -> Any:
        # What the function itself calls is as it would be.
        with set_xla_metadata(inlineable="true", xla_cpu_small_call="false"):
            return function(*args)

    compiled = jax.jit(within)

    def called(*args: Any) -> Any:
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return compiled(*args)

    return called if jax.default_backend() == "cpu" else function


def jax_function(expressions: Any, model: Model, shape: Sequence[int] | None = None) -> JaxFunction:
    """The expressions as one pure JAX function f(x, t, theta).

    `expressions` is a list or Matrix in the model's state, t and parameters; `shape` is the shape of the
    value (by default the Matrix' own, and (k,) for a column). f takes x (n,), a scalar t and theta (p,),
    returns float64, and may be used under `jit`, `vmap` and `grad`. Raises InputError for an undetermined
    function.

        >>> from zakai.models import load_model
        >>> model = load_model("gallery:benes")
        >>> jax_function(model.drift, model)(jnp.zeros(1), 0.0, model.theta())
        Array([0.], dtype=float64)
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


def jax_field(expressions: Any, model: Model) -> Callable[[Any, Any, Any], tuple[jax.Array, ...]]:
    """The expressions as one function of many states at once: f(x, t, theta) with x (..., n) gives an array (...) for each.

    Each expression is one vectorised loop over the points. They are not stacked: a compiler that fuses a stack into what
    uses it computes every entry twice, one number at a time. Raises InputError for an undetermined function.

        >>> from zakai.models import load_model
        >>> model = load_model("gallery:spiral-sensor")
        >>> len(jax_field(model.observation, model)(jnp.zeros((100, 1)), 0.0, model.theta()))
        2
    """
    flat, _ = flattened(expressions)
    program = program_of(flat, model)

    def function(x: Any, t: Any, theta: Any) -> tuple[jax.Array, ...]:
        values = program.run(x, jnp.asarray(t, dtype=jnp.float64), jnp.asarray(theta, dtype=jnp.float64), _JAX)
        shape = jnp.shape(x)[:-1]
        return tuple(jnp.broadcast_to(jnp.asarray(values[slot], dtype=jnp.float64), shape) for slot in program.outputs)

    return function


@dataclass(frozen=True, eq=False)
class CompiledModel:
    """The parts of a model as JAX functions of (x, t, theta); `covariance` is G = g Q g'."""

    drift: JaxFunction
    observation: JaxFunction
    diffusion: JaxFunction
    process_noise: JaxFunction
    covariance: JaxFunction
    observation_noise: JaxFunction


_COMPILED: WeakKeyDictionary[Model, CompiledModel] = WeakKeyDictionary()


def compile_model(model: Model) -> CompiledModel:
    """All parts of a model as JAX functions, made once for each model object.

    Values have the shapes drift (n,), observation (m,), diffusion (n, r), process_noise (r, r), covariance
    (n, n) and observation_noise (m, m). Raises InputError for a model with undetermined functions.

        >>> from zakai.models import load_model
        >>> model = load_model("gallery:benes")
        >>> compile_model(model).covariance(jnp.zeros(1), 0.0, model.theta())
        Array([[1.]], dtype=float64)
    """
    if model not in _COMPILED:
        matrices = ("diffusion", "process_noise", "covariance", "observation_noise")
        parts = {key: jax_function(getattr(model, key), model, getattr(model, key).shape) for key in matrices}
        vectors = {key: jax_function(getattr(model, key), model) for key in ("drift", "observation")}
        _COMPILED[model] = CompiledModel(**vectors, **parts)
    return _COMPILED[model]
