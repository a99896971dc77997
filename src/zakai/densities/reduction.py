"""Which Gaussians of a sum to split and which to put together, so that a fixed number of slots is spent where it matters.

Each component has a loss: how badly one Gaussian serves there, a number without unit.  Splitting a component lowers its loss;
putting two together costs their loss as one, and what is lost of their shape.  `exchange` makes every trade that pays.
Both operations keep the mass, the mean and the covariance of the sum.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from zakai import _float64  # noqa: F401

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip
import numpy as np

from zakai.densities.components import Components, wrapped

PRUNED = 1e-7
# Between readings that say little less is dropped: what is light may be the seed of a mode, and costs little to put together.
_DROPPED = 1e-12
# There weights count by this power: a light mode that may become the heavy one needs components of its own.
_POWER = 0.7
# A component of no variance counts as one of this share of the others'; what is further apart than _FAR is just far.
_POINT, _TINY, _FAR = 1e-12, 1e-100, 1e100
# A split leaves about a quarter of a loss that is quadratic in the variance.
GAINED = 0.75


class Exchanged(NamedTuple):
    """What an exchange did: `pruned` weight, and the loss of what was put `together`."""

    pruned: Any
    together: Any


def pair_costs(
    share: Any, means: Any, covs: Any, loss: Any, angles: tuple[int, ...] = (), xp: Any = jnp, power: float = 1.0
) -> Any:
    """What putting together components i and j would cost, (K, K): nats of relative entropy, weighted by their share^power.

    The loss of the pair as one Gaussian, and the relative entropy of the pair's shape: for components far apart Runnalls' (2007)
    bound, for close ones the leading cumulants (skewness^2 / 12 + kurtosis^2 / 48), whichever is smaller.
    """
    n = means.shape[1]
    both = share[:, None] + share
    alpha = share[:, None] / xp.where(both > 0, both, 1.0)
    beta = 1.0 - alpha
    product = xp.maximum(alpha * beta, 1e-30)
    apart = means[:, None] - means
    apart = wrapped(apart, angles) if angles else apart
    if n == 1:
        variance = xp.maximum(covs[:, 0, 0], _POINT * (share @ covs[:, 0, 0]) + _TINY)
        distance = apart[..., 0] ** 2 / (alpha * variance[:, None] + beta * variance)
        ratio = variance[:, None] / variance
        unlike = ratio + 1.0 / ratio - 2.0
    else:
        scale = xp.einsum("k,kii->i", share / xp.sum(share), covs)
        inverse = xp.linalg.inv(covs + xp.eye(n) * (_POINT * scale + _TINY))
        one_way = xp.einsum("ija,iab,ijb->ij", apart, inverse, apart)
        # The inverse is convex, so that this bounds the distance in the pair's own covariance.
        distance = alpha * one_way + beta * one_way.T
        trace = xp.einsum("iab,jba->ij", inverse, covs)
        unlike = xp.maximum(trace + trace.T - 2.0 * n, 0.0)
    between = xp.minimum(product * distance, _FAR)
    inside = between / (1.0 + between)
    shape = xp.minimum(
        0.5 * xp.log1p(between), inside**3 * ((1.0 - 2.0 * alpha) ** 2 + inside / 4.0) / (12.0 * product)
    ) + xp.minimum(0.5 * xp.log1p(0.5 * product * unlike), 0.1875 * (product * unlike) ** 2)
    # What the pair would lose as one, beyond what the two lose now.
    bent = xp.maximum(loss[:, None], loss) * (1.0 + between) ** 2 - alpha * loss[:, None] - beta * loss
    dead = (share[:, None] <= 0) | (share <= 0) | xp.eye(len(share), dtype=bool)
    cost = both**power * (bent + shape)
    # Two whose cost does not exist are the last that are put together, and not the first.
    return xp.where(dead, xp.inf, xp.where(xp.isnan(cost), _FAR, cost))


def exchange(
    sum_: Components, share: jax.Array, loss: jax.Array, axis: jax.Array, tolerance: float, most: Any,
    angles: tuple[int, ...] = (),
) -> tuple[Components, Exchanged]:
    """Split the components with the largest weighted loss, into empty slots or into those of pairs that cost little as one.

    share (K,): the weights that count.  loss (K,): see above.  axis (K, n): along which to split, one standard deviation long.
    tolerance: weighted losses below tolerance / K stay.  most: how many of the K slots may be used.
    Decisions are not differentiated.
    """
    K = len(share)
    tries = max(1, K // 4)
    share, loss = jax.lax.stop_gradient(share), jax.lax.stop_gradient(loss)
    alive = share > _DROPPED
    pruned = jnp.sum(jnp.where(alive, 0.0, share))
    share = jnp.where(alive, share, 0.0)
    index = jnp.arange(K)

    gains = share**_POWER * loss
    parents = jnp.argsort(-gains)[:tries]
    gain = gains[parents]
    wanted = gain > tolerance / K
    kept = jnp.zeros(K, bool).at[jnp.where(wanted, parents, K)].set(True, mode="drop")
    others = jnp.where(kept, 0.0, share)
    costs = jax.lax.stop_gradient(pair_costs(others, sum_.means, sum_.covs, loss, angles, power=_POWER))
    nearest = jnp.argmin(costs, axis=1)
    mutual = (nearest[nearest] == index) & (index < nearest)
    pair_cost = jnp.where(mutual, jnp.min(costs, axis=1), jnp.inf)
    pairs = jnp.argsort(pair_cost)[: 2 * tries]
    free = most - jnp.sum(alive)
    place = jnp.arange(2 * tries)
    slot = jnp.where(place < free, 0.0, pair_cost[pairs[jnp.clip(place - free, 0, 2 * tries - 1)]])
    price = slot[0::2] + slot[1::2]
    # Gains fall and prices rise along the list, so that what is accepted is its beginning.
    accepted = wanted & (GAINED * gain > price)
    count = jnp.maximum(0, 2 * jnp.sum(accepted) - free)
    merged, gone = _merge(sum_, pairs, nearest[pairs], place < count, angles)
    alive = alive & ~gone
    # What is told is in nats, whatever the power.
    nats = pair_cost[pairs] * (share[pairs] + share[nearest[pairs]]) ** (1.0 - _POWER)
    together = jnp.sum(jnp.where(place < count, nats, 0.0))
    empty = jnp.argsort(alive)[: 2 * tries]
    new = merged._replace(log_weights=jnp.where(alive, merged.log_weights, -jnp.inf))
    return _split(new, parents, axis[parents], empty, accepted), Exchanged(pruned, together)


def make_room(
    sum_: Components, share: jax.Array, loss: jax.Array, axis: jax.Array, tolerance: float, most: Any
) -> tuple[Components, jax.Array]:
    """Split the components with the largest weighted loss as long as slots are empty; and the weight that was dropped.

    Each becomes five of half the variance along its axis, whose relative entropy from it is 2e-6: the Gauss-Hermite rule of five
    nodes, moments up to the ninth.  Arguments are those of `exchange`; what a loss below 1e-5 would gain is not worth a split.
    """
    K = len(share)
    tries = max(1, K // 8)
    share, loss = jax.lax.stop_gradient(share), jax.lax.stop_gradient(loss)
    alive = share > PRUNED
    pruned = jnp.sum(jnp.where(alive, 0.0, share))
    gain = jnp.where(alive & (loss > 1e-5), share * loss, 0.0)
    parents = jnp.argsort(-gain)[:tries]
    spare = _FIVE.size - 1
    accepted = (gain[parents] > tolerance / K) & (spare * (jnp.arange(tries) + 1) <= most - jnp.sum(alive))
    empty = jnp.argsort(alive)[: spare * tries]
    alone = sum_._replace(log_weights=jnp.where(alive, sum_.log_weights, -jnp.inf))
    return _split(alone, parents, axis[parents], empty, accepted, _FIVE), pruned


def condensed(
    sum_: Components, share: jax.Array, most: Any, slots: int, angles: tuple[int, ...] = ()
) -> tuple[Components, jax.Array]:
    """The components put together in at most `most` of `slots` slots, the cheapest pairs first; and what that cost.

    Which with which is decided round by round and not differentiated; mass, mean and covariance are kept.
    """
    share, means, covs = (jax.lax.stop_gradient(a) for a in (share, sum_.means, sum_.covs))
    share = jnp.where(share > PRUNED, share, 0.0)
    index = jnp.arange(len(share))
    none = jnp.zeros(len(share))

    def together(carry):
        share, means, covs, label, cost = carry
        costs = pair_costs(share, means, covs, none, angles)
        nearest = jnp.argmin(costs, axis=1)
        least = jnp.min(costs, axis=1)
        first = (nearest[nearest] == index) & (index < nearest) & jnp.isfinite(least)
        excess = jnp.sum(share > 0) - most
        # Half of the pairs at most: the dear ones wait for what the others become.
        rank = jnp.argsort(jnp.argsort(jnp.where(first, least, jnp.inf)))
        first = first & (rank < jnp.minimum(excess, (jnp.sum(first) + 1) // 2))
        second = jnp.zeros_like(first).at[jnp.where(first, nearest, len(share))].set(True, mode="drop")
        total = jnp.where(first, share + share[nearest], 1.0)
        alpha = jnp.where(first, share / total, 1.0)
        apart = wrapped(means - means[nearest], angles)
        mean = jnp.where(first[:, None], means[nearest] + alpha[:, None] * apart, means)
        a = alpha[:, None, None]
        between = a * (1 - a) * apart[:, :, None] * apart[:, None, :]
        cov = jnp.where(first[:, None, None], a * covs + (1 - a) * covs[nearest] + between, covs)
        label = jnp.where(second[label], nearest[label], label)
        share = jnp.where(first, total, jnp.where(second, 0.0, share))
        # Where no two are each other's nearest the rest is lost, and that is said.
        cost = jnp.where(jnp.any(first), cost + jnp.sum(jnp.where(first, least, 0.0)), jnp.inf)
        return share, mean, cov, label, cost

    def more(carry):
        return (jnp.sum(carry[0] > 0) > most) & jnp.isfinite(carry[4])

    start = (share, means, covs, index, jnp.zeros(()))
    share, _, _, label, cost = jax.lax.while_loop(more, together, start)
    leaders = jnp.argsort(share <= 0)[:slots]
    member = (label == leaders[:, None]) & (share[leaders] > 0)[:, None]
    return _gathered(sum_, member, sum_.means[leaders], angles), cost


def _merge(sum_: Components, first: jax.Array, second: jax.Array, valid: jax.Array, angles) -> tuple[Components, jax.Array]:
    """Pairs put together in the slot of the first, with the moments kept; and which slots that leaves empty."""
    K = len(sum_.log_weights)
    a, b = sum_.log_weights[first], sum_.log_weights[second]
    a, b = jnp.where(valid, a, 0.0), jnp.where(valid, b, 0.0)
    log_weight = jnp.logaddexp(a, b)
    alpha = jnp.exp(a - log_weight)
    apart = wrapped(sum_.means[first] - sum_.means[second], angles)
    mean = sum_.means[second] + alpha[:, None] * apart
    alpha = alpha[:, None, None]
    between = alpha * (1.0 - alpha) * apart[:, :, None] * apart[:, None, :]
    cov = alpha * sum_.covs[first] + (1.0 - alpha) * sum_.covs[second] + between
    at = jnp.where(valid, first, K)
    gone = jnp.zeros(K, bool).at[jnp.where(valid, second, K)].set(True, mode="drop")
    return _put(sum_, at, log_weight, mean, cov), gone


class _Rule(NamedTuple):
    """A Gaussian as `size` of half the variance: the places in deviations of what is left, the first 0, and the weights."""

    places: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def size(self) -> int:
        return len(self.places)


def _rule(size: int) -> _Rule:
    node, weight = np.polynomial.hermite_e.hermegauss(size)
    order = np.argsort(np.abs(node))
    return _Rule(tuple(node[order] * np.sqrt(0.5)), tuple(weight[order] / weight.sum()))


_THREE, _FIVE = _rule(3), _rule(5)


def _split(
    sum_: Components, parents: jax.Array, axis: jax.Array, empty: jax.Array, valid: jax.Array, rule: _Rule = _THREE
) -> Components:
    """Gaussians of half the variance along an axis: N(0, P/2) convolved with the Gauss-Hermite rule for N(0, P/2).

    With three nodes the weights are 2/3, 1/6, 1/6 at 0 and +- sqrt(3/2) deviations, and moments up to the fifth are kept.
    """
    K = len(sum_.log_weights)
    log_weight, mean = sum_.log_weights[parents], sum_.means[parents]
    cov = sum_.covs[parents] - 0.5 * axis[:, :, None] * axis[:, None, :]
    new = _put(sum_, jnp.where(valid, parents, K), log_weight + np.log(rule.weights[0]), mean, cov)
    spare = rule.size - 1
    for i, (place, weight) in enumerate(zip(rule.places[1:], rule.weights[1:])):
        at = jnp.where(valid, empty[i::spare], K)
        new = _put(new, at, log_weight + np.log(weight), mean + place * axis, cov)
    return new


def _put(sum_: Components, at: jax.Array, log_weights: jax.Array, means: jax.Array, covs: jax.Array) -> Components:
    """Some slots replaced; an index past the end is dropped."""
    return sum_._replace(
        log_weights=sum_.log_weights.at[at].set(log_weights, mode="drop"),
        means=sum_.means.at[at].set(means, mode="drop"),
        covs=sum_.covs.at[at].set(covs, mode="drop"),
    )


def groups(
    share: np.ndarray, means: np.ndarray, covs: np.ndarray, loss: np.ndarray, most: int, angles: tuple[int, ...] = ()
) -> np.ndarray:
    """Which of at most `most` groups each component belongs to, (N,), on the host: cheap pairs first, round by round."""
    share, means, covs, loss = (np.array(a, float) for a in (share, means, covs, loss))
    label = np.arange(len(share))
    while (excess := int(np.sum(share > 0)) - most) > 0:
        costs = np.asarray(pair_costs(share, means, covs, loss, angles, np))
        nearest = costs.argmin(axis=1)
        first = np.flatnonzero((nearest[nearest] == np.arange(len(share))) & (np.arange(len(share)) < nearest) & (share > 0))
        if not len(first):
            # No two are each other's nearest: the one that weighs least goes to its own.
            least = int(np.argmin(np.where(share > 0, share, np.inf)))
            first, nearest[nearest[least]] = np.array([nearest[least]]), least
        cost = costs[first, nearest[first]]
        first = first[np.argsort(cost, kind="stable")][: max(1, min(excess, (len(first) + 1) // 2))]
        second = nearest[first]
        total = share[first] + share[second]
        alpha = share[first] / total
        apart = np.asarray(wrapped(jnp.asarray(means[first] - means[second]), angles))
        means[first] = means[second] + alpha[:, None] * apart
        alpha = alpha[:, None, None]
        old = np.trace(covs[first] + covs[second], axis1=1, axis2=2) / 2 + _TINY
        covs[first] = alpha * covs[first] + (1 - alpha) * covs[second]
        covs[first] += alpha * (1 - alpha) * apart[:, :, None] * apart[:, None, :]
        loss[first] = np.maximum(loss[first], loss[second]) * np.minimum(
            np.trace(covs[first], axis1=1, axis2=2) / old, 1 / _POINT
        ) ** 2
        share[first], share[second] = total, 0.0
        for i, j in zip(first, second):
            label[label == j] = i
    return np.unique(label, return_inverse=True)[1]


def gathered(sum_: Components, label: np.ndarray, angles: tuple[int, ...] = ()) -> Components:
    """Each group as one Gaussian with its mass, mean and covariance; `label` (N,) from `groups`."""
    leaders = np.array([np.flatnonzero(label == g)[0] for g in range(label.max() + 1)])
    return _gathered(sum_, jnp.asarray(label == np.arange(label.max() + 1)[:, None]), sum_.means[leaders], angles)


def _gathered(sum_: Components, member: jax.Array, origin: jax.Array, angles: tuple[int, ...]) -> Components:
    """Groups (G, K) of components, each as one Gaussian; `origin` (G, n) is a mean of each group."""
    logs = jnp.where(member, sum_.log_weights, -jnp.inf)
    # Each group has a scale of its own: the weights of two may be further apart than numbers go.
    top = jax.lax.stop_gradient(jnp.max(logs, axis=1))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    parts = jnp.exp(logs - top[:, None])
    weight = jnp.sum(parts, axis=1)
    share = parts / jnp.where(weight > 0, weight, 1.0)[:, None]
    apart = wrapped(sum_.means[None] - origin[:, None], angles)
    shift = jnp.einsum("gk,gki->gi", share, apart)
    rest = apart - shift[:, None]
    covs = jnp.einsum("gk,kij->gij", share, sum_.covs) + jnp.einsum("gk,gki,gkj->gij", share, rest, rest)
    # An empty group keeps a Gaussian that is one.
    covs = jnp.where((weight > 0)[:, None, None], covs, sum_.covs[0])
    logs = jnp.where(weight > 0, jnp.log(jnp.where(weight > 0, weight, 1.0)) + top, -jnp.inf)
    return Components(logs, origin + shift, covs, jnp.ones(len(logs)))
