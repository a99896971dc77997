"""Which Gaussians of a sum to split and which to merge, so that a fixed number of components is spent where it matters.

Each component has a loss: how badly one Gaussian serves there, a number without unit.  Splitting a component lowers its loss;
merging two costs their loss as one, and what is lost of their shape.  Both keep the mass, the mean and the covariance of the sum.
Decisions are taken by real parts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zakai.numerics.sums.mixture import Array, Components, joined, selected, wrapped

PRUNED = 1e-7  # a share below which a component is dropped after a sample
# Between observations that say little a light component may be the seed of a mode.
_DROPPED = 1e-12
# There weights count by this power: a light mode that may become the heavy one needs components of its own.
_POWER = 0.7
# A component of no variance counts as one of this share of the others' variance; what is further apart than _FAR is just far.
_POINT, _TINY, _FAR = 1e-12, 1e-100, 1e100
# A split leaves about a quarter of a loss that is quadratic in the variance.
_GAINED = 0.75


def pair_costs(
    share: Array,
    means: Array,
    covs: Array,
    loss: Array | None = None,
    angles: tuple[int, ...] = (),
    power: float = 1.0,
    rows: Array | None = None,
) -> Array:
    """Return what merging components i and j would cost, (R, K): nats of relative entropy, weighted by their share^power.

    The loss of the pair as one Gaussian, and the relative entropy of the pair's shape: for components far apart Runnalls' (2007)
    bound, for close ones the leading cumulants (skewness^2 / 12 + kurtosis^2 / 48), whichever is smaller.

    Args:
        share: (K,).
        means: (K, n).
        covs: (K, n, n).
        loss: (K,); None for zero.
        angles: Coordinates that are angles.
        power: The power of the share.
        rows: The components i (R,); all by default.
    """
    K, n = means.shape
    rows = np.arange(K) if rows is None else rows
    one = share[rows, None]
    both = one + share
    alpha = one / np.where(both > 0, both, 1.0)
    beta = 1.0 - alpha
    weight = np.maximum(alpha * beta, 1e-30)
    apart = means[rows, None] - means
    apart = wrapped(apart, angles) if angles else apart
    if n == 1:
        variance = np.maximum(covs[:, 0, 0], _POINT * (share @ covs[:, 0, 0]) + _TINY)
        mine = variance[rows, None]
        distance = apart[..., 0] ** 2 / (alpha * mine + beta * variance)
        ratio = mine / variance
        unlike = ratio + 1.0 / ratio - 2.0
    else:
        scale = share @ np.diagonal(covs, axis1=1, axis2=2) / share.sum()
        inverse = np.linalg.inv(covs + np.eye(n) * (_POINT * scale + _TINY))
        # The inverse is convex, so that the average bounds the distance in the pair's own covariance.
        from_row, from_column = np.zeros(both.shape), np.zeros(both.shape)
        for a in range(n):
            for b in range(a + 1):
                square = (1.0 if a == b else 2.0) * apart[..., a] * apart[..., b]
                from_row += square * inverse[rows, a, b, None]
                from_column += square * inverse[:, a, b]
        distance = alpha * from_row + beta * from_column
        flat_inverse, flat_covs = inverse.reshape(K, n * n), covs.reshape(K, n * n)
        trace = flat_inverse[rows] @ flat_covs.T + flat_covs[rows] @ flat_inverse.T
        unlike = np.maximum(trace - 2.0 * n, 0.0)
    between = np.minimum(weight * distance, _FAR)
    inside = between / (1.0 + between)
    cumulants = inside**3 * ((alpha - beta) ** 2 + 0.25 * inside) / (12.0 * weight)
    width = weight * unlike
    cost = np.minimum(0.5 * np.log1p(between), cumulants) + np.minimum(0.5 * np.log1p(0.5 * width), 0.1875 * width**2)
    if loss is not None:  # what the pair would lose as one, beyond what the two lose now
        mine = loss[rows, None]
        cost = cost + np.maximum(mine, loss) * (1.0 + between) ** 2 - alpha * mine - beta * loss
    cost = cost * (both if power == 1.0 else both**power)
    cost = np.where(np.isnan(cost), _FAR, cost)
    cost[(one <= 0) | (share <= 0)] = np.inf
    cost[np.arange(len(rows)), rows] = np.inf
    return cost


def exchange(
    sum_: Components,
    share: Array,
    loss: Array,
    axes: Callable[[Array], Array],
    tolerance: float,
    most: int,
    angles: tuple[int, ...] = (),
) -> tuple[Components, float, float]:
    """Split the components of the largest weighted loss, while that gains more than merging pairs for their places costs.

    Args:
        sum_: The sum.
        share: The weights (K,) that count.
        loss: See above, (K,).
        axes: Function that returns the vectors (P, n) along which components (P,) are split, one standard deviation long.
        tolerance: Weighted losses below tolerance / most stay.
        most: The largest number of components.
        angles: Coordinates that are angles.

    Returns:
        The new sum, the share that was dropped, and the loss by merging.
    """
    alive = np.flatnonzero(share > _DROPPED)
    pruned = 1.0 - float(share[alive].sum()) if len(alive) < len(share) else 0.0
    if len(alive) < len(share):
        sum_, share, loss = selected(sum_, alive), share[alive], loss[alive]
    K = len(share)
    gains = share**_POWER * loss
    parents = np.argsort(-gains, kind="stable")[: max(1, most // 4)]
    parents = parents[gains[parents] > tolerance / most]
    free, count = most - K, 2 * len(parents)
    costs, first, second = np.zeros(count), np.zeros(0, int), np.zeros(0, int)
    if count > free:
        others = share.copy()
        others[parents] = 0.0
        first, second, prices = _mutual(pair_costs(others, sum_.means.real, sum_.covs.real, loss, angles, _POWER))
        costs = np.full(count, np.inf)
        costs[: max(free, 0)] = 0.0
        paid = prices[: count - max(free, 0)]
        costs[max(free, 0) : max(free, 0) + len(paid)] = paid
    price = costs[0::2] + costs[1::2]
    # Gains fall and prices rise along the list, so that what is accepted is its beginning.
    accepted = int(np.argmin(np.append(_GAINED * gains[parents] > price, False)))
    merges = max(0, 2 * accepted - max(free, 0))
    first, second, parents = first[:merges], second[:merges], parents[:accepted]
    nats = costs[max(free, 0) : max(free, 0) + merges] * (share[first] + share[second]) ** (1.0 - _POWER)
    rest = np.ones(K, bool)
    for used in (first, second, parents):
        rest[used] = False
    pieces = [selected(sum_, rest)]
    if merges:
        pair = np.concatenate([first, second])
        pieces.append(gathered(selected(sum_, pair), np.tile(np.arange(merges), 2), angles))
    if accepted:
        pieces.append(split(selected(sum_, parents), axes(alive[parents]), THREE))
    return joined(*pieces), pruned, float(nats.sum())


def _mutual(costs: Array) -> tuple[Array, Array, Array]:
    """Return the pairs (first, second) that are each other's cheapest, with their costs, the cheapest first."""
    nearest = np.argmin(costs, axis=1)
    index = np.arange(len(costs))
    least = costs[index, nearest]
    first = np.flatnonzero((nearest[nearest] == index) & (index < nearest) & np.isfinite(least))
    first = first[np.argsort(least[first], kind="stable")]
    return first, nearest[first], least[first]


