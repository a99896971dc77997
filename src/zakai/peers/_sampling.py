"""What the two peers that sample have in common: draws of the prior, and a substep's noise drawn for one member."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.densities import GridDensity
from zakai.densities._density import wrap
from zakai.errors import InputError
from zakai.filters._lattice_choice import first_lattice
from zakai.filters._protocol import Schedule
from zakai.filters.observations import Data
from zakai.models._definite import square_root
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.peers._translation import Interval, Prepared, Reading, readings, system_of, whole_number


def prepared_by(
    rule: Any, model: Model, schedule: Schedule, scheme: str, substeps: int, seed: int, notes: tuple[str, ...] = ()
) -> Prepared:
    """The intervals with a root of each substep's noise, R R' = G times its length, (K, substeps, n, r)."""
    system = system_of(model, scheme, substeps, rule)
    starts, theta = schedule.starts, model.theta()
    lengths = ((schedule.stops - starts) / system.substeps)[:, None]
    times = system.noise_time(starts[:, None] + np.arange(system.substeps) * lengths, lengths)
    diffusion, noise = (
        numpy_function(matrix, model, matrix.shape)(np.zeros(model.n), times, theta)
        for matrix in (model.diffusion, model.process_noise)
    )
    roots = np.broadcast_to(diffusion @ square_root(noise), (*times.shape, model.n, model.process_noise.shape[0]))
    roots = roots * np.sqrt(lengths)[:, :, None, None]
    intervals = Interval(starts, schedule.stops, np.tile(theta, (len(starts), 1)), roots, system)
    return Prepared(model, system, schedule, theta, intervals, whole_number("seed", seed, 0, 2**63 - 1), notes)


def draws(model: Model, prior: Any, seed: int, count: int) -> np.ndarray:
    """States (count, n) drawn from a prior; InputError for a density in more than two coordinates."""
    if isinstance(prior, GaussianPrior | MixturePrior):
        drawn = prior.sample(np.random.default_rng(seed), count)
    elif model.n > 2:
        raise InputError(f"{model.source}: prior: a density in {model.n} coordinates cannot be drawn from; give a gaussian")
    else:
        logs, centre, basis = (np.asarray(a) for a in first_lattice(model, prior, None)[0])
        drawn = GridDensity(logs, centre, basis, model.state, (False,) * model.n).sample(seed, count)
    return np.where([name in model.periodic for name in model.state], wrap(drawn), drawn)


def moved(interval: Interval, key: Any, x: Any) -> Any:
    """One state (n,) after the interval, with noise of its own."""
    system, theta = interval.system, interval.theta
    length = (interval.stop - interval.start) / system.substeps
    noise = jax.random.normal(key, (system.substeps, interval.roots.shape[-1]))

    def part(x: Any, slices: Any) -> tuple[Any, None]:
        index, root, white = slices
        t = interval.start + index * length
        x = system.before_noise(x, t, length, theta) + root @ white
        return system.after_noise(x, t, length, theta), None

    slices = (jnp.arange(system.substeps), interval.roots, noise)
    return jax.lax.scan(part, x, slices)[0]


def observations(prepared: Prepared, data: Data) -> Reading:
    """The white readings of all intervals."""
    return readings(prepared, data)


def start_interval(prepared: Prepared) -> Interval:
    """An interval of no length at the start, for a sample that is read there."""
    system, start = prepared.system, prepared.model.start
    roots = np.zeros(prepared.intervals.roots.shape[1:])
    return Interval(start, start, prepared.theta, roots, system)


def moments(share: Any, points: Any, angles: tuple[int, ...]) -> tuple[Any, Any]:
    """The mean (n,) and the covariance (n, n) of points (N, n) with weights (N,); an angle has its mean direction."""
    mean = share @ points
    turning = np.isin(np.arange(points.shape[1]), angles)
    if angles:
        mean = jnp.where(turning, jnp.arctan2(share @ jnp.sin(points), share @ jnp.cos(points)), mean)
    deviation = points - mean
    if angles:
        deviation = jnp.where(turning, jnp.pi - jnp.mod(jnp.pi - deviation, 2 * jnp.pi), deviation)
    return mean, (share[:, None] * deviation).T @ deviation
