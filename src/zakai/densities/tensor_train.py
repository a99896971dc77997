"""A density as a tensor train: the density of `tensor-train`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from zakai.densities._density import DensityMethods
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size, wrap
from zakai.densities.gaussian import GaussianMixture
from zakai.densities.grid import GridDensity
from zakai.densities.points import PointMasses
from zakai.errors import InputError

_MOST_POINTS = {1: 512, 2: 128}  # along an axis of a marginal
_STARTS, _ROUNDS = 8, 40  # of the search for the mode


class Train(Protocol):
    """A function on a grid x = centre + basis z, as `numerics/trains/train.py` has it."""

    @property
    def grid(self) -> Any: ...

    @property
    def cores(self) -> tuple[np.ndarray, ...]: ...

    @property
    def mass(self) -> float: ...

    def evaluate(self, x: np.ndarray) -> np.ndarray: ...

    def moments(self, direction: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]: ...

    def characteristic(self, waves: np.ndarray) -> np.ndarray: ...

    def drawn(self, share: np.ndarray, flat: bool) -> tuple[np.ndarray, np.ndarray]: ...

    def cloud(self, count: int) -> tuple[np.ndarray, np.ndarray]: ...


@dataclass(frozen=True, repr=False)
class TensorTrainDensity(DensityMethods):
    """The density u(x) / mass of a tensor train on a grid in a frame x = m + B z; outside of the grid it is zero.

    Moments are sums over the grid.  Marginals of one or two states are Fourier integrals of the characteristic function, which a
    train gives at the cost of one product of small matrices for each frequency; they are densities on a grid.  A file keeps the
    train; a prior that is made of it, of three and more states, is a mixture of 1,024 Gaussian kernels with the same moments.
    """

    train: Train
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    def resultant(self) -> np.ndarray:
        """Return E exp(i x) of each angle (n,); 1 for other states."""
        grid, angles = self.train.grid, np.array(self.periodic)
        waves = np.where(angles[:, None], grid.basis, 0.0)
        return np.asarray(self.train.characteristic(waves) * np.exp(1j * np.where(angles, grid.centre, 0.0)))

    @cached_property
    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        if not any(self.periodic):
            return self.train.moments()
        resultant = self.resultant()
        direction = np.where(np.abs(resultant) < 1e-9, 0.0, np.angle(resultant))
        return self.train.moments(np.where(self.periodic, direction, np.nan))

    def mean(self) -> np.ndarray:
        return self._moments[0]

    def cov(self) -> np.ndarray:
        return self._moments[1]

    def log_density(self, x: np.ndarray) -> np.ndarray:
        points = as_states(x, len(self.names))
        values = self.train.evaluate(points.reshape(-1, len(self.names)).T) / self.train.mass
        with np.errstate(divide="ignore"):
            return np.log(np.maximum(values, 0.0)).reshape(points.shape[:-1])

    def mode(self) -> np.ndarray:
        grid = self.train.grid
        points, _ = self.train.cloud(1024)
        values = self.train.evaluate(points)
        best = points[:, np.argsort(-values, kind="stable")[:_STARTS]]
        # A search along the axes of the frame, where deviations are about one, whose step is halved where no axis gains.
        directions = np.concatenate([grid.basis, -grid.basis], axis=1)
        length, x, top = 0.5, best, self.train.evaluate(best)
        n, count = x.shape
        for _ in range(_ROUNDS):
            trial = x[:, :, None] + length * directions[:, None, :]
            found = self.train.evaluate(trial.reshape(n, -1)).reshape(count, -1)
            which = found.argmax(axis=1)
            better = found[np.arange(count), which]
            gain = better > top
            x, top = np.where(gain, trial[:, np.arange(count), which], x), np.where(gain, better, top)
            length *= 1.0 if gain.any() else 0.5
        place = x[:, int(np.argmax(top))]
        return np.where(self.periodic, wrap(place), place)

    def kernels(self, count: int) -> GaussianMixture:
        """Return a mixture of Gaussian kernels around so many points, with the same mean and covariance."""
        points, weights = self.train.cloud(count)
        return PointMasses(weights, points.T, self.names, self.periodic).smoothed

    def quadrature(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed weights (N,) and points (N, n), sums over which are expectations; N is about `count`."""
        points, weights = self.train.cloud(2 * (count // 2))
        return weights, points.T

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        wanted = probabilities(q)
        return np.concatenate([self.marginal(i).quantile(wanted.tolist()) for i in range(len(self.names))], axis=1)

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        x, _ = self.train.drawn(np.ascontiguousarray(rng.random((len(self.names), count))), False)
        return np.where(self.periodic, wrap(x.T), x.T)

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> Any:
        """Return the density of one or two states, on a grid; the density itself for all states in their order.

        Raises:
            InputError: more than two of the states.
        """
        keep = coordinate_numbers(self.names, coordinates)
        if keep == list(range(len(self.names))):
            return self
        if len(keep) > 2:
            raise InputError(f"marginal: {len(keep)} of {len(self.names)} states; a tensor train gives marginals of one or two")
        return self._projected(keep)

    def _projected(self, keep: list[int]) -> GridDensity:
        """Return the marginal of some states by its characteristic function, on a grid in a frame y of its own."""
        grid, count = self.train.grid, len(keep)
        around = np.array([bool(self.periodic[i] and (grid.closed & (np.abs(grid.basis[i]) > 0)).any()) for i in keep])
        cov = self.cov()[np.ix_(keep, keep)]
        basis = np.diag(np.sqrt(np.diag(cov))) if around.any() else np.linalg.cholesky(cov + 1e-12 * np.diag(np.diag(cov)))
        basis = np.where(np.diag(around), 1.0, basis)
        to_y = np.linalg.solve(basis, grid.basis[keep])  # y = to_y z
        with np.errstate(divide="ignore"):
            highest = (np.pi / grid.step / np.abs(to_y)).min(axis=1)
        ends = to_y * grid.low, to_y * grid.high
        low, high = (choose(*ends).sum(axis=1) for choose in (np.minimum, np.maximum))
        low, high = np.where(around, -np.pi, low), np.where(around, np.pi, high)
        sizes = np.minimum(2 * np.ceil((high - low) * highest / (2 * np.pi)), _MOST_POINTS[count]).astype(int)
        spacing, middle = (high - low) / sizes, 0.5 * (low + high)
        waves = [2 * np.pi * np.fft.fftfreq(size, step) for size, step in zip(sizes, spacing, strict=True)]
        w = np.stack(np.meshgrid(*waves, indexing="ij"), axis=-1).reshape(-1, count)
        z = w @ to_y
        held = (np.abs(z) <= np.pi / grid.step * (1 + 1e-9)).all(axis=1)
        values = np.zeros(len(w), complex)
        values[held] = self.train.characteristic(z[held]) * np.exp(-1j * (w[held] @ middle))
        values = np.fft.fftshift(np.fft.fftn(values.reshape(sizes)).real)
        with np.errstate(divide="ignore"):
            logs = np.log(np.maximum(values, 0.0))
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        return GridDensity(logs, grid.centre[keep] + basis @ middle, basis * spacing, names, periodic)
