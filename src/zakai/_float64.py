"""The one place where JAX is told to compute in double precision.

Every module that imports JAX imports this one first. A density is a product of thousands of factors; single precision loses it.
"""

import jax

jax.config.update("jax_enable_x64", True)
