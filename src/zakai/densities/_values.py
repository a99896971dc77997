"""Checks of what densities are asked for, and angles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zakai.errors import InputError


def coordinate_numbers(names: tuple[str, ...], coordinates: int | str | Sequence[int | str]) -> list[int]:
    """Return the numbers of coordinates that are given by names or numbers.

    Raises:
        InputError: There is no such coordinate, or one is given twice.
    """
    wanted = [coordinates] if isinstance(coordinates, int | str | np.integer) else list(coordinates)
    numbers = []
    for one in wanted:
        if isinstance(one, str):
            if one not in names:
                raise InputError(f"marginal: there is no state '{one}'; the states are {', '.join(names)}")
            numbers.append(names.index(one))
        else:
            if not 0 <= int(one) < len(names):
                raise InputError(f"marginal: there is no state number {one}; numbers run from 0 to {len(names) - 1}")
            numbers.append(int(one))
    if not numbers or len(set(numbers)) < len(numbers):
        raise InputError("marginal: expected one state or several different ones")
    return numbers


def as_states(x: object, n: int) -> np.ndarray:
    """Return points (..., n); for one coordinate (...) is accepted too."""
    points = np.asarray(x, float)
    if n == 1 and points.shape[-1:] != (1,):
        points = points[..., None]
    if points.shape[-1:] != (n,):
        raise InputError(f"log_density: x has shape {points.shape}; expected (..., {n}), a coordinate for each state")
    return points


def sample_size(count: object) -> int:
    """Return the number of draws, checked."""
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
        raise InputError(f"sample: count is {count!r}; expected a whole number from 0")
    return int(count)


def generator(key: object) -> np.random.Generator:
    """Return NumPy's generator from an integer, a generator, or a JAX key."""
    if isinstance(key, np.random.Generator):
        return key
    if isinstance(key, int | np.integer):
        return np.random.default_rng(int(key))
    import jax

    data = jax.random.key_data(key) if jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key) else key  # type: ignore[attr-defined,arg-type]
    return np.random.default_rng(np.asarray(data).astype(np.uint64).tolist())


def wrap(angle: np.ndarray) -> np.ndarray:
    """Return an angle in (-pi, pi]; complex numbers keep their derivatives."""
    return np.asarray(angle + 2.0 * np.pi * np.floor((np.pi - np.real(angle)) / (2.0 * np.pi)))


def probabilities(q: Sequence[float]) -> np.ndarray:
    """Return probabilities, checked."""
    wanted = np.atleast_1d(np.asarray(q, float))
    if not np.all((wanted >= 0.0) & (wanted <= 1.0)):
        raise InputError("quantile: probabilities lie between 0 and 1")
    return wanted
