"""Regions of highest density against SciPy's laws."""

import numpy as np
import pytest
from scipy import stats

import zakai
from zakai.densities import GaussianMixture
from zakai.errors import InputError


def mixture(weights, means, variances, angle=False):
    return GaussianMixture(np.array(weights), np.array(means)[:, None], np.array(variances)[:, None, None], ("x",), (angle,))


def test_of_a_gaussian_it_is_the_central_interval():
    ((low, high),) = mixture([1.0], [0.3], [4.0]).highest_density_region(0.9)
    np.testing.assert_allclose([low, high], stats.norm.ppf([0.05, 0.95], 0.3, 2.0), atol=2e-3)


def test_of_two_peaks_it_is_two_intervals_with_equal_densities_at_their_ends():
    density = mixture([0.7, 0.3], [-2.0, 3.0], [0.25, 0.01])
    found = density.highest_density_region(0.95)
    assert len(found) == 2
    ends = np.array(found).ravel()
    values = density.pdf(ends[:, None])
    np.testing.assert_allclose(values, values.mean(), rtol=1e-2)

    def upto(x):
        return 0.7 * stats.norm.cdf(x, -2, 0.5) + 0.3 * stats.norm.cdf(x, 3, 0.1)

    assert upto(ends[1]) - upto(ends[0]) + upto(ends[3]) - upto(ends[2]) == pytest.approx(0.95, abs=1e-3)


def test_of_an_angle_it_may_go_through_pi():
    ((low, high),) = mixture([1.0], [3.0], [0.04], angle=True).highest_density_region(0.95)
    np.testing.assert_allclose([low, high], 3.0 + 0.2 * stats.norm.ppf([0.025, 0.975]), atol=1e-3)


def test_of_two_coordinates_it_is_the_level_of_the_density():
    cov = np.array([[1.0, 0.6], [0.6, 2.0]])
    density = GaussianMixture(np.ones(1), np.zeros((1, 2)), cov[None], ("x", "y"), (False, False))
    expected = np.exp(-0.5 * stats.chi2.ppf(0.8, 2)) / (2 * np.pi * np.sqrt(np.linalg.det(cov)))
    assert density.highest_density_region(0.8) == pytest.approx(expected, rel=1e-2)


def test_of_a_result_and_what_is_refused():
    model = zakai.Model(
        state=["x", "y", "z"], drift=["-x", "-y", "-z"], observation=["x + y*z"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0, 0, 0], "cov": np.eye(3).tolist()},
    )  # fmt: skip
    density = zakai.filter(model, zakai.Record([0.1], [0.3], "samples")).density(-1)
    assert len(density.marginal("x").highest_density_region()) == 1
    assert density.marginal(["x", "y"]).highest_density_region(0.5) > 0
    with pytest.raises(InputError, match="3 states; take the marginal"):
        density.highest_density_region()
    with pytest.raises(InputError, match="level is 95; give a probability"):
        density.marginal("x").highest_density_region(95)

