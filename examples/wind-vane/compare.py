"""Show that the wind vane's filter is right and useful: `python examples/wind-vane/compare.py`, a quarter of an hour.

Writes results.json and, from RESULTS.template.md, RESULTS.md beside this file.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import reference
from scipy.optimize import minimize

import zakai

HERE = Path(__file__).parent
PARTICLES, REPETITIONS = 40_000, 8
RATE_HOURS = 500
# A density per radian at which some hundred particles are near the observation; and the hours that it takes to come back.
IMPROBABLE, AFTER = 1e-2, 3
# Where sigma and r are looked for, and from how many of the best points there a local search begins: few where the likelihood is
# smooth, many for the extended Kalman filter's, which is rough.
COARSE = (np.geomspace(0.25, 1.0, 3), np.geomspace(0.07, 0.7, 3)), 1
FINE = (np.geomspace(0.2, 1.2, 28), np.geomspace(0.05, 1.5, 36)), 4
WEEK = 168  # hours; sums over weeks are nearly independent, which gives their standard errors


class Year:
    """The record, or its first hours, and what every filter is asked of it: the direction's log density one hour ahead."""

    def __init__(self, hours: int | None = None) -> None:
        self.model = zakai.load_model(HERE / "wind-vane.toml")
        self.record = zakai.read_record(HERE / "observations.csv", self.model)
        self.record = zakai.Record(self.record.times[:hours], self.record.values[:hours], self.record.kind)
        self.times, self.observations = self.record.times, self.record.values
        self.seen = ~np.isnan(self.observations).any(axis=1)
        self.angles = np.arctan2(self.observations[:, 1], self.observations[:, 0])

    def direct(self, sigma: float, r: float):
        """The direct method's result, and the log score of the direction of each observation."""
        result = zakai.filter(self.model.with_parameters(sigma=sigma, r=r), self.record, "limited-direct")
        return result, np.where(self.seen, result.log_likelihood_increments[1:] - reference.log_length_density(r), 0.0)

    def extended_kalman(self, sigma: float, r: float):
        """The same for the extended Kalman filter; its mean does not move between observations and its variance grows evenly."""
        result = zakai.filter(self.model.with_parameters(sigma=sigma, r=r), self.record, "extended-kalman-bucy", keep="moments")
        variance = result.variance[:-1, 0] + sigma**2 * np.diff(result.times)
        length = reference.log_length_density_gaussian(variance, np.full(len(variance), r))
        return result, np.where(self.seen, result.log_likelihood_increments[1:] - length, 0.0)

    def extended_kalman_scores(self, sigmas: np.ndarray, rs: np.ndarray) -> np.ndarray:
        """Its log score of the year at many sigmas and rs, side by side in plain NumPy, for the search."""
        return reference.extended_kalman_scores(self.times, self.observations, sigmas, rs)

    def angle_kalman(self, sigma: float, r: float):
        """The same for the Kalman filter of the angle itself with a wrapped innovation."""
        return reference.angle_kalman_filter(self.times, self.angles, sigma, r)


