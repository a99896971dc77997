"""One step of a method as one compiled function of two vectors, for a filter that is called thousands of times a second.

A call takes its time for every array that goes in or comes out.  So one vector holds a whole state with what the step told, and
another a whole interval with its reading.  What no step changes of a state stands apart: it goes in as it is and does not come
out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters._protocol import Info, Method
from zakai.models.compile import jit_small, one_kernel

FEW = 4  # numbers that are as easily told one by one


class Layout(NamedTuple):
    """How a pytree of arrays is laid in a vector of float64, which holds every number that a step is made of exactly.

    Beside it stand the arrays that are `apart` (a flag for each): those in the fields that the pytree's class names in `LASTING`,
    but for a few numbers.
    """

    tree: Any
    shapes: tuple[tuple[int, ...], ...]
    types: tuple[str, ...]
    apart: tuple[bool, ...]

    @classmethod
    def of(cls, tree: Any) -> Layout:
        found, structure = jax.tree.flatten(tree)
        shapes, types = tuple(np.shape(leaf) for leaf in found), tuple(np.dtype(_type(leaf)).str for leaf in found)
        return cls(structure, shapes, types, _apart(_names(tree), structure, shapes))

    @classmethod
    def of_rows(cls, tree: Any) -> Layout:
        """That of one row of a pytree whose arrays have a leading axis."""
        whole = cls.of(tree)
        return whole._replace(shapes=tuple(shape[1:] for shape in whole.shapes))

    @property
    def zeros(self) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """A vector and what stands apart, of no particular values."""
        apart = (np.zeros(shape, kind) for shape, kind, beside in zip(*self[1:], strict=True) if beside)
        return np.zeros(self.size), tuple(apart)

    @property
    def size(self) -> int:
        return _places(self.shapes, self.apart)[-1][1] if self.shapes else 0

    def unpacked(self, vector: Any, lasting: Sequence[Any] = ()) -> Any:
        """The pytree that begins a vector, with the arrays that stand apart; JAX may trace it."""
        leaves, beside = [], iter(lasting)
        for (begin, end), shape, kind, apart in zip(_places(self.shapes, self.apart), *self[1:], strict=True):
            leaf = next(beside) if apart else vector[begin:end].reshape(shape)
            leaves.append(leaf if apart or kind == "<f8" else leaf.astype(kind))
        return jax.tree.unflatten(self.tree, leaves)


def _names(tree: Any) -> tuple[str, ...]:
    return getattr(type(tree), "LASTING", ())


@lru_cache(maxsize=256)
def _apart(names: tuple[str, ...], structure: Any, shapes: tuple[tuple[int, ...], ...]) -> tuple[bool, ...]:
    """Of each array of a pytree whether it stands apart: what is more than a few numbers in a field with one of the names."""
    if not names:
        return (False,) * structure.num_leaves
    leaves = jax.tree_util.tree_leaves_with_path(jax.tree.unflatten(structure, range(structure.num_leaves)))
    large = (math.prod(shape) > FEW for shape in shapes)
    return tuple(much and getattr(path[0], "name", "") in names for (path, _), much in zip(leaves, large, strict=True))


@lru_cache(maxsize=256)
def _places(shapes: tuple[tuple[int, ...], ...], apart: tuple[bool, ...]) -> tuple[tuple[int, int], ...]:
    """Where in a vector each array begins and ends."""
    sizes = (0 if beside else math.prod(shape) for shape, beside in zip(shapes, apart, strict=True))
    return tuple(pairwise(np.cumsum([0, *sizes]).tolist()))


def _divided(tree: Any) -> tuple[list[Any], tuple[Any, ...]]:
    """The arrays of a pytree that are laid in a vector, and those that stand apart."""
    found, structure = jax.tree.flatten(tree)
    both = list(zip(found, _apart(_names(tree), structure, tuple(map(np.shape, found))), strict=True))
    return [leaf for leaf, apart in both if not apart], tuple(leaf for leaf, apart in both if apart)


def _type(leaf: Any) -> Any:
    return leaf.dtype if hasattr(leaf, "dtype") else np.asarray(leaf).dtype


def packed(tree: Any) -> np.ndarray:
    """A pytree as a vector, but for what stands apart."""
    return _flat(_divided(tree)[0])


def _flat(leaves: Sequence[Any]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(np.asarray(leaf, float).ravel() for leaf in leaves)])


def packed_rows(tree: Any, count: int, room: int) -> np.ndarray:
    """A pytree whose arrays have a leading axis, as a matrix (count, room + size), with `room` for something in front."""
    leaves = [np.asarray(leaf).reshape(count, -1) for leaf in jax.tree.leaves(tree)]
    edges = np.cumsum([room, *(leaf.shape[1] for leaf in leaves)]).tolist()
    rows = np.zeros((count, edges[-1]))
    for (begin, end), leaf in zip(pairwise(edges), leaves, strict=True):
        rows[:, begin:end] = leaf
    return rows


class Laid(NamedTuple):
    """A state as a vector, which may go on with something else, how it is laid in it, and the arrays that stand apart."""

    vector: Any
    layout: Layout
    lasting: tuple[Any, ...]

    @classmethod
    def of(cls, state: Any) -> Laid:
        within, beside = _divided(state)
        # What goes into many calls is brought to the device once.
        brought = (leaf if isinstance(leaf, jax.Array) else jnp.asarray(leaf) for leaf in beside)
        return cls(_flat(within), Layout.of(state), tuple(brought))

    @property
    def state(self) -> Any:
        return self.layout.unpacked(np.asarray(self.vector), self.lasting)


def _joined(leaves: Sequence[Any]) -> jax.Array:
    """Arrays as one vector.  Numbers that stand side by side are brought together first: by one loop, where each would have its
    own."""
    parts: list[Any] = []
    for small, beside in groupby(leaves, lambda leaf: np.size(leaf) <= FEW):
        rows = [jnp.ravel(leaf).astype(float) for leaf in beside]
        parts += [_stacked([row[i] for row in rows for i in range(len(row))])] if small else rows
    return jnp.concatenate(parts)


def _stacked(numbers: Sequence[jax.Array]) -> jax.Array:
    # An array of the compiler's own: each that is given is brought to every call.
    at, row = jax.lax.iota(int, len(numbers)), jnp.zeros(len(numbers))
    for i, number in enumerate(numbers):
        row = jnp.where(at == i, number, row)
    return row


class Step(NamedTuple):
    """A compiled step: `call(vector, inputs, lasting)` gives the vector of the new state, with what was told behind it.

    `inputs` is a row of a Block with the values of the reading, zero where there is none; `lasting` is what stands apart.
    `state` is the layout before and `new` that after; `info` is that of the Info.  The last number is the
    verdict: one where the step kept what `adapt` looks at, zero where it did not, nan where nothing of the density was left.
    """

    call: Callable[[Any, np.ndarray, tuple[Any, ...]], Any]
    state: Layout
    new: Layout
    info: Layout
    begin: int  # of what is told, in the vector
    last: int  # byte of the vector, where the verdict begins

    def begun(self, laid: Laid) -> Laid:
        """A state that no step told of, with room for it."""
        return Laid(np.concatenate([laid.vector, np.zeros(self.info.size + 1)]), self.state, laid.lasting)

    def told(self, after: Laid) -> Told:
        """What it told of the state that it gave."""
        return Told(np.asarray(after.vector), self.begin, self.info)


class Told(NamedTuple):
    """The Info of one step, which in a vector stands from `begin` on."""

    vector: np.ndarray
    begin: int
    layout: Layout

    @property
    def info(self) -> Info:
        return self.layout.unpacked(self.vector[self.begin :])

    @property
    def well(self) -> bool:
        """Whether the step kept what `adapt` looks at."""
        return self.vector.item(-1) == 1.0


def settled(laid: Laid) -> Laid:
    """A state as its class' `settled` leaves it, where there is one."""
    settle = _settling(laid.layout)
    return laid if settle is None else settle(laid)


