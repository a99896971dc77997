"""What filtering a record gives."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai.algebra.conditions import Condition
from zakai.densities import Density
from zakai.errors import InputError
from zakai.models.model import Model
from zakai.records import Record
from zakai.records.netcdf import load_variables, save_variables
from zakai.records.writing import shown

if TYPE_CHECKING:
    import xarray

    from zakai.engine.plan import Plan
    from zakai.records import Inputs

_LARGEST_COV = 32
_LONGEST_NAME = 64  # of a state, or a method
# All others are over the time.
_DIMENSIONS = {
    **{name: (name,) for name in ("time", "state", "state_")},
    **{name: ("time", "state") for name in ("mean", "variance")},
    "cov": ("time", "state", "state_"),
}
# Names that health figures had in version 0.1.
_RENAMED = {
    "missed": "tolerance_ratio",
    "lost": "tail_truncation",
    "surprise": "tail_depth",
    "exponent": "gauge_exponent",
    "splitting": "splitting_error",
    "resolution": "std_in_spacings",
    "negative": "negative_mass",
}
_MOST_ASSEMBLED = 4 * 2**30  # bytes of the covariances of independent blocks, when they are put together


@dataclass(eq=False, repr=False)
class FilterResult:
    """The posterior at every time of a record.

    Index 0 is the prior at the model's start; index k is after observation k has been used. `times` (K+1,), `mean` and
    `variance` (K+1, n), `cov` (K+1, n, n), `log_likelihood_increments` (K+1,) with entry 0 zero, and `health`, figures of each
    step (K+1,). `warnings` are sentences; none means that every bound was kept. `method` and `why` say which filter ran
    and on what grounds, `conditions` those of every method that was considered. Of a system that was filtered block by block
    `blocks` are the results of the blocks; `health` is the worst of theirs, and `cov` is put together when it is asked for.
    """

    times: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    log_likelihood_increments: np.ndarray
    health: dict[str, np.ndarray]
    warnings: list[str]
    method: str
    why: str
    model: Model | None
    record: Record | None = None
    conditions: Mapping[str, tuple[Condition, ...]] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    state: tuple[str, ...] = ()
    attributes: dict[str, str] = field(default_factory=dict)
    blocks: tuple[FilterResult, ...] = ()
    origin: tuple[Plan, tuple[Any, ...]] | None = None
    _cov: np.ndarray | None = None
    _density: Callable[[int], Density] | None = None
    _no_density: str = "the densities were not kept"

    def __repr__(self) -> str:
        names = self.state if len(self.state) <= 8 else (*self.state[:6], "...", self.state[-1])
        return (
            f"FilterResult({self.method}, {len(self.times) - 1} observations of {', '.join(names)}, "
            f"log-likelihood {self.log_likelihood:.6g}, {len(self.warnings)} warnings)"
        )

    @property
    def cov(self) -> np.ndarray:
        """The covariances (K+1, n, n).

        Raises InputError where they were not stored, or those of many blocks would fill the memory.
        """
        if self._cov is None:
            self._cov = self._assembled()
        return self._cov

    def _assembled(self) -> np.ndarray:
        """The covariances of independent blocks as those of the whole."""
        count, n = self.mean.shape
        if not self.blocks:
            raise InputError(f"cov: the covariances of {n} states were not stored, only their variances; see `variance`")
        size = 8 * count * n * n
        if size > _MOST_ASSEMBLED:
            raise InputError(
                f"cov: the covariances of {n} states at {count} times take {size / 2**30:.3g} GiB, nearly all of them zeros; "
                "see `variance`, `density(k).cov()`, or the `cov` of each of `blocks`"
            )
        whole, place = np.zeros((count, n, n)), {name: i for i, name in enumerate(self.state)}
        for block in self.blocks:
            places = np.array([place[name] for name in block.state])
            whole[:, places[:, None], places] = block.cov
        return whole

    @property
    def log_likelihood(self) -> float:
        """The logarithm of the evidence of the whole record."""
        return float(np.sum(self.log_likelihood_increments))

    @property
    def has_densities(self) -> bool:
        """Whether `density` can be asked."""
        return self._density is not None

    def density(self, k: int) -> Density:
        """The posterior after observation k (0: the prior; negative numbers count from the end).

        Raises InputError where the densities were not kept.
        """
        if self._density is None:
            raise InputError(self._no_density)
        count = len(self.times)
        if not isinstance(k, int | np.integer) or not -count <= k < count:
            raise InputError(f"density: there is no time number {k!r}; numbers run from 0 to {count - 1}")
        return self._density(k % count)

    def forecast(self, times: Any, inputs: Inputs | None = None) -> FilterResult:
        """Return the density of the state at times after the record, when nothing more is observed.

        Index 0 of the forecast is the end of the record, index k the time k.  It equals, to the bit, the result of a record that
        goes on with unobserved rows.

        Args:
            times: (K,), increasing, after the last time of the record.
            inputs: for a model with known inputs; they replace those of the record from their first time on.

        Raises:
            InputError: a time before the end of the record, missing inputs, or a result that was read from a file.

        Example:

            ahead = result.forecast([11.0, 12.0])
            ahead.mean, ahead.density(-1).quantile([0.05, 0.95])
        """
        from zakai.engine.forecast import forecast

        return forecast(self, times, inputs)

    def residuals(self, seed: int = 0) -> np.ndarray:
        """Return the probability integral transforms (K, m) of the observations.

            u_kj = P(Z_kj <= z_kj | z_k1, ..., z_k(j-1), all rows before k)

        They are independent and uniform on (0, 1) if the model is true.  Of counts u is drawn uniformly between P(Z < z) and
        P(Z <= z).  NaN where nothing is observed.

        Args:
            seed: of the draws for counts.

        Raises:
            InputError: a result that was read from a file, or a law without conditional laws of its coordinates.

        References:
            Diebold, Gunther and Tay 1998, Evaluating density forecasts.
            Czado, Gneiting and Held 2009, Predictive model assessment for count data.

        Example:

            u = result.residuals()
            scipy.stats.kstest(u[~np.isnan(u)], "uniform").pvalue
        """
        from zakai.engine.residuals import residuals

        return residuals(self, seed)

    def report(self, path: str | os.PathLike[str], truth: Any = None) -> None:
        """Write an HTML report of the result: one file that needs no network.

        Args:
            path: the file.
            truth: the true states (K+1, n) or what `zakai.simulate` returns, where they are known.

        Raises:
            InputError: a truth of the wrong shape, or the extra `plots` is not installed.
        """
        from zakai.report import write_report

        write_report(self, Path(path), truth)

    def _variables(self) -> dict[str, tuple[list[str], np.ndarray, dict[str, Any]]]:
        names = np.array(self.state, dtype=object)
        variables: dict[str, tuple[list[str], np.ndarray, dict[str, Any]]] = {
            "time": (["time"], self.times, {}),
            "state": (["state"], names, {}),
            "state_": (["state_"], names, {}),
            "mean": (["time", "state"], self.mean, {}),
            "variance": (["time", "state"], self.variance, {}),
            "log_likelihood_increment": (["time"], self.log_likelihood_increments, {}),
        }
        if len(names) <= _LARGEST_COV:
            variables["cov"] = (["time", "state", "state_"], self.cov, {})
        for name, values in self.health.items():
            variables[name] = (["time"], values, {"description": self.bounds.get(name, (0, name))[1]})
        return variables

    def _attributes(self) -> dict[str, Any]:
        return {
            "method": self.method,
            "why": self.why,
            "log_likelihood": self.log_likelihood,
            "warnings": "\n".join(self.warnings),
            "model": self.model.text if self.model is not None else "",
            **self.attributes,
        }

    def to_dataset(self) -> xarray.Dataset:
        """Return the result as an xarray Dataset with dimensions `time` and `state`."""
        import xarray

        variables = self._variables()
        coordinates = {name: variables.pop(name) for name in ("time", "state", "state_")}
        return xarray.Dataset(variables, coords=coordinates, attrs=self._attributes())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as NetCDF, atomically."""
        save_variables(self._variables(), self._attributes(), path)


