"""What is known of the state at the start: a Gaussian, a mixture, or a density by its logarithm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy

from zakai.densities import Density
from zakai.densities.as_prior import prior_table
from zakai.errors import InputError
from zakai.models._definite import ROUNDING, is_symmetric, smallest_eigenvalue, square_root
from zakai.models._entries import array, formula, items, kind_of, known_keys
from zakai.models._errors import did_you_mean, listing, named
from zakai.models.formulas import parse_expression
from zakai.models.grid_prior import read_grid, read_interval


def _gaussian_log_density(x: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """log N(x; mean, cov) for x of shape (..., n); the covariance must be positive definite."""
    try:
        factor = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise InputError("prior: its covariance is singular, so it has no density; give every direction a variance") from None
    whitened = np.linalg.solve(factor, (np.asarray(x, dtype=float) - mean)[..., None])[..., 0]
    log_volume = np.log(np.diag(factor)).sum() + 0.5 * len(mean) * np.log(2 * np.pi)
    return -0.5 * (whitened**2).sum(axis=-1) - log_volume


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """N(mean, cov), with `mean` of shape (n,) and `cov` of shape (n, n), which may be singular.

    >>> GaussianPrior(np.zeros(1), np.eye(1)).log_density(np.zeros(1))
    np.float64(-0.9189385332046727)
    """

    mean: np.ndarray
    cov: np.ndarray

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The prior as a mixture of one: the weights (1,), means (1, n) and covariances (1, n, n)."""
        return np.ones(1), self.mean[None], self.cov[None]

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """The logarithm of the density at `x` (..., n); InputError where the covariance is singular."""
        return _gaussian_log_density(x, self.mean, self.cov)

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """`count` draws, of shape (count, n)."""
        return self.mean + rng.standard_normal((count, len(self.mean))) @ square_root(self.cov).T


