"""Gaussians and finite mixtures of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zakai.densities._density import DensityMethods
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size, wrap

_AT_ONCE = 2**21  # points times components in one array
_PROPOSALS = 1000  # of a draw from a mixture with negative weights


@dataclass(frozen=True, repr=False)
class GaussianMixture(DensityMethods):
    """sum_k w_k N(m_k, P_k): `weights` (k,), `means` (k, n), `covs` (k, n, n); one component is a Gaussian.

    Weights sum to one and may be slightly negative, as those of nodes that represent a smooth density are; a density is then
    -inf in the logarithm where rounding leaves nothing.  A coordinate in `periodic` is wrapped to the circle: its density is
    summed over the windings that matter.
    """

    weights: np.ndarray
    means: np.ndarray
    covs: np.ndarray
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    @classmethod
    def gaussian(cls, mean: np.ndarray, cov: np.ndarray, names: tuple[str, ...], periodic: tuple[bool, ...]) -> GaussianMixture:
        """Return a single Gaussian with mean (n,) and covariance (n, n)."""
        return cls(np.ones(1), np.asarray(mean)[None], np.asarray(cov)[None], names, periodic)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        x = as_states(x, len(self.names))
        points = x.reshape(-1, len(self.names))
        rows = max(1, _AT_ONCE // len(self.weights))
        parts = [self._log_density(points[i : i + rows]) for i in range(0, len(points), rows)]
        return np.concatenate(parts or [np.zeros(0)]).reshape(x.shape[:-1])

    def _log_density(self, points: np.ndarray) -> np.ndarray:
        # SciPy takes long to import, and an online filter does not need it.
        from scipy.linalg import solve_triangular
        from scipy.special import logsumexp

        logs, signs = [], []
        for rows in self._shared():
            cov, means, weights = self.covs[rows.start], self.means[rows], self.weights[rows]
            factor = np.linalg.cholesky(cov)
            whiten = solve_triangular(factor, np.eye(len(cov)), lower=True)  # once, for many points
            with np.errstate(divide="ignore"):
                constants = np.log(np.abs(weights)) - np.sum(np.log(np.diag(factor))) - 0.5 * len(cov) * np.log(2 * np.pi)
            for winding in self._windings(cov):
                difference = self._difference(points[:, None], means) + winding
                white = difference @ whiten.T
                logs.append(constants - 0.5 * np.sum(white**2, axis=-1))
                signs.append(np.broadcast_to(np.sign(weights), logs[-1].shape))
        with np.errstate(divide="ignore"):
            value, sign = logsumexp(np.hstack(logs), axis=1, b=np.hstack(signs), return_sign=True)
        return np.where(sign > 0, value, -np.inf)

    def _shared(self) -> list[slice]:
        """Return runs of consecutive components that share a covariance."""
        ends = np.flatnonzero(np.any(self.covs[1:] != self.covs[:-1], axis=(1, 2))) + 1
        return [slice(a, b) for a, b in zip([0, *ends], [*ends, len(self.covs)], strict=True)]

    def _difference(self, x: np.ndarray, mean: np.ndarray) -> np.ndarray:
        difference = x - mean
        return np.asarray(np.where(self.periodic, wrap(difference), difference))

    def _windings(self, cov: np.ndarray) -> np.ndarray:
        turns = [
            np.arange(-k, k + 1) * 2 * np.pi
            for k in (
                int(np.ceil((np.pi + 9 * np.sqrt(cov[i, i])) / (2 * np.pi))) if angle else 0
                for i, angle in enumerate(self.periodic)
            )
        ]
        return np.asarray(np.stack(np.meshgrid(*turns, indexing="ij"), axis=-1).reshape(-1, len(turns)))

    def mean(self) -> np.ndarray:
        return np.asarray(np.where(self.periodic, np.angle(self.resultant()), self.weights @ self.means))

    def resultant(self) -> np.ndarray:
        """Return E exp(i x) of each coordinate (n,)."""
        damping = np.exp(-0.5 * np.diagonal(self.covs, axis1=1, axis2=2))
        return np.asarray(self.weights @ (damping * np.exp(1j * self.means)))

    def cov(self) -> np.ndarray:
        deviation = self._difference(self.means, self.mean())
        within = np.einsum("k,kij->ij", self.weights, self.covs)
        return np.asarray(within + np.einsum("k,ki,kj->ij", self.weights, deviation, deviation))

    def mode(self) -> np.ndarray:
        heaviest = np.argsort(-self.weights)[:256]
        x = self.means[heaviest][np.argmax(self.log_density(self.means[heaviest]))]
        for _ in range(200):  # the mean-shift iteration climbs to the mode near the best component
            precisions = np.linalg.inv(self.covs)
            with np.errstate(divide="ignore"):
                weights = np.log(np.abs(self.weights))
            logs = (
                weights
                + 0.5 * np.linalg.slogdet(precisions)[1]
                - 0.5 * np.einsum("ki,kij,kj->k", x - self.means, precisions, x - self.means)
            )
            share = np.sign(self.weights) * np.exp(logs - logs.max())
            new = np.linalg.solve(
                np.einsum("k,kij->ij", share, precisions), np.einsum("k,kij,kj->i", share, precisions, self.means)
            )
            if np.allclose(new, x, rtol=1e-12, atol=1e-14):
                break
            x = new
        return np.where(self.periodic, wrap(x), x)

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        from scipy.special import ndtr, ndtri

        wanted = probabilities(q)
        deviations = np.sqrt(np.diagonal(self.covs, axis1=1, axis2=2))
        centre = self.mean()
        if len(self.weights) == 1:
            return np.asarray(centre + ndtri(wanted)[:, None] * deviations[0])
        means = centre + self._difference(self.means, centre)
        out = np.empty((len(wanted), len(self.names)))
        for i in range(len(self.names)):
            low = np.full(len(wanted), (means[:, i] - 40 * deviations[:, i]).min())
            high = np.full(len(wanted), (means[:, i] + 40 * deviations[:, i]).max())
            for _ in range(200):
                middle = 0.5 * (low + high)
                below = ndtr((middle[:, None] - means[:, i]) / deviations[:, i]) @ self.weights < wanted
                low, high = np.where(below, middle, low), np.where(below, high, middle)
            out[:, i] = 0.5 * (low + high)
        out[wanted == 0.0], out[wanted == 1.0] = -np.inf, np.inf
        return out

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> GaussianMixture:
        keep = coordinate_numbers(self.names, coordinates)
        return GaussianMixture(
            self.weights,
            self.means[:, keep],
            self.covs[:, keep][:, :, keep],
            tuple(self.names[i] for i in keep),
            tuple(self.periodic[i] for i in keep),
        )

    def drawn(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return weights (N,) and points (N, n), sums over which are expectations, by uniform numbers (n + 1, N).

        The first row draws the components, with the signs of their weights, and the others a point of each.
        """
        from scipy.special import ndtri

        order = np.argsort(self.means[:, 0], kind="stable")  # neighbours in the order are neighbours in the state
        size = np.cumsum(np.abs(self.weights[order]))
        which = order[np.searchsorted(size, share[0] * size[-1]).clip(0, len(order) - 1)]
        x = self.means[which] + np.einsum("cij,cj->ci", self._roots[which], ndtri(share[1:]).T)
        signs = np.sign(self.weights[which])
        return signs / signs.sum(), np.where(self.periodic, wrap(x), x)

    @property
    def _roots(self) -> np.ndarray:
        """Roots R (k, n, n) with R R' = P, which may be singular."""
        variances, axes = np.linalg.eigh(self.covs)
        return np.asarray(axes * np.sqrt(np.maximum(variances, 0.0))[:, None])

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        roots = self._roots
        size, signed = np.abs(self.weights), bool((self.weights < 0.0).any())
        positive = GaussianMixture(size / size.sum(), self.means, self.covs, self.names, self.periodic)
        x, rest = np.empty((count, len(self.names))), np.arange(count)
        for _ in range(_PROPOSALS):
            which = rng.choice(len(size), size=len(rest), p=positive.weights)
            x[rest] = self.means[which] + np.einsum("cij,cj->ci", roots[which], rng.standard_normal((len(rest), len(self.names))))
            if not signed or not len(rest):
                break
            # With negative weights a proposal is accepted by the share of the density in that of the sizes of the weights.
            share = np.exp(self.log_density(x[rest]) - positive.log_density(x[rest])) * self.weights.sum() / size.sum()
            rest = rest[rng.random(len(rest)) >= share]
        return np.where(self.periodic, wrap(x), x)
