"""A grid of three states that is slanted in every way: values between its points and marginals against SciPy's Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from zakai.densities import GridDensity


@pytest.mark.parametrize("seed", [0, 1])
def test_a_slanted_lattice_of_three_states_gives_values_and_marginals_to_rounding(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3))
    mean, cov = rng.normal(size=3), root @ root.T + np.eye(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    basis = np.linalg.cholesky(cov) @ turn @ (np.eye(3) + 0.3 * np.triu(rng.normal(size=(3, 3)), 1)) / 3.2
    index = np.stack(np.meshgrid(*[np.arange(size) - size // 2 for size in (64, 72, 81)], indexing="ij"), axis=-1)
    logs = multivariate_normal(mean, cov).logpdf(mean + index @ basis.T) + 2.0
    density = GridDensity(logs, mean, basis, ("a", "b", "c"), (False,) * 3)
    for keep in ([0, 1, 2], [0], [1], [2], [0, 1], [2, 0], [1, 2], [2, 1, 0]):
        law = multivariate_normal(mean[keep], cov[np.ix_(keep, keep)])
        x = np.reshape(law.rvs(30, random_state=2), (-1, len(keep)))
        marginal = density.marginal(keep)
        error = np.abs(np.exp(marginal.log_density(x)) - np.reshape(law.pdf(x), -1))
        assert error.max() <= 1e-12 * law.pdf(mean[keep])
        assert marginal.mean() == pytest.approx(mean[keep], abs=1e-12)
