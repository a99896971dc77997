"""One step of a method as one compiled function of two vectors, for a filter that is called thousands of times a second.

A call takes its time for every array that goes in or comes out.  So one vector holds a whole state with what the step told, and
another a whole interval with its reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters._protocol import Info, Method


class Layout(NamedTuple):
    """How a pytree of arrays is laid in a vector of float64, which holds every number that a step is made of exactly."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    types: tuple[str, ...]

    @classmethod
    def of(cls, tree: Any) -> Layout:
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple(np.shape(leaf) for leaf in leaves), tuple(np.dtype(_type(leaf)).str for leaf in leaves))

    @classmethod
    def of_rows(cls, tree: Any) -> Layout:
        """That of one row of a pytree whose arrays have a leading axis."""
        whole = cls.of(tree)
        return whole._replace(shapes=tuple(shape[1:] for shape in whole.shapes))

    @property
    def size(self) -> int:
        return sum(math.prod(shape) for shape in self.shapes)

    def unpacked(self, vector: Any) -> Any:
        """The pytree that begins a vector; JAX may trace it."""
        leaves = []
        for (begin, end), shape, kind in zip(_places(self.shapes), self.shapes, self.types, strict=True):
            leaf = vector[begin:end].reshape(shape)
            leaves.append(leaf if kind == "<f8" else leaf.astype(kind))
        return jax.tree.unflatten(self.tree, leaves)


@lru_cache(maxsize=256)
def _places(shapes: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, int], ...]:
    """Where in a vector each array begins and ends."""
    ends = np.cumsum([0, *(math.prod(shape) for shape in shapes)]).tolist()
    return tuple(pairwise(ends))


def _type(leaf: Any) -> Any:
    return leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype


def packed(tree: Any) -> np.ndarray:
    """A pytree as a vector."""
    return np.concatenate([np.zeros(0), *(np.ravel(np.asarray(leaf)).astype(float) for leaf in jax.tree.leaves(tree))])


def packed_rows(tree: Any, count: int) -> np.ndarray:
    """A pytree whose arrays have a leading axis, as a matrix (count, size)."""
    leaves = (np.asarray(leaf).reshape(count, -1).astype(float) for leaf in jax.tree.leaves(tree))
    return np.concatenate([np.zeros((count, 0)), *leaves], axis=1)


class Step(NamedTuple):
    """A compiled step: `call(vector, inputs)` gives the vector of the new state, with what was told behind it.

    `inputs` are the values of the reading, zero where there is none, and a row of a Block.  `state` is the layout before and
    `new` that after; `info` is that of the Info; the last number is its verdict.
    """

    call: Callable[[Any, np.ndarray], Any]
    state: Layout
    new: Layout
    info: Layout
    begin: int  # of what is told, in the vector

    def begun(self, state: Any) -> np.ndarray:
        """The vector of a state that no step told of."""
        return np.concatenate([packed(state), np.zeros(self.info.size + 1)])


class Told(NamedTuple):
    """The Info of one step, out of its vector."""

    vector: np.ndarray
    layout: Layout

    @property
    def info(self) -> Info:
        return self.layout.unpacked(self.vector)

    @property
    def verdict(self) -> float:
        """One where the step kept what `adapt` looks at, zero where it did not, nan where nothing of the density was left."""
        return self.vector.item(-1)

    @property
    def well(self) -> bool:
        return self.verdict == 1.0


def compiled(method: Method, state: Layout, inputs: Layout, values: int) -> Step:
    """The step for a state and inputs of these layouts; `values` is how many a reading has."""
    return _compiled(method.step, method.fits, method.healthy, method.adapt is None, state, inputs, values)


@lru_cache(maxsize=128)
def _compiled(step, fits, healthy, rigid: bool, state: Layout, inputs: Layout, values: int) -> Step:
    def stepped(vector: Any, given: Any) -> tuple[Any, Info]:
        interval, rule = inputs.unpacked(given[values:])
        return step(interval, state.unpacked(vector), rule(given[:values]))

    def one(vector: Any, given: Any) -> Any:
        new, info = stepped(vector, given)
        well = jnp.array(rigid) if fits is None and healthy is None else fits(new, info) if fits else healthy(info)
        # With the evidence and the mean all the rest is finite.
        finite = jnp.isfinite(info.log_likelihood_increment + jnp.sum(info.mean))
        leaves = (*jax.tree.leaves((new, info)), jnp.where(finite, well.astype(float), jnp.nan))
        return jnp.concatenate([jnp.ravel(leaf).astype(float) for leaf in leaves])

    new, info = jax.eval_shape(stepped, np.zeros(state.size), np.zeros(values + inputs.size))
    after = Layout.of(new)
    return Step(jax.jit(one), state, state if after == state else after, Layout.of(info), after.size)
