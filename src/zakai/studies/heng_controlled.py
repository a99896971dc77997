"""Two experiments of "Controlled sequential Monte Carlo" in continuous time: log-likelihoods by particles.

Lorenz' system of 1996 with noise, d states, of which all but two are seen every 0.1:

    dx_i = ((x_(i+1) - x_(i-2)) x_(i-1) - x_i + F) dt + 0.1 dw_i,  F = 4.8801,  x(0) ~ N(0, 0.01 I),   z ~ N(x_i, zeta)

The published system is in discrete time: a Runge-Kutta step of 0.1, then noise of variance 1e-3, which is that of 0.1 units of
time here.  Counts of a neuron, of which the data are simulated:

    dx = log(0.99) x dt + sigma dw,   z ~ Binomial(50, 1 / (1 + e^-x)) at t = 1, 2, ...,

with sigma such that the noise of a unit of time has the variance 0.11.  The density on a grid gives their log-likelihood without
random error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from zakai.engine.driver import filter as filter_record
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, OURS, SERIES, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table, by_computation

FORCE, NOISE, SEEN, SPACING = 4.8801, 1e-2, 1e-4, 0.1
TRIALS, DECAY, VARIANCE = 50, 0.99, 0.11
KNOWN = {8: 0.47, 16: 0.49, 32: 0.85, 64: 1.9}  # standard deviations of an auxiliary filter, in discrete time, zeta = 1e-4
SPREAD = 0.3  # standard deviation of log-likelihoods that is asked for
ERRORS = 3.0  # reported errors within which a log-likelihood agrees


class Estimates(NamedTuple):
    """Log-likelihoods (repeats,) of one record with their reported errors, and the exact one where it is known."""

    values: np.ndarray
    reported: np.ndarray
    exact: float | None
    warnings: tuple[str, ...]


def lorenz(states: int) -> Model:
    """Return Lorenz' system of 1996."""
    names = [f"x{i}" for i in range(states)]
    drift = [f"(x{(i + 1) % states} - x{(i - 2) % states})*x{(i - 1) % states} - x{i} + {FORCE}" for i in range(states)]
    return Model(
        state=names, drift=drift, process_noise=(NOISE * np.eye(states)).tolist(), observation=names[:-2],
        observation_noise=(SEEN * np.eye(states - 2)).tolist(), observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0] * states, "cov": [0.01] * states},
    )  # fmt: skip


def neuron() -> Model:
    """Return the neuron."""
    rate = float(-np.log(DECAY))
    noise = VARIANCE * 2 * rate / (1 - DECAY**2)
    return Model(
        state=["x"], drift=[f"-{rate!r}*x"], process_noise=[[repr(float(noise))]], observation=["1/(1 + exp(-x))"],
        observation_kind="samples", observation_family="binomial", trials=str(TRIALS),
        prior={"kind": "gaussian", "mean": [0.0], "cov": [1.0]},
    )  # fmt: skip


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    states: int = 8,
    observations: int = 100,
    counts: int = 1000,
    particles: int = 2000,
    repeats: int = 5,
    seed: int = 0,
) -> Reproduction:
    """Run both experiments.

    Args:
        progress: called with the work done and all of it.
        pictures: where pictures go.
        states: those of Lorenz' system.
        observations: of Lorenz' system.
        counts: the number of observations of the neuron; the published figures are of 3,000.
        particles: the number of particles.
        repeats: the number of runs with other random numbers.
        seed: of the records; the runs have the seeds 0, 1, ...
    """
    whole_number("states", states, 4, 100)
    whole_number("observations", observations, 1, 10_000)
    whole_number("counts", counts, 1, 100_000)
    whole_number("particles", particles, 2, 10**6)
    whole_number("repeats", repeats, 2, 1000)
    whole_number("seed", seed, 0, 2**31)
    pictures, work = pictures or Pictures(), Progress(progress, 2 * repeats + 1)

    def estimates(model: Model, times: np.ndarray, exact: float | None, record: Record | None = None) -> Estimates:
        record = simulate(model, times, seed=seed)[1] if record is None else record
        runs = []
        for repeat in range(repeats):
            runs.append(filter_record(model, record, "guided-particles", particles=particles, seed=repeat, keep="moments"))
            work.add()
        values, reported = np.array([(one.log_likelihood, one.log_likelihood_standard_error) for one in runs], float).T
        return Estimates(values, reported, exact, tuple(runs[0].warnings))

    found = {f"Lorenz-96, {states} states": estimates(lorenz(states), SPACING * np.arange(1, observations + 1), None)}
    cell, times = neuron(), np.arange(1.0, counts + 1)
    _, record = simulate(cell, times, seed=seed)
    grid = filter_record(cell, record, keep="moments")
    work.add()
    found["neuron"] = estimates(cell, times, grid.log_likelihood, record)
    pictures.add("log-likelihoods", partial(draw, found))
    settings = {"states": states, "observations": observations, "counts": counts, "particles": particles}
    return reproduction(found, {**settings, "repeats": repeats, "seed": seed})


