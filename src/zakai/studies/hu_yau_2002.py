"""Hu and Yau (2002), Finite-dimensional filters with nonlinear drift XV: the universal filter, any initial density.

The paper has theorems and no example.  Theorems 4 to 6 reduce the Duncan-Mortensen-Zakai equation of

    dx = (G grad F + D x + d) dt + g dv,  G = g g' constant,    dy = (C x + c) dt + dw,    eta quadratic

to an equation without data and to ordinary differential equations (12) to (14) for statistics (b, a, c).  Each is run on systems
of that class from densities that are no Gaussian, and compared with a converged solution that shares no code with it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from zakai.engine.driver import filter as filter_record
from zakai.engine.results import FilterResult
from zakai.methods._options import whole_number
from zakai.models.model import Model
from zakai.simulation.simulate import simulate
from zakai.studies._drawing import INK, OURS, PALE, SERIES, new_figure, plain
from zakai.studies._published import Comparison, Pictures, Progress, Reproduction, Table, by_computation
from zakai.studies._reference_density import Solution, conditional_densities

STEP = 0.1
EXACT = 1e-6
SLOPE, OFFSET = -1.0, 0.5  # D and d of the system on which (14) is tried
TWO_PEAKS = "-(x**2 - 1)**2"
G2 = np.array([[1.0, 0.3], [0.3, 0.6]])
CENTRES, SPREADS, WEIGHTS = np.array([[-0.8, 0.5], [0.7, -0.4]]), np.array([[0.3, 0.25], [0.25, 0.3]]), (0.4, 0.6)


class System(NamedTuple):
    """A system of the class, in words and as functions, and the forms that are run on it."""

    keys: dict[str, Any]
    drift: Callable[[np.ndarray], np.ndarray]
    observation: Callable[[np.ndarray], np.ndarray]
    covariance: np.ndarray
    prior: Callable[[np.ndarray], np.ndarray]
    box: tuple[float, int]
    forms: tuple[tuple[str, str], ...]


def _two_peaks(x: np.ndarray) -> np.ndarray:
    return np.exp(-((x[..., 0] ** 2 - 1) ** 2))


def _two_gaussians(x: np.ndarray) -> np.ndarray:
    logs = -0.5 * np.sum((x[..., None, :] - CENTRES) ** 2 / SPREADS, axis=-1) - 0.5 * np.log(SPREADS).sum(axis=-1)
    return np.exp(logs) @ np.array(WEIGHTS)


def _scalar(drift: str, noise: str = "1") -> dict[str, Any]:
    return {
        "state": ["x"], "drift": [drift], "observation": ["x"], "process_noise": [[noise]],
        "prior": {"kind": "density", "log_density": TWO_PEAKS},
    }  # fmt: skip


ALL = tuple((form, theorem) for form in ("stepwise", "one-shot") for theorem in ("theorem-4", "theorem-5", "theorem-6"))
SYSTEMS = {
    "Benes": System(_scalar("tanh(x)"), np.tanh, lambda x: x, np.eye(1), _two_peaks, (14.0, 256), ALL),
    "Kalman-Bucy": System(
        _scalar("1/2 - x"), lambda x: OFFSET + SLOPE * x, lambda x: x, np.eye(1), _two_peaks, (10.0, 192), ALL[:4:3]
    ),
    "Benes, G = 3/5": System(
        _scalar("3/5*tanh(x + 3/10)", "3/5"), lambda x: 0.6 * np.tanh(x + 0.3), lambda x: x, 0.6 * np.eye(1), _two_peaks,
        (12.0, 224), ALL[:4:3],
    ),
    "two states, one observed": System(
        {
            "state": ["x1", "x2"],
            "drift": ["23/20*tanh(x1 + x2/2 + 1/5)", "3/5*tanh(x1 + x2/2 + 1/5)"],
            "process_noise": [["1", "3/10"], ["3/10", "3/5"]],
            "observation": ["x1"],
            "prior": {
                "kind": "mixture", "weights": list(WEIGHTS), "means": CENTRES.tolist(), "covs": SPREADS.tolist(),
            },
        },
        lambda x: np.tanh(x[..., :1] + x[..., 1:] / 2 + 0.2) * np.array([1.15, 0.6]),
        lambda x: x[..., :1], G2, _two_gaussians, (9.0, 80), ALL[:4:3],
    ),
}  # fmt: skip


def run(
    progress: Callable[[int, int], None] | None = None,
    pictures: Pictures | None = None,
    *,
    observations: int = 10,
    systems: int = len(SYSTEMS),
    forms: int = len(ALL),
    seed: int = 1,
) -> Reproduction:
    """Every theorem on every system.

    progress: called with the work done and all of it. pictures: where they go. observations: of each record, 0.1 apart. systems,
    forms: how many of the systems are run, and of the forms on each. seed: of the records.
    """
    whole_number("observations", observations, 1, 50)
    whole_number("systems", systems, 1, len(SYSTEMS))
    whole_number("forms", forms, 1, len(ALL))
    whole_number("seed", seed, 0, 2**31)
    pictures = pictures or Pictures()
    used = dict(list(SYSTEMS.items())[:systems])
    work = Progress(progress, sum(1 + len(one.forms[:forms]) for one in used.values()))
    times = STEP * np.arange(1, observations + 1)
    comparisons, rows = [], []
    for name, system in used.items():
        model = Model(**system.keys, observation_kind="increments")
        _, record = simulate(model, times, seed=seed)
        converged = conditional_densities(
            system.drift, system.observation, system.covariance, system.prior, times, record.values, *system.box
        )
        work.add()
        for form, theorem in system.forms[:forms]:
            result = filter_record(model, record, "hu-yau", form=form, theorem=theorem)
            density, evidence = distances(converged, result)
            what = f"{name}: {theorem.replace('-', ' ').capitalize()}, {form}"
            comparisons.append(
                by_computation(f"{what}: error of the density", "0", f"{density:.1e}", density <= EXACT, "digits are lost")
            )
            rows.append((what, f"{density:.1e}", f"{evidence:.1e}"))
            work.add()
        number = list(SYSTEMS).index(name) + 1
        pictures.add(f"density-{number}", partial(draw, name, system, converged, result))
    comparisons += [statistics(), equation_14(times, seed)]
    return reproduction(comparisons, rows, {"observations": observations, "seed": seed})


def distances(converged: Solution, result: FilterResult) -> tuple[float, float]:
    """The largest error of the density over all observations, relative to its maximum, and that of the evidence in nats."""
    apart = [
        np.abs(np.exp(result.density(k).log_density(converged.points)) - density).max() / density.max()
        for k, density in enumerate(converged.densities, 1)
    ]
    evidence = np.abs(np.cumsum(result.log_likelihood_increments)[-len(apart) :] - converged.evidence)
    return float(max(apart)), float(evidence.max())


def statistics() -> Comparison:
    """How many numbers follow the data."""
    because = "b is of second order and brings a with it; what is true is that no covariance follows the data"
    return by_computation("sufficient statistics that follow the data", "n", "2 n + 1: b, a and c", False, because)


def equation_14(times: np.ndarray, seed: int) -> Comparison:
    """What (14) as printed, with d_ji for d_i, makes of the evidence of dx = (1/2 - x) dt + dv, dy = x dt + dw.

        b' = a + D b - y,    a' = N b - D b',    c' = ... - d b'  (printed: - D b'),    N = D^2 + 1
    """
    model = Model(**_scalar("1/2 - x"), observation_kind="increments")
    _, record = simulate(model, times, seed=seed)
    path = np.concatenate([[0.0], np.cumsum(record.values[:, 0])])
    grid = np.concatenate([[0.0], record.times])

    def rate(t: float, state: np.ndarray) -> list[float]:
        b, a, _ = state
        b_rate = a + SLOPE * b - np.interp(t, grid, path)
        return [b_rate, (SLOPE**2 + 1) * b - SLOPE * b_rate, (OFFSET - SLOPE) * b_rate]

    error = solve_ivp(rate, (0.0, grid[-1]), np.zeros(3), rtol=1e-10, atol=1e-12, max_step=STEP / 4).y[2, -1]
    because = "the third term has d_i and not d_ji; every density is right, and the evidence is not"
    return by_computation("(14) as printed: error of the evidence, nats", "0", f"{abs(error):.2f}", False, because)


def reproduction(comparisons: list[Comparison], rows: list[tuple[str, str, str]], settings: dict[str, Any]) -> Reproduction:
    """The figures and what they say."""
    right = sum(one.verdict == "agrees" for one in comparisons)
    table = Table(
        "Largest errors over the observations, of the density relative to its maximum and of the evidence in nats",
        ("system, theorem and form", "density", "evidence"),
        tuple(rows),
    )
    verdict = (
        f"{right} of {len(rows)} runs of Theorems 4 to 6 give the density of the converged solution: for a G that is not the "
        "identity, a state of which one coordinate is observed, and starts that are no Gaussian. One formula is misprinted, "
        "(14), which changes the evidence alone. From time 0 the statistics cancel more digits the longer the record is; "
        "restarted at every observation they do not."
    )
    return Reproduction(
        "Hu and Yau 2002: the universal finite-dimensional filter, for any initial density",
        "Published are theorems without an example; each says that its formulas solve the equation, so that its error is 0. "
        f"Checked are Theorems 4 to 6 on systems of their class, on records of {settings['observations']} "
        f"observations, 0.1 apart, from "
        "starts with two peaks, against a converged solution of the Duncan-Mortensen-Zakai equation.",
        tuple(comparisons),
        verdict,
        (table,),
        settings,
    )


def draw(name: str, system: System, converged: Solution, result: FilterResult) -> Any:
    """The start and the density after some observations: the filter's as a line, the converged one below it."""
    figure = new_figure(8.0, 4.4)
    panel = plain(figure.subplots())
    x = converged.points
    if x.ndim == 2:
        fine = np.linspace(-4.0, 4.0, 401)[:, None]
        panel.fill_between(fine[:, 0], system.prior(fine) / (system.prior(x).sum() * converged.cell), color=PALE, label="start")
        for colour, k in zip(SERIES, sorted({1, len(converged.densities) // 2, len(converged.densities)} - {0})):
            panel.plot(x[:, 0], converged.densities[k - 1], color=colour, linewidth=3.5, alpha=0.35)
            own = np.exp(result.density(k).log_density(fine))
            panel.plot(fine[:, 0], own, color=colour, linewidth=1.1, label=f"observation {k}")
        panel.set_xlim(-4, 4)
        panel.set_xlabel("x")
        panel.set_ylabel("density (wide: converged, narrow: Hu and Yau)")
    else:
        own = np.exp(result.density(-1).log_density(x))
        first, second = x[:, 0, 0], x[0, :, 1]
        panel.contour(first, second, converged.densities[-1].T, levels=6, colors=OURS, linewidths=3.5, alpha=0.35)
        panel.contour(first, second, own.T, levels=6, colors=INK, linewidths=1.0)
        panel.set_xlim(-4, 4)
        panel.set_ylim(-4, 4)
        panel.set_xlabel("x1, observed")
        panel.set_ylabel("x2 (wide: converged, narrow: Hu and Yau)")
    if x.ndim == 2:
        panel.legend(frameon=False, fontsize=9)
    figure.suptitle(f"Hu and Yau 2002: {name}, from a start with two peaks", fontsize=11)
    return figure
