"""Lorenz' system of 1963, all coordinates every 0.1 with variance 4: the setting of Ramgraber and others (2022).

    dx1 = 10 (x2 - x1) dt,  dx2 = (x1 (28 - x3) - x2) dt,  dx3 = (x1 x2 - 8/3 x3) dt,    z_k = x(t_k) + N(0, 4 I),  t_k = k/10

without process noise; paths by the classical Runge-Kutta formula with steps of 0.01.  The error is the root of the mean of the
squared error over the three coordinates, averaged over the times of the observations after the first ones.  Particles are given
process noise of variance q in a unit of time and coordinate, for some fixed q.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from zakai.engine.driver import filter as filter_record
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.records import Record
from zakai.studies._drawing import OURS, SERIES, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table
from zakai.studies.lorenz_63_sakov_2012 import START, runge_kutta

STEPS, SPACING, NOISE = 10, 0.1, 4.0
LEVELS = (0.001, 0.01, 0.1)
KNOWN = (
    ("ensemble Kalman filter, 100 members", 0.460), ("ensemble filter EnKF-N, 10 members", 0.43), ("transport maps, 600", 0.365),
    ("iterative smoother iEnKS", 0.32), ("particle filter, 800", 0.28), ("particle filter, 4,000", 0.24),
)  # fmt: skip
ASKED = 0.28


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    observations: int = 2000,
    unused: int = 200,
    particles: int = 4000,
    seed: int = 0,
) -> Reproduction:
    """Run the experiment.

    Args:
        progress: called with the work done and all of it.
        pictures: where pictures go.
        observations: their number; the known figures are of 4,000 after 2,000.
        unused: how many of the first observations are not counted.
        particles: the number of particles.
        seed: of the path, the observations and the particles.
    """
    whole_number("observations", observations, 2, 10**6)
    whole_number("unused", unused, 0, observations - 1)
    whole_number("particles", particles, 2, 10**6)
    whole_number("seed", seed, 0, 2**31)
    pictures, work = pictures or Pictures(), Progress(progress, len(LEVELS))
    rng = np.random.default_rng(seed)
    x, states = START + np.sqrt(2.0) * rng.standard_normal(3), np.empty((observations, 3))
    for k in range(observations):
        for _ in range(STEPS):
            x = runge_kutta(x)
        states[k] = x
    values = states + np.sqrt(NOISE) * rng.standard_normal(states.shape)
    record = Record(SPACING * np.arange(1, observations + 1), values, "samples")
    errors, rows = {}, list[tuple[Any, ...]]()
    for level in LEVELS:
        result = filter_record(model(level), record, "guided-particles", particles=particles, seed=seed, keep="moments")
        each = np.sqrt(np.mean((result.mean[1:] - states) ** 2, axis=1))[unused:]
        errors[level] = each
        spread = float(np.sqrt(np.mean(np.trace(result.cov[1 + unused :], axis1=1, axis2=2)) / 3))
        rows.append((f"q = {level:g}", float(each.mean()), _error_of_mean(each), spread, str(len(result.warnings))))
        work.add()
    pictures.add("errors", partial(draw, errors))
    best = min(LEVELS, key=lambda level: float(errors[level].mean()))
    settings = {"observations": observations, "unused": unused, "particles": particles, "seed": seed, "levels": list(LEVELS)}
    return reproduction(float(errors[best].mean()), _error_of_mean(errors[best]), rows, settings)


def _error_of_mean(each: np.ndarray) -> float:
    """Return the standard error of the mean of correlated errors, by 20 means of consecutive ones."""
    parts = np.array([part.mean() for part in np.array_split(each, min(20, len(each)))])
    return float(parts.std(ddof=1) / np.sqrt(len(parts))) if len(parts) > 1 else 0.0


def model(level: float) -> Model:
    """Return Lorenz' system with the given process noise."""
    return Model(
        state=["x1", "x2", "x3"], drift=["10*(x2 - x1)", "x1*(28 - x3) - x2", "x1*x2 - 8/3*x3"],
        process_noise=(level * np.eye(3)).tolist(), observation=["x1", "x2", "x3"],
        observation_noise=(NOISE * np.eye(3)).tolist(), observation_kind="samples",
        prior={"kind": "gaussian", "mean": START.tolist(), "cov": [2.0, 2.0, 2.0]},
    )  # fmt: skip


def reproduction(best: float, chance: float, rows: list[tuple[Any, ...]], settings: dict[str, Any]) -> Reproduction:
    """Return the figures and what they say."""
    comparisons = [Comparison(f"error, {name}", known, None, None, "not run here") for name, known in KNOWN]
    said = f"{'below' if best <= ASKED else 'above'} that of the particle filter with 800 particles"
    comparisons.append(Comparison("error, guided-particles, best q", ASKED, best, chance, said))
    table = Table(
        f"guided-particles, {settings['particles']} particles, by the variance q of the process noise in a unit of time: the "
        "error, its standard error, the root of the mean variance that the filter reports, and the number of warnings",
        ("", "error", "s.e.", "reported", "warnings"),
        tuple(rows),
    )
    return Reproduction(
        "Lorenz' system of 1963, all coordinates every 0.1 with variance 4",
        f"Known are errors of filters in a public collection of benchmarks. Here {settings['observations']} observations, of "
        f"which the first {settings['unused']} are not counted, seed {settings['seed']}; errors of one path.",
        tuple(comparisons),
        f"the error of the best of {len(LEVELS)} process noises is {best:.3g}.",
        (table,),
        settings,
    )


def draw(errors: dict[float, np.ndarray]) -> Any:
    """Draw the distribution of the errors by process noise."""
    figure = new_figure(8.0, 4.0)
    panel = figure.subplots()
    plain(panel)
    for (level, each), color in zip(errors.items(), SERIES, strict=False):
        panel.plot(np.sort(each), np.linspace(0, 1, len(each)), color=color, label=f"q = {level:g}")
    panel.axvline(ASKED, color=OURS, linewidth=1.0, linestyle=(0, (4, 2)), label="particle filter, 800")
    panel.set_xlabel("error at a time")
    panel.set_ylabel("share of times")
    panel.legend(frameon=False, fontsize=9)
    return figure
