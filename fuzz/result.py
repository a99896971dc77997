"""NetCDF to results, in a process that may be sent astray: HDF5 can crash or never end on a damaged file.

`load_result` has such a file read by another process first, and takes the end of that process for "is damaged". Here one process
reads file after file until HDF5 ends it, and what comes out of the others is checked.
"""

from __future__ import annotations

import multiprocessing
import traceback
from multiprocessing.connection import Connection

PATIENCE = 5  # seconds
ends = {"crash": 0, "hang": 0}
_worker: tuple[multiprocessing.process.BaseProcess, Connection] | None = None


def one_input(data: bytes) -> None:
    global _worker
    if _worker is None:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("fork").Process(target=_work, args=(theirs,), daemon=True)
        process.start()
        theirs.close()
        _worker = process, ours
    process, connection = _worker
    try:
        connection.send_bytes(data)
        if connection.poll(PATIENCE):
            finding = connection.recv_bytes().decode()
            assert not finding, finding
            return
        ends["hang"] += 1
    except (EOFError, BrokenPipeError, ConnectionResetError):
        ends["crash"] += 1
    process.kill()
    process.join()
    _worker = None


def _work(connection: Connection) -> None:
    with open("/dev/null", "w") as nothing:
        import os

        os.dup2(nothing.fileno(), 2)  # what the C library says when it is killed
    while True:
        data = connection.recv_bytes()
        try:
            _check(data)
        except BaseException:
            connection.send_bytes(traceback.format_exc().encode())
        else:
            connection.send_bytes(b"")


def _check(data: bytes) -> None:
    import h5py

    from fuzz.oracle import value_or_one_line
    from zakai.errors import InputError
    from zakai.filters.results import result_of
    from zakai.records import _hdf5
    from zakai.records.netcdf import assembled

    try:
        with h5py.File(h5py.h5f.open_file_image(data)) as file:
            dataset = assembled(*_hdf5.read(file))
    except Exception as error:
        assert str(error).isprintable() or not isinstance(error, _hdf5.NotOursError)
        return
    result = value_or_one_line(lambda: result_of(dataset, "r.nc"))
    if isinstance(result, InputError):
        assert str(result).startswith("r.nc: ")
        return
    count, n = len(result.times), len(result.state)
    assert result.mean.shape == result.variance.shape == (count, n)
    assert result.log_likelihood_increments.shape == (count,)
    assert all(values.shape == (count,) for values in result.health.values())
    assert 8 * count * (n + 1) <= len(data)
    assert repr(result).isprintable()
