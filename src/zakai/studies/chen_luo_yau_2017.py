"""Chen, Luo and Yau (2017), section V: the spiral sensor (79), Table II and Figures 1 to 3.

    dx = t/40 x dt + dv,    dy_1 = x sin x dt + dw_1,    dy_2 = x cos x dt + dw_2,    x(0) = 0.1,    0 <= t <= 10

100 Euler paths with dt = 0.01; the mean squared error of one path is mu = mean_k (x(t_k) - xhat(t_k))^2, k = 0 .. 1000 (80).
The first estimate is drawn about x(0) with a spread P0 that can be read in two ways: xhat(0) = x(0) + sqrt(P0) eta ("variance")
or x(0) + P0 eta ("standard deviation"); the prior of every filter is N(xhat(0), P0).

On the same paths: the direct method, the grid-optimal filter of the Euler model, which shares no code with it, and the extended
Kalman-Bucy filter by explicit Euler, as in the paper, and with a step that cannot blow up.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtr

from zakai.engine.driver import filter_from
from zakai.errors import InputError
from zakai.methods._options import whole_number
from zakai.models.files import load_model
from zakai.models.prior import GaussianPrior
from zakai.records import Record
from zakai.studies._chen_luo_yau_2017_text import text_of
from zakai.studies._extended_kalman import extended_kalman
from zakai.studies._grid_optimal import grid_optimal
from zakai.studies._published import Comparison, Pictures, Progress, by_chance, comparison_lines, write_figures

STEP = 0.01
START = 0.1
# Table II and the text below it; None: not given.
PAPER: dict[float, dict[str, float | None]] = {
    0.1: {"direct": 1.9671, "ekf-euler": 7.1694, "lost": None},
    3.0: {"direct": 2.1196, "ekf-euler": None, "lost": 8},
    10.0: {"direct": 2.2753, "ekf-euler": None, "lost": 80},
}
CUT = 11.0  # half the width of the window that would explain the paper's figures


@dataclass(frozen=True)
class Setting:
    """One column of the table: an interpretation of P0 and its value."""

    interpretation: str
    spread: float

    @property
    def deviation(self) -> float:
        """The standard deviation with which the first estimate is drawn."""
        return self.spread if self.interpretation == "standard deviation" else float(np.sqrt(self.spread))

    @property
    def expected_losses(self) -> float:
        """The probability that explicit Euler makes the variance negative in its first step: P0 (1 + xhat(0)^2) dt > 1."""
        edge = np.sqrt(1 / (self.spread * STEP) - 1)
        return float(ndtr((-edge - START) / self.deviation) + ndtr((START - edge) / self.deviation))


INTERPRETATIONS = ("variance", "standard deviation")
SETTINGS = tuple(Setting(interpretation, spread) for interpretation in INTERPRETATIONS for spread in PAPER)


@dataclass(frozen=True, eq=False)
class Study:
    """What was run: `times` (N+1,), `states` (paths, N+1), `means[method]` (settings, paths, N+1), `diverged` (settings, paths).

    `diverged` marks the paths on which the variance of explicit Euler became negative. `figures` are the table's, ready for JSON.
    """

    settings: tuple[Setting, ...]
    times: np.ndarray
    states: np.ndarray
    means: dict[str, np.ndarray]
    diverged: np.ndarray
    figures: dict[str, Any]

    def text(self) -> str:
        """Table II beside our figures, the comparison on the same paths, and what can be reproduced."""
        comparisons = [Comparison(**one) for one in self.figures["comparisons"]]
        agree = {word: [c.verdict.startswith("agrees") for c in comparisons if word in c.what] for word in INTERPRETATIONS}
        said = "; ".join(f"with P0 read as {word} {sum(found)} of {len(found)}" for word, found in agree.items() if found)
        verdict = f"Verdict: of the paper's figures these agree within chance: {said}; the reasons are above."
        return "\n".join([text_of(self.figures, PAPER), "", *comparison_lines(comparisons), "", verdict])

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write figures.json and table.txt."""
        write_figures(folder, self.text(), self.figures)


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    paths: int = 100,
    steps: int = 1000,
    seed: int = 20170111,
    settings: tuple[Setting, ...] = SETTINGS,
) -> Study:
    """The whole experiment.

    progress: called with the work done and all of it. pictures: where figure-1 to figure-3 go. paths, steps: of the Monte-Carlo
    experiment (the paper: 100 and 1000). seed: of NumPy's generator, which draws the paths, then the first estimates.
    settings: the columns of the table.
    """
    whole_number("paths", paths, 1, 10**5)
    whole_number("steps", steps, 1, 10**5)
    whole_number("seed", seed, 0, 2**63)
    if not isinstance(settings, tuple):
        raise InputError("option settings: is a tuple of Setting, to be given in Python")
    rng = np.random.default_rng(seed)
    states, increments = euler_paths(rng, paths, steps)
    deviates = rng.standard_normal(paths)
    first = np.stack([START + setting.deviation * deviates for setting in settings])
    variances = np.array([setting.spread for setting in settings])
    work = Progress(progress, len(settings) * paths + 2 * steps)

    model = load_model("gallery:spiral-sensor")
    times = STEP * np.arange(1, steps + 1)
    means = {"direct": _direct(model, times, increments, first, variances, work.add)}
    wide = max(40.0, np.abs(states).max() + 8, (np.abs(first) + 7 * np.sqrt(variances)[:, None]).max())
    for name, half_width in (("grid-optimal", wide), ("grid-cut", CUT)):
        means[name] = grid_optimal(_drift, _observation, increments, STEP, first, variances, half_width, work.add)
    means["ekf-euler"], lost = _extended(increments, first, variances, stable=False)
    means["ekf-stable"], _ = _extended(increments, first, variances, stable=True)

    figures = _figures(settings, states, means, lost) | {"paths": paths, "steps": steps, "seed": seed, "grid": wide}
    figures["comparisons"] = [asdict(one) for one in _comparisons(figures)]
    study = Study(settings, np.concatenate([[0.0], times]), states, means, lost, figures)
    if pictures is not None and pictures.folder is not None:
        from zakai.studies._chen_luo_yau_2017_figures import draw

        for number, spread in enumerate(PAPER, 1):
            if any(setting.spread == spread for setting in settings):
                pictures.add(f"figure-{number}", partial(draw, study, spread, number))
    return study


