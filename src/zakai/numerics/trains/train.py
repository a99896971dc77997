"""Tensor trains: u(z_i) = G_1[i_1] G_2[i_2] ... G_n[i_n] on a grid, their integrals, draws, and convolution with a Gaussian."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from zakai.numerics.quasi_random import quasi_random
from zakai.numerics.trains.grid import Grid, after_noise, kernel_matrix, padded_prefilter
from zakai.numerics.trains.kernels import add_train, draw, values_on_grid

Array = Any
ROUNDING, SMALLEST = 1e-16, 1e-300  # of squares of numbers, and the least square that is divided by
SMALL = 1e-12  # variance of noise along an axis, in variances of the density, that is left out


@lru_cache(maxsize=64)
def tail_radius(n: int, share: float) -> float:
    """Return the square of the radius beyond which a Gaussian of n states has a share of its mass."""
    from scipy.stats import chi2

    return float(chi2.isf(share, n))


@dataclass(frozen=True, eq=False)
class Train:
    """A function on a `grid` by its `cores` (a, N, b); `periods` (n,) are 2 pi for angles and 0 for other states.

    With `tails`, a share of the mass, a Gaussian with the moments of the train stands for it beyond the radius that leaves this
    share of the Gaussian, where the train is smaller than the Gaussian at the radius.  There a train is below the error that it
    has relative to its largest value: an observation six deviations away would find nothing but that error, and lose the density.
    A curved density, with more mass out there, keeps its own values.
    """

    grid: Grid
    cores: tuple[Array, ...]
    periods: Array
    tails: float = 0.0

    @property
    def ranks(self) -> list[int]:
        """The ranks (n + 1,)."""
        return [1, *(core.shape[2] for core in self.cores)]

    @cached_property
    def arrays(self) -> tuple[Any, ...]:
        """The train as `add_train` takes it.

        The coefficients of a core have the order (N + 2 PAD, a, b): those that the points of a cell need are one matrix.
        """
        grid, parts = self.grid, list[Array]()
        for k, core in enumerate(self.cores):
            a, N, b = core.shape
            A = padded_prefilter(N, bool(grid.closed[k]))
            parts.append((A @ core.transpose(1, 0, 2).reshape(N, a * b)).ravel())
        offsets = np.cumsum([0, *(part.size for part in parts)])
        return (
            grid.centre, np.ascontiguousarray(np.linalg.inv(grid.basis)), grid.low, grid.step, grid.sizes, self.periods,
            np.array(self.ranks), offsets, np.concatenate(parts), *self._tail,
        )  # fmt: skip

    @cached_property
    def _tail(self) -> tuple[Array, Array, Array]:
        """The Gaussian with the moments of the train that stands for it where it is below its accuracy."""
        n, mass = self.grid.n, self.mass
        none = np.zeros(n), np.zeros((n, n)), np.array([np.inf, 0.0, 1.0])
        if not self.tails or self.grid.closed.any() or not mass > 0:
            return none
        mean, P = self.moments()
        try:
            whitening = np.linalg.inv(np.linalg.cholesky(P))
        except np.linalg.LinAlgError:
            return none
        top = mass * float(np.prod(np.diag(whitening))) / (2.0 * math.pi) ** (0.5 * n)
        radius = tail_radius(n, self.tails)
        least = top * math.exp(-0.5 * radius)
        return mean - self.grid.centre, np.ascontiguousarray(whitening), np.array([radius, top, least])

    @cached_property
    def _packed(self) -> tuple[Any, ...]:
        """The cores in the order (N, a, b), as `draw` takes them."""
        parts = [core.transpose(1, 0, 2).ravel() for core in self.cores]
        offsets = np.cumsum([0, *(part.size for part in parts[:-1])])
        return np.array(self.ranks), self.grid.sizes, offsets, np.concatenate(parts)

    def evaluate(self, x: Array) -> Array:
        """Return the values (P,) at points x (n, P)."""
        out = np.zeros(x.shape[1])
        add_train(self.arrays, np.ascontiguousarray(x), False, np.ones(2), out)
        return out

    def on_grid(self, index: Array) -> Array:
        """Return the values (P,) at indices (P, n) of the grid."""
        out = np.empty(len(index))
        values_on_grid(self._packed, index, out)
        return out

    @cached_property
    def _sums(self) -> tuple[list[Array], list[Array], list[Array]]:
        """Products of the cores summed over their axes: from the left (1, a), from the right (b, 1), and the sums (a, b)."""
        total = [core.sum(axis=1) for core in self.cores]
        left, right = [np.ones((1, 1))], [np.ones((1, 1))]
        for one in total:
            left.append(left[-1] @ one)
        for one in reversed(total):
            right.append(one @ right[-1])
        return left, right[::-1], total

    @cached_property
    def mass(self) -> float:
        """The integral over x."""
        return float(self._sums[0][-1][0, 0]) * self.grid.volume

    def moments(self, direction: Array | None = None) -> tuple[Array, Array]:
        """Return the mean (n,) and the covariance (n, n) in x by sums over the grid.

        With a `direction` (n,), NaN but for angles, the mean of an angle is that, and deviations are those from it, wrapped.  On
        a closed axis a wrapped deviation is its Fourier series up to the frequencies that the points hold.
        """
        return self._line_moments if direction is None else self._moments(direction)

    @cached_property
    def _line_moments(self) -> tuple[Array, Array]:
        return self._moments(None)

    def _moments(self, direction: Array | None) -> tuple[Array, Array]:
        left, right, total = self._sums
        n, mass, B = self.grid.n, left[-1][0, 0], self.grid.basis
        axes = [self.grid.axis(k) for k in range(n)]
        squares = [z**2 for z in axes]
        for k in np.flatnonzero(self.grid.closed):
            d = int(np.argmax(B[:, k]))
            centre = 0.0 if direction is None else direction[d] - self.grid.centre[d]
            axes[k], squares[k] = _wrapped_powers(axes[k] - centre)
        first = [z @ core for z, core in zip(axes, self.cores, strict=True)]
        mean, second = np.empty(n), np.empty((n, n))
        for i, core in enumerate(self.cores):
            v = left[i] @ first[i]
            mean[i] = (v @ right[i + 1])[0, 0] / mass
            second[i, i] = (left[i] @ (squares[i] @ core) @ right[i + 1])[0, 0] / mass
            for j in range(i + 1, n):
                second[i, j] = second[j, i] = (v @ first[j] @ right[j + 1])[0, 0] / mass
                v = v @ total[j]
        known = self.grid.closed if direction is not None else np.zeros(n, bool)
        about = np.where(known, 0.0, mean)
        x, cov = self.grid.centre + B @ about, B @ (second - np.outer(mean, mean)) @ B.T
        off = B @ np.where(known, mean, 0.0)
        if direction is not None:
            angles = np.isfinite(direction)
            line = angles & ~(np.abs(B) @ known > 0)
            off = np.where(line, np.remainder(x - direction + np.pi, 2 * np.pi) - np.pi, off)
            x = np.where(angles, direction, x)
        return x, cov + np.outer(off, off)

    def marginal(self, k: int) -> Array:
        """Return the marginal of z_k on its axis (N_k,), of sum one."""
        left, right, _ = self._sums
        p = left[k][0] @ (self.cores[k] @ right[k + 1][:, 0])
        return p / p.sum()

    def edges(self) -> Array:
        """Return the share of the mass near the ends of each axis (n,)."""
        found = np.zeros(self.grid.n)
        for k in np.flatnonzero(~self.grid.closed):
            p = np.abs(self.marginal(int(k)))
            found[k] = p[0] + p[1] + p[-1] + p[-2]
        return found

    def characteristic(self, waves: Array) -> Array:
        """Return E exp(i w'z) (P,) for wave vectors (P, n): one product of matrices for each."""
        v: Array = np.ones((len(waves), 1))
        for k, core in enumerate(self.cores):
            phases = np.exp(1j * waves[:, k, None] * self.grid.axis(k))
            a, N, b = core.shape
            inner = (phases @ core.transpose(1, 0, 2).reshape(N, a * b)).reshape(-1, a, b)
            v = np.einsum("pa,pab->pb", v, inner)
        return v[:, 0] / self._sums[0][-1][0, 0]

    def drawn(self, share: Array, flat: bool) -> tuple[Array, Array]:
        """Return draws x (n, P) by uniform numbers (n, P), and their probabilities in both laws of `draw` (2, P)."""
        n = self.grid.n
        out, right = np.empty((n + 2, share.shape[1])), self._sums[1]
        rest = np.concatenate([(core @ after[:, 0]).ravel() for core, after in zip(self.cores, right[1:], strict=True)])
        draw(self._packed, rest, share, flat, out)
        z = self.grid.low[:, None] + self.grid.step[:, None] * out[:n]
        return self.grid.x_of(z), out[n:]

    def cloud(self, count: int) -> tuple[Array, Array]:
        """Return points of the mass (n, P) with weights (P,), sums over which are integrals of the normalised train.

        Half of an even `count` are draws, half draws of conditional laws in proportion to their square roots: parts with little
        mass, and tails, have points too.  They are weighted as draws of the mixture, by the values of the train where they are:
        with the masses of the cells instead a point in the steep tail of a ridge counts too much, and its error is taken for one
        of the mean.  The weights are NaN where the train is positive at none of the points, or infinite.
        """
        if count not in self._clouds:
            x, likely, drawn = self._proposed(count)
            values = np.maximum(self.evaluate(x), 0.0)
            top = float(values.max())
            values = values / top if 0.0 < top < math.inf else np.full(count, np.nan)
            weights = values / np.maximum(likely + drawn, 1e-300)
            weights = weights / weights.sum()
            self._clouds[count] = self._with_moments(x, weights), weights
        return self._clouds[count]

    @cached_property
    def _clouds(self) -> dict[int, tuple[Array, Array]]:
        """The clouds that were drawn, by their numbers of points."""
        return {}

    def _proposed(self, count: int) -> tuple[Array, Array, Array]:
        """Return draws x (n, P), half by each law of `draw`, and their probabilities (P,) in both."""
        share = quasi_random(count, self.grid.n)
        plain, p = self.drawn(np.ascontiguousarray(share[:, : count // 2]), False)
        wide, q = self.drawn(np.ascontiguousarray(share[:, count // 2 :]), True)
        likely, drawn = np.concatenate([p, q], axis=1)
        return np.concatenate([plain, wide], axis=1), likely, drawn

    def _with_moments(self, x: Array, weights: Array) -> Array:
        """Return points (n, P) after the affine map, near the identity, that gives them the moments of the train.

        Frames that are made from points are then as free of chance as the density: independent states stay on axes of their own.
        """
        if self.grid.closed.any():
            return x
        mean, P = self.moments()
        own = x @ weights
        apart = x - own[:, None]
        try:
            L, C = np.linalg.cholesky((apart * weights) @ apart.T), np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return x
        return np.asarray(mean[:, None] + C @ np.linalg.solve(L, apart))

    def scaled(self, factor: float) -> Train:
        """Return the train times a number."""
        return Train(self.grid, (self.cores[0] * factor, *self.cores[1:]), self.periods)

    def in_basis(self, basis: Array) -> Train:
        """Return the train with another basis of its frame."""
        return Train(self.grid._replace(basis=basis), self.cores, self.periods)

    def convolve(self, variances: Array, tolerance: float) -> Train:
        """Return the convolution with N(0, diag(variances)) in z, on the grid that it needs, rounded to a relative error."""
        target, cores = after_noise(self.grid, variances), list[Array]()
        for k, core in enumerate(self.cores):
            if variances[k] > SMALL:
                core = kernel_matrix(self.grid, k, variances[k], target) @ core
            cores.append(core)
        return Train(target, rounded(cores, tolerance), self.periods)


def _wrapped_powers(angle: Array) -> tuple[Array, Array]:
    """Return the wrapped angle and its square at the points of a circle (N,), as Fourier series that the points hold."""
    waves = np.arange(1, (len(angle) + 1) // 2)[:, None]
    signs = np.where(waves % 2, -1.0, 1.0)
    first = -2.0 * (signs * np.sin(waves * angle) / waves).sum(axis=0)
    return first, np.pi**2 / 3.0 + 4.0 * (signs * np.cos(waves * angle) / waves**2).sum(axis=0)


def rounded(cores: Sequence[Array], tolerance: float) -> tuple[Array, ...]:
    """Return the train with the fewest ranks within a relative error in the Frobenius norm, above that of rounding, 1e-8.

    Singular values are roots of eigenvalues of b x b matrices, which take a quarter of the time of decompositions of cores.
    """
    found, n = list(cores), len(cores)
    for k in range(n - 1, 0, -1):  # orthonormal rows in all cores but the first
        a, N, b = found[k].shape
        M = found[k].reshape(a, N * b)
        vectors, values = _singular(M @ M.T, 0.0)
        found[k] = ((vectors / values).T @ M).reshape(-1, N, b)
        found[k - 1] = found[k - 1] @ (vectors * values)
    for k in range(n - 1):
        a, N, b = found[k].shape
        M = found[k].reshape(a * N, b)
        vectors, values = _singular(M.T @ M, tolerance / math.sqrt(n - 1))
        found[k] = (M @ (vectors / values)).reshape(a, N, -1)
        N, last = found[k + 1].shape[1:]
        found[k + 1] = ((vectors * values).T @ found[k + 1].reshape(b, N * last)).reshape(-1, N, last)
    return tuple(map(np.ascontiguousarray, found))


def _singular(square: Array, tolerance: float) -> tuple[Array, Array]:
    """Return the right singular vectors (b, r) and values (r,) of M with M'M = `square` (b, b), to a relative error of M."""
    values, vectors = np.linalg.eigh(square)
    left_out = np.cumsum(np.maximum(values, 0.0)) <= max(tolerance**2, ROUNDING * len(values)) * max(float(values.sum()), 0.0)
    left_out[-1] = False
    return vectors[:, ~left_out], np.sqrt(np.maximum(values[~left_out], SMALLEST))
