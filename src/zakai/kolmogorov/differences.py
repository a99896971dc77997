"""Central differences along an axis of a lattice, the same for NumPy and for JAX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from zakai import _float64  # noqa: F401
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax

SECOND_ORDER = (1 / 2,)
SIXTH_ORDER = (45 / 60, -9 / 60, 1 / 60)
OUTER = len(SIXTH_ORDER)  # layers on each side of which the differences are of lower order


def differences(values: Any, axis: int) -> Any:
    """The slope of an array of NumPy or JAX along an axis, a cell the unit: of sixth order but for the `OUTER` layers on each
    side, where a lattice has next to nothing of its density."""
    xp, size = numpy_or_jax(values), values.shape[axis]

    def part(begin: int, end: int) -> Any:
        return values[(slice(None),) * axis + (slice(begin, end),)]

    def central(begin: int, end: int, weights: Sequence[float]) -> Any:
        apart = (w * (part(begin + k, end + k) - part(begin - k, end - k)) for k, w in enumerate(weights, 1))
        return sum(apart, start=0.0)

    inner = central(OUTER, size - OUTER, SIXTH_ORDER)
    near, far = central(1, OUTER, SECOND_ORDER), central(size - OUTER, size - 1, SECOND_ORDER)
    ends = part(1, 2) - part(0, 1), part(size - 1, size) - part(size - 2, size - 1)
    return xp.concatenate([ends[0], near, inner, far, ends[1]], axis=axis)
