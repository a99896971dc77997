"""How long an observation takes by each method of several states, counted from the model and the accuracy that is asked.

The seconds are those of one processor core and are only compared with each other.  They follow from the model, its prior and the
tolerance, never from a clock, so that a model is filtered by the same method on any machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from zakai import _display
from zakai.algebra.systems import affine_observation
from zakai.errors import InputError
from zakai.models import features
from zakai.models.families import FAMILIES
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.observation_law import ObservationLaw
from zakai.models.prior import DensityPrior, GaussianPrior, MixturePrior
from zakai.numerics.prior_grid import prior_grid

# `benchmarks/choices.py` prints seconds of an observation; divided by these numbers of points and of particles they are the
# seconds of a point, and those of a particle over the `GROWTH`-th power of the number of states: medians over its systems, with
# the substeps of an interval, and moves of the past.  Beyond `USUAL` substeps each takes so many seconds more for each state.
POINT, PARTICLE, GROWTH = 9e-6, 4e-7, 1.5
SUBSTEP, USUAL = 8e-8, 4
AXIS = 32  # points along an axis of a grid for a density near a Gaussian
MOST_OF_AXIS = {2: 512, 3: 128, 4: 40}  # points along an axis that a grid has at most
MOST_POINTS = 2**18
# Seconds of one computation of a density at a point of a grid, of which a substep makes three or more; and how many times the
# work of particles a method may take for one of the first intervals from the prior: "auto" never takes what needs ten times.
GRID_POINT, MOST_TIMES = 1.5e-7, 10.0
WIDE = 4.0  # curvature of a level of h, in deviations of its noise, that adds the points of one more grid, or as many particles
PARTICLES = 5.0  # particles, times the square of the tolerance
TOLERANCE = 0.03  # of particles, where none is asked for
DRAWS = 64  # points of the prior at which the sensors and the drift are differentiated
STEP = 1e-3  # of these differences, in deviations of the prior
MOST_OF_DENSITY, EDGE_OF_DENSITY = 4, 1e-6  # states of a prior by its log density, and the density where its grid ends
# Seconds of one product of an evaluation of a train, and of all else in an observation; builds of a substep, points of an axis,
# and builds for one column of a noise that depends on the state.  The expected work is `MARGIN` times what the expected rank
# gives, or that of the first interval, as a rank that is 1.4 times as large makes it.
PRODUCT, AROUND, MARGIN = 1.2e-8, 0.01, 3.0
BUILDS, TRAIN_AXIS, KICK = 2.5, 30, 20
MOST_STATES, MOST_RANK = 6, 24
# Rank of a train: of a system near a linear one, per relative variation of the drift's derivatives over the prior, per square of
# the curvature of a sensor; and the growth with the inverse of the tolerance.  Eighteen systems with ranks from 3 to 24.
RANK, OF_DRIFT, OF_SENSORS, OF_TOLERANCE = 3.0, 40.0, 15.0, 0.25
TRAIN_TOLERANCES = 1e-3, 5e-3  # for three states and for more, where none is asked for


class Work(NamedTuple):
    """Seconds of an observation, of what they are made, and whether the method is expected to fail."""

    seconds: float
    words: str
    fails: bool = False

    def __str__(self) -> str:
        """As in "0.3 s (a grid of 3e+04 points)"."""
        return f"{_display.rough(self.seconds)} s ({self.words})"


def expected_work(name: str, model: Model, tolerance: float | None) -> Work | None:
    """Return the work of a method for an observation of a model with two or more states; None where nothing is known of it."""
    if model.n < 2:
        return None
    if name == "yau-yau":
        return _of_grid(model)
    if name == "tensor-train":
        return _of_train(model, tolerance)
    if name == "guided-particles":
        return work_of_particles(model, tolerance, USUAL)
    return None


def work_of_particles(model: Model, tolerance: float | None, substeps: float) -> Work:
    """Return the work of particles for an observation after so many substeps.

    A precise sensor leaves few particles along a curved level of h: they reach it by powers of the likelihood.
    """
    count = PARTICLES / (TOLERANCE if tolerance is None else tolerance) ** 2
    each = PARTICLE * model.n**GROWTH * (1.0 + curvature(model) / WIDE) + SUBSTEP * model.n * max(substeps - USUAL, 0.0)
    return Work(each * count, f"{_display.rough(count)} particles")


def work_of_step(name: str, model: Model, health: Mapping[str, float]) -> Work | None:
    """Return the work of a step from its health figures; None for a method that does not report it."""
    if name != "tensor-train":
        return None
    rank, substeps = health["rank"], health["substeps"]
    return _of_builds(model, rank, substeps * BUILDS)


def _of_grid(model: Model) -> Work:
    """Return the work of a density on a grid.

    A grid in a frame that is fitted to a density near a Gaussian needs equally many points for any deviations.  A precise sensor
    leaves mass along a curved level of h: the grid then holds the range of the curve with the spacing of the noise.
    """
    along = AXIS * (1.0 + curvature(model) / WIDE)
    points = AXIS ** (model.n - 1) * along
    fails = along > MOST_OF_AXIS.get(model.n, 0)
    return Work(POINT * min(points, MOST_POINTS), f"a grid of {_display.rough(points)} points", fails)


def _of_train(model: Model, tolerance: float | None) -> Work | None:
    """Return the work of a tensor train; None where the model and the prior do not give its rank."""
    n = model.n
    laws = (features.OF_OBSERVATION - {features.OBSERVED_ANGLES}) & model.features.keys()
    if model.observation_kind != "samples" or laws or not 3 <= n <= MOST_STATES:
        return None
    usual = TRAIN_TOLERANCES[n > 3]
    tolerance = usual if tolerance is None else tolerance
    if not 1e-6 <= tolerance <= 0.1:
        return None
    rank = RANK + OF_DRIFT * variation(model) + OF_SENSORS * curvature(model) ** 2
    rank *= (usual / tolerance) ** OF_TOLERANCE
    return _of_builds(model, rank, MARGIN * BUILDS)


def _of_builds(model: Model, rank: float, builds: float) -> Work:
    """Return the work of so many builds of a train; one of a rank beyond the largest is expected to fail.

    A build takes about n - 2 cores of r^2 N fibres and two of r N, each an evaluation of n r products.
    """
    n, used = model.n, min(rank, MOST_RANK)
    builds *= KICK * model.diffusion.shape[1] if model.diffusion.free_symbols & set(model.x) else 1
    evaluations = TRAIN_AXIS * ((n - 2) * used**2 + 2 * used)
    words = f"a tensor train of rank {_display.rough(rank)}"
    return Work(AROUND + PRODUCT * builds * evaluations * n * used, words, not rank <= MOST_RANK)


@once_for_a_model
def variation(model: Model) -> float:
    """Return how much the derivatives of the drift vary over the prior, relative to their size; in its deviations.

        median |A - median A| / median |A|,      A = R^-1 (df/dx) R,  the prior has the covariance R R'
    """
    prior = _draws(model)
    if prior is None:
        return np.inf
    _, root, draws = prior
    f, at, theta = numpy_function(model.drift, model), float(model.start), model.theta()
    inputs = np.ones(len(model.u)) if model.u else None  # with zeros a speed times a direction would be linear
    sides = draws[:, None, None] + STEP * np.array([1.0, -1.0])[:, None, None] * root.T
    with np.errstate(all="ignore"):
        values = f(sides, at, theta, inputs)
    J = np.moveaxis((values[:, 0] - values[:, 1]) / (2.0 * STEP), 1, 2)
    scale = np.maximum(np.sqrt(np.diag(root @ root.T)), 1e-300)
    A = np.linalg.lstsq(root / scale[:, None], np.moveaxis(J / scale[:, None], 0, 1).reshape(model.n, -1), rcond=1e-9)[0]
    A = np.moveaxis(A.reshape(model.n, len(draws), model.n), 1, 0)
    A = A[np.isfinite(A).all(axis=(1, 2))]
    if not len(A):
        return np.inf
    sizes, apart = np.linalg.norm(A, axis=(1, 2)), np.linalg.norm(A - np.median(A, axis=0), axis=(1, 2))
    return float(np.median(apart) / max(float(np.median(sizes)), 1e-300))


class Draws(NamedTuple):
    """Draws (J, n) of a prior, its mean (n,), and a root (n, n) of its covariance."""

    mean: np.ndarray
    root: np.ndarray
    draws: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, cov: np.ndarray, draws: np.ndarray | None = None) -> Draws:
        """Return draws, or those of the Gaussian with these moments."""
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        normals = np.random.default_rng(1).standard_normal((DRAWS, len(mean)))
        return cls(mean, root, mean + normals @ root.T if draws is None else draws)


@once_for_a_model
def _draws(model: Model) -> Draws | None:
    """Return draws of the prior; None where it has no moments, or its density is one of more than four states."""
    prior, n = model.prior, model.n
    if isinstance(prior, GaussianPrior | MixturePrior):
        return Draws.of(np.asarray(prior.mean, float), np.asarray(prior.cov, float))
    if not isinstance(prior, DensityPrior) or n > MOST_OF_DENSITY:
        return None
    function, at, theta = numpy_function([prior.log_density], model, ()), float(model.start), model.theta()
    angles = [name in model.periodic for name in model.state]
    try:
        grid = prior_grid(lambda x: function(x, at, theta), n, angles, tolerance=EDGE_OF_DENSITY)
    except InputError:  # the filter itself reports it
        return None
    weights = np.exp(grid.log_values - grid.log_values.max()).ravel()
    weights, points = weights / weights.sum(), grid.points.reshape(-1, n)
    mean = weights @ points
    places = np.random.default_rng(1).choice(len(weights), DRAWS, p=weights)
    return Draws.of(mean, ((points - mean) * weights[:, None]).T @ (points - mean), points[places])


def _precisions(model: Model, draws: Draws, inputs: np.ndarray | None) -> np.ndarray:
    """Return the information (m,) of a sample about its h at the mean of the prior: for N(h, S) one over S.

        -d^2/dh^2 log p(z | h)   where z is the mean of the law
    """
    h, S, shapes = ObservationLaw(model).parameters(draws.mean, float(model.start), model.theta(), inputs)
    found = np.zeros(model.m)
    for j, name in enumerate(model.observation_family):
        family, noise = FAMILIES[name], S[j, j]
        if name == "gaussian":
            found[j] = 1.0 / noise
            continue
        step = STEP * max(abs(h[j]), np.sqrt(noise) if family.noise else 0.0, 1e-300)
        logs = family.log_density(family.mean(h[j], noise, shapes[j]), h[j] + step * np.array([-1.0, 0.0, 1.0]), noise, shapes[j])
        found[j] = -(logs[0] - 2.0 * logs[1] + logs[2]) / step**2
    return np.where(found > 0, found, 0.0)


@once_for_a_model
def curvature(model: Model) -> float:
    """Return how curved the levels of h are over the prior, in deviations of the noise: the largest of all sensors.

        max_j median |J_j - median J_j| / 2,      J_j = R' grad h_j / sqrt(S_jj),  the prior has the covariance R R'

    Of a law that is not Gaussian one over its information about h stands for S.

    It is zero for a sample with a log density of its own, for increments, and for a prior without moments.
    """
    if model.observation_kind != "samples" or model.log_density is not None or affine_observation(model) is not None:
        return 0.0
    prior = _draws(model)
    if prior is None:
        return 0.0
    at, theta, inputs = float(model.start), model.theta(), np.zeros(len(model.u)) if model.u else None
    h = numpy_function(model.observation, model, (model.m,))
    sides = prior.draws[:, None, None] + STEP * np.array([1.0, -1.0])[:, None, None] * prior.root.T
    with np.errstate(all="ignore"):
        values, precisions = h(sides, at, theta, inputs), _precisions(model, prior, inputs)
    J = np.moveaxis((values[:, 0] - values[:, 1]) / (2.0 * STEP) * np.sqrt(precisions), 1, 2)
    found = 0.5 * np.nanmedian(np.linalg.norm(J - np.nanmedian(J, axis=0), axis=2), axis=0)
    return float(np.max(found[np.isfinite(found)], initial=0.0))
