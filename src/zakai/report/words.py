"""The verdict on a run in words, and an explanation of each health figure."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.report.heatmap import is_periodic, state_names

_MOST_STATES = 12  # states whose errors are listed one by one

# Figures with the same meaning for every method: the explanation, and the bound where the method has none of its own.
_HEALTH: dict[str, tuple[str, float | None]] = {
    "edge_mass": (
        "Probability at the edges of the grid, an estimate of the probability beyond it. Rounding is about 1e-16; above the "
        "bound the grid cuts off part of the posterior.",
        1e-9,
    ),
    "discarded_mass": (
        "Probability of the small parts of the density that were dropped. Its sum over the record bounds the error.",
        1e-6,
    ),
    "quadrature_error": (
        "Relative error of replacing an integral over the state by a sum over the grid.",
        1e-9,
    ),
    "std_in_spacings": (
        "Smallest standard deviation along an axis, in grid spacings. Above 2 the density is resolved to many digits; below 1 "
        "it is too narrow for its grid.",
        1.0,
    ),
    "gauge_exponent": (
        "Largest exponent, over the grid, of the factor between the density and the function that is computed. Beyond 700 a "
        "double-precision number underflows and mass is lost.",
        600.0,
    ),
    "tolerance_ratio": ("Estimated error of the step, relative to the tolerance that was asked for.", 1.0),
    "tail_truncation": ("Part of the tails that the representation of the density does not hold.", None),
    "tail_depth": (
        "Nats below the maximum of the prediction at which the observation is. An observation far in the tail uses a part of "
        "the density that is known with fewer digits.",
        None,
    ),
    "splitting_error": ("Estimated error of separating the motion of the state from the observation in one interval.", None),
    "negative_mass": ("Probability of the parts of the computed density that are negative.", None),
    "error_estimate": ("Estimated error of the mean, in standard deviations of the posterior.", None),
    "effective_sample_size": (
        "The number of equally weighted particles with the same information: low means that few of them count.",
        None,
    ),
}


def health_words(result: Any, name: str) -> str:
    """Return the explanation of a health figure: the common one, else that of the method."""
    if name in _HEALTH:
        return _HEALTH[name][0]
    own = (getattr(result, "bounds", None) or {}).get(name)
    text = str(own[1]) if own else "a figure that this method reports at every step"
    return text[:1].upper() + text[1:] + "."


def health_bound(result: Any, name: str) -> float | None:
    """Return the bound of a health figure, if there is one: that of the method, else the common one."""
    own = (getattr(result, "bounds", None) or {}).get(name)
    return float(own[0]) if own else _HEALTH.get(name, ("", None))[1]


def health_span(values: Any) -> str:
    """Return the range and the median of a figure over the run."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)] + 0.0  # no negative zero
    if finite.size == 0:
        return "No value was recorded."
    if np.ptp(finite) == 0:
        return f"{finite[0]:.3g} throughout."
    return f"From {finite.min():.2g} to {finite.max():.2g}, median {np.median(finite):.2g}."


def moment(result: Any, k: int) -> str:
    """Return time number k as text: its date, or its time."""
    dates = getattr(result, "dates", None)
    if dates is None:
        return signed(f"t = {float(result.times[k]):.6g}")
    return str(dates[k].astype("datetime64[s]")).replace("T", " ")


def spoken(name: str) -> str:
    """Return a variable's name as a phrase: `mass_at_edge` is "mass at edge"."""
    return name.replace("_", " ")


def signed(number: str) -> str:
    """Return a formatted number with a typographic minus sign."""
    return number.replace("-", "−")