def reproduction(found: dict[str, Estimates], settings: dict[str, Any]) -> Reproduction:
    """Return the figures and what they say."""
    comparisons, rows = list[Comparison](), list[tuple[Any, ...]]()
    for name, one in found.items():
        spread, repeats = float(one.values.std(ddof=1)), settings["repeats"]
        chance, reported = spread / np.sqrt(2 * (repeats - 1)), float(np.sqrt(np.mean(one.reported**2)))
        if one.exact is None:
            known = KNOWN.get(settings["states"])
            said = f"{'below' if spread <= SPREAD else 'above'} {SPREAD}; the published figure is of the system in discrete time"
            comparisons.append(Comparison(f"standard deviation, {name}", known, spread, chance, said))
        else:
            apart = abs(float(one.values.mean()) - one.exact)
            error = max(spread, reported)
            # The logarithm of an estimate without bias is biased by half of its variance.
            agrees = apart <= ERRORS * error / np.sqrt(repeats) + error**2
            because = f"the errors are {spread:.2g}"
            comparisons.append(by_computation(f"log-likelihood, {name}", one.exact, float(one.values.mean()), agrees, because))
        exact = None if one.exact is None else float(one.exact)
        rows.append((name, float(one.values.mean()), spread, reported, exact, str(len(one.warnings))))
    table = Table(
        f"Log-likelihoods by guided-particles, {settings['particles']} particles, {settings['repeats']} runs: mean, standard "
        "deviation, the reported one, the log-likelihood by the density on a grid, and the number of warnings",
        ("", "mean", "s.d.", "reported", "grid", "warnings"),
        tuple(rows),
    )
    largest = max(float(one.values.std(ddof=1)) for one in found.values())
    return Reproduction(
        'Two experiments of "Controlled sequential Monte Carlo": log-likelihoods by particles',
        "Published are standard deviations of the logarithm of the estimate by an auxiliary particle filter, and by controlled "
        "particles (0.003 for Lorenz' system), in discrete time; here the systems are equations in continuous time, and the data "
        f"are simulated, seed {settings['seed']}.",
        tuple(comparisons),
        f"the standard deviation of the log-likelihood is at most {largest:.2g}; controlled particles, which learn a proposal by "
        "many passes over the record, have smaller ones.",
        (table,),
        settings,
    )


def draw(found: dict[str, Estimates]) -> Any:
    """Draw the log-likelihoods with their reported errors."""
    figure = new_figure(10.0, 4.0)
    for panel, (name, one) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        plain(panel)
        panel.errorbar(np.arange(len(one.values)), one.values, yerr=1.96 * one.reported, fmt="o", color=SERIES[0], markersize=3)
        panel.axhline(one.values.mean(), color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="mean")
        if one.exact is not None:
            panel.axhline(one.exact, color=OURS, linewidth=1.4, label="density on a grid")
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("run")
        panel.set_ylabel("log-likelihood")
        panel.legend(frameon=False, fontsize=9)
    return figure
