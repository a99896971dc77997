"""Sums of exponentials of quadratics, which need not decrease, and their products with Gaussian sums.

    psi(x) = sum_j exp(logs_j + slopes_j.x - x'information_j x / 2)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.numerics.sums.mixture import Array, Components, dot, log_volumes, solve, symmetric, weighed
from zakai.numerics.transition import Transition

# A quotient or a product may have at most this share of the inverse variance of a Gaussian as negative information.
_NEGATIVE = 0.9


class Exponents(NamedTuple):
    """`logs` (J,), `slopes` (J, n), `information` (J, n, n), about a `centre` (n,): the x above is relative to it."""

    centre: Array
    logs: Array
    slopes: Array
    information: Array

    def around(self, centre: Array) -> Exponents:
        """Return the same sum about another centre."""
        away = centre - self.centre
        push = self.information @ away
        logs = self.logs + self.slopes @ away - 0.5 * push @ away
        return Exponents(centre, logs, self.slopes - push, self.information)


def product(sum_: Components, psi: Exponents) -> Components:
    """Return the products of all components of a Gaussian sum with all exponentials: those of the first component first.

    Information that no Gaussian of the sum can bear is cut off.
    """
    count, number = len(sum_.signs), len(psi.logs)
    pairs = Components(*(np.repeat(array, number, axis=0) for array in sum_))
    information = np.tile(psi.information, (count, 1, 1))
    if (np.linalg.eigvalsh(psi.information)[:, 0] < 0).any():
        information = _bounded(pairs.covs, information)
    pairs = pairs._replace(means=pairs.means - psi.centre)
    found = weighed(pairs, np.tile(psi.logs, count), np.tile(psi.slopes, (count, 1)), information)
    return found._replace(means=found.means + psi.centre)


def _bounded(covs: Array, information: Array) -> Array:
    """Return information of which root' information root is above -_NEGATIVE, with root root' = covs."""
    values, vectors = np.linalg.eigh(covs)
    values = np.sqrt(np.maximum(values, 0.0))
    root = vectors * values[:, None, :]
    inverse = vectors * np.where(values > 0, 1.0 / np.where(values > 0, values, 1.0), 0.0)[:, None, :]
    sizes, axes = np.linalg.eigh(np.swapaxes(root, 1, 2) @ information @ root)
    more = (axes * np.maximum(-_NEGATIVE - sizes, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(information + inverse @ more @ np.swapaxes(inverse, 1, 2))


def quotient(sum_: Components, mean: Array, cov: Array) -> Exponents:
    """Return a Gaussian sum divided by the Gaussian N(mean, cov), about its mean."""
    inverse, whole = np.linalg.inv(sum_.covs), np.linalg.inv(cov)
    away = sum_.means - mean
    slopes = dot(inverse, away[:, None, :])
    logs = sum_.log_weights - 0.5 * (log_volumes(sum_.covs) - np.linalg.slogdet(cov)[1]) - 0.5 * dot(slopes, away)
    return Exponents(mean, logs, slopes, symmetric(inverse - whole))


def adjoint(transition: Transition, psi: Exponents, inputs: Array, centre: Array) -> Exponents:
    """Return the sum before a transition from that after it, about another centre: x -> E psi(Psi x + b + N(0, Gamma)), weighed.

    With W = (I + Gamma A)^-1 and s = Psi centre + b - psi.centre: Psi'A W Psi + Omega, Psi'(W'q - A W s) + eta - Omega centre,
    q'W s - s'A W s / 2 + q'W Gamma q / 2 - log |I + Gamma A| / 2 + c.
    """
    own, n, (_, logs, slopes, information) = transition, len(centre), psi
    start = own.map @ centre + own.offset @ inputs - psi.centre
    system = np.eye(n) + own.noise @ information
    given = np.column_stack([own.map, start, own.noise])
    solved = solve(system, np.broadcast_to(given, (len(logs), *given.shape)))
    moved, offset, noise = solved[:, :, :n], solved[:, :, n], symmetric(solved[:, :, n + 1 :])
    push = own.information @ centre
    pull = own.vector @ inputs - push
    drawn = dot(information, offset[:, None, :])
    return Exponents(
        centre,
        logs + dot(slopes, offset) - 0.5 * drawn @ start + 0.5 * dot(dot(noise, slopes[:, None, :]), slopes)
        - 0.5 * log_volumes(system) + inputs @ own.constant @ inputs + pull @ centre + 0.5 * push @ centre,
        dot(np.swapaxes(moved, 1, 2), slopes[:, None, :]) - drawn @ own.map + pull,
        symmetric(own.map.T @ information @ moved) + own.information,
    )  # fmt: skip
