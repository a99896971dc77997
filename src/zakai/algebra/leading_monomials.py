"""A proof of infinite dimension by leading monomials, for elements with polynomial symbols.

Weigh x_i and xi_i so that w(x_i) + w(xi_i) > 0, smallest for one coordinate i only.  The bracket of two operators with
leading monomials x^a xi^b and x^c xi^d then has the leading monomial x^(a+c-e_i) xi^(b+d-e_i), with the coefficient
b_i c_i - a_i d_i, unless that is zero: every other term of Leibniz' rule weighs less.  So ad_A^m B has

    the coefficient  prod_k<m (b_i c_i - a_i d_i + k (a_i - b_i)),    the monomial  x^(c + m(a - e_i)) xi^(d + m(b - e_i)),

and if no factor vanishes and A's monomial is not x_i xi_i, these are infinitely many independent elements.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WEIGHTS_FOR_EACH_COORDINATE = 300


@dataclass(frozen=True)
class Growth:
    """Elements number `left` (A) and `right` (B) whose brackets ad_A^m B grow, for `weights` of x (n) and then xi (n)."""

    left: int
    right: int
    weights: tuple[int, ...]


def growing_pair(supports: Sequence[np.ndarray], n: int) -> Growth | None:
    """The earliest pair that grows, for some of a fixed choice of weights; a support has rows (exponents of x, of xi)."""
    found: Growth | None = None
    table = _weights(n)
    leading = [_leading(support, table) for support in supports]
    for column, weights in enumerate(table.T):
        known = [k for k, (single, _) in enumerate(leading) if single[column]]
        if not known:
            continue
        i = int(np.argmin(weights[:n] + weights[n:]))
        monomials = np.array([supports[k][leading[k][1][column]] for k in known])
        a, b = monomials[:, i], monomials[:, n + i]
        factor = np.outer(b, a) - np.outer(a, b)
        step = (a - b)[:, None]
        divisor = np.where(step == 0, 1, step)
        vanishes = (factor == 0) | ((step != 0) & (factor % divisor == 0) & (-factor // divisor >= 0))
        euler = np.zeros(2 * n, dtype=int)
        euler[[i, n + i]] = 1
        grows = ~vanishes & (monomials != euler).any(axis=1)[:, None]
        for left, right in np.argwhere(grows):
            pair = known[left], known[right]
            if found is None or max(pair) < max(found.left, found.right):
                found = Growth(*pair, tuple(int(w) for w in weights))
    return found


def _leading(support: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each column of weights, whether there is a single heaviest monomial, and which it is."""
    weighed = support @ table
    return np.sum(weighed == weighed.max(axis=0), axis=0) == 1, weighed.argmax(axis=0)


def _weights(n: int) -> np.ndarray:
    """Fixed pseudo-random weights, a column each, in turn for each coordinate to be the lightest."""
    rng = random.Random(1919)
    columns = []
    for _ in range(WEIGHTS_FOR_EACH_COORDINATE):
        for i in range(n):
            x = [rng.randint(-60, 60) for _ in range(n)]
            sums = [rng.randint(2, 90) if j != i else 1 for j in range(n)]
            columns.append([*x, *(total - w for total, w in zip(sums, x))])
    return np.array(columns).T
