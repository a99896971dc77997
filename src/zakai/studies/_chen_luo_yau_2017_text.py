"""Table II in words."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

_NAMES = {
    "direct": "direct method",
    "grid-optimal": "grid-optimal filter",
    "grid-cut": "the same, cut to [-11, 11]",
    "ekf-euler": "EKF, explicit Euler, survivors",
    "ekf-stable": "EKF, stable Riccati step",
}
_WIDTH = 34

_WORDS = (
    "What is reproducible: the order of the methods, the ratios on the same paths, and the number of paths that explicit Euler "
    "loses. The direct method is the optimal filter: on the same paths its error is that of Bayes' rule on a grid. The EKF is "
    "several times worse, with any Riccati step; that it blows up is a property of explicit Euler, which makes the variance "
    "negative in its first step as soon as P0 (1 + xhat(0)^2) dt > 1. The counts in the paper, 8 and 80 of 100, are those of a "
    "first estimate drawn with standard deviation P0 (6 and 76 expected); with variance P0, 0 and 34 are expected.",
    "What is not: the absolute errors of Table II. They change by 5 to 8 percent from one draw of 100 paths to another, and the "
    "paper's direct method at P0 = 0.1 lies several times that above the optimum, so that no exact filter gives its figure. A "
    "window of integration of about [-11, 11], which the state leaves on some paths, brings an exact filter nearer to the "
    "paper's direct row (see the row that is cut so); this is a hypothesis, since the paper does not give its window. The mean "
    "of the EKF is fragile too: a few paths that lost track decide it.",
)


def text_of(figures: Mapping[str, Any], paper: Mapping[float, Mapping[str, float | None]]) -> str:
    """The table, the comparison on the same paths, and what can be reproduced."""
    paths, settings = figures["paths"], figures["settings"]
    spreads = list(dict.fromkeys(s["P0"] for s in settings))
    lines = [
        "Chen, Luo and Yau 2017, Table II: average of (80), the mean squared error, over paths",
        f"(the paper: 100 paths; here: {paths} paths of {figures['steps']} steps, seed {figures['seed']}; +- one standard error)",
        "",
        _row("", [f"P0 = {p:g}" for p in spreads]),
        _row("paper, direct method", [_plain(paper[p]["direct"]) for p in spreads]),
        _row("paper, EKF", [_plain(paper[p]["ekf-euler"]) for p in spreads]),
        _row("paper, EKF lost, of 100", [_plain(paper[p]["lost"]) for p in spreads]),
    ]
    for interpretation in dict.fromkeys(s["interpretation"] for s in settings):
        chosen = [s for s in settings if s["interpretation"] == interpretation]
        centre = "sqrt(P0)" if interpretation == "variance" else "P0"
        lines += ["", f"P0 read as {interpretation}: xhat(0) = 0.1 + {centre} eta, prior N(xhat(0), P0)"]
        for key, name in _NAMES.items():
            lines.append(_row(name, [_measured(s["mse"][key], s["standard_error"][key]) for s in chosen]))
        lines.append(_row(f"EKF, explicit Euler, lost of {paths}", [f"{s['lost']}" for s in chosen]))
        lines.append(_row("  expected by the first step", [f"{s['expected_lost']:.1f}" for s in chosen]))
        lines.append(_row("direct - grid-optimal, paired", [_paired(s["direct_minus_grid"]) for s in chosen]))
        lines.append(_row("  in percent (band: 0.5)", [f"{s['direct_over_grid_percent']:+.3f}" for s in chosen]))
        lines.append(_row("  rms of means (band: 0.02)", [f"{s['rms_difference_of_means']:.4f}" for s in chosen]))
    for words in _WORDS:
        lines += ["", *textwrap.wrap(words, 100)]
    return "\n".join(lines)


def _row(name: str, cells: Sequence[str]) -> str:
    return (name.ljust(_WIDTH) + "".join(cell.rjust(20) for cell in cells)).rstrip()


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def _measured(value: float | None, error: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" + ("" if error is None else f" +- {error:.3f}")


def _paired(difference: Mapping[str, float | None]) -> str:
    mse, error = difference["mse"], difference["standard_error"]
    return f"{mse:+.4f}" + ("" if error is None else f" +- {error:.4f}")
