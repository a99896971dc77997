"""A step in one state where nothing but the readings depends on the time: the transition is a matrix that is known beforehand.

Between two looks at the lattice it stands still.  What a step needs of f, G and h is then a table, made once for a lattice, and
an interval costs a product with a matrix, two factors and small products for all that is told.  Lattices are taken out of few,
so that a density that comes back to where it was finds its table.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.filters import _splitting as splitting
from zakai.filters import _window as window
from zakai.filters._window import Extent, Plan
from zakai.filters.observations import Whole
from zakai.kolmogorov.comoving import LOST, Field, axes_of
from zakai.kolmogorov.differences import differences
from zakai.kolmogorov.transition import transition
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

# Points: of few sizes few are compiled, with fewer a step is no faster, and with more a product with a matrix costs more than a
# lattice that moves.
SIZES = 64, 96, 192, 384
FEWEST = 8  # steps that a table is made for
TERMS = 9  # products of coordinates of h, beyond which a sum over all of them costs more than it saves
LEVELS = 4  # widths of cells in an octave
PLACES = 8  # where lattices of one width may stand, in the length of one
EDGE = 16  # what part of a lattice is its edge, on each side
SOUND = 100.0  # the largest sum of the absolute values in a row of a transition: beyond, rounding is amplified
KEPT_BYTES = 128 * 2**20


class Table(NamedTuple):
    """What is known of a lattice of N points without data.

    `transition` (N, N); `terms` (a, 5, N), for each h_i and each h_i h_j: itself, the slope times the root of G, the second
    derivative times G, the slope of L of it times the root of G, and L L of it, where L is the backward operator; `rows` (7, N),
    whose products with a density are its sum, its first two moments, what is at the highest frequency and at the edges, where
    the drift fades, and the mean of f and of f times the index; `spread` is G.  All of it in cells.
    """

    transition: Any
    terms: Any
    rows: Any
    spread: Any


def serves(model: Model) -> bool:
    """Whether steps of a model can be taken with tables."""
    timeless = not any(model.t in part.free_symbols for part in (*model.drift, *model.covariance, *model.observation))
    return model.n == 1 and timeless and model.m + model.m * (model.m + 1) // 2 <= TERMS


class Tables:
    """The tables of one system."""

    def __init__(self, model: Model):
        self.drift = numpy_function(model.drift, model)
        self.observe = numpy_function(model.observation, model)
        self.covariance = numpy_function(model.covariance, model, (1, 1))
        self.kept: OrderedDict[Any, Table | None] = OrderedDict()
        self.bytes, self.lock = 0, Lock()

    def of(self, centre: float, cell: float, size: int, tau: float, theta: np.ndarray) -> Table | None:
        """That of a lattice and a length of time; None where there is none that is sound."""
        # Intervals that are meant to be of one length differ by rounding.
        key = centre, cell, size, float(f"{tau:.10g}"), theta.tobytes()
        with self.lock:
            if key not in self.kept:
                self.kept[key] = table = self._made(*key[:4], theta)
                self.bytes += 0 if table is None else sum(part.nbytes for part in table)
                while self.bytes > KEPT_BYTES and len(self.kept) > 1:
                    _, old = self.kept.popitem(last=False)
                    self.bytes -= 0 if old is None else sum(part.nbytes for part in old)
            self.kept.move_to_end(key)
            return self.kept[key]

    def _made(self, centre: float, cell: float, size: int, tau: float, theta: np.ndarray) -> Table | None:
        (z,) = axes_of((size,))
        points = (centre + cell * z)[:, None]
        f, h = self.drift(points, 0.0, theta)[:, 0] / cell, self.observe(points, 0.0, theta).T
        G = float(self.covariance(np.zeros(1), 0.0, theta)[0, 0]) / cell**2

        def slope(values: np.ndarray) -> np.ndarray:
            return np.asarray(differences(values, values.ndim - 1))

        def backward(values: np.ndarray) -> np.ndarray:
            return f * slope(values) + 0.5 * G * slope(slope(values))

        with np.errstate(all="ignore"):
            terms = np.stack([*h, *(h[i] * h[j] for i, j in _pairs(len(h)))])
            once = backward(terms)
            root = np.sqrt(G)
            terms = np.stack([terms, root * slope(terms), G * slope(slope(terms)), root * slope(once), backward(once)], axis=1)
            inwards = np.minimum(z - z[0], z[-1] - z) / (size // EDGE)
            rows = np.stack([np.ones(size), z, z**2, 1.0 - 2.0 * (np.arange(size) % 2), inwards < 1, f, f * z])
            if not (np.isfinite(terms).all() and np.isfinite(rows).all()):
                return None
            # What flows apart where the ends of a lattice meet would grow out of rounding.
            matrix = transition(f * np.sin(0.5 * np.pi * np.minimum(inwards, 1.0)) ** 2, G, tau)
            # What is not a number is not less either.
            sound = np.abs(matrix).sum(axis=1).max() < SOUND
        # On the device once, for all runs of steps.
        return jax.tree.map(jnp.asarray, Table(matrix, terms, rows, np.array(G))) if sound else None


def _pairs(m: int) -> list[tuple[int, int]]:
    return list(combinations_with_replacement(range(m), 2))


def _near(middle: float, widest: float, size: int) -> tuple[float, float]:
    """Centre and cell of the lattice that is nearest to the middle, of those whose cells are not wider."""
    # The logarithm of a width that is one of them is off by rounding.
    cell = float(2.0 ** (np.floor(LEVELS * np.log2(widest) + 1e-6) / LEVELS))
    place = cell * size / PLACES
    return round(middle / place) * place, cell


def placed(fields: Field, measures: Extent, plan: Plan) -> tuple[float, float, int] | None:
    """Centre, cell and size of a lattice, one of few, that holds and resolves densities, one a record: their own if that is as
    good.

    None if that were too many points.
    """
    size, centres, cells = fields.values.shape[-1], fields.centre[:, 0], fields.basis[:, 0, 0]
    first, last, band = (part[:, 0] for part in measures)
    spare = 0.5 * ((window.SPARE * plan.wider - 1) * (last - first) + 3 * window.SPARE * plan.wider)
    low = float(np.min(centres + cells * (first - spare - size // 2)))
    high = float(np.max(centres + cells * (last + spare - size // 2)))
    widest = float(np.min(cells * window.coarser(band, plan)))
    centre, cell = float(centres[0]), float(cells[0])
    middle, span = 0.5 * (low + high), (high - low) * (1 + 1 / PLACES)
    enough = next((size for size in SIZES if size >= span / _near(middle, widest, size)[1]), None)
    own = np.all(centres == centre) and np.all(cells == cell) and (centre, cell) == _near(centre, cell, size)
    own = own and centre - 0.5 * size * cell <= low and high <= centre + 0.5 * size * cell and 0.5 * widest <= cell <= widest
    if own and (enough is None or size < 2 * enough):
        return centre, cell, size
    if enough is None:
        return None
    # What there is too much of goes to the window and to the cells alike: far out a drift may be steep.
    finer = _near(middle, np.sqrt(widest * span / enough), enough)
    return (*(finer if finer[1] * enough >= span else _near(middle, widest, enough)), enough)


def crossed(fields: Field, tables: Tables, theta: np.ndarray, tau: float) -> bool:
    """Whether the drift takes a density through a quarter of its lattice within few steps: then the lattice had better move."""
    values, (size,) = fields.values, fields.values.shape[1:]
    points = fields.centre[:, None] + fields.basis[:, 0, 0, None, None] * axes_of((size,))[0][:, None]
    flow = np.where(values > 0, tables.drift(points, 0.0, theta)[..., 0], 0.0)
    far = FEWEST * tau * np.abs((values * flow).sum(axis=1)) / values.sum(axis=1)
    return not np.all(far < 0.25 * size * fields.basis[:, 0, 0])


class Likelihood(NamedTuple):
    """The logarithms b (K, N) of likelihoods at the points, and of b what stands in the `terms` of a Table."""

    log: Any
    slope: Any
    bend: Any
    upward: Any
    twice: Any


def likelihood(table: Table, factors: Whole, share: Any) -> Likelihood:
    """share (K,) times linear . h - h'(energy) h / 2."""
    m = factors.linear.shape[-1]
    weights = [*(factors.linear[:, i] for i in range(m))]
    weights += [-(0.5 if i == j else 1.0) * factors.energy[:, i, j] for i, j in _pairs(m)]
    shares = (share * jnp.stack(weights)).T
    return Likelihood(*(shares @ table.terms[:, k] for k in range(5)))


