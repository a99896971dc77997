"""The splitting of an increment's likelihood from the transition: what its errors are, which are undone and what is left.

With b the logarithm of the likelihood of an interval tau and A the forward operator, Strang's exp(b/2) exp(tau A) exp(b/2) is
the exponential of

    tau A + b - tau [b, [b, A]] / 24 - tau^2 [A, [b, A]] / 12 - ...

Of a path that has noise, b is of the order of sqrt(tau), so that the first error is of the order tau^2 in every interval and
has always one sign.  [b, [b, A]] = grad b . G grad b = g is a function, so that it can be undone by the factors themselves
(Takahashi and Imada 1984).  The second is smaller and changes its sign with the noise.  Where it is too large, one transition
more undoes it too (Chin 1997, scheme A of fourth order): exp(b/6) exp(tau A/2) exp(2b/3 - tau g/72) exp(tau A/2) exp(b/6) is the
exponential of

    tau A + b - tau^2 [[b, A], g] / 4320 - tau^3 (7 [A, [A, g]] / 8640 + [[b, A], [A, [b, A]]] / 2160)
              + tau^4 [A, [A, [A, [A, b]]]] / 2880 + ...

With one state, where exp(tau A) is a filter between the points of a lattice that stands still, both are undone with most of what
comes after them (`bridged`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.kolmogorov import comoving
from zakai.kolmogorov.differences import differences
from zakai.kolmogorov.resolution import along


class Scheme(NamedTuple):
    """Factors exp(share b + undone tau g), one a pair of the two, with equal parts of the transition between them; what is left
    after a given time is of the `order` in tau."""

    shares: tuple[float, ...]
    undone: tuple[float, ...]
    order: int

    @property
    def factors(self) -> tuple[tuple[float, float], ...]:
        """The share and what is undone of each factor."""
        return tuple(zip(self.shares, self.undone, strict=True))


STRANG = Scheme((1 / 2, 1 / 2), (1 / 48, 1 / 48), 2)
CHIN = Scheme((1 / 6, 2 / 3, 1 / 6), (0.0, -1 / 72, 0.0), 4)
ALIKE = 0.1  # how much the errors of different intervals have in common: between those of noise, 0, and those of one sign, 1
THIN = 32  # points of an axis from which every second one will do
LONGEST = 1e4  # intervals after which every error is taken for forgotten


def slopes(values: jax.Array) -> list[jax.Array]:
    """The slope of an array along each of its axes, a cell the unit; that of the outermost layers, which is less exact, is not
    undone with what a splitting leaves."""
    # Products with a matrix: what has several parts, as differences have, takes longer, and longer to compile.
    return [along(_central(size), values, d) for d, size in enumerate(values.shape)]


def bends(values: jax.Array) -> tuple[list[jax.Array], list[list[jax.Array]]]:
    """The slopes and the second derivatives of an array."""
    n, sizes = values.ndim, values.shape
    both = [jnp.split(along(_central_twice(size), values, d), 2, axis=d) for d, size in enumerate(sizes)]
    slope = [first for first, _ in both]
    mixed = {(d, e): along(_central(sizes[e]), slope[d], e) for e in range(n) for d in range(e)}
    return slope, [[both[d][1] if d == e else mixed[min(d, e), max(d, e)] for e in range(n)] for d in range(n)]


@lru_cache(maxsize=64)
def _central_twice(size: int) -> np.ndarray:
    return np.concatenate([_central(size), _central(size) @ _central(size)])


@lru_cache(maxsize=64)
def _central(size: int) -> np.ndarray:
    return np.asarray(differences(np.eye(size), 0))


def product(spread: jax.Array, a: Sequence[jax.Array], b: Sequence[jax.Array]) -> jax.Array:
    """a'(spread) b at every point."""
    return sum((spread[i, j] * p * q for i, p in enumerate(a) for j, q in enumerate(b)), start=jnp.zeros(()))


def corrected(log: jax.Array, spread: jax.Array, length: Any, share: Any, undone: Any) -> jax.Array:
    """share b + undone tau grad b . G grad b on a lattice in whose coordinates G is `spread`; where that is large, less."""
    slope = slopes(log)
    return made_up(share * log, 12 * undone * length * product(spread, slope, slope))


def made_up(log: Any, steepness: Any) -> Any:
    """A logarithm and a twelfth of the `steepness`; where that is large, less.

    Half of b is made up for Strang's first error where tau grad(b/2) . G grad(b/2) is the steepness.
    """
    more = steepness / 12
    return log + more / (1.0 + jnp.maximum(more, 0.0))


class Half(NamedTuple):
    """One half of the factor of an increment, with one state: its logarithm, and what stands beside it in the kernel."""

    log: Any
    bend: Any
    twice: Any


