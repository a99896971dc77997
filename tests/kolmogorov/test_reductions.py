import jax
import numpy as np
import pytest

from zakai.kolmogorov.reductions import highest, lowest, summed
from zakai.kolmogorov.resolution import resolution_of

SIZES = (1,), (7,), (64,), (5, 12), (48, 36), (6, 10, 4), (3, 2, 5, 4)


@pytest.mark.parametrize("sizes", SIZES)
def test_sums_and_extremes_are_those_of_numpy(sizes):
    values = np.random.default_rng(0).normal(size=sizes)
    for compiled in (lambda f: f, jax.jit):
        assert compiled(highest)(values) == values.max()
        assert compiled(lowest)(values) == values.min()
        np.testing.assert_allclose(compiled(summed)(values), values.sum(), rtol=1e-13, atol=1e-13)


def test_what_is_not_a_number_or_infinite_is_seen():
    values = np.zeros((6, 5))
    values[4, 3] = np.inf
    assert highest(values) == np.inf and np.isinf(summed(values))
    values[4, 3] = np.nan
    assert np.isnan([highest(values), lowest(values), summed(values)]).all()


@pytest.mark.parametrize("sizes", [(12,), (480,), (10, 14), (6, 10, 8)])
def test_the_resolution_is_what_is_at_the_edges_and_at_the_highest_frequency_of_an_axis(sizes):
    values = np.random.default_rng(1).random(sizes)
    edge, alias = 0.0, 0.0
    for axis, size in enumerate(sizes):
        outer = np.arange(10 if size == 480 else 2)
        edge += np.take(values, [*outer, *(size - 1 - outer)], axis=axis).sum() / values.sum()
        spectrum = np.fft.fft(values, axis=axis)
        alias = max(alias, np.abs(np.take(spectrum, size // 2, axis=axis)).sum() / values.sum())
    np.testing.assert_allclose(resolution_of(values), (alias, edge), rtol=1e-12)