def load_result(path: str | os.PathLike[str]) -> FilterResult:
    """A result that was written by `FilterResult.save`; densities are not stored.

    Raises InputError for a file that is not such a result.
    """
    return result_of(*load_variables(path), shown(path))


def result_of(variables: Mapping[str, Any], attributes: Mapping[str, Any], source: str) -> FilterResult:
    """The result that a file's variables and attributes are; `source` is what errors call it.

    Raises InputError where they are none.
    """
    from zakai.models.files import read_model

    _check_layout(variables, source)
    arrays = {name: values for name, (_, values, _) in variables.items()}
    method, state = str(attributes.get("method", "")), tuple(str(name) for name in arrays["state"])
    for word in (method, *state):
        if not word.isprintable() or len(word) > _LONGEST_NAME:
            fault = f"{ascii(word[:40])} is no name of a method or a state"
            raise InputError(f"{source}: {fault}; give a result written by zakai filter")
    text = str(attributes.get("model", ""))
    known = {*_DIMENSIONS, "log_likelihood_increment"}
    return FilterResult(
        times=arrays["time"],
        mean=arrays["mean"],
        variance=arrays["variance"],
        log_likelihood_increments=arrays["log_likelihood_increment"],
        health={_RENAMED.get(name, name): values for name, values in arrays.items() if name not in known},
        warnings=[line for line in str(attributes.get("warnings", "")).split("\n") if line],
        method=method,
        why=str(attributes.get("why", "")),
        model=read_model(text, source) if text else None,
        state=state,
        _cov=arrays.get("cov"),
        _no_density=f"{source}: a stored result has no densities; filter again to have them",
    )


