"""Results as NetCDF files (HDF5 inside), written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from zakai.errors import InputError
from zakai.records.writing import atomic_write, shown

if TYPE_CHECKING:
    import xarray

# The attribute by which a file of ours is known, and the number that changes when its layout does.
FORMAT = "zakai result 1"


def save_dataset(dataset: xarray.Dataset, path: str | os.PathLike[str]) -> None:
    """Write a result as NetCDF, atomically, with the attribute `format` by which `load_dataset` knows it.

    Arguments:
        dataset: variables over `time` and `state`, as `FilterResult.to_dataset` gives; it is not changed.
        path: the file to write.

    Raises:
        InputError: the file cannot be written.

    Example:
        >>> import tempfile, pathlib, xarray
        >>> from zakai.records import load_dataset, save_dataset
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "result.nc"
        >>> save_dataset(xarray.Dataset({"mean": ("time", [0.1, 0.2])}), path)
        >>> load_dataset(path)["mean"].values.tolist()
        [0.1, 0.2]
    """
    # Built in memory first: HDF5 meets a full disk with errors at close and with files that cannot be closed.
    content = dataset.assign_attrs(format=FORMAT).to_netcdf(engine="h5netcdf")
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def load_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Read a result that `save_dataset` wrote, whole, into memory.

    Arguments:
        path: a NetCDF file made by `zakai filter` or `FilterResult.save`.

    Raises:
        InputError: there is no such file, or it is not a result of ours, or it is damaged.

    Example: see `save_dataset`.
    """
    import xarray

    if not Path(path).is_file():
        what = "is not a regular file" if os.path.exists(path) else "there is no such file"
        raise InputError(f"{shown(path)}: {what}; give a result written by zakai filter")
    try:
        dataset = xarray.load_dataset(path, engine="h5netcdf", decode_times=False)
    except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError):
        raise InputError(f"{shown(path)}: is damaged or no NetCDF; give a result of zakai filter") from None
    if dataset.attrs.get("format") != FORMAT:
        fault = f"its attribute format is {str(dataset.attrs.get('format'))[:40]!r}, not {FORMAT!r}"
        raise InputError(f"{shown(path)}: {fault}; give a result written by this version's zakai filter")
    return dataset