def parents_of(share: Array, loss: Array, tolerance: float, most: int) -> Array:
    """Return which components (P,) of a sum are split in five before a sample, those of the largest weighted loss.

    Their number leaves at most `most` components.  What a loss below 1e-5 would gain is not worth a split.
    """
    gain = np.where(loss > 1e-5, share * loss, 0.0)
    parents = np.argsort(-gain, kind="stable")[: max(1, most // 8)]
    parents = parents[gain[parents] > tolerance / most]
    return np.asarray(parents[: max(0, (most - len(share)) // 4)])


def groups(
    share: Array, means: Array, covs: Array, loss: Array | None, most: int, angles: tuple[int, ...] = ()
) -> tuple[Array, float]:
    """Return which of at most `most` groups each component belongs to, (K,), and what the merging costs in nats.

    The cheapest pairs are merged first, round by round; arguments are those of `pair_costs`.
    """
    index = np.arange(len(share))
    label, total_cost = index.copy(), 0.0
    used = np.flatnonzero(share > 0)
    if len(used) < len(share):  # those of no weight belong to the first
        label[:] = used[0] if len(used) else 0
        label[used] = used
    share, means, covs = share[used], means[used].copy(), covs[used].copy()
    loss = None if loss is None else loss[used]
    member = used.copy()
    costs = pair_costs(share, means, covs, loss, angles) if len(used) > most else np.zeros((0, 0))
    while (excess := len(share) - most) > 0:
        first, second, price = _mutual(costs)
        if not len(first):  # no two are each other's cheapest: the one that weighs least goes to its own
            least = int(np.argmin(share))
            partner = int(np.argmin(costs[least])) if np.isfinite(costs[least]).any() else (least + 1) % len(share)
            first, second, price = np.array([partner]), np.array([least]), np.array([costs[partner, least]])
        # Half of the pairs at most: the dear ones wait for what the others become.
        count = max(1, min(excess, (len(first) + 1) // 2))
        first, second, price = first[:count], second[:count], price[:count]
        total_cost += float(price.sum())
        both = share[first] + share[second]
        alpha = (share[first] / both)[:, None, None]
        apart = wrapped(means[first] - means[second], angles)
        means[first] = means[second] + alpha[:, 0] * apart
        if loss is not None:
            before = np.trace(covs[first] + covs[second], axis1=1, axis2=2) / 2 + _TINY
        outer = apart[:, :, None] * apart[:, None, :]
        covs[first] = alpha * covs[first] + (1 - alpha) * covs[second] + alpha * (1 - alpha) * outer
        if loss is not None:
            growth = np.minimum(np.trace(covs[first], axis1=1, axis2=2) / before, 1 / _POINT)
            loss = loss.copy()
            loss[first] = np.maximum(loss[first], loss[second]) * growth**2
        share[first] = both
        for i, j in zip(member[first], member[second], strict=True):
            label[label == j] = i
        kept = np.ones(len(share), bool)
        kept[second] = False
        place = np.cumsum(kept) - 1
        share, means, covs, member = share[kept], means[kept], covs[kept], member[kept]
        loss = None if loss is None else loss[kept]
        costs = costs[kept][:, kept]
        changed = place[first]
        costs[changed] = pair_costs(share, means, covs, loss, angles, rows=changed)
        costs[:, changed] = costs[changed].T
    return np.unique(label, return_inverse=True)[1], total_cost


def gathered(sum_: Components, label: Array, angles: tuple[int, ...] = ()) -> Components:
    """Return each group as one Gaussian with its mass, mean and covariance; `label` (K,) is that of `groups`."""
    count = int(label.max()) + 1
    member = label == np.arange(count)[:, None]
    origin = sum_.means[np.argmax(member, axis=1)]
    # Each group has a scale of its own: the weights of two may be further apart than numbers go.
    top = np.max(np.where(member, sum_.log_weights.real, -np.inf), axis=1)
    top = np.where(np.isfinite(top), top, 0.0)
    parts = np.exp(sum_.log_weights - top[label])
    weight = member @ parts
    share = member * (parts / np.where(weight.real > 0, weight, 1.0)[label])
    apart = wrapped(sum_.means - origin[label], angles)
    shift = share @ apart
    rest = apart - shift[label]
    n = apart.shape[1]
    second = sum_.covs + rest[:, :, None] * rest[:, None, :]
    covs = (share @ second.reshape(len(label), n * n)).reshape(count, n, n)
    return Components(np.log(weight) + top, origin + shift, covs, np.ones(count))


class SplitRule:
    """A Gaussian as `size` of half the variance: `places` in deviations of the parent, and `weights`."""

    def __init__(self, size: int) -> None:
        node, weight = np.polynomial.hermite_e.hermegauss(size)
        self.size, self.places, self.log_weights = size, node * np.sqrt(0.5), np.log(weight / weight.sum())


# With three nodes moments up to the fifth are kept, with five up to the ninth (relative entropy 2e-6).
THREE, FIVE = SplitRule(3), SplitRule(5)


def split(parents: Components, axis: Array, rule: SplitRule) -> Components:
    """Return Gaussians of half the variance along an axis: N(0, P/2) convolved with the Gauss-Hermite rule for N(0, P/2)."""
    covs = parents.covs - 0.5 * axis[:, :, None] * axis[:, None, :]
    logs = parents.log_weights[:, None] + rule.log_weights
    means = parents.means[:, None] + rule.places[:, None] * axis[:, None]
    size = rule.size
    return Components(
        logs.reshape(-1), means.reshape(-1, axis.shape[1]), np.repeat(covs, size, axis=0), np.repeat(parents.signs, size)
    )