def one_by_one(score: Callable[[float, float], tuple]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The year's log score for each of many sigmas and rs."""
    return lambda sigmas, rs: np.array([score(float(sigma), float(r))[1].sum() for sigma, r in zip(sigmas, rs, strict=True)])


def most_likely(
    scores: Callable[[np.ndarray, np.ndarray], np.ndarray], scan: tuple[np.ndarray, np.ndarray], starts: int
) -> dict[str, Any]:
    """The sigma and r that give the year the largest likelihood found: a scan, then local searches from its `starts` best points.

    `scores` takes sigmas (P,) and rs (P,) and gives the year's log scores (P,). One local search is enough where the likelihood
    is smooth. That of the extended Kalman filter is not: where sigma and r are such that its mean comes to lie half a turn from
    the observations, sin(angle - mean) is small, the mean stays there for hours, and the likelihood has a narrow gap, at which a
    local search turns back.
    """

    def negative(point: np.ndarray) -> float:
        return -float(scores(*np.exp(point)[:, None])[0])

    points = np.log(np.stack(np.meshgrid(*scan, indexing="ij")).reshape(2, -1))
    scanned = -scores(*np.exp(points))
    spacing = np.log([axis[1] / axis[0] for axis in scan])
    ends = []
    for corner in points.T[np.argsort(scanned)[:starts]]:
        simplex = corner + 0.5 * spacing * np.array([[0, 0], [1, 0], [0, 1]])
        options = {"xatol": 1e-3, "fatol": 1e-2, "initial_simplex": simplex}
        ends.append(minimize(negative, corner, method="Nelder-Mead", options=options))
    ends.sort(key=lambda end: end.fun)
    sigma, r = np.exp(ends[0].x)
    if not (scan[0][0] < sigma < scan[0][-1] and scan[1][0] < r < scan[1][-1]):
        raise RuntimeError(f"the most likely sigma and r, {sigma} and {r}, are not inside the scan: widen it")
    return {"sigma": sigma, "r": r, "log_score": -ends[0].fun, "local_searches": [-end.fun for end in ends],
            "evaluations": points.shape[1] + sum(end.nfev for end in ends)}  # fmt: skip


def standard_errors(score: Callable[[float, float], tuple], sigma: float, r: float) -> dict[str, float]:
    """The standard errors of the most likely sigma and r, from the curvature there; for a likelihood that is smooth."""
    step, at = 0.03, np.log([sigma, r])
    value = {(i, j): -float(score(*np.exp(at + step * np.array([i, j])))[1].sum())
             for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))}  # fmt: skip
    middle = value[0, 0]
    first, second = value[1, 0] + value[-1, 0] - 2 * middle, value[0, 1] + value[0, -1] - 2 * middle
    mixed = 0.5 * (value[1, 1] + value[-1, -1] - 2 * middle - first - second)
    errors = np.sqrt(np.diag(np.linalg.inv(np.array([[first, mixed], [mixed, second]]) / step**2)))
    return {"sigma_error": sigma * errors[0], "r_error": r * errors[1]}


