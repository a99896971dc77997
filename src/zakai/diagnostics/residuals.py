"""Residuals: where each observation lies in its one-step-ahead predictive law.

The law is a sum over the predicted density where that is a grid, points, a mixture of Gaussians, or a tensor train
(`zakai.diagnostics.predictive`).  Elsewhere, and where such a sum is too coarse, the density of a coordinate z given the past is
the evidence of the filter's own step as a function of z; for an increment, times the density of the noise alone.  Its
distribution function is a quadrature over z, so that every method and every kind of observation is served, with the accuracy of
the method.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zakai._progress import Progress, counting
from zakai.diagnostics.predictive import Pair, PredictiveSums
from zakai.diagnostics.predictive_evidence import PredictiveEvidence
from zakai.engine.forecast import origin_of
from zakai.engine.loop import CHUNK, Run, segments
from zakai.errors import InputError
from zakai.methods._protocol import State
from zakai.models.features import OBSERVED_PATH
from zakai.numerics.tangent_quadrature import MASS_ERROR

if TYPE_CHECKING:
    from zakai.engine.results import FilterResult

Array = NDArray[Any]
LONGEST = 0.2  # variance that the state adds to an increment within its interval, in units of that of its noise


def residuals(result: FilterResult, seed: int = 0, first: int = 0, progress: Progress | None = None) -> Array:
    """Return the probability integral transforms (K, m); see `FilterResult.residuals`.  Rows before `first` are left out."""
    plan, _, record = origin_of(result, "residuals")
    draws = np.random.default_rng(seed).uniform(size=record.values.shape)
    found: Array = np.full(draws.shape, np.nan)
    error, share = 0.0, 0.0
    runs = zip(plan.runs(record, "moments"), plan.blocks, result._states, strict=True)
    observed = [parts for parts in runs if parts[1].observations]
    with counting("computing residuals", len(observed) * (len(record) - first), progress) as counted:
        for run, block, states in observed:
            columns = list(block.observations)
            for k, (below, upto), *errors in counted(_laws(run, states, first)):
                found[k, columns] = below + draws[k, columns] * (upto - below)
                error, share = max(error, errors[0]), max(share, errors[1])
    if error > MASS_ERROR:
        warnings.warn(
            f"residuals: the mass of a predictive law differs from 1 by {error:.2g} nats: the steps are too long for increments, "
            "the law of the samples is not normalised, or the filter is not accurate there",
            stacklevel=3,
        )
    if share > LONGEST:
        warnings.warn(
            f"residuals: within an interval the state adds {share:.2g} times the noise of an increment: the steps are too long "
            "for increments, and residuals have errors of about 0.01 or more",
            stacklevel=3,
        )
    return found


def _laws(run: Run, states: Sequence[State] | None, first: int) -> Iterator[tuple[int, Pair, float, float]]:
    """Yield k, (P(Z < z), P(Z <= z)), both (m,), the error of the mass of a law and the `length_share`, from row `first` on.

    `states` are those at the start and after each interval; the record is filtered where they are not known.
    """
    setting, model = run.setting, run.setting.model
    if model.observation_kind == "samples" and model.log_density is not None and model.m > 1:
        raise InputError(f"{model.source}: residuals: observation_log_density of several coordinates gives no law of one of them")
    if OBSERVED_PATH in model.features:
        raise InputError(f"{model.source}: residuals: an increment has no law here where formulas contain what is observed")
    spread = [_spread(run.values[run.schedule.seen[:, j], j]) for j in range(model.m)]
    for k, before in enumerate(_states_before(run) if states is None else states[:-1]):
        place = k % CHUNK
        if place == 0:
            chunk = run.schedule.part(slice(k, k + CHUNK))
            sums = PredictiveSums(setting, chunk)
            evidence = PredictiveEvidence(setting, chunk, sums, spread)
        if k < first:
            continue
        with np.errstate(all="ignore"):
            law = sums.row(place, before, run.values[k]) or evidence.row(place, before, run.values[k])
        yield k, law, evidence.mass_error, sums.length_share


def _states_before(run: Run) -> Iterator[State]:
    """Yield the state before each interval, from the filter."""
    for segment in segments(run.setting, run.schedule, run.state, run.values):
        yield from [segment.before, *segment.states[:-1]]


def _spread(values: Array) -> tuple[float, float]:
    """Return the median of the observations of one coordinate and a scale of them."""
    if not len(values):
        return 0.0, 1.0
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return float(middle), float(high - low) / 3.3 or max(abs(float(middle)), 1.0)
