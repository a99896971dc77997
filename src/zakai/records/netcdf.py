"""Results as NetCDF files (HDF5 inside), written whole or not at all; a file is checked before it is loaded."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zakai.errors import InputError
from zakai.records.writing import atomic_write, shown

if TYPE_CHECKING:
    import xarray

    from zakai.records._hdf5 import Variable

DAMAGED = "is damaged or no NetCDF; give a result of zakai filter"


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
    from zakai.records._hdf5 import FORMAT

    # Built in memory first: HDF5 meets a full disk with errors at close and with files that cannot be closed.
    content = dataset.assign_attrs(format=FORMAT).to_netcdf(engine="h5netcdf")
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def save_variables(variables: Mapping[str, Variable], attributes: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write variables as `save_dataset` writes a dataset, without importing xarray, which takes longer than most filters.

    Args:
        variables: for each name the dimensions, the values and the attributes; a dimension has the size of its variable.
        attributes: texts and numbers of the file.
        path: the file to write.

    Raises:
        InputError: the file cannot be written.
    """
    import h5netcdf
    import h5py

    from zakai.records._hdf5 import FORMAT

    buffer = BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        file.attrs.update({**attributes, "format": FORMAT})
        for dimensions, values, _ in variables.values():
            file.dimensions.update({name: size for name, size in zip(dimensions, values.shape) if name not in file.dimensions})
        for name, (dimensions, values, own) in variables.items():
            words = values.dtype.kind not in "fiu"
            if words:
                values = values.astype(object)
            kind = h5py.string_dtype() if words else values.dtype
            variable = file.create_variable(name, tuple(dimensions), kind, data=values)
            variable.attrs.update(own)
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def load_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Read a result that `save_dataset` wrote, whole, into memory.

    Arguments:
        path: a NetCDF file made by `zakai filter` or `FilterResult.save`.

    Raises:
        InputError: there is no such file, or it is not a result, or it is damaged.

    Example: see `save_dataset`.
    """
    import xarray

    variables, attributes = load_variables(path)
    axes = {dimension for dimensions, _, _ in variables.values() for dimension in dimensions}
    coordinates = {name: variable for name, variable in variables.items() if name in axes}
    try:
        return xarray.Dataset({name: variables[name] for name in variables if name not in axes}, coordinates, attributes)
    except Exception:  # the dimensions do not fit together
        raise InputError(f"{shown(path)}: {DAMAGED}") from None


def load_variables(path: str | os.PathLike[str]) -> tuple[dict[str, Variable], dict[str, Any]]:
    """The same as what a file is made of: of each variable its dimensions, values and attributes; and the attributes of the file.

    The dimensions need not fit together. Raises InputError as `load_dataset`.
    """
    if not Path(path).is_file():
        what = "is not a regular file" if os.path.exists(path) else "there is no such file"
        raise InputError(f"{shown(path)}: {what}; give a result written by zakai filter")
    fault = _look(path)
    if fault is not None:
        raise InputError(f"{shown(path)}: {fault}")
    import h5py

    from zakai.records import _hdf5

    try:
        with h5py.File(path, "r") as file:
            return _hdf5.read(file)
    except MemoryError:
        raise InputError(f"{shown(path)}: does not fit into the memory of this machine") from None
    except Exception:  # it was changed since it was checked
        raise InputError(f"{shown(path)}: {DAMAGED}") from None


def _look(path: str | os.PathLike[str]) -> str | None:
    """What is wrong with a file, found out by another process: a file can be made so that HDF5 crashes or never ends."""
    from zakai.records import _hdf5

    if not sys.executable:  # an embedded Python has nobody to send
        return None
    # -P: its folder has a csv.py, which is not Python's.
    command = [sys.executable, "-P", "-W", "ignore", _hdf5.__file__, os.path.abspath(path)]
    alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    patience = 60 + os.stat(path).st_size // 10_000_000  # seconds; it limits itself to much less, where the system has limits
    try:
        said = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, timeout=patience, env=alone, check=False)
    except subprocess.TimeoutExpired:
        return DAMAGED
    word = said.stdout.decode("utf-8", errors="replace").strip()
    return None if word == _hdf5.READABLE else word or DAMAGED
