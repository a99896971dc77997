"""The shared part of the two filters that sample: draws of the prior, and the noise of the substeps drawn for one member."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.densities import GridDensity
from zakai.errors import InputError
from zakai.methods._options import whole_number
from zakai.methods.system.prior_moments import density_grid, wrapped
from zakai.models._definite import square_root
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.peers import _float64  # noqa: F401
from zakai.peers._translation import Interval, Prepared, System, system_of
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip


def prepared_by(
    rule: Any,
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    scheme: str,
    substeps: int,
    seed: int,
    notes: tuple[str, ...] = (),
) -> Prepared:
    """Return the intervals with a root of each substep's noise, R R' = G times its length, (K, substeps, n, r).

    Where g depends on the state, it is R R' = Q times the length, (K, substeps, r, r).
    """
    system = system_of(model, scheme, substeps, rule)
    lengths = (schedule.lengths / system.substeps)[:, None]
    times = system.noise_time(schedule.starts[:, None] + np.arange(system.substeps) * lengths, lengths)
    diffusion, noise = (
        numpy_function(matrix, model, matrix.shape)(np.zeros(model.n), times, theta)
        for matrix in (model.diffusion, model.process_noise)
    )
    root = square_root(noise) if system.diffusion is not None else diffusion @ square_root(noise)
    roots = np.broadcast_to(root, (*times.shape, *root.shape[-2:]))
    roots = roots * np.sqrt(lengths)[:, :, None, None]
    seed = whole_number("seed", seed, 0, 2**63 - 1)
    return Prepared.of(model, system, schedule, theta, roots=roots, seed=seed, notes=notes)


def first_key(prepared: Prepared) -> np.ndarray:
    """Return the key of the first draws."""
    return np.asarray(jax.random.key_data(jax.random.key(prepared.seed)))


def draws(prepared: Prepared, prior: Any, count: int) -> np.ndarray:
    """Return states (count, n) drawn from a prior.

    Raises:
        InputError: a density in more than two coordinates.
    """
    model, seed = prepared.model, prepared.seed
    if isinstance(prior, GaussianPrior | MixturePrior):
        drawn = prior.sample(np.random.default_rng(seed), count)
    elif model.n > 2:
        raise InputError(f"{model.source}: prior: a density in {model.n} coordinates cannot be drawn from; give a gaussian")
    else:
        grid = density_grid(model, prior, prepared.theta, 1e-9)
        drawn = GridDensity(grid.log_values, grid.centre, grid.basis, model.state, (False,) * model.n).sample(seed, count)
    return wrapped(model, drawn)


def moved(system: System, interval: Interval, key: Any, x: Any) -> Any:
    """Return one state (n,) after the interval, with noise of its own."""
    theta = interval.theta
    length = interval.length / system.substeps
    noise = jax.random.normal(key, (system.substeps, interval.roots.shape[-1]))

    def substep(x: Any, slices: Any) -> tuple[Any, None]:
        index, root, white = slices
        t = interval.start + index * length
        shock, middle = root @ white, system.before_noise(x, t, length, theta)
        if system.diffusion is not None:
            at = x if system.scheme == "euler" else middle
            shock = system.diffusion(at, system.noise_time(t, length), theta) @ shock
        return system.after_noise(middle + shock, t, length, theta), None

    slices = (jnp.arange(system.substeps), interval.roots, noise)
    return jax.lax.scan(substep, x, slices)[0]


def ahead(system: System, interval: Interval, x: Any) -> Any:
    """Return one state (n,) after the interval without noise."""
    length = interval.length / system.substeps

    def substep(index: Any, x: Any) -> Any:
        t = interval.start + index * length
        return system.after_noise(system.before_noise(x, t, length, interval.theta), t, length, interval.theta)

    return jax.lax.fori_loop(0, system.substeps, substep, x)


def moments(share: Any, points: Any, angles: tuple[int, ...]) -> tuple[Any, Any]:
    """Return the mean (n,) and the covariance (n, n) of points (N, n) with weights (N,); an angle has its mean direction."""
    mean = share @ points
    periodic = np.isin(np.arange(points.shape[1]), angles)
    if angles:
        mean = jnp.where(periodic, jnp.arctan2(share @ jnp.sin(points), share @ jnp.cos(points)), mean)
    deviation = points - mean
    if angles:
        deviation = jnp.where(periodic, jnp.pi - jnp.mod(jnp.pi - deviation, 2 * jnp.pi), deviation)
    return mean, (share[:, None] * deviation).T @ deviation
