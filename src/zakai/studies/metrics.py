"""How good an estimate is: every figure of a study, with its definition and its source.

Shapes: `truth` and `mean` (..., n), `variance` (..., n), `cov` (..., n, n); the dots are runs, times, or both.  `periodic` (n,)
says which states are angles; their errors are the short way round, in (-pi, pi].  What cannot be computed is nan.

A belief is given by its moments, and is then the Gaussian that has them (wrapped round the circle for an angle), or as a
`Density`, of which nothing is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy import stats
from scipy.special import logsumexp, ndtr

from zakai.densities import Density
from zakai.densities._values import wrap

PROBABILITIES = (np.arange(400) + 0.5) / 400  # at which the quantiles of a density stand for it
_TAILS = np.array([1e-9, 1e-7, 1e-5, 1e-4, 3e-4])
_DRAWS = 4000
_NARROW = 0.5  # radians: the standard deviation up to which an angle's spread meets itself at one point only
_ROOT_PI, _ROOT_2PI, _LOG_2PI = np.sqrt(np.pi), np.sqrt(2 * np.pi), np.log(2 * np.pi)


def deviations(truth: np.ndarray, mean: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """truth - mean (..., n), for angles the short way round, in (-pi, pi]."""
    error = np.asarray(truth, float) - np.asarray(mean, float)
    angles = np.asarray(periodic, bool)
    if angles.any():
        error[..., angles] = wrap(error[..., angles])
    return error


def squared_error(truth: np.ndarray, mean: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """|x - m|^2 (...): the squared error of an estimate, summed over the states.

    Its expectation is least for the conditional mean (Jazwinski 1970, chapter 5).
    """
    return np.sum(deviations(truth, mean, periodic) ** 2, axis=-1)


def distance(mean: np.ndarray, reference: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """( mean_k |m_k - m*_k|^2 )^1/2 (...): how far estimates (..., K, n) are from a reference, the optimal filter for one.

    For the conditional mean m*, E|x - m|^2 = E|x - m*|^2 + E|m* - m|^2 (Pythagoras): the squared distance is what the
    approximation alone adds to the squared error, and needs far fewer runs to be seen.
    """
    return np.sqrt(np.mean(squared_error(reference, mean, periodic), axis=-1))


def nees(truth: np.ndarray, mean: np.ndarray, cov: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """(x - m)' P^-1 (x - m) (...): the normalised estimation error squared; infinite where P does not allow the error.

    Chi-square with n degrees of freedom for a Gaussian posterior, of mean n whatever the posterior if m and P are its moments
    (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2).
    """
    return mahalanobis(deviations(truth, mean, periodic), cov)


def mahalanobis(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """e' P^-1 e (...), for e (..., n) and P (..., n, n) of any rank; infinite where e leaves the range of P."""
    error, cov = np.asarray(error, float), np.asarray(cov, float)
    if error.shape[-1] == 1:
        with np.errstate(divide="ignore", invalid="ignore"):
            squared, variance = error[..., 0] ** 2, cov[..., 0, 0]
            none = np.where(squared == 0, 0.0, np.where(variance <= 0, np.inf, np.nan))
            return np.where(variance > 0, squared / variance, none)
    known = np.isfinite(error).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
    out = np.full(error.shape[:-1], np.nan)
    out[known] = _quadratic_form(error[known], cov[known])
    return out


