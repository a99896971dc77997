"""A survey of direct methods for Yau filtering systems (Chen and Dong): its four methods on one system.

    dx = tanh x dt + dv,    dy = x dt + dw,    sigma_0 proportional to exp(-(x^2 - 1)^2)

is a system for which the assumptions of all four hold.  The survey compares the methods by their assumptions and has no figures;
ours are distances from a converged solution of the Duncan-Mortensen-Zakai equation that shares no code with any of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.algebra.analysis import analyze
from zakai.algebra.conditions import all_hold
from zakai.engine.driver import filter as filter_record
from zakai.engine.results import FilterResult
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, PALE, SERIES, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table, by_computation
from zakai.studies._reference_density import Solution, conditional_densities

STEP, ALPHA = 0.1, 0.01
EXACT = 1e-6  # distance up to which a method that is exact on paper is said to be so


class Direct(NamedTuple):
    """A method of the survey, as we run it; `published` is what it promises for the density; whether y is `frozen` for it."""

    method: str
    options: dict[str, Any]
    published: str
    frozen: bool = False

    def reference(self, linear: Solution, frozen: Solution) -> Solution:
        """The converged solution of the equation that it solves."""
        return frozen if self.frozen else linear


_FITTED = {"reduction": "algorithm-1", "alpha": ALPHA, "components": 20}
METHODS = {
    "1: Theorem 1, one shot": Direct("hu-yau", {"theorem": "survey-1", "form": "one-shot"}, "exact"),
    "1: stepwise": Direct("hu-yau", {}, "exact"),
    "2: Algorithms 1 and 2": Direct("gaussian-sum", _FITTED, f"{ALPHA:g} at a fit"),
    "2: fitted once": Direct("gaussian-sum", {}, f"{ALPHA:g} at a fit"),
    "3: Algorithm 3": Direct("limited-direct", {"splitting": "lie"}, "exact", True),
    "4: Algorithm 4": Direct("general-direct", _FITTED, f"{ALPHA:g} at a fit"),
    "4: fitted once": Direct("general-direct", {}, f"{ALPHA:g} at a fit"),
}
# Which of the four the survey's assumptions admit: affine h and no time (1), |h|^2 quadratic and no time (2), Assumption 2 (3).
SYSTEMS: dict[str, tuple[dict[str, Any], str, str]] = {
    "tanh x, h = x": ({"state": ["x"], "drift": ["tanh(x)"], "observation": ["x"]}, "1 2 3 4", ""),
    "0, h = x (sin x, cos x)": (
        {"state": ["x"], "drift": ["0"], "observation": ["x*sin(x)", "x*cos(x)"]}, "- 2 3 4", ""
    ),
    "t x/40, h = x (sin x, cos x)": (
        {"state": ["x"], "drift": ["t/40*x"], "observation": ["x*sin(x)", "x*cos(x)"]}, "- - 3 4", ""
    ),
    "(t x2, -x1), h = x": (
        {"state": ["x1", "x2"], "drift": ["t*x2", "-x1"], "observation": ["x1", "x2"]}, "- - - 4",
        "a root F of G that turns makes Assumption 2 true for every L, and (1) is stepped with coefficients that vary",
    ),
}  # fmt: skip


class Run(NamedTuple):
    """A method's result and the microseconds that an observation takes when nothing is left to compile."""

    result: FilterResult
    microseconds: float


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    observations: int = 20,
    seed: int = 1,
    methods: int = len(METHODS),
) -> Reproduction:
    """The comparison by assumptions, and by distance from the converged solution.

    progress: called with the work done and all of it. pictures: where they go. observations: of the record, 0.1
    apart. seed: of the
    record. methods: how many of the rows are run.
    """
    whole_number("observations", observations, 1, 100)
    whole_number("seed", seed, 0, 2**31)
    whole_number("methods", methods, 1, len(METHODS))
    pictures = pictures or Pictures()
    model = Model(
        state=["x"], drift=["tanh(x)"], observation=["x"], observation_kind="increments",
        prior={"kind": "density", "log_density": "-(x**2 - 1)**2"},
    )  # fmt: skip
    times = STEP * np.arange(1, observations + 1)
    _, record = simulate(model, times, seed=seed)
    work = Progress(progress, methods + 1)

    def start(x: np.ndarray) -> np.ndarray:
        return np.exp(-((x[..., 0] ** 2 - 1) ** 2))

    solve = partial(conditional_densities, np.tanh, lambda x: x, np.eye(1), start, times, record.values, 14.0, 256)
    linear, frozen = solve(), solve(frozen=True)
    work.add()
    pictures.add("converged", partial(draw_converged, times, linear))
    runs = {}
    for name, method in list(METHODS.items())[:methods]:
        filter_record(model, record, method.method, **method.options)
        begin = time.perf_counter()
        result = filter_record(model, record, method.method, **method.options)
        runs[name] = Run(result, 1e6 * (time.perf_counter() - begin) / observations)
        work.add()
    pictures.add("distances", partial(draw_distances, times, linear, frozen, runs))
    return reproduction(linear, frozen, runs, {"observations": observations, "seed": seed})


def distances(converged: Solution, result: FilterResult) -> tuple[np.ndarray, np.ndarray, float]:
    """Errors at each observation: of the densities (of the maximum), the means (deviations) and the evidence."""
    x = converged.points
    found = np.array([np.exp(result.density(k).log_density(x)) for k in range(1, len(result.times))])
    apart = np.abs(found - converged.densities).max(axis=-1) / converged.densities.max(axis=-1)
    means = np.abs(result.mean[1:, 0] - converged.means[:, 0]) / converged.deviations[:, 0]
    return apart, means, abs(float(result.log_likelihood) - float(converged.evidence[-1]))


