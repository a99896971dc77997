"""dynamax' filters, imported so that JAX stays as it is: dynamax sets the precision of all matrix products to "float32"."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

import jax

from zakai import _float64  # noqa: F401


def _imported(*names: str) -> tuple[ModuleType, ...]:
    precision = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    try:
        return tuple(import_module(f"dynamax.nonlinear_gaussian_ssm.{name}") for name in names)
    finally:
        jax.config.update("jax_default_matmul_precision", precision)


inference_ekf, inference_ukf = _imported("inference_ekf", "inference_ukf")
