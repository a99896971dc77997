"""Distribution functions from densities at points, against those of SciPy."""

from __future__ import annotations

from math import log

import numpy as np
from scipy.stats import norm

from zakai.numerics.tangent_quadrature import distribution


def asked(log_density, centre, deviation, ends):
    points = []

    def counted(z):
        points.append(z)
        return log_density(z)

    return *distribution(counted, ends, centre, 3.0 * deviation), np.array(points)


def test_a_mode_far_from_the_others_is_found_by_its_missing_mass():
    weights, law = np.array([0.95, 0.05]), norm([-0.3, 5.7], 0.3)
    deviation = np.sqrt(weights @ (np.array([-0.3, 5.7]) ** 2 + 0.3**2))
    ends = [-0.3, 2.0, 5.7]
    found, log_mass, _ = asked(lambda z: log(weights @ law.pdf(z) + 1e-300), 0.0, deviation, ends)
    assert abs(log_mass) < 0.01
    assert np.allclose(found, [weights @ law.cdf(z) for z in ends], rtol=0, atol=2e-3)


def test_a_density_without_unit_mass_is_not_searched_in_its_far_tails():
    ends = [-1.0, 0.5]
    found, log_mass, points = asked(lambda z: norm.logpdf(z) - 0.05, 0.0, 1.0, ends)
    assert abs(log_mass + 0.05) < 1e-3
    assert np.allclose(found, norm.cdf(ends), rtol=0, atol=1e-3)
    assert len(points) < 100 and np.abs(points).max() < 12.0