def count(number: int, noun: str) -> str:
    """Return the number with its noun, in the plural where needed."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def exactness(result: Any) -> str:
    """Return the kind of the method, if the result states it: exact, convergent or approximate."""
    return str(result.attributes.get("exactness", ""))


def kind_of(result: Any) -> str:
    """Return what a result is: "filtered", "smoothed" or "forecast"."""
    return str(getattr(result, "attributes", {}).get("kind", "filtered"))


def title(result: Any) -> str:
    """Return the heading of the report."""
    return {"smoothed": "Smoothing report", "forecast": "Forecast report"}.get(kind_of(result), "Filtering report")


def given(result: Any) -> str:
    """Return what a density of a result is conditioned on."""
    whole = {"smoothed": "all observations, earlier and later", "forecast": "all observations of the record"}
    return whole.get(kind_of(result), "all observations up to that time")


def first_moment(result: Any) -> str:
    """Return the name of the first time of a result."""
    return {"smoothed": "start", "forecast": "end of the record"}.get(kind_of(result), "prior")


def estimate(result: Any) -> str:
    """Return a sentence with the first states at the end, each with its deviation."""
    if not np.isfinite(np.asarray(result.mean)[-1]).all():
        return "At the end there is no estimate: the density was lost. "
    names, deviation = state_names(result), np.sqrt(np.maximum(np.asarray(result.variance)[-1], 0.0))
    few = [f"{name} = {signed(f'{mean:.4g}')} ± {width:.2g}" for name, mean, width in zip(names, result.mean[-1], deviation)][:3]
    more = f" (the first 3 of {len(names)} states)" if len(names) > 3 else ""
    last = len(result.times) - 1
    return f"At the end, {moment(result, last)}, the estimate is {', '.join(few)}{more}: mean and standard deviation. "


def verdict(result: Any) -> str:
    """Return a few sentences: the estimate, the method, amount of data, likelihood, warnings, exactness."""
    observations = len(result.times) - 1
    by_blocks = getattr(result, "blocks", ())
    text = f"{estimate(result)}The method {result.method}"
    if by_blocks:
        methods = result.method.removeprefix("blocks: ")
        text = f"{estimate(result)}A method for each of {count(len(by_blocks), 'independent block')} ({methods})"
    if kind_of(result) == "forecast":
        text += f" forecast {count(observations, 'time')} without observations"
    else:
        total = signed(f"{result.log_likelihood:,.2f}")
        done, known = "smoothed" if kind_of(result) == "smoothed" else "filtered", np.isfinite(result.log_likelihood)
        text += f" {done} {count(observations, 'observation')} {f'with a log-likelihood of {total}' if known else 'in part'}"
        if observations and known:
            text += f" ({signed(f'{result.log_likelihood / observations:.3f}')} per observation)"
    warned = len(result.warnings)
    text += f"; it raised {count(warned, 'warning')}, below." if warned else "; it raised no warning."
    kind = exactness(result)
    what = "What they are" if len({block.method for block in by_blocks}) > 1 else "It is" if by_blocks else "The method is"
    return text + (f" {what}{':' if what.startswith('What') else ''} {kind.rstrip('.')}." if kind else "")


def angles(result: Any) -> list[tuple[str, str]]:
    """Return (label, figure) pairs for the page's head: circular mean and deviation of each angle at the end."""
    names = state_names(result)
    periodic = [i for i in range(min(len(names), _MOST_STATES)) if is_periodic(result, i)]
    if not periodic:
        return []
    deviation = result.density(len(result.times) - 1).circular_deviation() if result.has_densities else None
    facts = []
    for i in periodic:
        mean = signed(f"{float(result.mean[-1, i]):.4g}")
        spread = "" if deviation is None else f" ± {deviation[i]:.3g}"
        facts.append((f"{names[i]} at the end, circular", f"{mean}{spread} rad"))
    return facts


def errors(result: Any, error: np.ndarray | None) -> list[tuple[str, str]]:
    """Return (label, figure) pairs for the page's head: the root mean squared error of each mean where the truth is known."""
    facts: list[tuple[str, str]] = []
    if error is None:
        return facts
    names = state_names(result)
    if len(names) > _MOST_STATES and np.isfinite(error).any():
        return [(f"rms error of the {len(names)} means", f"{np.sqrt(np.nanmean(error**2)):.4g}")]
    for i, name in enumerate(names):
        known = error[np.isfinite(error[:, i]), i]
        if known.size:
            label = "rms error of the mean" + (f" of {name}" if len(names) > 1 else "")
            facts.append((label, f"{np.sqrt(np.mean(known**2)):.4g}"))
    return facts
