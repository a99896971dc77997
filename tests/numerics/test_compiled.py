"""Compilation of kernels."""

import numpy as np
from numba import float64

from zakai.numerics.compiled import kernel
from zakai.numerics.exponentials import exponentiate


def test_exponentials_of_arrays_are_those_of_numpy():
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(-700, 700, 1001), rng.normal(size=1000), [0.0, -np.inf, -1e8, -709.0, np.inf, np.nan]])
    found = _exponentials(x)
    assert np.array_equal(found[-6:], [1.0, 0.0, 0.0, 0.0, np.inf, np.nan], equal_nan=True)
    assert np.allclose(found[:-6], np.exp(x[:-6]), rtol=4e-16, atol=0)


@kernel(float64[::1](float64[::1]))
def _exponentials(x):
    found = x.copy()
    exponentiate(found)
    return found
