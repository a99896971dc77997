"""The result of one run: what its steps reported, and the sentences on what to doubt."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy

import numpy as np

from zakai.algebra.conditions import Condition
from zakai.engine.along_path import record_along
from zakai.engine.loop import Run
from zakai.engine.results import FilterResult
from zakai.engine.versions import versions
from zakai.methods._protocol import joined
from zakai.notes.escape import notes_on_escape
from zakai.notes.lengths import distances_of_lengths, notes_on_lengths
from zakai.notes.misfit import OF_START, notes_on_law
from zakai.notes.model import notes_on_domain, notes_on_formulas


def result_of_run(run: Run, why: str, considered: Mapping[str, tuple[Condition, ...]], warned: bool = True) -> FilterResult:
    """Return the result of a run that has filtered its record.

    Args:
        run: the run.
        why: on what grounds its method was chosen.
        considered: the conditions of every method that was checked.
        warned: whether to look for reasons to warn, which may take a second run.
    """
    model, method = run.setting.model, run.setting.method
    first_mean, first_cov = run.start_moments()
    infos = joined(run.parts)
    cov = np.concatenate([first_cov[None], infos.cov])
    kept = len(run.states) == len(run.schedule) + 1
    theta, (noted, schedule) = run.setting.theta.real, run.noted
    distances = distances_of_lengths(noted, theta, schedule, infos) if warned else None
    samples = model.observation_kind == "samples"
    result = FilterResult(
        times=np.concatenate([[model.start], run.record.times]),
        mean=np.concatenate([first_mean[None], infos.mean]),
        variance=np.diagonal(cov, axis1=1, axis2=2),
        log_likelihood_increments=np.concatenate([[0.0], infos.log_likelihood_increment]),
        health={name: np.concatenate([[np.nan], values]) for name, values in infos.health.items()},
        warnings=[],
        method=method.name,
        why=why,
        model=model,
        record=run.record,
        conditions=considered,
        bounds={name: bound for name, bound in method.bounds.items() if name in infos.health},
        state=model.state,
        increment_law_error=None if distances is None or samples else np.cumsum(np.append(0.0, distances.shortfall)),
        attributes={"source": method.source, "exactness": method.exactness, **versions()},
        mean_standard_error=_with_start(infos.mean_standard_error),
        log_likelihood_standard_error=_last(infos.log_likelihood_standard_error),
        _cov=cov,
        _density=run.density if kept else None,
        _no_density=run.why_no_density(),
    )
    if distances is None:
        return run.complete(result)
    record = record_along(run.record, schedule)
    undefined = notes_on_formulas(noted, theta, record, result.mean, result.variance)
    undefined += notes_on_domain(noted, theta, record, result, method.reflects)
    undefined += notes_on_escape(method.name, noted, schedule, theta, result.mean, result.cov)
    lengths = notes_on_lengths(schedule, distances)
    misfit, first = notes_on_law(noted, theta, schedule, run.values, infos, (result.bounds, method.losses))
    run.misfit = run.misfit or misfit
    result.warnings.extend([*undefined, *run.notes, *lengths, *misfit, *run.health_warnings(_until(result, first))])
    return run.complete(result)


def _until(result: FilterResult, first: int) -> FilterResult:
    """Return the result without the figures from observation `first` on, which its note has."""
    found = copy(result)
    known = np.arange(len(result.times)) <= first
    found.health = {name: np.where(known | (name in OF_START), figures, np.nan) for name, figures in result.health.items()}
    return found


def _with_start(errors: np.ndarray | None) -> np.ndarray | None:
    """Return standard errors with those of the start, which are those of draws of the prior and not reported."""
    return None if errors is None else np.concatenate([np.full((1, errors.shape[1]), np.nan), errors])


def _last(errors: np.ndarray | None) -> float | None:
    return None if errors is None else float(errors[-1])
