"""The density of independent blocks is the product of theirs, wherever their coordinates stand."""

import numpy as np
import pytest

from zakai.densities import Density, GaussianMixture, ProductDensity
from zakai.errors import InputError

NAMES = ("a", "b", "c", "d")
MEAN = np.array([1.0, -2.0, 0.5, 3.0])
COV = np.array([[2.0, 0.0, 0.6, 0.0], [0.0, 1.5, 0.0, 0.0], [0.6, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.3]])


def gaussian(places, names):
    places = list(places)
    return GaussianMixture.gaussian(MEAN[places], COV[np.ix_(places, places)], names, (False,) * len(places))


def product():
    # The first part is about c and a, in this order; the others name their coordinate otherwise.
    places = ((2, 0), (1,), (3,))
    parts = (gaussian(places[0], ("c", "a")), gaussian(places[1], ("other",)), gaussian(places[2], ("other",)))
    return ProductDensity(parts, places, NAMES, (False,) * 4)


WHOLE = gaussian(range(4), NAMES)


def test_it_is_the_gaussian_of_a_covariance_in_blocks():
    density = product()
    assert isinstance(density, Density)
    x = np.random.default_rng(0).normal(size=(3, 5, 4))
    assert np.allclose(density.log_density(x), WHOLE.log_density(x), rtol=0, atol=1e-12)
    assert np.array_equal(density.mean(), MEAN) and np.array_equal(density.cov(), COV)
    assert np.allclose(density.mode(), MEAN, rtol=0, atol=1e-9)
    q = [0.025, 0.5, 0.9]
    assert density.quantile(q).shape == (3, 4)
    assert np.allclose(density.quantile(q), WHOLE.quantile(q), rtol=0, atol=1e-9)


@pytest.mark.parametrize("wanted", ["b", ["a", "c"], ["c", "a"], [3, "a"], ["d", "c", "b", "a"], [2], ["c", "b"]])
def test_a_marginal_takes_any_coordinates_across_blocks(wanted):
    density, expected = product().marginal(wanted), WHOLE.marginal(wanted)
    assert density.names == expected.names and len(density.periodic) == len(expected.names)
    assert np.allclose(density.mean(), expected.mean()) and np.allclose(density.cov(), expected.cov())
    x = np.random.default_rng(1).normal(size=(6, len(density.names)))
    assert np.allclose(density.log_density(x), expected.log_density(x), rtol=0, atol=1e-12)
    again = density.marginal(density.names[-1])
    assert again.names == density.names[-1:] and np.allclose(again.mean(), expected.mean()[-1])


def test_samples_have_the_moments_and_repeat_with_their_key():
    density = product()
    draws = density.sample(3, 40_000)
    assert np.array_equal(draws, density.sample(3, 40_000))
    assert np.allclose(draws.mean(axis=0), MEAN, rtol=0, atol=0.04)
    assert np.allclose(np.cov(draws.T), COV, rtol=0, atol=0.06)


def test_a_wrong_question_is_refused_in_words():
    with pytest.raises(InputError, match="no state 'e'; the states are a, b, c, d"):
        product().marginal("e")
    with pytest.raises(InputError, match=r"expected \(\.\.\., 4\)"):
        product().log_density(np.zeros(3))
    with pytest.raises(InputError, match="between 0 and 1"):
        product().quantile([2.0])
