"""The transition as a matrix, against exact solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from zakai.kolmogorov.transition import transition

SIZE, CELL = 96, 0.125
X = CELL * (np.arange(SIZE) - SIZE // 2)


def gaussian(mean: float, variance: float) -> np.ndarray:
    return CELL * norm.pdf(X, mean, np.sqrt(variance))


@pytest.mark.parametrize("tau", [0.01, 1.0])
def test_a_gaussian_of_a_linear_system_stays_one(tau):
    rate, noise = 0.7, 0.5
    matrix = transition(-rate * X / CELL, noise / CELL**2, tau)
    kept = np.exp(-rate * tau)
    after = gaussian(0.8 * kept, 0.4 * kept**2 + noise * (1 - kept**2) / (2 * rate))
    assert np.abs(matrix @ gaussian(0.8, 0.4) - after).max() < 1e-12


def test_mass_is_conserved_and_what_comes_to_rest_is_the_invariant_density():
    wave, noise = 2 * np.pi / (CELL * SIZE), 0.5
    matrix = transition(-np.sin(wave * X) / CELL, noise / CELL**2, 2.0)
    assert np.abs(matrix.sum(axis=0) - 1).max() < 1e-12
    rest = np.exp(2 / (noise * wave) * np.cos(wave * X))
    found = np.linalg.matrix_power(matrix, 50) @ gaussian(0.5, 0.4)
    assert np.abs(found / found.sum() - rest / rest.sum()).max() < 1e-12