def bridged(half: Sequence[Any], spread: Any, tilt: Any) -> Half:
    """One half of a factor as the kernel of its interval asks for it, from b/2 and its first four derivatives.

    With its ends x and y given a path is a Brownian bridge X between them, of the variance V = G tau, and the likelihood is

        E exp(int b(X_s) ds) = exp(E int b + Var int b / 2 + K3 / 6 + ...),  0 < s < 1,

    where exp((b(x) + b(y)) / 2) is Strang's part and K3 the third cumulant.  To the second order in V, with d = x - y,

        E int b = (b(x) + b(y)) / 2 + (V - d^2) S2 / 12 + (2 d^4 - 2 V d^2 + V^2) S4 / 240
        Var int b = V S11 / 12 + V^2 (b''^2 / 180 + b' b''' / 60) - V d^2 (7 b''^2 / 360 + b' b''' / 60)
        K3 = V^2 b'^2 b'' / 40

    with S2, S4, S11 the means of b'', b'''' and b'^2 at x and y.  In the Hermite polynomials d^2 - V and d^4 - 6 V d^2 + 3 V^2,
    whose means under the kernel are zero, what stands beside neither is a function: `log`.  `bend` at x and at y multiplies
    the first of them and `twice` at x the second (`bent`).  A drift is in the gauge; the potential Q of the transition is with b
    in the exponent, and what it has in common with b is here too: `tilt` is -tau Q'.  Corrections that are not small are bounded.
    """
    value, first, second, third, fourth = half
    more = spread / 12 * (tilt * first + spread * (fourth / 4 + first * (first + tilt) * second / 5))
    bend = second + spread * ((first + tilt / 2) * third / 5 - second**2 / 10 - fourth / 2)
    twice = 2 * (fourth / 120 + second**2 / 144)
    return Half(value + jnp.clip(spread * first**2 / 12 + more, -1.0, 1.0), bend, twice)


def bent(weights: Any, steps: Any, spread: Any) -> tuple[Any, Any]:
    """The `weights` of a Gaussian kernel at the distances `steps`, times the polynomials that `bend` and `twice` stand beside."""
    square = steps**2
    return weights * (spread - square) / 12, weights * (square**2 - 6 * spread * square + 3 * spread**2)


def thinned(sizes: Sequence[int]) -> tuple[tuple[slice, ...], np.ndarray]:
    """Which points of a lattice are enough for `terms`, and how many cells they are apart along each axis.

    Sums over every second point are off by what a density has at the highest frequency of all points.
    """
    apart = [2 if size >= THIN else 1 for size in sizes]
    return tuple(slice(None, None, k) for k in apart), np.array(apart, dtype=float)


class Terms(NamedTuple):
    """Of what the errors of a splitting are made, for a density of which `growth` is the trace of G P^-1 and `turning` the rate
    of the drift: the norm of [A, [b, A]]; the mean of g and its deviation; that of [[b, A], g] / 2, which is a function; and the
    root of the mean square of the trace of (G b'')^2.  `third_spread` and `bent` are for the error of Chin's scheme alone.

    An error of the mean is forgotten at the rate G P^-1 + f', averaged over the coordinates, which for a Kalman-Bucy filter is
    its own rate.
    """

    second: Any
    steep: Any
    steep_spread: Any
    third_spread: Any
    bent: Any
    growth: Any
    turning: Any
    forgets: Any


def error(scheme: Scheme, terms: Terms, length: Any) -> Any:
    """What a scheme leaves of an interval, relative to the density: what it does not undo, or what comes next after that.

    A in a commutator is taken for what it does to a Gaussian of that variance, and a longer one for the one before times
    `growth` and `turning`.
    """
    if scheme == STRANG:
        first, first_spread = length / 24 * terms.steep, length / 24 * terms.steep_spread
        beyond = first_spread * jnp.minimum(1.0, jnp.sqrt(first) + length * terms.growth)
        return length**2 / 12 * terms.second + beyond
    once, rate = np.sqrt(8.0) * terms.growth * terms.bent, terms.growth + terms.turning
    third = length**2 / 2160 * terms.third_spread
    return third + 7 / 8640 * length**3 * once + length**4 / 2880 * rate**2 * terms.second


