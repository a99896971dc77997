"""NetCDF to results, in a process that may be sent astray: HDF5 can crash or never end on a damaged file.

`load_result` has such a file read by another process first, and takes the end of that process for "is damaged". Here one process
reads file after file, with a limit of time for each, until HDF5 ends it; what comes out of the others is checked.  What came
to an end in a new way is read once more where the fuzzer sees it, and becomes a file to begin with:

    python -m fuzz result -runs=100000 -max_len=17000 -keep_seed=1 -len_control=0
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import re
import signal
import traceback
from multiprocessing.connection import Connection

import h5py

from fuzz.oracle import value_or_one_line
from zakai.engine.results import FilterResult
from zakai.engine.stored import result_of
from zakai.errors import InputError
from zakai.records import _hdf5

SECONDS = 0.2  # of the process, for a small file; some milliseconds are usual, and `load_result` gives it more
PATIENCE = 60  # seconds; a process that computes is ended long before
ends = {"crash or hang of HDF5": 0, "refused by its reader": 0, "refused as a result": 0, "read": 0}
_ways: set[str] = set()
_OWN_WORDS = re.compile(r"'[^']*'|\d+")  # what a reason quotes of the file
_worker: tuple[multiprocessing.process.BaseProcess, Connection] | None = None


def one_input(data: bytes) -> None:
    global _worker
    if _worker is None:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.get_context("fork").Process(target=_work, args=(ours, theirs), daemon=True)
        process.start()
        theirs.close()
        _worker = process, ours
    process, connection = _worker
    try:
        connection.send_bytes(data)
        assert connection.poll(PATIENCE), "the reader waits for something"
        end, _, how = connection.recv_bytes().decode().partition("\n")
    except (EOFError, BrokenPipeError, ConnectionResetError):
        end = how = "crash or hang of HDF5"
        process.join()
        _worker = None
    assert end in ends, f"{end}\n{how}"
    ends[end] += 1
    way = _OWN_WORDS.sub("", how)
    if _worker is not None and way not in _ways:
        _ways.add(way)
        check(data)


@atexit.register
def _say() -> None:
    if any(ends.values()):
        print(ends)


def _work(ours: Connection, connection: Connection) -> None:
    ours.close()  # so that it ends with the fuzzer
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 2)  # what the C library says when it is killed
    while True:
        try:
            data = connection.recv_bytes()
        except EOFError:
            os._exit(0)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            said = "\n".join(check(data))
        except BaseException:
            said = traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
        connection.send_bytes(said.encode())


def check(data: bytes) -> tuple[str, str]:
    """Read a file as `load_result` does; what came of it, and the words of an error."""
    try:
        with h5py.File(h5py.h5f.open_file_image(data)) as file:
            variables, attributes = _hdf5.read(file)
    except Exception as error:
        assert str(error).isprintable() or not isinstance(error, _hdf5.NotOursError)
        return "refused by its reader", f"{type(error).__name__}: {error}"
    result = value_or_one_line(lambda: result_of(variables, attributes, "r.nc"))
    if isinstance(result, InputError):
        assert str(result).startswith("r.nc: ")
        return "refused as a result", str(result)
    check_result(result)
    assert 8 * len(result.times) * (len(result.state) + 1) <= len(data)
    return "read", ""


def check_result(result: FilterResult) -> None:
    """Whether what was read can be worked with."""
    count, n = len(result.times), len(result.state)
    assert result.mean.shape == result.variance.shape == (count, n)
    assert result.log_likelihood_increments.shape == (count,)
    assert all(values.shape == (count,) for values in result.health.values())
    assert repr(result).isprintable()
