"""dynamax' filters, imported without their side effect: dynamax sets the precision of all of JAX's matrix products."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from zakai.peers import _float64  # noqa: F401

import jax  # isort: skip


def _imported(*names: str) -> tuple[ModuleType, ...]:
    precision = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    try:
        return tuple(import_module(f"dynamax.nonlinear_gaussian_ssm.{name}") for name in names)
    finally:
        jax.config.update("jax_default_matmul_precision", precision)


inference_ekf, inference_ukf = _imported("inference_ekf", "inference_ukf")
