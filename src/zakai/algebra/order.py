"""The order in which "auto" tries the methods: exact ones, then those that need the least time for the accuracy that is asked."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from zakai import _registry
from zakai.algebra.expected_work import Work, expected_work
from zakai.algebra.systems import affine_observation
from zakai.models import features
from zakai.models.model import Model

# Methods for any system of several states, the most exact first.  To let "auto" take another one, name it here and give its work
# in `expected_work`.
GENERAL = ("yau-yau", "tensor-train", "guided-particles")
AFFORDABLE = 3.0  # times the work of the cheapest method, up to which a more exact one is taken


def in_order(model: Model, tolerance: float | None = None) -> tuple[str, ...]:
    """Return the methods that "auto" tries for a model, in order.

    With a nonlinear h, or a sample with a law of its own, a Gaussian sum is less accurate than a density on a grid and than
    particles; with three or more states, of which the law reads one, it is taken before them, as it is faster.  "limited-direct"
    needs many times the work of "yau-yau" with three states, and for increments of an h with a kink in several; in two its grid
    does not hold the narrow peaks and rings that precise samples of a nonlinear h leave.

    The methods that hold for any system of several states stand in the order of `by_work`.
    """
    nonlinear, samples = affine_observation(model) is None, model.observation_kind == "samples"
    laws = features.OF_OBSERVATION & model.features.keys()
    later: tuple[str, ...] = ()
    if model.features.keys() - {features.OBSERVED_ANGLES} or nonlinear:
        later = ("general-direct",)
    kinks = not samples and model.observation.has(sp.Abs, sp.sign)
    if model.n > 1 and (kinks or model.n > 2 or (samples and (nonlinear or laws))):
        later = ("limited-direct", "general-direct")
    if model.n > 2 and not ((nonlinear or laws) and len(_read(model)) > 1):
        later = ("limited-direct",)
    first, *others = by_work(model, tolerance) if model.n > 1 else ("yau-yau", "guided-particles")
    # It takes the nearest image of an angle alone.
    last = (first, *later, *others, *(["kalman-bucy"] if features.OBSERVED_ANGLES in model.features else []))
    return (*(name for name in _registry.AUTO if name not in last and name not in GENERAL), *last)


def _read(model: Model) -> set[sp.Symbol]:
    """Return the states that the law of the observations reads."""
    law = [*model.observation, *model.observation_noise.diagonal(), *model.family_parameters.values()]
    law += [] if model.log_density is None else [model.log_density]
    return set().union(*(part.free_symbols for part in law)) & set(model.x)


def by_work(model: Model, tolerance: float | None = None) -> tuple[str, ...]:
    """Return the methods for any system of several states, in the order in which they are tried.

    The first is the most exact one that is not expected to fail and needs at most `AFFORDABLE` times the work of the cheapest;
    the others follow by their work, and those that are expected to fail come last.
    """
    works = {name: work for name in GENERAL if (work := expected_work(name, model, tolerance)) is not None}
    sound = {name: work for name, work in works.items() if not work.fails} or works
    least = min(work.seconds for work in sound.values())
    first = next(name for name, work in sound.items() if work.seconds <= AFFORDABLE * least)
    others = sorted((name for name in works if name != first), key=lambda name: (works[name].fails, works[name].seconds))
    return (first, *others)


def work_in_words(model: Model, tolerance: float | None, names: Sequence[str]) -> str:
    """Return the expected work of methods for any system, as in "yau-yau 0.3 s (a grid of 33,000 points), ..."."""

    def words(name: str, work: Work | None) -> str:
        fails = ", which would not hold the density" if work is not None and work.fails else ""
        return f"{name} {work}{fails}"

    return ", ".join(words(name, expected_work(name, model, tolerance)) for name in names)
