"""A run of steps of the limited direct method for one state, on a lattice that stands still.

The kernel of an interval is the exponential of a quadratic form in (x, y).  On one lattice for both,

    x y = (x^2 + y^2 - (x - y)^2) / 2

makes of it a filter with the same taps at every point, between two factors that are Gaussian functions of the point,

    p'(x) = e^{after(x)} sum_y e^{-(x - y)^2 / (2 P11 Sigma)} e^{before(y)} p(y).

They are multiplied with the factors of the observation, and h at the points is in a table that outlasts the runs.  A step makes
its factors where it uses them, and is a filter between two products, with the second error of the splitting undone on both
sides; one product gives mass, mean, variance and what stands at the edges for `LOOK` steps.  Everything is positive, so that
rounding loses no tail.  Every `LOOK` steps the window is laid over the mass anew, by whole cells, its resolution is looked
at, and the next steps are taken on the part of it that holds the mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import gcd
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters import _splitting as splitting
from zakai.filters.observations import Factors
from zakai.kolmogorov import lattice as lat
from zakai.kolmogorov.flow import Flow, motion
from zakai.kolmogorov.lattice import Lattice
from zakai.models.compile import one_kernel

LOOK = 16  # steps
DEEP = 28.0  # how deep, in units of the logarithm, the tails are kept where they are cut: at 1e-13
ROOM = 14  # cells that the mass may move to either side between two looks
SHARES = (0.4375, 0.5, 0.625)  # of a window, of which the steps between two looks take the smallest that holds the mass


class Kernel(NamedTuple):
    """The kernel of an interval between the points of one lattice: the `variance` of its taps and, as polynomials (3,) in x from
    the constant on, `before` and `after`; or of many intervals with a leading axis."""

    variance: Any
    before: Any
    after: Any


def kernel_of(flow: Flow) -> Kernel:
    """The kernel of one flow of one state, up to the length of a cell."""
    moved = motion(flow, jnp.zeros(1), jnp.ones(1))
    scale, spread, at = flow.map[0, 0], flow.spread[0, 0], moved.centre[0]
    variance = scale * spread
    # Equation (2) of `flow` in x = at + scale xi.
    tilt, bend = moved.tilt[0] / scale, flow.bend[0, 0] / scale**2 - 0.5 / (scale * variance)
    before = jnp.stack([jnp.zeros(()), -at / variance, 0.5 * (1 - scale) / variance])
    constant = moved.log_mass - at * tilt + at**2 * bend - 0.5 * jnp.log(2 * jnp.pi * spread)
    narrow = flow.bend[0, 0] / scale**2 + 0.5 * (scale - 1) / (scale * variance)
    return Kernel(variance, before, jnp.stack([constant, tilt - 2 * at * bend, narrow]))


def _around(polynomial: jax.Array, centre: jax.Array) -> jax.Array:
    """A polynomial (..., 3) in x as one in x - centre."""
    constant, slope, bend = jnp.moveaxis(polynomial, -1, 0)
    return jnp.stack([constant + centre * (slope + centre * bend), slope + 2 * centre * bend, bend], axis=-1)


class Table(NamedTuple):
    """h on a lattice for windows to stand on: `h` (m, 5, M) itself and its first four derivatives, at points that are a `cell`
    apart, around `home`."""

    home: Any
    cell: Any
    h: Any


def place(table: Table, centre: Any) -> Any:
    """Where on a table a window stands, in cells from its home."""
    return jnp.rint((centre - table.home) / table.cell).astype(int)


def seen(table: Table, at: Any, size: int) -> Any:
    """h and its derivatives (m, 5, size) on the window `at` a place."""
    return jax.lax.dynamic_slice_in_dim(table.h, (table.h.shape[-1] - size) // 2 + at, size, axis=2)


class Steps(NamedTuple):
    """What a run of K steps tells: for each step the `sums` (K, 4) of p, p i, p i^2 and of p at the edges, i an index from the
    window's centre, which is at `place` (K,) in cells from the home of its table, the logarithm by which the sum of p grew,
    `growth` (K,), and if asked for the `logs` (K, N) of p itself; for each look (L,) the narrowest feature in `cells`, that of
    its product with a kernel, `joint`, and how deep in its tails the mass lies, `depth`."""

    sums: Any
    place: Any
    growth: Any
    logs: Any
    cells: Any
    joint: Any
    depth: Any


def moved(
    lattice: Lattice,
    table: Table,
    kernel: Kernel,
    turned: Any,
    given: Factors,
    own: Any,
    taps: int,
    keep: bool,
    even: bool,
    wide: bool,
    most: Any,
    well: Callable[[Any, Any, Any, Any], Any],
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], Any, Steps]:
    """K intervals, each with its kernel, from the density on a lattice of N points: at the end the values (N,), where the window
    stands and the narrowest feature in cells; how many steps were taken; and what is told on the way.

    `turned` (K, 2) is by how much the gauge changed in an interval, from its linear term on.  `own` is the narrowest feature of
    the density, in cells; `even` says that both halves of every factor are the same; a window is `wide` for mass that moves far
    in one step: there is a look at every one, which is taken on all of the window.  Of the steps `most` are taken, rounded up to
    whole looks, or those before the first look in which `well`, of `growth`, `sums`, `cells` and `joint`, does not hold for all;
    what is told of those after it is zero.
    """
    size, cell, count = len(lattice.log_values), table.cell, len(kernel.variance)
    each = 1 if wide else gcd(count, LOOK)
    apart, variance = cell * np.arange(taps + 1), kernel.variance[:, None]
    weights = cell * jnp.exp(-0.5 * apart**2 / variance)
    taps_of = weights, *splitting.bent(weights, apart, variance)
    slices = (kernel, turned, given.before, given.after), taps_of
    still = jax.lax.stop_gradient  # of what only says where to look nothing is differentiated

    def halves(slices: Any, shown: Any, xi: Any) -> tuple[splitting.Half, splitting.Half]:
        """Those of one step's factor, with the polynomials of its kernel, at `xi`, where a table has `shown` (m, 5, ...)."""
        kernel, turned, before, after = slices
        slope, bend = (kernel.before + kernel.after)[1:] - turned

        def half(linear: Any) -> splitting.Half:
            parts = [sum(linear[i] * shown[i, k] for i in range(len(shown))) for k in range(5)]
            return splitting.bridged(parts, kernel.variance, slope + 2 * bend * xi)

        def with_polynomial(half: splitting.Half, of: Any) -> splitting.Half:
            return half._replace(log=half.log + (of[0] + xi * (of[1] + xi * of[2])))

        first = half(before)
        last = first if even else half(after)
        return with_polynomial(first, kernel.before), with_polynomial(last, kernel.after)

    def multiplied(p: Any, log: Any) -> Any:
        # Far from the mass, where a wide window has nothing, the logarithm may be any number.
        return jnp.where(p > 0, p * jnp.exp(log), 0.0) if wide else p * jnp.exp(log)

    def steps(p: Any, slices: Any, taps_of: Any, shown: Any) -> tuple[Any, Any, Any, Any]:
        """Those between two looks: the last density, the logarithm of what it was multiplied with last, all densities and by
        how much each was made smaller."""
        # An evidence far from one leaves no mark: at the highest point nothing grows.
        top, xi = jnp.argmax(p), cell * jnp.asarray(_index(len(p)))
        first, last = jax.vmap(lambda one: halves(one, shown[:, :, top], xi[top]))(slices)
        offset = still(first.log + last.log)

        def step(carry: Any, slices: Any) -> tuple[Any, Any]:
            p, _, *rooms = carry
            slices, taps_of, offset = slices
            first, last = halves(slices, shown, xi)
            q = multiplied(p, first.log)
            inner = q, first.bend * q
            # Written into the middle of zeros: to pad is to ask at every point whether there is one, which is not vectorised.
            rooms = [jax.lax.dynamic_update_slice(room, each, (taps,)) for room, each in zip(rooms, inner, strict=True)]
            p = multiplied(_filtered(rooms, last, taps_of), last.log - offset)
            return (p, last.log, *rooms), p

        zeros = jnp.zeros(len(p) + 2 * taps)
        (p, lifted, *_), values = jax.lax.scan(step, (p, p, zeros, zeros), (slices, taps_of, offset))
        return p, lifted, values, offset

    def within(part: int, p: Any, at: Any, own: Any, slices: Any) -> tuple[Any, Any]:
        """The steps between two looks on the middle `part` of the window, outside of which there is nothing."""
        (kernel, turned, *given), taps_of = slices
        around, centre = (size - part) // 2, table.home + cell * at
        kernel = Kernel(kernel.variance, _around(kernel.before, centre), _around(kernel.after, centre))
        slices = kernel, _turned(turned, centre), *given
        p = p[around : around + part]
        p, multiplied, values, offset = one_kernel(steps)(p / jnp.sum(p), slices, taps_of, seen(table, at, part))
        sums = values @ _columns(part)
        lost = beyond(kernel, cell * sums[:, 1] / sums[:, 0], cell * taps)
        sums = sums.at[:, 3].set(jnp.maximum(sums[:, 3], lost * sums[:, 0]))
        masses = jnp.log(sums[:, 0])
        growth = masses - jnp.concatenate([jnp.zeros(1), masses[:-1]]) + offset
        end = still(lattice._replace(log_values=lat.log(p)))
        cells = lat.features(end)[0]
        joint = jax.lax.rsqrt(1.0 / jnp.minimum(own, cells) ** 2 + cell**2 / jnp.min(kernel.variance))
        depth = lat.reach(end, end.log_values - still(multiplied))
        # The logarithms of what is nothing are known.
        logs = jnp.pad(lat.log(values), ((0, 0), (around, around)), constant_values=-jnp.inf) if keep else None
        return jnp.pad(p, around), (sums, growth, logs, cells, joint, depth)

    def look(carry: Any, slices: Any) -> tuple[Any, Any]:
        p, at, own, taken, _ = carry
        first, slices = slices
        shift, reach = _shift(p > np.exp(-DEEP) * jnp.max(p), at, table)
        new, moved = lat.slid(p, shift, 0.0), at + shift
        parts = [size] if wide else _parts(size)
        which = jnp.sum(reach + ROOM > np.array(parts[:-1]) // 2)
        new, (sums, growth, logs, cells, joint, depth) = jax.lax.switch(
            which, [partial(within, part) for part in parts], new, moved, own, slices
        )
        good = jnp.all(well(growth, sums, cells, joint) | (first + np.arange(each) >= most))
        told = sums, jnp.broadcast_to(moved, (each,)), growth, logs
        carry = *jax.tree.map(partial(jnp.where, good), (new, moved, cells), (p, at, own)), taken + good * each, good
        return carry, (told, cells, joint, depth)

    def look_or_not(carry: Any, given: Any) -> tuple[Any, Any]:
        return jax.lax.cond((given[0] < most) & carry[-1], look, lambda carry, _: (carry, nothing), carry, given)

    start, zero, zeros = place(table, lattice.centre[0]), jnp.zeros(()), jnp.zeros(each)
    told = jnp.zeros((each, 4)), jnp.zeros(each, int), zeros, jnp.zeros((each, size)) if keep else None
    nothing = told, zero, zero, zero
    blocks = jax.tree.map(lambda a: a.reshape(count // each, each, *a.shape[1:]), slices)
    begin = jnp.exp(lattice.log_values), start, own, jnp.zeros((), int), jnp.array(True)
    (*end, taken, _), (told, *looks) = jax.lax.scan(look_or_not, begin, (np.arange(0, count, each), blocks))
    told = jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), told)
    return tuple(end), jnp.minimum(taken, most), Steps(*told, *looks)


def _parts(size: int) -> list[int]:
    """The parts of a window on which steps can be taken."""
    return sorted({16 * round(size * share / 16) for share in SHARES} | {size})


class Stepped(NamedTuple):
    """What one step leaves: the logarithms (N,) of a density whose largest value is one; the `sums` (5,) of its values, as in
    Steps, and of them times how deep in the tails of what was only spread they are; and the logarithm by which it is too
    `small`."""

    logs: Any
    sums: Any
    small: Any


def stepped(
    lattice: Lattice, seen: Any, kernel: Kernel, turned: Any, given: Factors, taps: int, even: bool
) -> Stepped:
    """One interval, from the density on a lattice of N points of which `seen` is what a table shows, in as few loops over its
    points as can be: for a filter that is told its readings one by one.  All else is as in `moved`."""
    logs, centre, cell = lattice.log_values, lattice.centre[0], lattice.basis[0, 0]
    size = len(logs)
    xi = cell * _index(size)
    before, after = _around(kernel.before, centre), _around(kernel.after, centre)
    slope, bend = (before + after)[1:] - _turned(turned, centre)

    def half(linear: jax.Array) -> splitting.Half:
        parts = list((linear @ seen.reshape(len(linear), -1)).reshape(5, size))
        return splitting.bridged(parts, kernel.variance, slope + 2 * bend * xi)

    def polynomial(of: jax.Array) -> jax.Array:
        return of[0] + xi * (of[1] + xi * of[2])

    first = half(given.before)
    last = first if even else half(given.after)
    factor = last.log + polynomial(after)
    # Of logarithms the largest is taken out, so that nothing overflows.
    lifted = logs + first.log + polynomial(before)
    top = jnp.max(lifted)
    q = jnp.exp(lifted - top)
    steps = cell * np.arange(taps + 1)
    weights = cell * jnp.exp(-0.5 * steps**2 / kernel.variance)
    rooms = [jnp.pad(each, taps) for each in (q, first.bend * q)]
    spread = lat.log(_filtered(rooms, last, (weights, *splitting.bent(weights, steps, kernel.variance))))
    lowered = spread + factor
    crest = jnp.max(lowered)
    values = jnp.exp(lowered - crest)
    deep = jnp.where(values > 0, jnp.max(spread) - spread, 0.0) @ values
    return Stepped(lowered - crest, jnp.append(_columns(size).T @ values, deep), top + crest)


def drift(kernel: Kernel, x: Any) -> Any:
    """By how much what was at x moves in an interval; NumPy or JAX."""
    return -kernel.variance * (kernel.before[..., 1] + 2 * kernel.before[..., 2] * x)


def beyond(kernel: Kernel, x: Any, reach: Any) -> Any:
    """The share of what was at x that moves farther than the taps of a kernel `reach`, about; for one interval or many."""
    return jnp.exp(-0.5 * jnp.maximum(reach - jnp.abs(drift(kernel, x)), 0.0) ** 2 / kernel.variance)


def left_over(kernel: Kernel, given: Factors, table: Table, mean: Any) -> Any:
    """The last that `splitting.bridged` makes up for, at the mean of a density after the interval, as a logarithm: more than what
    is left; for one interval or many."""
    kernel, given, table, mean = jax.lax.stop_gradient((kernel, given, table, mean))
    at = place(table, mean) + table.h.shape[-1] // 2
    weights = given.before + given.after
    bent, fourth = (jnp.sum(weights * table.h[:, k, at].T, axis=-1) for k in (2, 4))
    square = drift(kernel, mean) ** 2
    return jnp.abs(fourth) * (square + kernel.variance) ** 2 / 240 + (kernel.variance * bent) ** 2 / 180


def laid_anew(logs: jax.Array, at: jax.Array, table: Table) -> tuple[jax.Array, jax.Array]:
    """A window laid over the mass, by whole cells: the logarithms (N,) of a density and its place."""
    shift, _ = _shift(logs > jnp.max(logs) - lat.SUPPORT, at, table)
    return lat.slid(logs, shift, -jnp.inf), at + shift


def _shift(used: jax.Array, at: jax.Array, table: Table) -> tuple[jax.Array, jax.Array]:
    """By how many cells a window moves to have what is used (N,) in its middle, as far as the table goes; and how far that
    reaches from there."""
    size, index = len(used), _index(used.size).astype(int)
    far = (table.h.shape[-1] - size) // 2
    low, high = jnp.min(jnp.where(used, index, size)), jnp.max(jnp.where(used, index, -size))
    shift = jnp.clip((low + high) // 2, -(size // 4), size // 4)
    shift = jnp.clip(shift, -far - at, far - at)
    return shift, jnp.maximum(high - shift, shift - low)


def _filtered(rooms: Sequence[jax.Array], last: splitting.Half, taps: tuple[Any, Any, Any]) -> jax.Array:
    """What the kernel with its polynomials makes of q and of what is `bent` of it, both with room for all taps at each end."""
    weights, once, twice = taps
    spread, begin, end, ends = lat.filtered_all(rooms, ((0, weights), (1, once), (0, once), (0, twice)))
    # Nothing is made up for by more than there is.
    return jnp.clip(spread + begin + last.bend * end + last.twice * ends, 0.5 * spread, 2.0 * spread)


def _index(size: int) -> np.ndarray:
    return np.arange(size, dtype=float) - size // 2


def _columns(size: int) -> np.ndarray:
    """What p is multiplied with for its sums (N, 4)."""
    outer = (np.minimum(np.arange(size), np.arange(size)[::-1]) < 2).astype(float)
    return np.stack([np.ones(size), _index(size), _index(size) ** 2, outer], axis=1)


def _turned(turned: jax.Array, centre: Any) -> jax.Array:
    """The slope and the bend around a centre of a gauge that changed by `turned` (..., 2) x and x^2."""
    slope, bend = jnp.moveaxis(turned, -1, 0)
    return jnp.stack([slope + 2 * centre * bend, bend], axis=-1)