def _quadratic_form(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    try:
        factor = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        along = np.einsum("...ji,...j->...i", vectors, error) ** 2
        rounding = 1e-13 * np.abs(values).max(axis=-1, keepdims=True)
        inside = values > rounding
        free = np.where(along > 1e-20 * along.sum(axis=-1, keepdims=True), np.inf, 0.0)
        return np.where(inside, along / np.where(inside, values, 1.0), free).sum(axis=-1)
    return np.sum(np.linalg.solve(factor, error[..., None])[..., 0] ** 2, axis=-1)


def chi_square_bounds(degrees: float, count: int = 1, level: float = 0.95) -> tuple[float, float]:
    """Where the average of `count` independent chi-square variables of `degrees` degrees lies with probability `level`.

        [ q((1 - level)/2), q((1 + level)/2) ] / count,   q the quantile function of chi-square with count degrees

    (Bar-Shalom, Li and Kirubarajan 2001, section 5.4.2).  NEES: degrees n, NIS: m.  The average is over runs at one time;
    the times of one run are not independent.
    """
    ends = stats.chi2.ppf([0.5 * (1 - level), 0.5 * (1 + level)], count * degrees) / count
    return float(ends[0]), float(ends[1])


def crps_gaussian(truth: np.ndarray, mean: np.ndarray, variance: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """The continuous ranked probability score of each state (..., n), from the moments.

        E|X - x| - E|X - X'| / 2 = s (z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi)),     z = (x - m)/s

    (Gneiting and Raftery 2007, equations 20 and 21).  For an angle |.| is the arc (Grimit, Gneiting, Berrocal and Johnson 2006)
    and X is wrapped normal.  Smaller is better; for a deviation of zero it is the absolute error.
    """
    error = deviations(truth, mean, periodic)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.asarray(variance, float))
    score = _absolute(error, spread) - spread / _ROOT_PI
    angles = np.asarray(periodic, bool)
    if angles.any():
        e, s = error[..., angles], spread[..., angles]
        score[..., angles] = _arc(e, s) - 0.5 * _arc(np.zeros_like(e), np.sqrt(2) * s)
    return score


def _absolute(error: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """E|e + s Z| for a standard normal Z."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = error / spread
    smooth = error * (2 * ndtr(z) - 1) + 2 * spread * np.exp(-0.5 * z**2) / _ROOT_2PI
    return np.where(spread == 0, np.abs(error), smooth)


def _arc(error: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """E arc(e + s Z): |.| folded at pi for narrow spreads, else pi/2 - 4/pi sum_(odd j) cos(j e) e^(-j^2 s^2/2) / j^2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        folded = _absolute(error, spread)
        for end in (np.abs(error), -np.abs(error)):
            a = (end - np.pi) / spread
            beyond = spread * np.exp(-0.5 * a**2) / _ROOT_2PI + (end - np.pi) * ndtr(a)
            folded = folded - 2 * np.where(spread == 0, 0.0, beyond)
    wide = np.full_like(folded, np.pi / 2)
    for j in range(1, 2 * int(5 / _NARROW), 2):
        wide -= 4 / np.pi * np.cos(j * error) * np.exp(-0.5 * (j * spread) ** 2) / j**2
    return np.where(spread < _NARROW, folded, wide)


def crps_sample(truth: np.ndarray, sample: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """E|X - x| - E|X - X'| / 2 of each state (..., n), X one of M equally likely points (..., M, n)."""
    truth, sample = np.asarray(truth, float), np.asarray(sample, float)
    count = sample.shape[-2]
    ordered = np.sort(sample, axis=-2)
    weights = (2 * np.arange(count) + 1 - count)[:, None]
    between = 2 * np.sum(weights * ordered, axis=-2) / count**2
    angles = np.asarray(periodic, bool)
    if angles.any():
        points = sample[..., angles]
        between[..., angles] = np.abs(wrap(points[..., :, None, :] - points[..., None, :, :])).mean(axis=(-3, -2))
    return np.abs(deviations(truth[..., None, :], sample, periodic)).mean(axis=-2) - 0.5 * between


def pit_gaussian(truth: np.ndarray, mean: np.ndarray, variance: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """F(x) of each state (..., n), F the distribution function of the belief: the probability integral transform.

    Uniform on [0, 1] if the belief is right (Dawid 1984; Diebold, Gunther and Tay 1998).  For an angle F begins
    opposite the mean.
    """
    error = deviations(truth, mean, periodic)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(np.asarray(variance, float))
        value = ndtr(error / spread)
        for j in np.flatnonzero(np.asarray(periodic, bool)):
            below = [ndtr((error[..., j] + 2 * np.pi * k) / spread[..., j]) for k in (-2, -1, 0, 1, 2)]
            start = [ndtr((-np.pi + 2 * np.pi * k) / spread[..., j]) for k in (-2, -1, 0, 1, 2)]
            value[..., j] = np.clip(sum(below) - sum(start), 0.0, 1.0)
    return value


def pit_sample(truth: np.ndarray, mean: np.ndarray, quantiles: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """The same (..., n) from the quantiles (..., M, n) of the belief at `PROBABILITIES`, linear between them."""
    error = deviations(truth, mean, periodic)
    points = np.sort(deviations(quantiles, np.asarray(mean, float)[..., None, :], periodic), axis=-2)
    out = np.empty_like(error)
    for index in np.ndindex(error.shape):
        column = points[(*index[:-1], slice(None), index[-1])]
        out[index] = np.interp(error[index], column, PROBABILITIES, left=0.0, right=1.0) if np.isfinite(error[index]) else np.nan
    return out


def uniformity(values: np.ndarray) -> tuple[float, float]:
    """Kolmogorov's distance sup_u |F_N(u) - u| of N independent values from the uniform law, and the probability of a larger one.

    Values that are nan are left out; (nan, nan) without any.
    """
    known = np.asarray(values, float)[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan")
    test = stats.kstest(known, "uniform")
    return float(test.statistic), float(test.pvalue)


def log_score_gaussian(truth: np.ndarray, mean: np.ndarray, cov: np.ndarray, periodic: Sequence[bool]) -> np.ndarray:
    """-log p(x) (...), in nats, of the Gaussian with these moments: the logarithmic score (Good 1952). Smaller is better.

    Up to two angles are summed over their windings; of more the nearest counts.  Infinite where P is singular.
    """
    error, cov = deviations(truth, mean, periodic), np.asarray(cov, float)
    angles = np.flatnonzero(np.asarray(periodic, bool))
    reach = {0: 0, 1: 2, 2: 1}.get(len(angles), 0)
    terms = []
    for turns in product(range(-reach, reach + 1), repeat=len(angles) if reach else 0):
        shifted = error.copy()
        if turns:
            shifted[..., angles] += 2 * np.pi * np.array(turns)
        terms.append(-0.5 * mahalanobis(shifted, cov))
    sign, log_volume = np.linalg.slogdet(np.where(np.isfinite(cov), cov, 1.0))
    score = 0.5 * (log_volume + error.shape[-1] * _LOG_2PI) - logsumexp(np.stack(terms), axis=0)
    known = np.isfinite(error).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
    return np.where(known, np.where(sign > 0, score, np.inf), np.nan)


def hellinger_gaussian(
    mean: np.ndarray, cov: np.ndarray, other_mean: np.ndarray, other_cov: np.ndarray, periodic: Sequence[bool]
) -> np.ndarray:
    """The Hellinger distance H (...) of the Gaussians with these moments, angles the short way round.

        1 - H^2 = integral sqrt(p q) = |P|^1/4 |P'|^1/4 / |M|^1/2  exp(-(m - m')' M^-1 (m - m') / 8),     M = (P + P')/2

    (Pardo 2006, chapter 1).  0 for equal beliefs, 1 for beliefs without common ground.
    """
    cov, other_cov = np.asarray(cov, float), np.asarray(other_cov, float)
    middle = 0.5 * (cov + other_cov)
    with np.errstate(divide="ignore", invalid="ignore"):
        volumes = [np.linalg.slogdet(np.where(np.isfinite(c), c, np.nan))[1] for c in (cov, other_cov, middle)]
        inside = 0.25 * (volumes[0] + volumes[1]) - 0.5 * volumes[2]
    inside = inside - mahalanobis(deviations(mean, other_mean, periodic), middle) / 8
    return np.sqrt(np.clip(-np.expm1(inside), 0.0, 1.0))


def hellinger(one: Density, other: Density, seed: int = 0) -> float:
    """H of two densities, 1 - H^2 = integral sqrt(p q).

    One state: the trapezoidal rule on a grid that follows the quantiles of both.  Several: the average of 2 sqrt(p q)/(p + q),
    which lies in [0, 1], over as many draws from p as from q; the error is a few hundredths of H^2.
    """
    if len(one.names) == 1:
        points = _grid_of(one, other)
        root = np.exp(0.5 * (one.log_density(points[:, None]) + other.log_density(points[:, None])))
        inside = float(np.sum(0.5 * (root[1:] + root[:-1]) * np.diff(points)))
    else:
        rng = np.random.default_rng(seed)
        points = np.concatenate([density.sample(int(rng.integers(2**31)), _DRAWS // 2) for density in (one, other)])
        gap = one.log_density(points) - other.log_density(points)
        inside = float(np.mean(1 / np.cosh(0.5 * np.clip(gap, -1400, 1400))))
    return float(np.sqrt(max(0.0, 1.0 - inside)))


def _grid_of(*densities: Density) -> np.ndarray:
    """Points (N,) of one coordinate that are dense where any of the densities is, with all of its circle for an angle."""
    wanted = np.concatenate([_TAILS, PROBABILITIES, 1 - _TAILS[::-1]])
    points = [density.quantile(wanted.tolist())[:, 0] for density in densities]
    if densities[0].periodic[0]:
        points = [wrap(np.concatenate(points)), np.array([-np.pi, np.pi])]
    ends = np.unique(np.concatenate(points))
    return np.unique((ends[:-1, None] + np.diff(ends)[:, None] * np.arange(9) / 8).ravel()) if len(ends) > 1 else ends


def density_scores(density: Density, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """CRPS (n,), PIT (n,) and logarithmic score of one density at the true state (n,), nothing assumed of its shape.

    The marginals are taken by their quantiles at 400 probabilities.
    """
    quantiles = np.asarray(density.quantile(PROBABILITIES.tolist()))
    periodic = density.periodic
    crps = crps_sample(truth, quantiles, periodic)
    pit = pit_sample(truth, density.mean(), quantiles, periodic)
    return crps, pit, -float(density.log_density(np.asarray(truth, float)[None])[0])


def over_runs(values: np.ndarray, failed: np.ndarray) -> dict[str, Any]:
    """What a figure of each run (R,) comes to: mean with its standard error, median and worst, of the runs that did not fail.

    A run whose figure is not finite counts as failed.  Failures are counted, never averaged: read them first.
    """
    values = np.asarray(values, float)
    good = values[np.isfinite(values) & ~np.asarray(failed, bool)]
    none = {"mean": None, "standard_error": None, "median": None, "worst": None}
    figures: dict[str, Any] = none if not good.size else {
        "mean": float(good.mean()),
        "standard_error": float(good.std(ddof=1) / np.sqrt(len(good))) if len(good) > 1 else None,
        "median": float(np.median(good)),
        "worst": float(good.max()),
    }  # fmt: skip
    return {**figures, "runs": int(len(good)), "failures": int(len(values) - len(good))}