@lru_cache(maxsize=128)
def _settling(layout: Layout) -> Callable[[Laid], Laid] | None:
    settle = getattr(layout.unpacked(*layout.zeros), "settled", None)
    if settle is None:
        return None
    layouts: list[Layout] = []

    def one(vector: Any, lasting: Any) -> tuple[Any, Any]:
        new = settle(layout.unpacked(vector, lasting))
        layouts[:] = [Layout.of(new)]
        within, apart = _divided(new)
        return _joined(within), apart

    call = jit_small(one)
    call.eval_shape(*layout.zeros)
    (after,) = layouts
    new = layout if after == layout else after

    def again(laid: Laid) -> Laid:
        vector, lasting = call(np.asarray(laid.vector)[: layout.size], laid.lasting)
        return Laid(vector, new, lasting)

    return again


def compiled(method: Method, state: Layout, inputs: Layout, values: int) -> Step:
    """The step for a state and inputs of these layouts; `values` is how many a reading has."""
    return _compiled(method.step, method.fits, method.healthy, method.adapt is None, state, inputs, values)


@lru_cache(maxsize=128)
def _compiled(step, fits, healthy, rigid: bool, state: Layout, inputs: Layout, values: int) -> Step:
    layouts: list[Layout] = []
    small = False

    def one(vector: Any, given: Any, lasting: Any) -> Any:
        nonlocal small
        interval, rule = inputs.unpacked(given[values:])
        begin = state.unpacked(vector, lasting)
        small = getattr(begin, "small", False)
        new, info = step(interval, begin, rule(given[:values]))
        layouts[:] = Layout.of(new), Layout.of(info)
        well = jnp.array(rigid) if fits is None and healthy is None else fits(new, info) if fits else healthy(info)
        # With the evidence and the mean all the rest is finite.
        finite = jnp.isfinite(info.log_likelihood_increment + jnp.sum(info.mean))
        return _joined([*_divided(new)[0], *jax.tree.leaves(info), jnp.where(finite, well.astype(float), jnp.nan)])

    vector, lasting = state.zeros
    given = vector, np.zeros(values + inputs.size), lasting
    call = jit_small(one)
    # The first call finds it traced.
    call.eval_shape(*given)
    after, info = layouts
    if small:
        whole = jit_small(one_kernel(one))
        try:
            whole(*given)
            call = whole
        except jax.errors.JaxRuntimeError:  # what does not fit into one kernel is many, as it would be
            pass
    return Step(call, state, state if after == state else after, info, after.size, 8 * (after.size + info.size))