def corrected(b: Likelihood, length: Any, share: Any, undone: Any) -> jax.Array:
    """See `splitting.corrected`; the length (K, 1)."""
    return splitting.made_up(share * b.log, 12 * undone * length * b.slope**2)


class Passed(NamedTuple):
    """What K steps leave but for the last factor: the values (K, N) `after` the last transition, of which the largest is one, and
    `before` it; the logarithm by which `after` is too small, `gained` in this step; and what share of the maximum was `lost`."""

    after: Any
    before: Any
    gained: Any
    lost: Any


def weighted(values: jax.Array, logs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The values (..., N), of which the largest is one, times exp(logs - top), and top (...)."""
    top = jnp.max(jnp.where(values > LOST, logs, -jnp.inf), axis=-1, keepdims=True)
    # Where nothing of the density is left a factor may be as large as it likes.
    return values * jnp.exp(jnp.minimum(logs - top, 0.0)), top[..., 0]


def passed(table: Table, values: jax.Array, factors: Sequence[jax.Array], ends: jax.Array, splits: Any, known: int) -> Passed:
    """K intervals in `splits` parts each, `known` if it is known to the compiler, from the values (N,).

    Before each transition of a part stands one of the `factors` (K, N), their logarithms, and after the last one the last of
    them, or where the interval ends with it, that of `ends`.  What ends a part is multiplied with what the next begins with.
    """

    def step(carry: Any, slices: Any) -> tuple[Any, Passed]:
        values, ended = carry
        (first, *middle, last), end = slices

        def part(carry: Any, k: Any) -> Any:
            values, _, gained, lost, worst = carry
            logs = first + (ended if known == 1 else jnp.where(k == 0, ended, last))
            for j, factor in enumerate((logs, *middle)):
                before, top = weighted(values, factor)
                moved = table.transition @ before
                most = jnp.max(moved)
                noise = jnp.maximum(LOST, -jnp.min(moved) / most)
                # Of the tails below it rounding leaves nothing.
                values = jnp.where(moved > noise * most, moved / most, 0.0)
                # A part that has ended: what it lost is told at the maximum of the next.
                worst = jnp.maximum(worst, lost / most) if j == 0 else worst
                lost = jnp.maximum((LOST if j == 0 else lost) / most, noise)
                gained = gained + top + jnp.log(most)
            return values, before, gained, lost, worst

        zero = jnp.zeros(())
        values, before, gained, lost, worst = repeated(part, (values, values, zero, zero, zero), known, splits)
        return (values, end), Passed(values, before, gained, jnp.stack([lost, worst]))

    most = jnp.max(values)
    _, told = jax.lax.scan(step, (values / most, jnp.zeros_like(values)), (tuple(factors), ends))
    return told._replace(gained=told.gained.at[0].add(jnp.log(most)))


def repeated(body: Callable[[Any, Any], Any], carry: Any, known: int, count: Any) -> Any:
    """`body` of the carry and 0, 1, ... `count` times; `known` is the count, or 0 where it is not known to the compiler."""
    if known == 1:
        return body(carry, 0)
    if known == 0:
        return jax.lax.fori_loop(0, jnp.asarray(count, int), lambda k, carry: body(carry, k), carry)
    return jax.lax.scan(lambda carry, k: (body(carry, k), None), carry, jnp.arange(float(known)))[0]


class Told(NamedTuple):
    """Of K densities before and after a transition: the sum, mean and variance of the second, in cells, the worst of the shares
    at the highest frequency and at the edges, and what the splitting's errors are made of; arrays (K,)."""

    total: Any
    mean: Any
    variance: Any
    aliasing: Any
    edge: Any
    terms: splitting.Terms


def told(table: Table, before: jax.Array, after: jax.Array, b: Likelihood, scheme: splitting.Scheme) -> Told:
    """All of it of densities (K, N) by a few products; the terms are those of `splitting.terms` for the likelihood b."""
    sums, first_sums = table.rows @ after.T, table.rows @ before.T
    total, means = sums[0], sums / sums[0]
    shares = jnp.maximum(jnp.abs(means[3:5]), jnp.abs(first_sums[3:5]) / first_sums[0])
    mean = means[1]
    variance = means[2] - mean**2
    growth, turning = table.spread / variance, (means[6] - mean * means[5]) / variance
    steep, twice_bent = b.slope**2, b.bend**2
    functions = [b.twice, b.twice**2, b.upward**2, twice_bent, steep, steep**2]
    if scheme == splitting.CHIN:
        third = steep * b.bend
        functions += [twice_bent**2, third, third**2]
    averages = jnp.stack([jnp.sum(function * after, axis=1) for function in functions]) / total
    terms = splitting.measured(averages, growth, jnp.abs(turning), growth + turning)
    return Told(total, mean, variance, shares[0], shares[1], terms)