@dataclass(frozen=True, eq=False)
class MixturePrior:
    """sum_i weights_i N(means_i, covs_i); `weights` (k,) sum to 1, `means` (k, n), `covs` (k, n, n).

    >>> MixturePrior(np.array([0.5, 0.5]), np.array([[-1.0], [1.0]]), np.ones((2, 1, 1))).cov
    array([[2.]])
    """

    weights: np.ndarray
    means: np.ndarray
    covs: np.ndarray

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The weights (k,), means (k, n) and covariances (k, n, n)."""
        return self.weights, self.means, self.covs

    @property
    def mean(self) -> np.ndarray:
        """The mean of the mixture, of shape (n,)."""
        return self.weights @ self.means

    @property
    def cov(self) -> np.ndarray:
        """The covariance of the mixture, of shape (n, n)."""
        deviations = self.means - self.mean
        return np.einsum("k,kij->ij", self.weights, self.covs + deviations[:, :, None] * deviations[:, None, :])

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """The logarithm of the density at `x` (..., n); raises InputError where a covariance is singular."""
        parts = [
            np.log(weight) + _gaussian_log_density(x, mean, cov)
            for weight, mean, cov in zip(self.weights, self.means, self.covs, strict=True)
        ]
        return np.logaddexp.reduce(parts, axis=0)

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """`count` draws, of shape (count, n)."""
        chosen = rng.choice(len(self.weights), size=count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1]))
        return self.means[chosen] + np.einsum("kij,kj->ki", square_root(self.covs)[chosen], noise)


@dataclass(frozen=True, eq=False)
class DensityPrior:
    """A density, not necessarily normalised; its logarithm is a SymPy expression in state and parameters."""

    log_density: sympy.Expr


MOST_COMPONENTS = 10_000
# Filters square means and covariances and add the squares; beyond this the sum is no longer a float64.
LARGEST = 1e150
Prior = GaussianPrior | MixturePrior | DensityPrior

_KEYS = {
    "gaussian": ("mean", "cov"),
    "mixture": ("weights", "means", "covs"),
    "density": ("log_density",),
    "uniform": (),
    "grid": ("log_values", "centre", "basis"),
    "interval": ("values", "nodes", "rule"),
}
_OPTIONAL = {"grid": ("lower", "upper", "logarithms")}


def read_prior(
    keys: Any,
    states: Sequence[sympy.Symbol],
    read_formula: Callable[[str], sympy.Expr],
    periodic: tuple[bool, ...],
    bounded: tuple[bool, ...],
) -> tuple[Prior | None, dict[str, Any] | None]:
    """The prior of the table `[prior]`, and the table in plain numbers and text.

    `keys` is the table (or a prior, a density of `zakai.densities`, or None), `states` the symbols of the states, `periodic`
    which of them are angles, `bounded` which have a domain with two ends, `read_formula` reads the formula of a density.
    Raises InputError, naming the key.
    """
    if keys is None:
        return None, None
    n = len(states)
    if isinstance(keys, Density):
        if keys.names != tuple(map(str, states)):
            raise InputError(f"the density is of {listing(keys.names)}, and the states are {listing(map(str, states))}")
        keys = prior_table(keys)
    if isinstance(keys, GaussianPrior):
        keys = {"kind": "gaussian", "mean": keys.mean, "cov": keys.cov}
    elif isinstance(keys, MixturePrior):
        keys = {"kind": "mixture", "weights": keys.weights, "means": keys.means, "covs": keys.covs}
    elif isinstance(keys, DensityPrior):
        keys = {"kind": "density", "log_density": keys.log_density}
    if not isinstance(keys, Mapping):
        raise InputError(f"expected a table with the key kind, got {kind_of(keys)}")
    kind = keys.get("kind")
    if not isinstance(kind, str) or kind not in _KEYS:
        hint = did_you_mean(kind, _KEYS) if isinstance(kind, str) else ""
        got = f"got {kind_of(kind)}" if "kind" in keys else "it is missing"
        raise InputError(f"kind: expected one of {listing(_KEYS)}; {got}{hint}")
    known_keys(keys, ("kind", *_KEYS[kind], *_OPTIONAL.get(kind, ())))
    for key in _KEYS[kind]:
        if key not in keys:
            raise InputError(f"{key}: missing; a {kind} prior needs {listing(_KEYS[kind])}")
    if kind == "gaussian":
        prior: Prior = _read_gaussian(keys, n)
    elif kind == "mixture":
        prior = _read_mixture(keys, n)
    elif kind == "uniform":
        for state, angle, between in zip(states, periodic, bounded, strict=True):
            if not (angle or between):
                raise InputError(
                    f"kind: uniform is for angles and for domains with two ends, and {str(state)!r} has neither; list it in "
                    'periodic, give it a [domain] with lower and upper, or write kind = "gaussian" with a large variance'
                )
        return DensityPrior(sympy.Integer(0)), {"kind": kind}
    elif kind == "grid":
        log_density, grid = read_grid(keys, states, periodic)
        return DensityPrior(log_density), grid
    elif kind == "interval":
        log_density, interval = read_interval(keys, states)
        return DensityPrior(log_density), interval
    else:
        with named("log_density"):
            text = formula(keys["log_density"])
            return DensityPrior(read_formula(text)), {"kind": kind, "log_density": text}
    table = {"kind": kind} | {key: getattr(prior, key).tolist() for key in _KEYS[kind]}
    if isinstance(prior, GaussianPrior) and n > 1 and np.array_equal(prior.cov, np.diag(np.diag(prior.cov))):
        table["cov"] = np.diag(prior.cov).tolist()
    return prior, table


def _read_gaussian(keys: Mapping[str, Any], n: int) -> GaussianPrior:
    with named("mean"):
        mean = _numbers(_listed(keys["mean"], n), (n,), f"a list of {n} numbers (one a state)")
    with named("cov"):
        return GaussianPrior(mean, _read_covariance(keys["cov"], n))


def _read_mixture(keys: Mapping[str, Any], n: int) -> MixturePrior:
    with named("weights"):
        count = len(items(keys["weights"], None, "a list of positive numbers"))
        weights = _numbers(keys["weights"], (count,), "a list of positive numbers")
        if count == 0 or not (weights > 0).all():
            raise InputError("expected a list of positive numbers, at least one")
        if count > MOST_COMPONENTS:
            raise InputError(f"expected at most {MOST_COMPONENTS} numbers, got {count}")
    with named("means"):
        means = _numbers(keys["means"], (count, n), f"{count} lists of {n} numbers (one list a component)")
    with named("covs"):
        tables = items(keys["covs"], count, f"{count} covariances (one a component), each {n} x {n} or {n} variances")
        covs = []
        for index, table in enumerate(tables):
            with named(f"[{index}]"):
                covs.append(_read_covariance(table, n))
    return MixturePrior(weights / weights.sum(), means, np.array(covs))


def _numbers(value: Any, shape: tuple[int, ...], expected: str) -> np.ndarray:
    """`array` of numbers that a filter can square, of which some may be constant formulas such as "0.02**2"."""
    numbers = array(_constants(value), shape, expected)
    if numbers.size and np.abs(numbers).max() > LARGEST:
        largest = numbers.flat[np.abs(numbers).argmax()]
        raise InputError(f"expected numbers of at most {LARGEST:g} in size, got {largest:g}")
    return numbers


def _constants(value: Any) -> Any:
    """Return nested lists with the values of constant formulas; other texts stay."""
    if isinstance(value, list | tuple):
        return [_constants(entry) for entry in value]
    if not isinstance(value, str):
        return value
    try:
        constant = parse_expression(value, {})
    except InputError:
        return value
    return float(constant) if constant.is_number and constant.is_real else value


def _listed(value: Any, n: int) -> Any:
    """Return one number of one state as a list."""
    return [value] if n == 1 and isinstance(value, int | float | str | np.number) and not isinstance(value, bool) else value


def _read_covariance(value: Any, n: int) -> np.ndarray:
    expected = f"a {n} x {n} list of rows, or a list of {n} variances"
    rows = items(_listed(value, n), n, expected)
    if all(not isinstance(row, list | tuple | np.ndarray) for row in rows):
        cov = np.diag(_numbers(rows, (n,), expected))
    else:
        cov = _numbers(rows, (n, n), expected)
    if not is_symmetric(cov):
        raise InputError("is not symmetric")
    smallest = smallest_eigenvalue(cov)
    if smallest < -ROUNDING * n:
        raise InputError("is not positive semidefinite; variances cannot be negative nor correlations exceed 1")
    return (cov + cov.T) / 2