def _drift(x: np.ndarray, t: float) -> np.ndarray:
    return t / 40 * x


def _observation(x: np.ndarray) -> np.ndarray:
    return np.stack([x * np.sin(x), x * np.cos(x)], axis=-1)


def _slope(x: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(x) + x * np.cos(x), np.cos(x) - x * np.sin(x)], axis=-1)


def euler_paths(rng: np.random.Generator, paths: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Euler's paths of (79): the state (paths, steps + 1) and the increments of the observation (paths, steps, 2)."""
    states, increments = np.full((paths, steps + 1), START), np.empty((paths, steps, 2))
    for k in range(steps):
        noise = np.sqrt(STEP) * rng.standard_normal((paths, 3))
        x = states[:, k]
        increments[:, k] = _observation(x) * STEP + noise[:, 1:]
        states[:, k + 1] = x + _drift(x, k * STEP) * STEP + noise[:, 0]
    return states, increments


def _direct(model, times, increments, first, variances, one) -> np.ndarray:
    """The direct method, filter by filter."""
    means = np.empty((*first.shape, len(times) + 1))
    for path, observed in enumerate(increments):
        record = Record(times, observed, "increments")
        for number, variance in enumerate(variances):
            prior = GaussianPrior(first[number, path, None], np.array([[variance]]))
            means[number, path] = filter_from(prior, model, record, "limited-direct").mean[:, 0]
            one()
    return means


def _extended(increments: np.ndarray, first: np.ndarray, variances: np.ndarray, stable: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of the extended Kalman-Bucy filters, and where a variance was lost."""
    return extended_kalman(
        _drift, lambda x, t: np.full_like(x, t / 40), _observation, _slope, increments, STEP, first, variances, stable
    )


def _figures(settings, states, means, lost) -> dict[str, Any]:
    """The numbers of the table: averages over paths of (80), their standard errors, and the comparisons on the same paths."""
    out = []
    for number, setting in enumerate(settings):
        kept = {name: np.ones(len(states), bool) for name in means} | {"ekf-euler": ~lost[number]}
        errors = {name: np.mean((states - m[number])[kept[name]] ** 2, axis=-1) for name, m in means.items()}
        paired = errors["direct"] - errors["grid-optimal"]
        rms = np.sqrt(np.mean((means["direct"][number] - means["grid-optimal"][number]) ** 2))
        out.append(
            {
                "interpretation": setting.interpretation,
                "P0": setting.spread,
                "mse": {name: float(e.mean()) if len(e) else None for name, e in errors.items()},
                "standard_error": {name: _standard_error(e) for name, e in errors.items()},
                "direct_minus_grid": {"mse": float(paired.mean()), "standard_error": _standard_error(paired)},
                "direct_over_grid_percent": float(100 * paired.mean() / errors["grid-optimal"].mean()),
                "rms_difference_of_means": float(rms),
                "lost": int(lost[number].sum()),
                "expected_lost": setting.expected_losses * len(states),
            }
        )
    return {"settings": out}


def _comparisons(figures: dict[str, Any]) -> list[Comparison]:
    """Table II line by line, for each interpretation of P0."""
    found = []
    for setting in figures["settings"]:
        published, where = PAPER[setting["P0"]], f"P0 = {setting['P0']:g} as {setting['interpretation']}"
        for key, name, because in (
            ("direct", "direct method, MSE", "an exact filter is better; a window cut at about 11 comes nearer"),
            ("ekf-euler", "EKF, MSE", "a few paths that lost track decide the mean"),
        ):
            figure, mse, error = published[key], setting["mse"][key], setting["standard_error"][key]
            if figure is not None and mse is not None:
                # The paper's figure has the chance of as many paths.
                found.append(by_chance(f"{name}, {where}", figure, mse, error, because, error or 0.0))
        if published["lost"] is not None:
            expected = setting["expected_lost"] / figures["paths"]
            lost, error = 100 * setting["lost"] / figures["paths"], 100 * np.sqrt(expected * (1 - expected) / figures["paths"])
            because = "P0 is then read as the paper did not"
            found.append(by_chance(f"EKF lost of 100, {where}", published["lost"], lost, float(error), because, float(error)))
    return found


def _standard_error(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
