"""The protocol of conditional densities, and what its implementations share."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from zakai import _display
from zakai.densities._values import wrap
from zakai.densities.region import highest_density_region

INTERVAL = (0.025, 0.975)  # what a density shows of itself


@runtime_checkable
class Density(Protocol):
    """A conditional density of the n state coordinates `names`; angles (`periodic`) live on (-pi, pi].

    `log_density(x)` takes (..., n) and gives (...), `pdf(x)` its exponential; `mean()` (n,), `cov()` (n, n), `mode()` (n,),
    `quantile(q)` (len(q), n) of the marginals, `circular_deviation()` (n,) of the angles, `marginal(...)` the density of some of
    the coordinates, `sample(key, count)` (count, n), `highest_density_region(level)` the smallest region of one or two
    coordinates that holds a probability.  `plot()` draws one or two coordinates.  `save(path)` writes a file that
    `zakai.load_density` reads.
    """

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def periodic(self) -> tuple[bool, ...]: ...

    def log_density(self, x: np.ndarray) -> np.ndarray: ...

    def mean(self) -> np.ndarray: ...

    def cov(self) -> np.ndarray: ...

    def mode(self) -> np.ndarray: ...

    def quantile(self, q: Sequence[float]) -> np.ndarray: ...

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> Density: ...

    def sample(self, key: object, count: int) -> np.ndarray: ...

    def pdf(self, x: np.ndarray) -> np.ndarray: ...

    def resultant(self) -> np.ndarray: ...

    def circular_deviation(self) -> np.ndarray: ...

    def plot(self, coordinates: int | str | Sequence[int | str] | None = None, *, ax: Any = None) -> Any: ...

    def highest_density_region(self, level: float = ...) -> list[tuple[float, float]] | float: ...

    def save(self, path: str | os.PathLike[str]) -> None: ...


class DensityMethods:
    """What every density does by means of its other methods."""

    def pdf(self: Density, x: np.ndarray) -> np.ndarray:
        """Return the density at points x (..., n), of one coordinate (...) too."""
        return np.exp(self.log_density(x))

    def circular_deviation(self: Density) -> np.ndarray:
        """Return the circular standard deviation sqrt(-2 log R), R = |E exp(i x)|, of each angle (n,); NaN for other states.

        It is the standard deviation of an angle where that is small, and infinite for a uniform angle.

        References:
            Mardia and Jupp 2000, Directional Statistics, section 2.3.
        """
        with np.errstate(divide="ignore"):
            deviation = np.sqrt(-2.0 * np.log(np.clip(np.abs(self.resultant()), 0.0, 1.0)))
        return np.where(self.periodic, deviation, np.nan)

    def plot(self: Density, coordinates: int | str | Sequence[int | str] | None = None, *, ax: Any = None) -> Any:
        """Draw the density of one coordinate as a curve, or that of two as regions of highest density.

        Args:
            coordinates: one or two states, by name or number; needed where there are more than two.
            ax: the Matplotlib Axes to draw in; a new figure without it.

        Returns:
            The Matplotlib Axes.

        Raises:
            InputError: more than two states, or Matplotlib is not installed (extra `plots`).
        """
        from zakai.report.axes import draw_density

        return draw_density(self if coordinates is None else self.marginal(coordinates), ax)

    def highest_density_region(self: Density, level: float = 0.95) -> list[tuple[float, float]] | float:
        """Return the smallest region that holds a probability.

        Args:
            level: the probability.

        Returns:
            Of one coordinate the intervals (low, high), rising; of an angle one of them may go through pi, its high end then
            exceeds pi.  Of two coordinates the value of the density on the border of the region: it is where `pdf` is larger.

        Raises:
            InputError: more than two coordinates, or a level that is no probability.

        Example:
            for low, high in result.density(-1).marginal("x").highest_density_region(0.9):
                print(low, high)
        """
        return highest_density_region(self, level)

    def save(self: Density, path: str | os.PathLike[str]) -> None:
        """Write the density to a file that `zakai.load_density` reads; it can be the prior of a next record.

        Args:
            path: the file to write.

        Raises:
            InputError: the file cannot be written, or a density that a grid of 40,000 points does not resolve.

        Example:
            result.density(-1).save("end.density")
            later = model.with_prior(zakai.load_density("end.density"), start=result.times[-1])
        """
        from zakai.records.density_files import save_density

        save_density(self, path)

    def __repr__(self: Density) -> str:
        if len(self.names) > _display.MOST_NAMES:
            return f"{type(self).__name__}({len(self.names)} states: {_display.short_names(self.names)})"
        mean = ", ".join(map(_display.number, self.mean()))
        return f"{type(self).__name__}({', '.join(self.names)}: mean {mean})"

    def _repr_html_(self: Density) -> str:
        deviation = np.sqrt(np.maximum(np.diag(self.cov()), 0.0))
        low, high = self.quantile(INTERVAL)
        rows = [
            (name, *map(_display.number, row)) for name, *row in zip(self.names, self.mean(), deviation, low, high, strict=True)
        ]
        return _display.html_table(type(self).__name__, ("", "mean", "deviation", "2.5 %", "97.5 %"), rows)


class _Weighted(Density, Protocol):
    """A density that is known by `points` (..., n) and their probabilities `weights` (...)."""

    @property
    def points(self) -> np.ndarray: ...

    @property
    def weights(self) -> np.ndarray: ...


class WeightedPoints(DensityMethods):
    """The moments of a density with `points` (..., n) and their probabilities `weights` (...)."""

    def resultant(self: _Weighted) -> np.ndarray:
        """Return E exp(i x) of each angle (n,); 1 for other states."""
        angles = np.where(self.periodic, states(self), 0.0)
        return np.asarray(self.weights.ravel() @ np.exp(1j * angles))

    def mean(self: _Weighted) -> np.ndarray:
        resultant = self.resultant()
        # The direction of a uniform angle would be rounding.
        direction = np.where(np.abs(resultant) < 1e-9, 0.0, np.angle(resultant))
        return np.where(self.periodic, direction, self.weights.ravel() @ states(self))

    def cov(self: _Weighted) -> np.ndarray:
        apart = deviations(self)
        return np.asarray((self.weights.ravel()[:, None] * apart).T @ apart)


def states(density: _Weighted) -> np.ndarray:
    """Return the points as (N, n)."""
    return density.points.reshape(-1, len(density.names))


def deviations(density: _Weighted) -> np.ndarray:
    """Return the points less the mean (N, n), angles in (-pi, pi]."""
    difference = states(density) - density.mean()
    return np.where(density.periodic, wrap(difference), difference)