def warnings_of_step(health: Mapping[str, Any], bounds: Mapping[str, tuple[float, str]]) -> list[str]:
    """A sentence for every bound that one step did not keep."""
    return [
        f"{name} is {float(health[name]):.2g} and exceeds {bound:g}: {what}"
        for name, (bound, what) in bounds.items()
        if name in health and float(health[name]) > bound
    ]


def _check_layout(variables: Mapping[str, Any], source: str) -> None:
    """Raise InputError unless the variables are those of a result, over the right dimensions."""
    for name in ("time", "state", "mean", "variance", "log_likelihood_increment"):
        if name not in variables:
            raise InputError(f"{source}: has no variable {name!r}; give a result written by zakai filter")
    sizes = {name: np.size(variables[of][1]) for name, of in (("time", "time"), ("state", "state"), ("state_", "state"))}
    for name, (dimensions, values, _) in variables.items():
        expected = _DIMENSIONS.get(name, ("time",))
        numbers = values.dtype.kind == "f" or name in ("state", "state_")
        if tuple(dimensions) != expected or not numbers or values.shape != tuple(sizes[axis] for axis in expected):
            over = ", ".join(map(str, dimensions))[:60]
            fault = f"{name[:40]!r} is over {over!r} of shape {values.shape}, or holds no floating-point numbers"
            raise InputError(f"{source}: {fault}; give a result written by zakai filter")


def warnings_of_run(result: FilterResult) -> list[str]:
    """Return a sentence for every bound that was exceeded, and for values that are not finite."""
    said = []
    bad = ~np.isfinite(result.log_likelihood_increments)
    if bad.any():
        time = result.times[np.argmax(bad)]
        said.append(f"the density was lost at t = {time:g}; nothing after that time is to be trusted")
    for name, (bound, what) in result.bounds.items():
        over = result.health[name] > bound if name in result.health else np.zeros(0, bool)
        if over.any():
            worst = int(np.nanargmax(np.where(over, result.health[name], -np.inf)))
            said.append(
                f"{name} exceeded {bound:g} at {int(over.sum())} of {len(over) - 1} times, most at t = "
                f"{result.times[worst]:g} ({result.health[name][worst]:.2g}): {what}"
            )
    return said


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return the versions of what computed a result."""
    return {f"version_{name}": version(name) for name in ("zakai", "numba", "numpy", "scipy", "sympy")}


def other_versions(stored: Any) -> str:
    """Return the names of the packages of which a file has not the versions in use, joined by commas."""
    stored = stored if isinstance(stored, dict) else {}
    return ", ".join(name.removeprefix("version_") for name, own in versions().items() if stored.get(name) != own)
