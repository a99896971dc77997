"""Tasks after a record was filtered: smoothing, forecast, predicted observations, residuals, comparison, fit and profile."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from zakai.errors import InputError, ZakaiError
from zakai.models.clock import clock
from zakai.report.charts import clock_header
from zakai.studio.running import method_of, rows_of, summary
from zakai.studio.session import Answer, Held, Report, Session

LEVELS = (0.025, 0.975)
PREDICTED = 1_000  # rows at the end of a record whose laws are computed
BINS = 10
MOST_PROFILE = 25  # values of a parameter in a profile
NARROWED, SEEN = 4, 6.0  # times that a profile is computed at most, and the fall of the log-likelihood that it shows


def smooth(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Smooth a record, and keep the result under its name."""
    from zakai.engine.smoother import smooth as run_smoother

    model = session.model(request)
    found = session.given(model, request)
    method, options = method_of(request)
    held = Held(run_smoother(model, found.record, method, progress=report, **options), found.truth, found)
    session.keep(str(request.get("name") or "smooth"), held)
    return summary(held), {}


def forecast(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Forecast a result, and keep it under its name."""
    held = session.held(request, "of")
    last = float(held.result.times[-1])
    until, step = (_number(request, key) for key in ("until", "step"))
    if not until > last:
        raise InputError(f"forecast: until {until:.12g}: must be after the end of the record, {last:.12g}")
    times = clock(last, until, step, ("forecast: until", "forecast: step"))
    if len(times) > 10_000:
        raise InputError("forecast: more than 10,000 times; take a longer step")
    found = Held(held.result.forecast(times), None, held.given)
    session.keep(str(request.get("name") or "forecast"), found)
    return summary(found), {}


def _tail(held: Held, report: Report) -> tuple[Any, int]:
    """Return a result of the last rows of a record, begun with the density before them, and the number of its first row."""
    from zakai.engine.driver import filter as run_filter

    result, record = held.result, held.given.record
    first = len(record) - PREDICTED
    if first <= 0 or record.kind == "path" or not result.has_densities or result.model is None:
        return result, 0
    later = result.model.with_prior(result.density(first), start=float(result.times[first]))
    method, options = ("auto", {}) if result.origin is None else result.origin[0].request
    return run_filter(later, rows_of(record, first, len(record)), method, keep="moments", progress=report, **options), first


def predicted(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return each observation with its mean and its 95% band one step ahead, of the last rows of a record."""
    held = session.held(request)
    result, first = _tail(held, report)
    laws = result.predict_observations(progress=report)
    low, high = laws.quantile(LEVELS)
    record = result.record
    # The values of increments grow with their interval, and what is seen of them is their rate.
    spans = np.ones((len(record), 1))
    if record.kind == "increments":
        spans = np.diff(np.concatenate([[result.times[0]], record.times]))[:, None]
    arrays = {"times": np.asarray(laws.times, float)}
    parts = {"values": record.values, "mean": laws.mean, "lower": low, "upper": high}
    arrays |= {name: (part / spans).astype(np.float32) for name, part in parts.items()}
    seen = np.isfinite(record.values)
    outside = float(np.mean(((record.values < low) | (record.values > high))[seen])) if seen.any() else None
    names = list(result.model.observation_names) if result.model is not None else []
    about = {"names": names, "outside": outside, "before": first, "rates": record.kind == "increments"}
    return {**about, "clock": clock_header(record.clock)}, arrays


def residuals(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the histogram of the residuals of each observation, their normal scores, and what tests say of them."""
    from scipy.special import bdtr

    from zakai.report.calibration import calibration_of

    result, first = _tail(session.held(request), report)
    u = result.residuals(progress=report)
    times = np.asarray(result.times, float)[1:]
    found, arrays = [], {}
    names = result.model.observation_names if result.model is not None else [f"y{j + 1}" for j in range(u.shape[1])]
    for j, name in enumerate(names):
        known = np.isfinite(u[:, j])
        if known.sum() < 5:
            continue
        one = calibration_of(times, u[:, j])
        count = len(one.u)
        low, high = np.searchsorted(bdtr(np.arange(count), count, 1.0 / BINS), LEVELS) * BINS / count
        found.append(
            {
                "name": name,
                "count": count,
                "heights": (np.histogram(one.u, BINS, (0.0, 1.0))[0] * BINS / count).tolist(),
                "band": [float(low), float(high)],
                "verdicts": one.verdicts(),
                "autocorrelation": one.autocorrelation.tolist(),
            }
        )
        arrays[f"times{len(found) - 1}"] = one.times
        arrays[f"scores{len(found) - 1}"] = one.scores.astype(np.float32)
    if not found:
        raise InputError("residuals: fewer than five observations have one; take a longer record")
    return {"observations": found, "before": first, "clock": clock_header(result.clock)}, arrays


def compare(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the table of results by their names."""
    from zakai.diagnostics.compare import compare as table

    names = [str(name) for name in request.get("names") or []]
    labels = request.get("labels") or {}
    found = {str(labels.get(name) or name): session.held({"name": name}).result for name in names}
    if len(found) < 2:
        raise InputError("compare: keep at least two results with different names")
    return {"rows": [row._asdict() for row in table(found).rows]}, {}


def fit(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Fit parameters, with intervals of their profile likelihoods where these are wanted."""
    from zakai.inference.fit import fit as run_fit

    model = session.model(request)
    found = session.given(model, request)
    names = [str(name) for name in request.get("parameters") or model.parameters]
    if not names:
        raise InputError("fit: the model has no parameters; name some in [parameters] and use them in formulas")
    method, options = method_of(request)
    fitted = run_fit(model, found.record, names, method, **options)
    intervals: Any = None
    if request.get("intervals"):
        try:
            intervals = fitted.intervals(0.95)
        except ZakaiError as error:
            fitted.warnings.append(str(error))
    return {
        "estimates": fitted.estimates,
        "errors": fitted.standard_errors,
        "intervals": intervals,
        "log_likelihood": fitted.log_likelihood,
        "message": fitted.message,
        "converged": fitted.converged,
        "warnings": fitted.warnings,
        "method": fitted.method,
    }, {}


def profile(session: Session, request: Mapping[str, Any], report: Report) -> Answer:
    """Return the log-likelihood as a function of one parameter, the others as they are, around its maximum in an interval."""
    from zakai._progress import announced
    from zakai.engine.driver import filter as run_filter

    model = session.model(request)
    found = session.given(model, request)
    name = str(request.get("parameter"))
    low, high = (_number(request, key) for key in ("low", "high"))
    count = int(np.clip(int(request.get("count") or 15), 3, MOST_PROFILE))
    if not high > low:
        raise InputError(f"profile: {high:g} must be greater than {low:g}")
    method, options = method_of(request)
    done = 0

    def height(value: float) -> float:
        nonlocal done
        done += 1
        report(done, NARROWED * count)
        try:
            there = model.with_parameters(**{name: value})
            return float(run_filter(there, found.record, method, keep="moments", **options).log_likelihood)
        except ZakaiError:  # such as a noise that is not positive there
            return float("nan")
        finally:
            announce(done, -(-done // count) * count, NARROWED * count)

    with announced(f"the profile of {name}") as announce:
        for _ in range(NARROWED):
            values = np.linspace(low, high, count)
            heights = np.array([height(float(value)) for value in values])
            high_enough = np.flatnonzero(heights >= np.nanmax(heights, initial=-np.inf) - SEEN)
            if len(high_enough) == 0 or len(high_enough) >= count // 2:
                break
            low, high = values[max(0, high_enough[0] - 1)], values[min(count - 1, high_enough[-1] + 1)]
    if not np.isfinite(heights).any():
        raise InputError(f"profile: there is no log-likelihood for {name} from {low:g} to {high:g}; take other ends")
    return {"parameter": name}, {"values": values, "log_likelihood": heights}


def _number(request: Mapping[str, Any], key: str) -> float:
    try:
        return float(request[key])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{request.get('do')}: {key}: expected a number") from None


TASKS: dict[str, Callable[..., Answer]] = {
    "smooth": smooth,
    "forecast": forecast,
    "predicted": predicted,
    "residuals": residuals,
    "compare": compare,
    "fit": fit,
    "profile": profile,
}
