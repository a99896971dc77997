"""How long an observation takes by each method of several states, counted from the model and the accuracy that is asked.

The seconds are those of one processor core and are only compared with each other.  They follow from the model, its prior and the
tolerance, never from a clock, so that a model is filtered by the same method on any machine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai import _display
from zakai.models import features
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior, MixturePrior

# `benchmarks/choices.py` prints seconds of an observation; divided by these numbers of points and of particles they are the
# seconds of a point and of a particle: medians over its systems, with the substeps of an interval, and moves of the past.
POINT, PARTICLE = 9e-6, 1e-5
AXIS = 32  # points along an axis of a grid for a density near a Gaussian
MOST_OF_AXIS = {2: 512, 3: 128, 4: 40}  # points along an axis that a grid has at most
MOST_POINTS = 2**18
WIDE = 4.0  # curvature of a level of h, in deviations of its noise, that adds the points of one more grid
PARTICLES = 5.0  # particles, times the square of the tolerance
TOLERANCE = 0.03  # of particles, where none is asked for
DRAWS = 64  # points of the prior at which the sensors are differentiated
STEP = 1e-3  # of these differences, in deviations of the prior


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
    if name == "guided-particles":
        count = PARTICLES / (TOLERANCE if tolerance is None else tolerance) ** 2
        return Work(PARTICLE * count, f"{_display.rough(count)} particles")
    return None


def _of_grid(model: Model) -> Work:
    """Return the work of a density on a grid.

    A grid in a frame that is fitted to a density near a Gaussian needs equally many points for any deviations.  A precise sensor
    leaves mass along a curved level of h: the grid then holds the range of the curve with the spacing of the noise.
    """
    along = AXIS * (1.0 + curvature(model) / WIDE)
    points = AXIS ** (model.n - 1) * along
    fails = along > MOST_OF_AXIS.get(model.n, 0)
    return Work(POINT * min(points, MOST_POINTS), f"a grid of {_display.rough(points)} points", fails)


@once_for_a_model
def curvature(model: Model) -> float:
    """Return how curved the levels of h are over the prior, in deviations of the noise: the largest of all sensors.

        max_j median |J_j - median J_j| / 2,      J_j = R' grad h_j / sqrt(S_jj),  the prior has the covariance R R'

    It is zero where the law of the samples has no variance of its own, for increments, and for a prior by a formula.
    """
    prior, laws = model.prior, (features.OF_OBSERVATION - {features.OBSERVED_ANGLES}) & model.features.keys()
    if model.observation_kind != "samples" or laws or not isinstance(prior, GaussianPrior | MixturePrior):
        return 0.0
    mean, cov = np.asarray(prior.mean, float), np.asarray(prior.cov, float)
    values, vectors = np.linalg.eigh(cov)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = mean + np.random.default_rng(1).standard_normal((DRAWS, model.n)) @ root.T
    at, theta, inputs = float(model.start), model.theta(), np.zeros(len(model.u)) if model.u else None
    h = numpy_function(model.observation, model, (model.m,))
    sides = draws[:, None, None] + STEP * np.array([1.0, -1.0])[:, None, None] * root.T
    noise = numpy_function(model.observation_noise, model, (model.m, model.m))(mean, at, theta, inputs).diagonal()
    values = h(sides, at, theta, inputs)
    J = np.moveaxis((values[:, 0] - values[:, 1]) / (2.0 * STEP * np.sqrt(noise)), 1, 2)
    found = 0.5 * np.median(np.linalg.norm(J - np.median(J, axis=0), axis=2), axis=0)
    return float(np.max(found[np.isfinite(found)], initial=0.0))
