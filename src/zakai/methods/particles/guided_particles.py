"""Particles for any model: weights that are exact, proposals where they pay, moves of the past, and standard errors.

A particle's next state is a function of standard normal noise.  Every proposal and every move acts on that noise, so that weights
are exact for any law of the observations, any g(x) and any number of substeps.  Substeps are of second order in law.
"""

from __future__ import annotations

import numpy as np

from zakai.algebra.theorems import any_model as theorem
from zakai.errors import InputError
from zakai.methods._options import real_number, whole_number
from zakai.methods._protocol import Method
from zakai.methods.particles.carried import BACKWARD, density, step, valid
from zakai.methods.particles.conditional import conditional_system
from zakai.methods.particles.filter import MOST_GROWTH, VARIANCE, init, reduced
from zakai.methods.particles.islands import FEW_FAR
from zakai.methods.particles.split import split_of
from zakai.methods.particles.state import Prepared, Rule, State
from zakai.methods.particles.system import System, system_of
from zakai.methods.particles.window import INTERVALS
from zakai.models import features
from zakai.models._errors import listing
from zakai.models.model import Model
from zakai.numerics.complex_step import is_complex
from zakai.records.schedule import Schedule

TOLERANCE = 0.03


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    tolerance: float | None = TOLERANCE,
    particles: int | None = None,
    most_particles: int | None = None,
    seed: int = 0,
    split: bool | None = None,
) -> Prepared:
    """Return the programs of the formulas.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        tolerance: the wanted standard error of a mean, in standard deviations of the state; it decides the number of particles.
            None is the default, as in every method.
        particles: a fixed number of particles instead.
        most_particles: the largest number, with which the filter begins; by default four times what the tolerance needs for
            states that forget.
        seed: of the draws.
        split: whether particles carry a Kalman filter for the states that are linear given the others; by default where it
            pays.

    Raises:
        InputError: another value of an option.
    """
    wanted = TOLERANCE if tolerance is None else tolerance
    tolerance = real_number("tolerance", wanted, "a number from 0.001 to 0.5", lambda value: 0.001 <= value <= 0.5)
    seed = whole_number("seed", seed, 0, 2**63 - 1)
    most = 10**8 if most_particles is None else whole_number("most_particles", most_particles, 2, 10**8)
    if particles is not None:
        count = whole_number("particles", particles, 2, 10**8)
        if count > most:
            raise InputError(f"option particles: {count} is more than most_particles, {most}; leave one of them out")
        rule = Rule(count, count, None, seed, split is True)
    else:
        count = min(int(np.ceil(VARIANCE / tolerance**2)), most)
        rule = Rule(count, min(most, MOST_GROWTH * count), tolerance, seed, split is True)
    assert not is_complex(theta)
    return Prepared(_system(model, split), np.asarray(theta, float), schedule, rule, _notes(model, len(schedule)))


def _notes(model: Model, intervals: int) -> tuple[str, ...]:
    """Return a sentence where states never change and the record is longer than the past that is kept."""
    constant = [
        name for i, name in enumerate(model.state)
        if model.drift[i].is_zero and all(entry.is_zero for entry in model.diffusion[i, :])
    ]  # fmt: skip
    if not constant or intervals <= INTERVALS:
        return ()
    return (
        f"{listing(constant)} never changes: its particles are moved for at most {INTERVALS} intervals, and in a record of "
        f"{intervals} its error grows after that; give it a small noise, or compare seeds",
    )


def _system(model: Model, split: object) -> System:
    """Return the system with or without a Kalman filter in each particle.

    Raises:
        InputError: `split` is no boolean, or is asked for where it is not possible.
    """
    if split not in (None, True, False):
        raise InputError(f"option split: {split!r} is not true or false")
    if split is False:
        return system_of(model)
    found = conditional_system(model)
    if split and found.update is None:
        raise InputError(f"option split: {split_of(model).reason}; leave it out")
    return found


BOUNDS = {
    "monte_carlo_error": (0.1, "standard error of a mean, in standard deviations; lower the tolerance or name more particles"),
    "deviation_error": (
        FEW_FAR, "relative standard error of a standard deviation: few particles hold a part of the density that is far from the "
        "rest, as a second mode, and other seeds may not have it; name more particles",
    ),
    "uncertain_error": (
        0.2, "error of a mean, in standard deviations, that is possible where the standard errors are lower bounds, because an "
        "observation left few particles or few ancestors; run another seed and compare, or name more particles",
    ),
    "tempering_levels": (
        4.0, "powers of the likelihood that one observation needed: it is far from what was predicted, and the log-likelihood "
        "less sure than its standard error says; check it and its noise, or give more frequent observations",
    ),
    "largest_weight": (
        0.5, "one particle has most of the weight: none is near the observation; check it and its noise, or name more particles",
    ),
    "time_error": (0.1, "shift of a mean by the time step, in standard deviations; give more frequent observations"),
    "outside_tables": (1e-3, "share of the mass where a table is constant beyond its range"),
    "log_likelihood_error": (1.0, "standard error of the log-likelihood so far; name more particles before comparing models"),
}  # fmt: skip

METHOD: Method[Prepared, State] = Method(
    name="guided-particles",
    source="Gordon, Salmond and Smith 1993; moves of the past: Gilks and Berzuini 2001; standard errors: Lee and Whiteley 2018",
    exactness="convergent: in 1 / sqrt(particles), with a standard error that is reported, and of second order in a substep",
    theorem=theorem,
    options={"tolerance": TOLERANCE, "particles": None, "most_particles": None, "seed": 0, "split": None},
    prepare=prepare,
    init=init,
    step=step,
    density=density,
    state=State,
    bounds=BOUNDS,
    losses={"largest_weight": 0.5},
    differentiable=False,
    random=True,
    reflects=True,
    valid=valid,
    backward=BACKWARD,
    reduced=reduced,
    shorter="raise the tolerance",
    handles=frozenset(features.ASSUMPTIONS) - {features.OBSERVED_PATH},
)