def terms(
    log: jax.Array | None, values: jax.Array, flow: Sequence[jax.Array], spread: jax.Array, scheme: Scheme
) -> Terms:
    """All of them where b is `log`, or None where nothing is split, and the density is `values` on a lattice.

    `flow` is the drift and `spread` G in the lattice's coordinates.  With L the backward operator, [A, [b, A]] has a part that is
    the function L L b, one in which the slopes of L b stand beside those of the density, and one in which the second derivatives
    of b stand beside its own; each is taken for itself.
    """
    n = values.ndim
    total, mean, cov = comoving.moments(values)
    narrow = comoving.inverse(cov)
    growth = jnp.trace(spread @ narrow)
    functions = [] if log is None else _functions(log, flow, spread, scheme)
    apart = [z - mean[d] for d, z in enumerate(comoving.combined(np.eye(n), values.shape))]
    moved = [v * z for v in flow for z in apart]
    # All means by one product: what is compiled fast.
    means = jnp.stack([*functions, *moved]).reshape(len(functions) + n * n, -1) @ (values.reshape(-1) / total)
    turned = means[len(functions) :].reshape(n, n) @ narrow
    turning = jnp.sqrt(jnp.sum(jnp.abs(turned * turned.T)))
    forgets = (growth + jnp.trace(turned)) / n
    if not functions:
        zero = jnp.zeros(())
        return Terms(zero, zero, zero, zero, zero, growth, turning, forgets)
    return measured(means[: len(functions)], growth, turning, forgets)


def _functions(log: jax.Array, flow: Sequence[jax.Array], spread: jax.Array, scheme: Scheme) -> list[jax.Array]:
    """Those whose means `measured` takes, on a lattice."""
    n = len(flow)

    def total(parts: Any) -> jax.Array:
        return sum(parts, start=jnp.zeros(()))

    def generated(function: jax.Array) -> tuple[list[jax.Array], list[list[jax.Array]], jax.Array]:
        slope, second = bends(function)
        bent = [[total(spread[i, k] * second[k][j] for k in range(n)) for j in range(n)] for i in range(n)]
        return slope, bent, total(v * s for v, s in zip(flow, slope, strict=True)) + 0.5 * total(bent[i][i] for i in range(n))

    slope, bent, generator = generated(log)
    upward, _, twice = generated(generator)
    once = product(spread, upward, upward)
    twice_bent = total(bent[i][j] * bent[j][i] for i in range(n) for j in range(n))
    steep = product(spread, slope, slope)
    functions = [twice, twice**2, once, twice_bent, steep, steep**2]
    if scheme == CHIN:
        ahead = [total(spread[j, k] * slope[k] for k in range(n)) for j in range(n)]
        third = total(slope[i] * bent[i][j] * ahead[j] for i in range(n) for j in range(n))
        functions += [twice_bent**2, third, third**2]
    return functions


def measured(means: jax.Array, growth: Any, turning: Any, forgets: Any) -> Terms:
    """Terms from the means of L L b and its square, |grad L b|^2, tr (G b'')^2, g, g^2, and where there are
    more, of the square of the fourth, of [[b, A], g] / 2 and of its square."""

    def root(square: Any) -> Any:
        return jnp.sqrt(jnp.maximum(square, 0.0))

    twice, upward, bend = root(means[1] - means[0] ** 2), root(means[2] * growth), growth * root(2 * means[3])
    third, bent = (root(means[8] - means[7] ** 2), root(means[6])) if len(means) > 6 else (0.0, 0.0)
    steep_spread = root(means[5] - means[4] ** 2)
    return Terms(twice + 2 * upward + bend, means[4], steep_spread, third, bent, growth, turning, forgets)


def added(before: Any, error: Any, forgets: Any, length: Any) -> jax.Array:
    """The error of a density that had one `before` and then made another."""
    left = _kept(forgets, length) * before
    return jnp.sqrt(left**2 + 2 * ALIKE * left * error + error**2)


def added_up(before: Any, errors: jax.Array, forgets: jax.Array, lengths: jax.Array, parts: Any) -> jax.Array:
    """The errors (K,) of K densities one after another, the first of which had one `before`; each then made its own in every one
    of `parts` of that length."""
    # Those of the parts of one interval have as much in common as those of two intervals.
    made = errors * jnp.sqrt(parts * (1 + ALIKE * (parts - 1)))

    def add(before: Any, slices: Any) -> tuple[Any, Any]:
        after = added(before, *slices)
        return after, after

    return jax.lax.scan(add, before, (made, forgets, lengths * parts))[1]


def expected(error: Any, forgets: Any, length: Any) -> jax.Array:
    """What errors like this one come to in the long run."""
    kept = _kept(forgets, length)
    alike, rest = ALIKE * kept, 1.0 - kept**2
    return error * (alike + jnp.sqrt(alike**2 + rest)) / rest


def _kept(forgets: Any, length: Any) -> jax.Array:
    return jnp.exp(-jnp.clip(forgets * length, 1.0 / LONGEST, 50.0))
