"""What a fresh process imports, and where the compiled kernels are kept."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from .conftest import MODEL, RECORD

KERNEL = """
from zakai.numerics.compiled import kernel

@kernel("float64(float64[::1])")
def total(values):
    result = 0.0
    for value in values:
        result += value
    return result

@kernel("float64(float64)")
def half(value):
    return 0.5 * value
"""
USE = "import numpy, one; print(one.total(numpy.arange(4.0)))"
HITS = f"{USE}; print(sum(one.total.stats.cache_hits.values()))"


def started(folder, code, **environment):
    """A fresh process in a folder, with no cache of its own but those that are given."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_CACHE", "XDG_", "PYTHONDONTWRITE"))}
    own |= {"HOME": "/proc/nowhere", "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])} | environment
    return subprocess.Popen([sys.executable, "-c", code], cwd=folder, env=own, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def answered(process):
    out, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    return out.decode(), error.decode()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "one.py").write_text(KERNEL)
    return tmp_path


def test_without_a_cache_folder_a_kernel_is_compiled_and_nothing_is_printed(folder):
    for _ in range(2):
        assert answered(started(folder, HITS, NUMBA_CACHE_DIR="/proc/nowhere")) == ("6.0\n0\n", "")


@pytest.mark.parametrize(
    ("names", "place"),
    [({"HOME": "{}"}, ".cache/zakai"), ({"XDG_CACHE_HOME": "{}/own"}, "own/zakai"), ({"TMPDIR": "{}"}, "zakai-*")],
)
def test_kernels_are_kept_in_the_folder_of_the_user_and_never_beside_the_source(folder, names, place):
    own = {name: value.format(folder) for name, value in names.items()}
    assert answered(started(folder, HITS, **own)) == ("6.0\n0\n", "")
    assert answered(started(folder, HITS, **own)) == ("6.0\n1\n", "")
    assert list(folder.glob(f"{place}/**/*.nbi")) and not list(folder.glob("__pycache__/*.nbi"))


def test_a_folder_of_temporary_files_that_others_can_write_to_is_not_used(folder):
    assert answered(started(folder, HITS, TMPDIR=str(folder))) == ("6.0\n0\n", "")
    (own,) = folder.glob("zakai-*")
    assert own.stat().st_mode & 0o077 == 0
    own.chmod(0o777)
    assert answered(started(folder, HITS, TMPDIR=str(folder))) == ("6.0\n0\n", "")


def test_a_line_on_the_terminal_says_that_kernels_are_compiled(folder):
    slow = "import zakai._progress as p; p.shown = lambda: True; import zakai.numerics.compiled as c; c.LONG = 0.001; "
    out, error = answered(started(folder, slow + HITS, HOME=str(folder)))
    assert out == "6.0\n0\n"
    assert error.splitlines() == ["zakai: compiling, once for this machine (about 10 s; zakai warm-up does it beforehand)"]


def test_a_kernel_is_compiled_for_the_declared_types_when_it_first_receives_them(folder):
    (folder / "one.py").write_text(KERNEL.replace('[::1])"', '[::1])", "complex128(complex128[::1])"'))
    calls = ["", "one.total(x)", "one.total(1j * x)", "one.total(x)"]
    code = "; ".join(f"{call}; print(len(one.total.signatures), end=' ')".lstrip("; ") for call in calls)
    # A whole number in the place of a float64 is converted, and Numba is asked once only.
    code += "; one.half(3); one.half.compile = None; print(one.half(3))"
    assert answered(started(folder, f"import numpy, one; x = numpy.arange(4.0); {code}")) == ("0 1 2 2 1.5\n", "")


def test_a_kernel_refuses_arrays_of_other_types(folder):
    code = (
        "import numpy, one\n"
        "for values in (numpy.arange(4), numpy.arange(8.0)[::2], numpy.eye(2)):\n"
        "    try: print(one.total(values))\n"
        "    except TypeError: print('refused')"
    )
    assert answered(started(folder, code)) == (3 * "refused\n", "")


def test_two_processes_that_compile_at_once_leave_a_whole_cache(folder):
    for process in [started(folder, USE, HOME=str(folder)) for _ in range(2)]:
        assert answered(process) == ("6.0\n", "")
    assert list(folder.glob(".cache/**/*.nbi"))
    assert answered(started(folder, HITS, HOME=str(folder)))[0] == "6.0\n1\n"


def test_a_full_disk_behind_the_cache_costs_compilation_only(folder):
    (folder / "full.py").write_text(
        "import errno, numba.core.caching as caching\n"
        "def save(*_): raise OSError(errno.ENOSPC, 'no space')\n"
        "caching.IndexDataCacheFile.save = save\n"
    )
    assert answered(started(folder, f"import full; {USE}")) == ("6.0\n", "")


def test_a_filter_imports_no_library_that_it_does_not_need(tmp_path):
    (tmp_path / "model.toml").write_text(MODEL)
    (tmp_path / "record.csv").write_text(RECORD)
    filtered = ["filter", "model.toml", "record.csv", "-o", "result.nc", "--method", "kalman-bucy"]
    code = (
        f"import sys; from zakai.cli import main; assert main({filtered!r}) == 0\n"
        "print([name for name in ('jax', 'xarray', 'pandas', 'rich', 'anywidget', 'matplotlib') if name in sys.modules])"
    )
    assert answered(started(tmp_path, code))[0].splitlines()[-1] == "[]"
