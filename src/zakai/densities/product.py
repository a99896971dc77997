"""The density of coordinates that fall into independent blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np

from zakai.densities._density import Density, DensityMethods
from zakai.densities._values import as_states, coordinate_numbers, generator, probabilities, sample_size


@dataclass(frozen=True, repr=False)
class ProductDensity(DensityMethods):
    """p(x) = prod_b p_b(x_b): `parts` are the densities p_b, `places` the coordinates of each in the whole.

    The coordinates of a part may have other names; their order counts.
    """

    parts: Sequence[Density]
    places: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    periodic: tuple[bool, ...]

    def log_density(self, x: np.ndarray) -> np.ndarray:
        x = as_states(x, len(self.names))
        total = np.zeros(x.shape[:-1])
        for part, place in zip(self.parts, self.places, strict=True):
            total = total + part.log_density(x[..., place])
        return total

    def mean(self) -> np.ndarray:
        return self._vector([part.mean() for part in self.parts])

    def cov(self) -> np.ndarray:
        whole = np.zeros((len(self.names),) * 2)
        for part, place in zip(self.parts, self.places, strict=True):
            whole[np.ix_(place, place)] = part.cov()
        return whole

    def resultant(self) -> np.ndarray:
        """Return E exp(i x) of each coordinate (n,)."""
        return self._vector([part.resultant() for part in self.parts])

    def mode(self) -> np.ndarray:
        return self._vector([part.mode() for part in self.parts])

    def quantile(self, q: Sequence[float]) -> np.ndarray:
        wanted = probabilities(q).tolist()
        return self._vector([part.quantile(wanted) for part in self.parts])

    def sample(self, key: object, count: int) -> np.ndarray:
        rng, count = generator(key), sample_size(count)
        return self._vector([part.sample(rng, count) for part in self.parts])

    def marginal(self, coordinates: int | str | Sequence[int | str]) -> Density:
        keep = coordinate_numbers(self.names, coordinates)
        names, periodic = tuple(self.names[i] for i in keep), tuple(self.periodic[i] for i in keep)
        parts, places = [], []
        for number, place in enumerate(self.places):
            wanted = [i for i in keep if i in place]
            if wanted:
                own = [place.index(i) for i in wanted]
                part = self.parts[number]
                parts.append(part if own == list(range(len(place))) else part.marginal(own))
                places.append(tuple(keep.index(i) for i in wanted))
        return renamed(parts[0], names) if len(parts) == 1 else ProductDensity(tuple(parts), tuple(places), names, periodic)

    def _vector(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return arrays (..., n_b) of the blocks as one (..., n)."""
        whole = np.empty((*np.shape(parts[0])[:-1], len(self.names)), np.asarray(parts[0]).dtype)
        for part, place in zip(parts, self.places, strict=True):
            whole[..., place] = part
        return whole


def renamed(density: Density, names: tuple[str, ...]) -> Density:
    """Return the same density with other names of its coordinates."""
    if density.names == names:
        return density
    if is_dataclass(density) and any(field.name == "names" for field in fields(density)):
        return replace(density, names=names)
    return ProductDensity((density,), (tuple(range(len(names))),), names, density.periodic)
