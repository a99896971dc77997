"""A study: many runs of many methods on the same records, in a folder that survives interruption."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray

from zakai.errors import InputError
from zakai.records.writing import atomic_write
from zakai.studies import _workers
from zakai.studies._batch import COSTS
from zakai.studies._store import FORMAT, Store
from zakai.studies._summary import summary, timing
from zakai.studies.specification import Study
from zakai.studies.study_files import read_study


@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished study: what was studied, its `summary` and `timing` as in the files, and for each point a Dataset of all runs.

    A point's Dataset has the dimensions `run`, `filter` (the labels of the methods), `state`, `sample` (times of curves) and
    `scored` (times of PIT).
    """

    study: Study
    folder: Path
    summary: dict[str, Any]
    timing: dict[str, Any]
    points: tuple[xarray.Dataset, ...]


def run_study(
    study: Study | str | os.PathLike[str],
    folder: str | os.PathLike[str],
    scheduler: str | None = None,
    processes: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Outcome:
    """Run a study, or go on with it where it was left, and write `study.nc`, `summary.json` and `timing.json`.

    study: a study file, or what `read_study` made of one. folder: where everything goes; one that holds a part of this study is
    gone on with, whoever ended it and how. scheduler: the address of a Dask scheduler whose workers run the batches.
    processes: how many processes run them; without either, this one does. progress: called with the observations filtered in
    this call and all that were left.

    The numbers are those of the study file alone, bit for bit on one kind of machine: not of the order of the work, of
    interruptions, or of who did it. Raises InputError for a study or a folder that cannot be used, ConditionError where a method
    does not hold for a model.

    Example:
        outcome = run_study("three-filters.toml", "three-filters")
        outcome.summary["points"][0]["methods"]["kalman-bucy"]["squared_error"]["mean"]
    """
    if scheduler is not None and processes is not None:
        raise InputError("--processes: the workers of the scheduler do the work; give --scheduler or --processes")
    if processes is not None and processes < 1:
        raise InputError(f"--processes {processes}: must be at least 1")
    if not isinstance(study, Study):
        study = read_study(study)
    with Store(folder, study) as store:
        while True:
            missing = store.missing()
            weights = np.array([_observations(study, index) for index in missing])
            for index, batch in _finished(study, missing, scheduler, processes, _weighted(progress, weights)):
                store.write(index, batch)
            batches = store.read()
            if batches is not None:
                break
        return _assembled(study, store.folder, batches)


def _finished(study, missing, scheduler, processes, advance) -> _workers.Finished:
    if not missing:
        return iter(())
    if scheduler is not None:
        return _workers.on_cluster(study, missing, scheduler, advance)
    if processes is not None:
        return _workers.in_processes(study, missing, processes, advance)
    return _workers.here(study, missing, advance)


def _observations(study: Study, index: int) -> int:
    """How many observations a batch filters, of all methods together, up to a factor."""
    _, runs = study.batches[index]
    return (runs.stop - runs.start) * len(study.methods)


def _weighted(progress: Callable[[int, int], None] | None, weights: np.ndarray) -> Callable[[float], None]:
    """Progress in runs, from progress in batches."""
    ends = np.concatenate([[0], np.cumsum(weights)])

    def advance(batches: float) -> None:
        if progress is not None and len(weights):
            progress(int(np.interp(batches, np.arange(len(ends)), ends)), int(ends[-1]))

    return advance


def _assembled(study: Study, folder: Path, batches: Sequence[xarray.Dataset]) -> Outcome:
    """The batches put together, written and summed up."""
    points, costs = [], []
    for number in range(len(study.points)):
        own = [data for data, (point, _) in zip(batches, study.batches, strict=True) if point == number]
        costs.append(xarray.concat([data[list(COSTS)] for data in own], "batch"))
        points.append(_joined([data.drop_vars(COSTS) for data in own]))
    figures, seconds = summary(study, points), timing(study, costs)
    with atomic_write(folder / "study.nc") as temporary:
        _write(study, points, temporary)
    for name, content in (("summary.json", figures), ("timing.json", seconds)):
        with atomic_write(folder / name) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return Outcome(study, folder, figures, seconds, tuple(points))


def _joined(parts: list[xarray.Dataset]) -> xarray.Dataset:
    if len(parts) == 1:
        return parts[0]
    return xarray.concat(parts, "run", data_vars="minimal", coords="minimal", compat="override", join="override")


def _write(study: Study, points: Sequence[xarray.Dataset], path: Path) -> None:
    """One table of all points at the root, what has other dimensions in a group for each point."""
    each = [data[[name for name in data.data_vars if data[name].dims == ("run", "filter")]] for data in points]
    table = xarray.concat([data.drop_vars(set(data.coords) - {"run", "filter"}) for data in each], "point", join="override")
    names = sorted({name for point in study.points for name in point.parameters})
    columns = {f"parameter_{name}": [point.parameters.get(name, "") for point in study.points] for name in names}
    columns["model"] = [point.model for point in study.points]
    table = table.assign_coords({name: ("point", values) for name, values in columns.items()})
    table = table.assign_coords({"point": [point.label for point in study.points]})
    table.attrs = {"format": FORMAT, "name": study.name, "key": study.key(), "reference": study.reference or ""}
    table.to_netcdf(path, mode="w", engine="h5netcdf")
    for number, data in enumerate(points):
        rest = data.drop_vars([name for name in data.data_vars if data[name].dims == ("run", "filter")])
        rest.to_netcdf(path, mode="a", group=f"point-{number}", engine="h5netcdf")
