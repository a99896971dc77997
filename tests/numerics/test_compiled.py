"""Compilation of kernels."""

import gc
import time

import numpy as np
import pytest
from numba import float64, version_info

from zakai.numerics.compiled import helper, kernel, working_time
from zakai.numerics.exponentials import exponentiate


def test_the_clock_of_work_stands_still_while_a_kernel_is_compiled():
    names = {}
    exec("def advance(x):\n    return x + 1.0", names)  # from no file, so that nothing is read from a cache
    advance = kernel(float64(float64))(names["advance"])
    worked, began = working_time(), time.monotonic()
    assert advance(1.0) == 2.0
    time.sleep(0.02)
    worked, spent = working_time() - worked, time.monotonic() - began
    assert 0.02 <= worked < 0.02 + 0.5 * (spent - 0.02)
    assert gc.isenabled()  # a compilation turns the collection of garbage off


def test_the_garbage_of_a_compilation_is_no_work():
    """Its collection, which is put off while a kernel is compiled, takes a second after the first one."""
    names, moments = {}, []
    exec("def cubed(x):\n    return x * x * x", names)
    cubed = kernel(float64(float64))(names["cubed"])

    def note(phase: str, info: dict[str, int]) -> None:
        moments.append((phase, working_time()))

    gc.callbacks.append(note)
    try:
        assert cubed(2.0) == 8.0
        [[] for _ in range(2000)]  # so that it is collected now, if it is not
    finally:
        gc.callbacks.remove(note)
    assert [phase for phase, _ in moments[:2]] == ["start", "stop"]
    assert moments[1][1] - moments[0][1] < 1e-4


def test_exponentials_of_arrays_are_those_of_numpy():
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-700, 700, 1001), rng.normal(size=1000), [0.0, -np.inf, -1e8, -709.0, np.inf, np.nan]])
    found = _exponentials(x)
    assert np.array_equal(found[-6:], [1.0, 0.0, 0.0, 0.0, np.inf, np.nan], equal_nan=True)
    assert np.allclose(found[:-6], np.exp(x[:-6]), rtol=4e-16, atol=0)


def test_an_exception_in_a_helper_reaches_python():
    assert _half(3.0) == 1.5
    with pytest.raises(ValueError, match="negative"):
        _half(-1.0)


@pytest.mark.skipif(version_info.short != (0, 68), reason="only what is known of this version of Numba is replaced")
def test_a_helper_is_translated_with_the_kernel_that_calls_it():
    names = {"kernel": kernel, "helper": helper, "float64": float64}
    exec("@helper\ndef part(x):\n    return x + 1.0\n@kernel(float64(float64))\ndef whole(x):\n    return part(x)", names)
    assert names["whole"](1.0) == 2.0
    (compiled,) = names["part"].overloads.values()
    assert compiled.library.get_pointer_to_function(compiled.fndesc.llvm_func_name) == 0


@helper
def _halved(x):
    if x < 0.0:
        raise ValueError("negative")
    return 0.5 * x


@kernel(float64(float64))
def _half(x):
    return _halved(x)


@kernel(float64[::1](float64[::1]))
def _exponentials(x):
    found = x.copy()
    exponentiate(found)
    return found


def test_a_helper_of_a_kernel_with_reordered_sums_has_no_reordered_sums_itself():
    # Adding and subtracting 3 2^51 rounds to a whole number, unless the compiler may cancel the two.
    names = {"helper": helper}
    exec("@helper\ndef rounded(x):\n    return (x + 6755399441055744.0) - 6755399441055744.0", names)
    exec("def first(x):\n    return rounded(x)", names)
    exec("def second(x):\n    return rounded(x)", names)
    first = kernel(float64(float64), reordered=True)(names["first"])
    second = kernel(float64(float64))(names["second"])
    assert first(0.3) == 0.0
    assert second(0.3) == 0.0
