"""The cell model of "Computational Doob's h-transforms": the variance of estimates of the log-likelihood.

    dx_i = (x_i^4 / (2^-4 + x_i^4) + 2^-4 / (2^-4 + x_j^4) - x_i) dt + sigma dw_i,    x(0) = (1, 1),
    z ~ N(x, s^2 I) at t = 1, 2, ...

The text of the paper has sigma = sqrt(.1), the notebook of its figure (repeat_cell.ipynb of its repository) sigma = 1; both are
run.  The published variances are those of the notebook: a bootstrap filter has 4 to 13 with sigma = sqrt(.1), and 56 to 139
with sigma = 1, on the records of seeds 0 to 5.  A density on a grid has no random error: its
estimate is checked by a second run with a tolerance four times smaller.  The bootstrap particle filter is plain NumPy, with the
paper's Euler steps.
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
from zakai.studies._published import CHANCE, Comparison, Pictures, Progress, Reproduction, Table, by_computation

NOISE = 0.25  # the standard deviation s of an observation
EULER = 0.02
TOLERANCE = 1e-3
START_DEVIATION = 0.02  # of a start that is known: a grid needs a density
PUBLISHED = (  # variances of the logarithm of the estimate, read off a figure: K = 100 to 1600, N = 64 to 1024
    ("bootstrap filter", "40 to 100"), ("linear guided filter", "110 to 400"), ("static auxiliary filter", "12 to 30"),
    ("learned h-transform", "1.1 to 1.5"),
)  # fmt: skip
PUBLISHED_RANGE = 40.0, 100.0  # of the bootstrap filter
SIZES = ((100, 64), (200, 128), (400, 256), (800, 512), (1600, 1024))  # K and N of the figure
SIGMAS = {"sigma^2 = 0.1": 0.1, "sigma^2 = 1": 1.0}


class Estimates(NamedTuple):
    """Log-likelihoods of one record: ours, the same with a smaller tolerance, and those (repeats,) of the particle filter."""

    ours: float
    finer: float
    particles: np.ndarray
    warnings: tuple[str, ...]


def cell_model(variance: float) -> Model:
    """Return the model for sigma^2 = `variance`."""
    hill, other = "{0}**4/(0.0625 + {0}**4)", "0.0625/(0.0625 + {0}**4)"
    drift = [f"{hill.format(a)} + {other.format(b)} - {a}" for a, b in (("x1", "x2"), ("x2", "x1"))]
    return Model(
        state=["x1", "x2"], drift=drift, process_noise=[[str(variance), "0"], ["0", str(variance)]], observation=["x1", "x2"],
        observation_noise=[[str(NOISE**2), "0"], ["0", str(NOISE**2)]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1.0, 1.0], "cov": (START_DEVIATION**2 * np.eye(2)).tolist()},
    )  # fmt: skip


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    observations: int = 100,
    particles: int = 64,
    repeats: int = 100,
    seed: int = 0,
) -> Reproduction:
    """Run the experiment.

    Args:
        progress: called with the work done and all of it.
        pictures: where pictures go.
        observations: the number K of observations, one in a unit of time.
        particles: the number N of particles.
        repeats: the number of runs of the particle filter.
        seed: of the records and of the particles.
    """
    whole_number("observations", observations, 2, 10_000)
    whole_number("particles", particles, 2, 10**6)
    whole_number("repeats", repeats, 2, 10_000)
    whole_number("seed", seed, 0, 2**31)
    pictures, work = pictures or Pictures(), Progress(progress, 3 * len(SIGMAS))
    found = {}
    for name, variance in SIGMAS.items():
        model = cell_model(variance)
        _, record = simulate(model, np.arange(1.0, observations + 1), seed=seed, initial=[1.0, 1.0])
        ours, finer = (filter_record(model, record, keep="moments", tolerance=TOLERANCE / part) for part in (1, 4))
        work.add(2)
        estimates = bootstrap(record, variance, particles, repeats, seed)
        work.add()
        found[name] = Estimates(ours.log_likelihood, finer.log_likelihood, estimates, tuple(ours.warnings))
    pictures.add("log-likelihoods", partial(draw, found, particles))
    settings = {"observations": observations, "particles": particles, "repeats": repeats, "seed": seed}
    return reproduction(found, settings)


def bootstrap(record: Record, variance: float, particles: int, repeats: int, seed: int) -> np.ndarray:
    """Return estimates (repeats,) of the log-likelihood by the bootstrap filter, with systematic resampling at every time."""
    rng = np.random.default_rng(seed)
    x = 1.0 + START_DEVIATION * rng.standard_normal((2, repeats, particles))
    total, steps = np.zeros(repeats), round(1.0 / EULER)
    rows = np.arange(repeats)[:, None]
    for value in record.values:
        for _ in range(steps):
            powers = x**2 * x**2
            drift = powers / (0.0625 + powers) + 0.0625 / (0.0625 + powers[::-1]) - x
            x = x + EULER * drift + np.sqrt(variance * EULER) * rng.standard_normal(x.shape)
        logs = -0.5 * np.sum((value[:, None, None] - x) ** 2, axis=0) / NOISE**2 - np.log(2 * np.pi * NOISE**2)
        top = logs.max(axis=1, keepdims=True)
        weights = np.exp(logs - top)
        total += top[:, 0] + np.log(weights.mean(axis=1))
        shares = np.cumsum(weights, axis=1) / weights.sum(axis=1, keepdims=True)
        places = (rng.uniform(size=(repeats, 1)) + np.arange(particles)) / particles
        chosen = np.array([np.searchsorted(share, place) for share, place in zip(shares, places, strict=True)])
        x = x[:, rows, np.minimum(chosen, particles - 1)]
    return total


def reproduction(found: dict[str, Estimates], settings: dict[str, Any]) -> Reproduction:
    """Return the figures and what they say."""
    comparisons = [Comparison(f"variance, {name}", range_, None, None, "not run here") for name, range_ in PUBLISHED[1:]]
    rows: list[tuple[Any, ...]] = []
    for name, one in found.items():
        spread, error = float(one.particles.var(ddof=1)), abs(one.ours - one.finer)
        chance = spread * np.sqrt(2 / (settings["repeats"] - 1))
        said = _verdict(SIGMAS[name], spread, chance, settings)
        comparisons.append(Comparison(f"variance, bootstrap filter, {name}", PUBLISHED[0][1], spread, chance, said))
        comparisons.append(by_computation(
            f"variance, zakai, {name}", "-", 0.0, error < 0.05,
            f"the log-likelihood changes by {error:.2g} nats with a tolerance four times smaller",
        ))  # fmt: skip
        mean = float(one.particles.mean())
        rows.append((name, one.ours, error, mean, np.sqrt(spread), one.ours - mean, str(len(one.warnings))))
    table = Table(
        f"Log-likelihood of {settings['observations']} observations: zakai, its change with a tolerance four times smaller, the "
        f"mean and the standard deviation of {settings['repeats']} bootstrap filters of {settings['particles']} particles, the "
        "difference of the two (an estimate whose logarithm varies is biased low), and the number of warnings of zakai",
        ("", "zakai", "change", "bootstrap", "s.d.", "difference", "warnings"),
        tuple(rows),
    )
    worst = max(abs(one.ours - one.finer) for one in found.values())
    verdict = (
        f"the density on a grid gives the log-likelihood without random error, to {worst:.2g} nats; particle filters with the "
        "published settings give it with the variances above."
    )
    return Reproduction(
        'The cell model of "Computational Doob\'s h-transforms for online filtering": estimates of the log-likelihood',
        "Published are the variances of the logarithm of the estimate by particle filters, over 100 repeats, read off a figure "
        "(to 10 %). Here: zakai and a bootstrap filter in NumPy on a record for each sigma, of "
        f"{settings['observations']} observations, seed {settings['seed']}, s = {NOISE}; the start (1, 1) has a standard "
        f"deviation of {START_DEVIATION}.",
        tuple(comparisons),
        verdict,
        (table,),
        settings,
    )


def _verdict(variance: float, spread: float, chance: float, settings: dict[str, Any]) -> str:
    """Return whether the variance of the bootstrap filter is in the published range, where it can be compared."""
    if variance != 1.0:
        return "sigma of the text; the published figure has sigma = 1, that of its notebook"
    if (settings["observations"], settings["particles"]) not in SIZES:
        return "K and N are none of the figure's"
    low, high = PUBLISHED_RANGE
    if low - CHANCE * chance <= spread <= high + CHANCE * chance:
        return "agrees"
    return "differs: it depends on the record; the published range is over five records"


def draw(found: dict[str, Estimates], particles: int) -> Any:
    """Draw the estimates of the particle filters as histograms, and ours as lines."""
    figure = new_figure(10.0, 4.0)
    for panel, (name, one) in zip(figure.subplots(1, len(found)), found.items(), strict=True):
        plain(panel)
        panel.hist(one.particles, bins=20, color=SERIES[0], label=f"bootstrap filter, {particles} particles")
        panel.axvline(one.ours, color=OURS, linewidth=1.6, label="zakai")
        panel.axvline(one.particles.mean(), color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="their mean")
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("log-likelihood")
        panel.legend(frameon=False, fontsize=9)
    return figure
