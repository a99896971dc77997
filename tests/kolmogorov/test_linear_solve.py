"""Linear systems by products, against NumPy."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from zakai.kolmogorov.linear_solve import inverse, solve


@pytest.mark.parametrize("n", [1, 25, 26, 60, 100])
def test_a_system_and_the_volume_of_its_matrix_are_those_of_numpy(n):
    rng = np.random.default_rng(n)
    matrix, right = rng.standard_normal((2, n, n))
    right = right[:, : max(1, n // 2)]
    solution, log_volume = jax.jit(solve)(matrix, right)
    wanted = np.linalg.solve(matrix, right)
    bound = 1e-15 * n * np.linalg.cond(matrix) * np.abs(wanted).max()
    assert np.abs(solution - wanted).max() <= bound
    assert log_volume == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-11)


def test_the_residual_is_small_where_the_matrix_is_all_but_singular():
    """As a wide covariance makes it: 1 + P W with P from 1e-8 to 1e8."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.standard_normal((60, 60)))[0]
    cov, root = turn * np.geomspace(1e-8, 1e8, 60) @ turn.T, rng.standard_normal((60, 60)) / 8
    matrix = np.eye(60) + cov @ root @ root.T
    solution = np.asarray(jax.jit(solve)(matrix, cov)[0])
    residual = np.abs(matrix @ solution - cov).max() / (np.abs(matrix).max() * np.abs(solution).max() * 60)
    assert residual <= 1e-14


@pytest.mark.parametrize("n", [4, 40])
def test_the_derivative_of_an_inverse_is_minus_its_product_with_the_change_and_itself(n):
    rng = np.random.default_rng(n)
    matrix, direction = np.eye(n) + rng.standard_normal((2, n, n)) / (3 * np.sqrt(n))
    found = jax.jit(lambda a, d: jax.jvp(inverse, (a,), (d,))[1])(matrix, direction)
    own = np.linalg.inv(matrix)
    assert np.asarray(found) == pytest.approx(-own @ direction @ own, abs=1e-10)
