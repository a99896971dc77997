"""What filtering a record gives."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zakai import _display
from zakai._progress import Progress
from zakai.algebra.conditions import Condition
from zakai.densities import Density
from zakai.engine.forecast import forecast, origin_of
from zakai.engine.kept_record import Variables, quantiles_of, record_of
from zakai.engine.table import save_table
from zakai.engine.variables import attributes_of, variables_of
from zakai.errors import InputError
from zakai.methods._protocol import State
from zakai.models.model import Model
from zakai.records import Record
from zakai.records.dates import Clock
from zakai.records.netcdf import save_variables

if TYPE_CHECKING:
    import pandas
    import xarray

    from zakai.diagnostics.observed_ahead import PredictedObservations
    from zakai.engine.plan import Plan
    from zakai.records import Inputs

# Health figures that estimate the error of a mean, in standard deviations.
_ERRORS_OF_MEANS = ("mean_error", "error_estimate", "time_error")
_EXACT = ("kalman-bucy", "conditionally-gaussian", "benes", "hu-yau")
_MOST_ASSEMBLED = 4 * 2**30  # bytes of the covariances of independent blocks, when they are put together


@dataclass(eq=False, repr=False)
class FilterResult:
    """The posterior at every time of a record.

    Index 0 is the prior at the model's start; index k is after observation k has been used. `times` (K+1,), `mean` and
    `variance` (K+1, n), `cov` (K+1, n, n), `log_likelihood_increments` (K+1,) with entry 0 zero, and `health`, figures of each
    step (K+1,). `mean_standard_error` (K+1, n) and `log_likelihood_standard_error` are those of methods with random errors, None
    elsewhere. `warnings` are sentences; none means that every bound was kept. `method` and `why` say which filter ran
    and on what grounds, `conditions` those of every method that was considered. Of a system that was filtered block by block
    `blocks` are the results of the blocks; `health` is the worst of theirs, and `cov` is put together when it is asked for.

    `increment_law_error` (K+1,) are the nats by which the log-likelihood up to each time falls short of that of the exact law of
    the increments, since y is taken as linear between observations; None for samples, and in a result that was read from a file.
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
    origin: tuple[Plan, tuple[State, ...]] | None = None
    mean_standard_error: np.ndarray | None = None
    log_likelihood_standard_error: float | None = None
    increment_law_error: np.ndarray | None = None
    _cov: np.ndarray | None = None
    _density: Callable[[int], Density] | None = None
    _no_density: str = "the densities were not kept"
    _quantiles: tuple[np.ndarray, np.ndarray] | None = None  # of a result that was stored: levels (L,) and values (L, K+1, n)
    _states: tuple[Sequence[State] | None, ...] = ()  # of each run at the indices of the result, where they were kept
    _again: Callable[[], FilterResult] | None = None  # computes a result that was stored again

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.method}: {_display.counted(len(self.times) - 1, 'observation')}, "
            f"state {_display.short_names(self.state)}, log-likelihood {_display.number(self.log_likelihood)}, "
            f"{_display.counted(len(self.warnings), 'warning')})"
        )

    def _repr_html_(self) -> str:
        deviation = np.sqrt(np.maximum(self.variance[-1], 0.0))
        rows = [(name, *map(_display.number, row)) for name, *row in zip(self.state, self.mean[-1], deviation, strict=True)]
        when = _display.number(self.times[-1]) if self.dates is None else str(self.dates[-1].astype("datetime64[s]"))
        table = _display.html_table(repr(self), ("", f"mean at {when}", "deviation"), rows, self.warnings)
        from zakai.report import notebook_picture

        shown = self if self._again is None else replace(self, _density=None)  # which would filter the record again
        return table + str(notebook_picture(shown))

    @property
    def cov(self) -> np.ndarray:
        """The covariances (K+1, n, n).

        Raises InputError where they were not stored, or those of many blocks would fill the memory.
        """
        if self._cov is None:
            self._cov = self._assembled()
        return self._cov

    def _assembled(self) -> np.ndarray:
        """Return the covariances of the whole system from those of its independent blocks."""
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
    def error_estimate(self) -> np.ndarray:
        """The estimated error of the mean (K+1,), in standard deviations, the largest over the states.

        It is 0 for exact methods and NaN where the method has no estimate.
        """
        if self.blocks:
            return np.asarray(np.fmax.reduce([block.error_estimate for block in self.blocks]))
        if self.mean_standard_error is not None:
            with np.errstate(all="ignore"):
                share = self.mean_standard_error / np.sqrt(self.variance)
            share[self.variance <= 0] = 0.0
            return np.asarray(np.hypot(share.max(axis=1), self.health.get("error_estimate", 0.0)))
        for name in _ERRORS_OF_MEANS:
            if name in self.health:
                return np.asarray(self.health[name])
        return np.full(len(self.times), 0.0 if self.method in _EXACT else np.nan)

    @property
    def clock(self) -> Clock | None:
        """The unit and the date at which t = 0, of a record with dates."""
        if self.record is not None:
            return self.record.clock
        unit, origin = (self.attributes.get(f"time_{name}") for name in ("unit", "origin"))
        return None if unit is None or origin is None else Clock.of(origin, unit)

    @property
    def dates(self) -> np.ndarray | None:
        """The dates (K+1,) of `times` as datetime64, of a record with dates."""
        clock = self.clock
        if clock is None:
            return None
        dates = clock.dates(self.times)
        if self.record is not None and self.record.dates is not None and len(self.record) == len(dates) - 1:
            dates[1:] = self.record.dates
        return dates

    @property
    def has_densities(self) -> bool:
        """Whether `density` can be asked."""
        return self._density is not None

    def density(self, k: int) -> Density:
        """Return the posterior after observation k (0: the prior; negative numbers count from the end).

        Raises InputError where the densities were not kept.
        """
        if self._density is None:
            raise InputError(self._no_density)
        count = len(self.times)
        if not isinstance(k, int | np.integer) or not -count <= k < count:
            raise InputError(f"density: there is no time number {k!r}; numbers run from 0 to {count - 1}")
        return self._density(k % count)

    def quantile(self, q: float | Sequence[float]) -> np.ndarray:
        """Return quantiles of the marginal posteriors at all times.

        Args:
            q: probabilities from 0 to 1.

        Returns:
            (len(q), K+1, n), or (K+1, n) for one probability.  Quantiles of an angle are counted from the point opposite to its
            mean.

        Raises:
            InputError: the densities were not kept.

        Example:
            low, median, high = result.quantile([0.05, 0.5, 0.95])
        """
        wanted = np.asarray(q, float)
        listed = np.atleast_1d(wanted).tolist()
        if self._quantiles is not None:
            levels, values = self._quantiles
            places = [np.flatnonzero(np.abs(levels - one) < 1e-12) for one in listed]
            if all(len(place) for place in places):
                return values[[int(place[0]) for place in places]] if wanted.ndim else values[int(places[0][0])]
        found = np.stack([self.density(k).quantile(listed) for k in range(len(self.times))], axis=1)
        return found if wanted.ndim else found[0]

    def circular_deviation(self) -> np.ndarray:
        """Return the circular standard deviation of each angle at all times (K+1, n); NaN for other states.

        `mean` has the circular mean of an angle, and `variance` that of its deviations from it, wrapped to (-pi, pi].

        Raises:
            InputError: the densities were not kept.
        """
        return np.stack([self.density(k).circular_deviation() for k in range(len(self.times))])

    def plot(
        self, state: int | str = 0, truth: Any = None, *, start: int | None = None, stop: int | None = None, ax: Any = None
    ) -> Any:
        """Draw the posterior of one state over time: its density, mean, 95% band, and observations of the state itself.

        Args:
            state: a name or a number.
            truth: the true states (K+1, n) or what `zakai.simulate` returns, where they are known.
            start: number of the first time that is drawn.
            stop: number after the last one.
            ax: the Matplotlib Axes to draw in; a new figure without it.

        Returns:
            The Matplotlib Axes.

        Raises:
            InputError: an unknown state, a truth of the wrong shape, or Matplotlib is not installed (extra `plots`).
        """
        from zakai.report.axes import plot_result

        return plot_result(self, state, truth, start, stop, ax)

    def forecast(self, times: Any, inputs: Inputs | None = None) -> FilterResult:
        """Return the density of the state at times after the record, when nothing more is observed.

        Index 0 of the forecast is the end of the record, index k the time k.  It equals, to the bit, the result of a record that
        goes on with unobserved rows.

        Args:
            times: (K,), or one time, increasing, after the last time of the record.
            inputs: for a model with known inputs; they replace those of the record from their first time on.

        Raises:
            InputError: a time before the end of the record, missing inputs, or a result that was read from a file.

        Example:
            ahead = result.forecast([11.0, 12.0])
            ahead.mean, ahead.density(-1).quantile([0.05, 0.95])
        """
        return forecast(self, times, inputs)

    def predict_observations(
        self, times: Any = None, inputs: Inputs | None = None, progress: Progress | None = None
    ) -> PredictedObservations:
        """Return the laws of the observations before they are made.

            p(z_k | all rows before k), or p(z at a later time | all rows)

        Args:
            times: later times; by default those of the record, each given the rows before it.
            inputs: as for `forecast`.
            progress: called with the number of laws done and their total; without it long work has a bar on a terminal.

        Returns:
            `mean` (K, m), `quantile(q)` and `sample(count, seed)` of values of the model's `observation_kind`.

        Raises:
            InputError: as `forecast`, or a law given by `observation_log_density`.

        Example:
            predicted = result.predict_observations()
            low, high = predicted.quantile([0.05, 0.95])
            outside = (record.values < low) | (record.values > high)
        """
        from zakai.diagnostics.observed_ahead import predict_observations

        return predict_observations(self, times, inputs, progress)

    def residuals(self, seed: int = 0, progress: Progress | None = None) -> np.ndarray:
        """Return the probability integral transforms (K, m) of the observations.

            u_kj = P(Z_kj <= z_kj | z_k1, ..., z_k(j-1), all rows before k)

        They are independent and uniform on (0, 1) if the model is true.  Of counts u is drawn uniformly between P(Z < z) and
        P(Z <= z).  NaN where nothing is observed.

        Args:
            seed: of the draws for counts.
            progress: called with the number of observations done and K; without it long work has a bar on a terminal.

        Raises:
            InputError: a result that was read from a file, or a law without conditional laws of its coordinates.

        References:
            Diebold, Gunther and Tay 1998, Evaluating density forecasts.
            Czado, Gneiting and Held 2009, Predictive model assessment for count data.

        Example:
            u = result.residuals()
            scipy.stats.kstest(u[~np.isnan(u)], "uniform").pvalue
        """
        from zakai.diagnostics.residuals import residuals

        return residuals(self, seed, progress=progress)

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

    def to_dataset(self) -> xarray.Dataset:
        """Return the result as an xarray Dataset with dimensions `time`, of dates if the record has some, and `state`."""
        import xarray

        variables: Variables = {**variables_of(self), **({} if self._quantiles is None else quantiles_of(self))}
        if self.dates is not None:
            variables["time"] = (["time"], self.dates, {})
        coordinates = {name: variables.pop(name) for name in ("time", "state", "state_", "level") if name in variables}
        return xarray.Dataset(variables, coords=coordinates, attrs=attributes_of(self))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return means and standard deviations as a DataFrame, a row for each time, or date if the record has some.

        The columns are the names of the states, each followed by that name with `_deviation`, and `log_likelihood_increment`.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError("to_dataframe needs pandas: pip install 'zakai[pandas]'") from None
        columns = {}
        for i, name in enumerate(self.state):
            columns[name] = self.mean[:, i]
            columns[f"{name}_deviation"] = np.sqrt(np.maximum(self.variance[:, i], 0.0))
        columns["log_likelihood_increment"] = self.log_likelihood_increments
        index = pandas.Index(self.times if self.dates is None else self.dates, name="time")
        return pandas.DataFrame(columns, index=index)

    def save(self, path: str | os.PathLike[str], densities: bool = False) -> None:
        """Write the result atomically, as NetCDF, or as a table where the path ends in `.csv`.

        Both have the moments and, of up to 20,000 marginal densities that were kept, the quantiles 0.025, 0.05, 0.25, 0.5, 0.75,
        0.95 and 0.975.

        Args:
            path: the file.
            densities: whether `zakai.load_result` is to have `density`, all quantiles, `forecast`, `residuals` and what else a
                result has.  The file then holds the record and the options, too, from which the densities are computed when they
                are first asked.

        Raises:
            InputError: the file cannot be written; or, with `densities`, a CSV file, a forecast, or a result that was read from a
                file without them.
        """
        quantiles = quantiles_of(self)
        if str(path).lower().endswith(".csv"):
            if densities:
                raise InputError("save: densities are stored in a NetCDF file; give a name that ends in .nc")
            save_table(self, path, quantiles)
            return
        record: Variables = {}
        request: dict[str, str] = {}
        if densities:
            plan, _, given = origin_of(self, "save")
            record, request = record_of(self, plan, given)
        save_variables({**variables_of(self), **quantiles, **record}, {**attributes_of(self), **request}, path)
