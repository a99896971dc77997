"""The law of a sample given the state: log p(z | x, u, t) as NumPy functions, draws, and distribution functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray

from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.models.angles import Wrapped, observed_angles
from zakai.models.families import FAMILIES, Family
from zakai.models.numeric import numpy_function

if TYPE_CHECKING:
    from zakai.models.model import Model

Array = NDArray[Any]
Law = tuple[Array, Array, Array, Array]  # z, location, variance and shape of a coordinate
_DRAW_POINTS = 4001  # of the grid on which an observation is drawn from a log density


class ObservationLaw:
    """The law of the m coordinates of a sample of one model; for increments it is that of the noise, and is not used.

    Coordinates of a row are taken in order, each given the state and those before it.  Of `angles` (m,) the differences from
    their locations are taken modulo 2 pi (`models/angles.py`).
    """

    def __init__(self, model: Model):
        self._model = model
        self.families = model.observation_family
        self.angles = observed_angles(model)
        self._laws: list[Family | Wrapped] = [
            Wrapped(FAMILIES[name]) if angle else FAMILIES[name] for name, angle in zip(self.families, self.angles, strict=True)
        ]
        self.is_gaussian = model.log_density is None and set(self.families) == {"gaussian"} and not any(self.angles)
        self._coupled = not model.observation_noise.is_diagonal()

    @cached_property
    def _functions(self) -> tuple[Callable[..., Array], Callable[..., Array], Callable[..., Array]]:
        """h (m,), S (m,) or (m, m), and the shapes (m,) of the families, 0 where there is none."""
        model, noise = self._model, self._model.observation_noise
        shapes = [
            model.family_parameters.get((FAMILIES[name].parameter or "", column), sympy.Integer(0))
            for column, name in enumerate(self.families)
        ]
        S = numpy_function(noise, model, noise.shape) if self._coupled else numpy_function(list(noise.diagonal()), model)
        return numpy_function(list(model.observation), model), S, numpy_function(shapes, model)

    @cached_property
    def _log_density(self) -> Callable[..., Array]:
        return numpy_function([self._model.log_density], self._model, ())

    def parameters(self, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> tuple[Array, Array, Array]:
        """Return h (..., m), S (..., m, m) and the shapes of the families (..., m), zero where there is none."""
        h, S, shapes = (function(x, t, theta, u) for function in self._functions)
        return h, S if self._coupled else S[..., None] * np.eye(S.shape[-1]), shapes

    def log_density(self, values: Array, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> Array:
        """Return log p(z | x, u, t) of one row at many points.

        Args:
            values: (m,) or (..., m), NaN where a coordinate is not observed: its factor is left out.
            x: (..., n).
            t: (...) or a number.
            theta: (p,), complex for a derivative.
            u: (..., number of inputs), for a model with inputs.

        Returns:
            (...), NaN where there is no law, zero where nothing is observed.
        """
        values = np.asarray(values, dtype=float)
        if self._model.log_density is None:
            return np.sum(self.terms(values, x, t, theta, u), axis=-1)
        seen = ~np.isnan(values)
        if not (seen.all(axis=-1) | ~seen.any(axis=-1)).all():
            raise InputError("record: with observation_log_density a row is observed as a whole, or not at all")
        density = self._log_density(x, t, theta, u, np.where(seen, values, 0.0))
        return np.where(seen.all(axis=-1), density, 0.0)

    def terms(self, values: Array, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> Array:
        """Return the log densities (..., m) of the coordinates, each given those before it; they add up to `log_density`."""
        values = np.asarray(values, dtype=float)
        seen = ~np.isnan(values)
        parts = self._parts(values, x, t, theta, u)
        terms = [law.log_density(*part) for law, part in zip(self._laws, parts, strict=True)]
        return np.where(seen, np.stack(np.broadcast_arrays(*terms), axis=-1), 0.0)

    def largest(self, seen: Array, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> Array:
        """Return the log density (...) of the most probable row at many points, of the coordinates `seen` (..., m).

        Raises:
            InputError: a law given by its log density has no such row here.
        """
        if self._model.log_density is not None:
            raise InputError("observation_log_density: a law given by its log density has no most probable row here")
        h, S, shape = (function(x, t, theta, u) for function in self._functions)
        variance = np.diagonal(S, axis1=-2, axis2=-1) if self._coupled else S
        laws = zip(self._laws, *(np.moveaxis(part, -1, 0) for part in (h, variance, shape)), strict=True)
        modes = np.stack(np.broadcast_arrays(*(own.mode(*law) for own, *law in laws)), axis=-1)
        parts = self._conditional(np.where(seen, modes, np.nan), h, S, shape)
        terms = [law.log_density(*part) for law, part in zip(self._laws, parts, strict=True)]
        return np.sum(np.where(seen, np.stack(terms, axis=-1), 0.0), axis=-1)

    def cdf(self, values: Array, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> tuple[Array, Array]:
        """Return P(Z_j < z_j) and P(Z_j <= z_j) (..., m) given the coordinates before; NaN where nothing is observed.

        Raises:
            InputError: a law given by its log density has none.
        """
        if self._model.log_density is not None:
            raise InputError("observation_log_density: a law given by its log density has no distribution function here")
        values = np.asarray(values, dtype=float)
        parts = self._parts(values, x, t, theta, u)
        pairs = [law.cdf(*part) for law, part in zip(self._laws, parts, strict=True)]
        seen = ~np.isnan(values)
        below, upto = (np.stack(np.broadcast_arrays(*side), axis=-1) for side in zip(*pairs, strict=True))
        return np.where(seen, below, np.nan), np.where(seen, upto, np.nan)

    def mean(self, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> Array:
        """Return the means (..., m) of the coordinates given the state, of an angle the mean direction."""
        h, S, shape = (function(x, t, theta, u) for function in self._functions)
        variance = np.diagonal(S, axis1=-2, axis2=-1) if self._coupled else S
        laws = zip(self._laws, *(np.moveaxis(part, -1, 0) for part in (h, variance, shape)), strict=True)
        return np.stack(np.broadcast_arrays(*(own.mean(*law) for own, *law in laws)), axis=-1)

    def _parts(self, values: Array, x: Array, t: Array | float, theta: Array, u: Array | None) -> list[Law]:
        """Return for every coordinate z, location, variance and shape, given the coordinates before it."""
        return self._conditional(values, *(function(x, t, theta, u) for function in self._functions))

    def _conditional(self, values: Array, h: Array, S: Array, shape: Array) -> list[Law]:
        seen = ~np.isnan(values)
        z = np.where(seen, values, 0.0)
        if not self._coupled:
            return [(z[..., j], h[..., j], S[..., j], shape[..., j]) for j in range(len(self.families))]
        # By Cholesky's factor F of S among the observed: the mean of z_j given z_1, ..., z_(j-1) is h_j + sum_i F_ji w_i.
        parts: list[Law] = []
        columns: list[list[Array]] = []
        whitened: list[Array] = []
        for j in range(len(self.families)):
            row = [np.where(seen[..., j] & seen[..., i], S[..., j, i], 0.0) for i in range(j)]
            factors: list[Array] = []
            for i in range(j):
                rest = row[i] - sum((factors[k] * columns[i][k] for k in range(i)), np.zeros(()))
                factors.append(rest / columns[i][i])
            variance = S[..., j, j] - sum((factor**2 for factor in factors), np.zeros(()))
            mean = h[..., j] + sum((factor * w for factor, w in zip(factors, whitened)), np.zeros(()))
            deviation = np.sqrt(variance)
            parts.append((z[..., j], mean, variance, shape[..., j]))
            columns.append([*factors, deviation])
            apart = wrap(z[..., j] - mean) if self.angles[j] else z[..., j] - mean
            whitened.append(np.where(seen[..., j], apart / deviation, 0.0))
        return parts

    def sample(self, rng: np.random.Generator, x: Array, t: Array | float, theta: Array, u: Array | None = None) -> Array:
        """Return one draw (K, m) for each of the states x (K, n) at times t (K,).

        Raises:
            InputError: there is no law at a state, in one line with the state.
        """
        if self._model.log_density is not None:
            return self._sample_log_density(rng, x, t, theta, u)
        h, S, shape = (np.broadcast_to(a, (len(x), *a.shape[1:])) for a in (f(x, t, theta, u) for f in self._functions))
        variance = np.diagonal(S, axis1=-2, axis2=-1) if self._coupled else S
        columns = []
        for j, (name, law) in enumerate(zip(self.families, self._laws, strict=True)):
            with np.errstate(all="ignore"):
                likely = law.mode(h[:, j], variance[:, j], shape[:, j])
                valid = np.isfinite(h[:, j] + law.log_density(likely, h[:, j], variance[:, j], shape[:, j]))
                valid &= (variance[:, j] > 0) | (not law.noise)
            if not valid.all():
                self._refuse(j, name, x[int(np.argmin(valid))])
            columns.append(law.sample(rng, h[:, j], variance[:, j], shape[:, j]))
        draws = np.stack(columns, axis=-1)
        gaussian = [j for j, name in enumerate(self.families) if name == "gaussian"]
        if self._coupled:  # which only Gaussian coordinates are
            factor = np.linalg.cholesky(S[:, gaussian][:, :, gaussian])
            normal = rng.standard_normal((len(x), len(gaussian), 1))
            draws[:, gaussian] = h[:, gaussian] + (factor @ normal)[..., 0]
            draws[:, list(self.angles)] = wrap(draws[:, list(self.angles)])
        return draws

    def _refuse(self, column: int, name: str, x: Array) -> None:
        point = ", ".join(f"{state} = {value:.6g}" for state, value in zip(self._model.state, x, strict=True))
        raise InputError(
            f"{self._model.source}: observation[{column}] = {str(self._model.observation[column])[:60]}: "
            f"the family {name} has no such law at {point}; check its mean, its noise and its parameter there"
        )

    def _sample_log_density(self, rng: np.random.Generator, x: Array, t: Array | float, theta: Array, u: Array | None) -> Array:
        """Draw one coordinate by its distribution function on a grid that is fitted to all states together."""
        if len(self.families) > 1:
            raise InputError("observation_log_density: draws of several coordinates are not supported; give one")
        t = np.broadcast_to(t, len(x))
        draws = np.empty((len(x), 1))
        for k in range(len(x)):
            at = np.broadcast_to(x[k], (_DRAW_POINTS, x.shape[1]))
            own = None if u is None else np.broadcast_to(u[k], (_DRAW_POINTS, np.shape(u)[-1]))
            low, high = -8.0, 8.0
            for _ in range(100):
                grid = np.linspace(low, high, _DRAW_POINTS)
                logs = self._log_density(at, t[k], theta, own, grid[:, None])
                logs = np.where(np.isnan(logs), -np.inf, logs)
                used = np.flatnonzero(logs >= logs.max() - 40.0) if np.isfinite(logs.max()) else np.arange(_DRAW_POINTS)
                width = high - low
                if used[0] == 0 and logs[0] > -np.inf or used[-1] == _DRAW_POINTS - 1 and logs[-1] > -np.inf:
                    low, high = low - width / 2, high + width / 2
                elif len(used) < _DRAW_POINTS / 8:
                    margin = 4 * width / _DRAW_POINTS
                    low, high = grid[used[0]] - margin, grid[used[-1]] + margin
                else:
                    break
            else:
                name = self._model.observed[0]
                fault = f"has no finite mass over {name!r}, so that nothing can be drawn; give a density of {name!r}"
                raise InputError(f"{self._model.source}: observation_log_density: {fault}")
            weights = np.exp(logs - logs.max())
            total = np.concatenate([[0.0], np.cumsum((weights[1:] + weights[:-1]) / 2)])
            draws[k, 0] = np.interp(rng.uniform() * total[-1], total, grid)
        return draws

    def fault(self, values: Array) -> tuple[int, str] | None:
        """Return the row of the first observation (K, m) that the law cannot have made, and why, or None."""
        for j, (name, family) in enumerate(zip(self.families, self._laws, strict=True)):
            wrong = ~(np.isnan(values[:, j]) | family.inside(values[:, j]))
            if wrong.any():
                row = int(np.argmax(wrong))
                return row, f"observation {j + 1} is {float(values[row, j])!r}; the family {name} has {family.support}"
            trials = self._model.family_parameters.get(("trials", j))
            if trials is not None and trials.is_number and (values[:, j] > float(trials)).any():
                row = int(np.argmax(values[:, j] > float(trials)))
                return row, f"observation {j + 1} is {float(values[row, j])!r}, more than the {trials} trials"
        if self._model.log_density is not None:
            seen = ~np.isnan(values)
            partial = seen.any(axis=1) & ~seen.all(axis=1)
            if partial.any():
                given = "only some coordinates are observed; with observation_log_density give all of a row or none"
                return int(np.argmax(partial)), given
        return None