def reproduction(linear: Solution, frozen: Solution, runs: dict[str, Run], settings: dict[str, Any]) -> Reproduction:
    """The figures and what they say."""
    comparisons, rows = admitted(), []
    for name, (result, microseconds) in runs.items():
        apart, means, evidence = distances(METHODS[name].reference(linear, frozen), result)
        worst, exact = float(apart.max()), METHODS[name].published == "exact"
        otherwise = float(distances(linear, result)[0].max())
        comparisons.append(
            by_computation(
                f"({name.replace(':', ')', 1)}: error of the density", METHODS[name].published, f"{worst:.1e}",
                worst <= (EXACT if exact else ALPHA), "errors of the fits add up from observation to observation",
            )
        )  # fmt: skip
        rows.append((f"({name.replace(':', ')', 1)}", f"{worst:.1e}", f"{apart[-1]:.1e}", f"{means.max():.1e}",
                     f"{evidence:.1e}", f"{otherwise:.1e}", f"{microseconds:.0f}"))  # fmt: skip
    table = Table(
        "Against the equation that the method solves, in which y runs linearly between observations, or for (3) "
        "stays where it is "
        "until an observation: the largest error of the density, of its maximum; that after the last "
        "observation; of the mean, in "
        "standard deviations; of the evidence, in nats. The largest error of the density where y runs linearly. Microseconds "
        "an observation, when compiled, all of the call counted",
        ("method", "density", "at the end", "mean", "evidence", "y linear", "us"),
        tuple(rows),
    )
    right = sum(one.verdict == "agrees" for one in comparisons[len(SYSTEMS) :])
    verdict = (
        f"{right} of {len(runs)} runs do what the survey promises: (1) and (3) give the converged density of the equation that "
        "each solves, and the Gaussian sums (2) and (4) stay within the threshold of their fits. For an affine observation a "
        "Gaussian stays one, so that one fit of the start is enough and better than one at every observation. That y stays where "
        "it is between observations, as in the survey's Proposition 1, costs far more than any of the methods. The assumptions "
        "are decided as the survey states them, but that more is true of (1) and (3)."
    )
    return Reproduction(
        "Chen and Dong, A survey of direct methods for Yau filtering systems: four methods, dx = tanh x dt + dv, dy = x dt + dw",
        "Published are theorems, algorithms and a comparison of assumptions, without figures or an example. Checked are the "
        "assumptions, for four systems dx = f dt + dv (which of the methods (1) to (4) hold), and, where all four hold, the "
        f"error of each on one record of {settings['observations']} observations, 0.1 apart, from a start with two peaks.",
        tuple(comparisons),
        verdict,
        (table,),
        settings,
    )


def admitted() -> list[Comparison]:
    """Which methods hold for which system: the survey's assumptions, and what is decided from the equations."""
    found = []
    for name, (keys, published, because) in SYSTEMS.items():
        methods = analyze(Model(**keys, observation_kind="increments")).methods
        order = ("hu-yau", "gaussian-sum", "limited-direct", "general-direct")
        ours = " ".join(str(i) if all_hold(methods[key]) else "-" for i, key in enumerate(order, 1))
        found.append(by_computation(f"holds for f = {name}", published, ours, published == ours, because))
    return found


def draw_converged(times: np.ndarray, converged: Solution) -> Any:
    """The converged density over time."""
    figure = new_figure(8.0, 4.0)
    panel = plain(figure.subplots())
    x = converged.points[:, 0]
    inside = np.abs(x) <= 6
    image = panel.pcolormesh(times, x[inside], converged.densities[:, inside].T, cmap="Blues", shading="nearest", rasterized=True)
    panel.plot(times, converged.means[:, 0], color=INK, linewidth=1.0, label="mean")
    panel.set_xlabel("t")
    panel.set_ylabel("x")
    panel.legend(frameon=False, fontsize=9)
    figure.colorbar(image, ax=panel, label="density")
    figure.suptitle("dx = tanh x dt + dv, dy = x dt + dw: converged solution", fontsize=11)
    return figure


def draw_distances(times: np.ndarray, linear: Solution, frozen: Solution, runs: dict[str, Run]) -> Any:
    """The error of each method over time, and the last densities."""
    figure = new_figure(11.0, 4.6)
    left, right = (plain(panel) for panel in figure.subplots(1, 2))
    x = linear.points[:, 0]
    near = np.abs(x - linear.means[-1, 0]) <= 5 * linear.deviations[-1, 0]
    right.fill_between(x[near], linear.densities[-1][near], color=PALE, label="converged, y linear")
    # What lies on top is narrower, so that equal lines are all seen.
    for number, (colour, (name, (result, _))) in enumerate(zip(SERIES, runs.items())):
        width = 3.6 - 0.4 * number
        label = f"({name.replace(':', ')', 1)}"
        apart = distances(METHODS[name].reference(linear, frozen), result)[0]
        left.semilogy(times, np.maximum(apart, 1e-16), color=colour, linewidth=width, label=label)
        right.plot(x[near], np.exp(result.density(-1).log_density(x[near, None])), color=colour, linewidth=width)
    left.set_xlabel("t")
    left.set_ylabel("error of the density, of its maximum")
    right.set_xlabel("x")
    right.set_ylabel("density after the last observation")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.suptitle("Four direct methods on one record", fontsize=11)
    return figure
