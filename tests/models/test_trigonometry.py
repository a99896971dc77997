import jax
import mpmath
import numpy as np
import pytest

from zakai.models import _trigonometry

POINTS = np.concatenate([
    np.random.default_rng(0).uniform(-1, 1, (40, 1)) * np.array([1e-9, 1.0, 10.0, 1e3, 1e6]),
    # Where a reduction with too few digits of pi would leave nothing.
    (np.arange(-100, 100)[:, None] * np.pi / 2 * np.ones(5)),
]).ravel()  # fmt: skip


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_sine_and_cosine_are_right_to_the_last_digits(name):
    found = np.asarray(jax.jit(getattr(_trigonometry, name))(POINTS))
    with mpmath.workdps(60):
        exact = np.array([float(getattr(mpmath, name)(mpmath.mpf(float(x)))) for x in POINTS])
    assert np.all(np.abs(found - exact) <= 4e-16 * np.abs(exact))


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_they_stay_bounded_and_honest_far_out(name):
    function = getattr(_trigonometry, name)
    assert np.all(np.abs(function(np.array([1e15, -1e18, 1e300]))) <= 1.0)
    assert np.all(np.isnan(function(np.array([np.inf, -np.inf, np.nan]))))


def test_derivatives_of_all_orders_are_their_own():
    x = 0.7
    for order, expected in enumerate([np.cos(x), -np.sin(x), -np.cos(x), np.sin(x)], 1):
        derivative = _trigonometry.sin
        for _ in range(order):
            derivative = jax.grad(derivative)
        assert derivative(x) == pytest.approx(expected, rel=1e-15)
