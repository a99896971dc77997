"""The bimodal problem of Al-Jarrah, Jin, Hosseini and Taghvaei (2024) in n = 2 to 10 states, by blocks.

    x+ = .9 x + N(0, .4 I),    x(0) ~ N(0, I),    y = x * x + N(0, .1 I)  (componentwise),    20 steps

In continuous time: dx = -a x dt + g dv with e^{-.1 a} = .9 and the same law at times .1 apart.  The posterior has 2^n modes; it
is a product of n densities of one state, which `zakai` finds and filters one by one.  The figure is the maximum mean discrepancy
of samples of a filter from samples of the posterior, kernel exp(-d^2 / 32), on standardised samples; the reference is Bayes' rule
on a fine grid for each coordinate, in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from zakai.engine.driver import filter as filter_record
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.records import Record
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, OURS, SERIES, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table, by_computation

DECAY, PROCESS, NOISE, STEP = 0.9, 0.4, 0.1, 0.1
WIDTH = 32.0  # of the kernel
AXIS = np.linspace(-6.0, 6.0, 1201)
PUBLISHED = {2: (0.07, 0.10, 0.21), 6: (0.20, 0.45, 0.33), 10: (0.28, 0.66, 0.40)}  # transport, SIR, ensemble Kalman; of a figure
OURSELVES, PARTICLES, BOUND = "zakai by blocks", "particle filter (SIR)", "second sample of the reference"


def bimodal_model(n: int) -> Model:
    """Return the system in continuous time with n states."""
    rate = float(-np.log(DECAY) / STEP)
    intensity = PROCESS * 2 * rate / (1 - DECAY**2)
    names = [f"x{i + 1}" for i in range(n)]
    return Model(
        state=names, drift=[f"-{rate!r}*{name}" for name in names], process_noise=(intensity * np.eye(n)).tolist(),
        observation=[f"{name}**2" for name in names], observation_noise=(NOISE * np.eye(n)).tolist(),
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0.0] * n, "cov": np.eye(n).tolist()},
    )  # fmt: skip


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    largest: int = 10,
    records: int = 10,
    samples: int = 1000,
    seed: int = 0,
) -> Reproduction:
    """Run the experiment.

    Args:
        progress: called with the work done and all of it.
        pictures: where pictures go.
        largest: the largest of the numbers of states 2, 4, ..., 10 that is run.
        records: the number of records for each number of states.
        samples: the number of samples, and of particles.
        seed: of the first record.
    """
    whole_number("largest", largest, 2, 10)
    whole_number("records", records, 2, 1000)
    whole_number("samples", samples, 10, 10_000)
    whole_number("seed", seed, 0, 2**31)
    pictures, sizes = pictures or Pictures(), range(2, largest + 1, 2)
    work, found = Progress(progress, records * len(sizes)), {}
    for n in sizes:
        model, distances = bimodal_model(n), []
        for number in range(seed, seed + records):
            # The first sample is taken after the first step, as published.
            _, record = simulate(model, STEP * np.arange(1, 21), seed=number)
            distances.append(discrepancies(model, record, samples, np.random.default_rng(number)))
            work.add()
        found[n] = {name: np.array([one[name] for one in distances]) for name in distances[0]}
    pictures.add("discrepancies", partial(draw, found))
    return reproduction(found, {"largest": largest, "records": records, "samples": samples, "seed": seed})


def discrepancies(model: Model, record: Record, samples: int, rng: np.random.Generator) -> dict[str, float]:
    """Return the discrepancy of samples of each filter from samples of the posterior at the end of a record."""
    weights = posterior(record.values)
    reference, second = (drawn(weights, samples, rng) for _ in range(2))
    ours = filter_record(model, record).density(-1).sample(rng, samples)
    particles = bootstrap(record.values, samples, rng)
    return {name: discrepancy(reference, x) for name, x in ((OURSELVES, ours), (PARTICLES, particles), (BOUND, second))}


def posterior(values: np.ndarray) -> np.ndarray:
    """Return the weights (points, n) of the posterior of each coordinate on `AXIS`, by Bayes' rule."""
    transition = np.exp(-0.5 * (AXIS[:, None] - DECAY * AXIS) ** 2 / PROCESS)
    weights = np.repeat(np.exp(-0.5 * AXIS**2)[:, None], values.shape[1], axis=1)
    for value in values:
        weights = transition @ weights * np.exp(-0.5 * (value - AXIS[:, None] ** 2) ** 2 / NOISE)
        weights = weights / weights.sum(axis=0)
    return weights


