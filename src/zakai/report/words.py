"""What the figures of a run mean, in words: one verdict, and one explanation for each figure of health."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.report.heatmap import state_names

_MOST_STATES = 12  # whose errors are told one by one

# Figures that say the same for every method: what they are, and the bound where it is not the method's own.
_HEALTH: dict[str, tuple[str, float | None]] = {
    "edge_mass": (
        "Probability in the outermost cells of the window on which the density is computed: what may have "
        "been lost "
        "beyond it. Rounding is about 1e-16; above the bound the window cut off part of the posterior.",
        1e-9,
    ),
    "discarded_mass": (
        "Probability thrown away when small parts of the density were dropped. Its sum over the record bounds the error.",
        1e-6,
    ),
    "quadrature_error": (
        "Relative error made by replacing an integral over the state by a sum over the lattice.",
        1e-9,
    ),
    "resolution": (
        "Cells of the lattice in a standard deviation of the narrowest feature of the density. The more "
        "the better: "
        "above 2 the density is resolved to many digits, below 1 it is too narrow for its lattice.",
        1.0,
    ),
    "exponent": (
        "Largest exponent, over the window, of the factor that separates the density from what is computed. "
        "Beyond 700 a double-precision number underflows and mass would be lost.",
        600.0,
    ),
    "effective_sample_size": (
        "The number of equally weighted particles that would carry the same information: low means few of them count.",
        None,
    ),
}


def health_words(result: Any, name: str) -> str:
    """One explanation of a figure of health: the one known here, or else the method's own."""
    if name in _HEALTH:
        return _HEALTH[name][0]
    own = (getattr(result, "bounds", None) or {}).get(name)
    text = str(own[1]) if own else "a figure that this method reports at every step"
    return text[:1].upper() + text[1:] + "."


def health_bound(result: Any, name: str) -> float | None:
    """The value beyond which a reader should worry, if there is one: the method's, or else the usual one."""
    own = (getattr(result, "bounds", None) or {}).get(name)
    return float(own[0]) if own else _HEALTH.get(name, ("", None))[1]


def health_span(values: Any) -> str:
    """The middle and the extremes of a figure over the run."""
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return "No value was recorded."
    if np.ptp(finite) == 0:
        return f"{finite[0]:.3g} throughout."
    return f"From {finite.min():.2g} to {finite.max():.2g}, median {np.median(finite):.2g}."


def spoken(name: str) -> str:
    """A variable's name as a phrase: `mass_at_edge` is "mass at edge"."""
    return name.replace("_", " ")


def signed(number: str) -> str:
    """A formatted number with a true minus sign."""
    return number.replace("-", "−")


def count(number: int, noun: str) -> str:
    """The number with its noun, in the plural where it must be."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def exactness(result: Any) -> str:
    """What the method promises, if the result says it: exact, convergent or approximate."""
    return str(result.attributes.get("exactness", ""))


def verdict(result: Any) -> str:
    """In a sentence or two: which method, how much data, how likely, whether anything went wrong, how exact."""
    observations = len(result.times) - 1
    by_blocks = getattr(result, "blocks", ())
    text = f"The method {result.method}"
    if by_blocks:
        methods = result.method.removeprefix("blocks: ")
        text = f"A method for each of {count(len(by_blocks), 'independent block')} ({methods})"
    total = signed(f"{result.log_likelihood:,.2f}")
    text += f" filtered {count(observations, 'observation')} with a log-likelihood of {total}"
    if observations:
        text += f" ({signed(f'{result.log_likelihood / observations:.3f}')} per observation)"
    warned = len(result.warnings)
    text += f"; it raised {count(warned, 'warning')}, below." if warned else "; it raised no warning."
    kind = exactness(result)
    what = "What they are" if len({block.method for block in by_blocks}) > 1 else "It is" if by_blocks else "The method is"
    return text + (f" {what}{':' if what.startswith('What') else ''} {kind.rstrip('.')}." if kind else "")


def errors(result: Any, error: np.ndarray | None) -> list[tuple[str, str]]:
    """Root mean squared error of each mean, where the truth is known: (label, figure) pairs for the page's
    head.
    """
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
