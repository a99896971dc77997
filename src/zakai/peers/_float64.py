"""JAX in double precision; every module of this package that imports JAX imports this one first."""

import jax

jax.config.update("jax_enable_x64", True)
