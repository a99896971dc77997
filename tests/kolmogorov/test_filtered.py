"""The symmetric filter of `move_banded`, of any length, for one record and for many, against NumPy's convolution."""

import jax
import numpy as np
import pytest

from zakai.kolmogorov.lattice import filtered


@pytest.mark.parametrize("taps", [1, 16, 32, 64, 100])
def test_a_filter_is_a_convolution_for_one_record_and_for_many(taps):
    draw = np.random.default_rng(taps)
    values, weights = draw.random((3, 200)), draw.random((3, taps + 1))
    wanted = [np.convolve(v, np.concatenate([w[:0:-1], w]))[taps : taps + 200] for v, w in zip(values, weights, strict=True)]
    np.testing.assert_allclose(jax.jit(jax.vmap(filtered))(values, weights), wanted, rtol=1e-13)
    np.testing.assert_allclose(jax.jit(filtered)(values[0], weights[0]), wanted[0], rtol=1e-13)