def advantage(year: Year, better: np.ndarray, worse: np.ndarray) -> dict[str, float]:
    """The gain in log score an observation, its error from the weeks' sums, and the share of the best 1 % of them."""
    gain = (better - worse)[year.seen]
    whole = len(year.times) // WEEK * WEEK
    weeks = (better - worse)[:whole].reshape(-1, WEEK).sum(axis=1)
    error = weeks.std(ddof=1) * np.sqrt(len(weeks)) / year.seen[:whole].sum()
    largest = np.sort(gain)[::-1][: len(gain) // 100]
    return {"per_reading": gain.mean(), "error": error, "year": gain.sum(), "from_largest_percent": largest.sum()}


def against_grid(year: Year, sigma: float, r: float) -> dict[str, float]:
    """The largest differences from Bayes' rule on 720 points of the circle."""
    result, _ = year.direct(sigma, r)
    direction, increments = reference.grid_filter(year.times, year.observations, sigma, r)
    known = abs(direction) > 1e-6  # a uniform angle has no mean direction
    turned = np.angle(direction * np.exp(-1j * result.mean[1:, 0]))
    return {
        "log_likelihood": result.log_likelihood,
        "log_likelihood_difference": abs(increments.sum() - result.log_likelihood),
        "increment_difference": np.max(abs(increments - result.log_likelihood_increments[1:])),
        "mean_difference": np.max(abs(turned[known])),
        "warnings": len(result.warnings),
    }


def against_particles(year: Year, sigma: float, r: float) -> dict[str, float]:
    """Independent runs of a bootstrap particle filter: how far their average is from the direct method, and how far it may be.

    Everything is given for the whole year and for its `probable` hours: those that are not among, or just after, the hours whose
    direction was predicted with a density below `IMPROBABLE`.
    """
    result, score = year.direct(sigma, r)
    runs = [
        reference.particle_filter(year.times, year.observations, sigma, r, PARTICLES, np.random.default_rng(seed))
        for seed in range(REPETITIONS)
    ]
    excess = np.array([increments for _, increments in runs]) - result.log_likelihood_increments[1:]
    turned = np.angle(np.array([direction for direction, _ in runs]) * np.exp(-1j * result.mean[1:, 0]))
    improbable = np.convolve(score < np.log(IMPROBABLE), np.ones(1 + AFTER))[: len(score)] > 0
    found = {"sigma": sigma, "r": r, "particles": PARTICLES, "repetitions": REPETITIONS, "improbable": int(improbable.sum())}
    for name, hours in (("year", year.seen), ("probable", year.seen & ~improbable)):
        total, angles = excess[:, hours].sum(axis=1), turned[:, hours]
        # The particles' likelihood is unbiased, so that with a nearly normal logarithm its mean is half a variance too low.
        variance = total.var(ddof=1)
        found[name] = {
            "evidence_mean": total.mean(),
            "evidence_deviation": np.sqrt(variance),
            "evidence_difference": total.mean() + variance / 2,
            "evidence_error": np.sqrt(variance / REPETITIONS + variance**2 / (2 * (REPETITIONS - 1))),
            "mean_difference": np.sqrt(np.mean(angles.mean(axis=0) ** 2)),
            "mean_error": np.sqrt(np.mean(angles.var(axis=0, ddof=1)) / REPETITIONS),
        }
    return found


def with_rate() -> dict[str, float]:
    """The vane with an angle and a rate: the first hours against Bayes' rule on a grid of both."""
    model = zakai.load_model("gallery:wind-vane-rate")
    record = zakai.read_record(HERE / "observations.csv", model)
    record = zakai.Record(record.times[:RATE_HOURS], record.values[:RATE_HOURS], record.kind)
    result = zakai.filter(model, record, "limited-direct", keep="moments")
    numbers = {name: float(value) for name, value in model.parameters.items()}
    numbers |= {"angle_variance": model.prior.cov[0, 0], "rate_variance": model.prior.cov[1, 1]}
    direction, rate, increments = reference.grid_filter_with_rate(record.times, record.values, numbers)
    return {
        "hours": RATE_HOURS,
        "log_likelihood": result.log_likelihood,
        "log_likelihood_difference": abs(increments.sum() - result.log_likelihood),
        "increment_difference": np.max(abs(increments - result.log_likelihood_increments[1:])),
        "mean_difference": np.max(abs(np.angle(direction * np.exp(-1j * result.mean[1:, 0])))),
        "rate_difference": np.max(abs(rate - result.mean[1:, 1])),
        "warnings": len(result.warnings),
    }


def main() -> None:
    year = Year()
    found: dict[str, dict] = {"observations": {"hours": len(year.times), "with_a_direction": int(year.seen.sum())}}
    filters = {"direct": (year.direct, one_by_one(year.direct), COARSE),
               "extended_kalman": (year.extended_kalman, year.extended_kalman_scores, FINE),
               "angle_kalman": (year.angle_kalman, one_by_one(year.angle_kalman), COARSE)}  # fmt: skip
    scores = {}
    for name, (score, many, scan) in filters.items():
        found[name] = most_likely(many, *scan)
        scores[name] = score(found[name]["sigma"], found[name]["r"])[1]
        found[name]["mean"] = scores[name][year.seen].mean()
        print(name, found[name], flush=True)
    found["direct"] |= standard_errors(year.direct, found["direct"]["sigma"], found["direct"]["r"])
    found["uniform"] = {"log_score": -np.log(2 * np.pi) * year.seen.sum(), "mean": -np.log(2 * np.pi)}
    for name in ("extended_kalman", "angle_kalman"):
        found[f"advantage_over_{name}"] = advantage(year, scores["direct"], scores[name])
    ekf = found["extended_kalman"]
    result, _ = year.extended_kalman(ekf["sigma"], ekf["r"])
    mean, increments, _, _ = reference.extended_kalman_filter(year.times, year.observations, ekf["sigma"], ekf["r"])
    found["extended_kalman_check"] = {
        "increment_difference": np.max(abs(increments - result.log_likelihood_increments[1:])),
        "mean_difference": np.max(abs(np.angle(np.exp(1j * (mean - result.mean[1:, 0]))))),
    }
    best, blurred = ((found[name]["sigma"], found[name]["r"]) for name in ("direct", "extended_kalman"))
    checks = {
        "grid": lambda: against_grid(year, *best),
        "rate": with_rate,
        "particles": lambda: against_particles(year, *best),
        "particles_blurred": lambda: against_particles(year, *blurred),
    }
    for name, check in checks.items():
        found[name] = check()
        print(name, found[name], flush=True)
    write(found)


def write(found: dict[str, dict]) -> None:
    """Both files, from the same rounded figures."""
    rounded = json.loads(json.dumps(found, default=float), parse_float=lambda text: float(f"{float(text):.10g}"))
    (HERE / "results.json").write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")
    page = (HERE / "RESULTS.template.md").read_text(encoding="utf-8")
    (HERE / "RESULTS.md").write_text(page.format_map(rounded), encoding="utf-8")


if __name__ == "__main__":
    main()