def drawn(weights: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return draws (count, n) from the posterior on the grid, continuous between its points."""
    places = rng.uniform(size=(count, weights.shape[1]))
    found = np.stack([np.searchsorted(np.cumsum(w), u) for w, u in zip(weights.T, places.T, strict=True)], axis=1)
    return AXIS[np.minimum(found, len(AXIS) - 1)] + (rng.uniform(size=places.shape) - 0.5) * (AXIS[1] - AXIS[0])


def bootstrap(values: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the particles (count, n) of the bootstrap filter with multinomial resampling at every time."""
    x = rng.standard_normal((count, values.shape[1]))
    for value in values:
        x = DECAY * x + np.sqrt(PROCESS) * rng.standard_normal(x.shape)
        logs = -0.5 * np.sum((value - x**2) ** 2, axis=1) / NOISE
        weights = np.exp(logs - logs.max())
        x = x[rng.choice(count, count, p=weights / weights.sum())]
    return x


def discrepancy(reference: np.ndarray, x: np.ndarray) -> float:
    """Return the maximum mean discrepancy of two samples, standardised by the mean and the deviation of the first."""
    centre, scale = reference.mean(axis=0), reference.std(axis=0)
    a, b = (reference - centre) / scale, (x - centre) / scale
    aa, bb, ab = (np.exp(-cdist(u, v, "sqeuclidean") / WIDTH).mean() for u, v in ((a, a), (b, b), (a, b)))
    return float(np.sqrt(max(aa + bb - 2 * ab, 0.0)))


def reproduction(found: dict[int, dict[str, np.ndarray]], settings: dict[str, Any]) -> Reproduction:
    """Return the figures and what they say."""
    comparisons, rows = [], []

    def figures(values: np.ndarray) -> tuple[float, float]:
        return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))

    for n, one in found.items():
        (ours, error), (particles, spread), (bound, _) = (figures(one[name]) for name in (OURSELVES, PARTICLES, BOUND))
        rows.append((str(n), ours, error, bound, particles, spread))
        if n not in PUBLISHED:
            continue
        transport, sir, _ = PUBLISHED[n]
        words = "read off a figure; the resampling and the standardisation are not printed"
        comparisons.append(Comparison(f"n = {n}, {PARTICLES}", sir, particles, spread, words))
        apart = float(np.abs(one[OURSELVES] - one[BOUND]).mean())
        because = "the samples are farther from the posterior than two samples of it from each other"
        comparisons.append(
            by_computation(f"n = {n}, zakai (published: optimal transport)", transport, ours, ours < 2 * bound, because)
        )
        comparisons.append(Comparison(f"n = {n}, zakai - {BOUND}", None, apart, None, "0 for the posterior, but for chance"))
    table = Table(
        f"Maximum mean discrepancy of {settings['samples']} samples from the posterior after 20 steps, mean over "
        f"{settings['records']} records with its standard error; two samples of the posterior itself; particles",
        ("n", "zakai", "s.e.", "posterior", "particles", "s.e."),
        tuple(rows),
    )
    last = max(found)
    verdict = (
        f"samples of zakai are as near to the posterior as samples of the posterior itself: at n = {last} "
        f"{rows[-1][1]:.3f} against {rows[-1][3]:.3f}, where a particle filter of as many particles has {rows[-1][4]:.2f}. The "
        "blocks are found from the equations; a system that does not fall into blocks has no such advantage."
    )
    return Reproduction(
        "The bimodal problem of Al-Jarrah, Jin, Hosseini and Taghvaei (2024) in 2 to 10 states",
        "Published is the maximum mean discrepancy from the posterior over n, as a figure, for optimal transport, sequential "
        "importance resampling and ensemble Kalman filters with 1,000 particles. Here: samples of the density that zakai finds "
        "by blocks, and of a particle filter in NumPy, from Bayes' rule on a grid of every coordinate.",
        tuple(comparisons),
        verdict,
        (table,),
        settings,
    )


def draw(found: dict[int, dict[str, np.ndarray]]) -> Any:
    """Draw the discrepancies over the number of states, with the published ones."""
    figure = new_figure(8.0, 4.4)
    panel = plain(figure.subplots())
    sizes = list(found)
    for colour, name in ((OURS, OURSELVES), (SERIES[0], PARTICLES), (INK, BOUND)):
        means = [found[n][name].mean() for n in sizes]
        panel.plot(sizes, means, color=colour, marker="o", markersize=4, linewidth=1.2, label=name)
    for marker, column, name in (("s", 0, "optimal transport"), ("^", 1, "SIR"), ("v", 2, "ensemble Kalman")):
        panel.plot(
            list(PUBLISHED), [row[column] for row in PUBLISHED.values()], color=SERIES[1], marker=marker, linestyle="none",
            markerfacecolor="none", label=f"published: {name}",
        )  # fmt: skip
    panel.set_ylim(0.0, None)
    panel.set_xlabel("number of states n")
    panel.set_ylabel("maximum mean discrepancy")
    panel.legend(frameon=False, fontsize=9, ncols=2)
    return figure
