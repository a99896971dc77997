"""Schemes that split a likelihood from a transition, as matrices: against the exponential of the sum, which they split."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from zakai.filters import _splitting as splitting
from zakai.kolmogorov.differences import differences

SIZE, CELL, G = 96, 0.125, 0.8
X = CELL * (np.arange(SIZE) - SIZE // 2)


def generator() -> np.ndarray:
    """A of u_t = -(f u)' + G u'' / 2 with f = 3 sin(2x) / 2, by the derivatives of the trigonometric interpolant."""
    frequencies = 2 * np.pi * np.fft.fftfreq(SIZE, CELL)
    once, twice = 1j * np.where(np.arange(SIZE) == SIZE // 2, 0.0, frequencies), -(frequencies**2)
    slope, bend = (np.fft.ifft(k[:, None] * np.fft.fft(np.eye(SIZE), axis=0), axis=0).real for k in (once, twice))
    return 0.5 * G * bend - slope * (1.5 * np.sin(2 * X))


A = generator()
DENSITY = np.exp(-2 * (X - 0.4) ** 2)


def local_error(scheme: splitting.Scheme, noise: float, tau: float) -> float:
    """What one interval leaves of h = x + x^2 / 4, with dy = `noise` sqrt(tau) or, without noise, dy = tau / 2; on the whole
    density relative to its maximum, where the factors are not those of tails."""
    h, slope_of_h = X + X**2 / 4, 1 + X / 2
    dy = noise * np.sqrt(tau) or 0.5 * tau
    b, slope = h * dy - 0.5 * h**2 * tau, slope_of_h * dy - h * slope_of_h * tau
    near = np.abs(X) < 4.0
    b, slope = np.where(near, b, -3.0 * tau), np.where(near, slope, 0.0)
    exact = expm(tau * A + np.diag(b)) @ DENSITY
    transition = expm(tau / (len(scheme.shares) - 1) * A)
    values = DENSITY
    for j, (share, undone) in enumerate(scheme.factors):
        values = transition @ values if j else values
        values = values * np.exp(splitting.made_up(share * b, 12 * undone * tau * G * slope**2))
    return float(np.abs(values - exact).max() / exact.max())


@pytest.mark.parametrize(
    ("scheme", "noise", "order"),
    [(splitting.STRANG, 0.0, 3.0), (splitting.CHIN, 0.0, 5.0), (splitting.STRANG, 1.5, 2.5), (splitting.CHIN, 1.5, 3.5)],
    ids=["Strang, smooth", "Chin, smooth", "Strang, noise", "Chin, noise"],
)
def test_a_scheme_has_at_least_the_local_order_that_its_commutators_say(scheme, noise, order):
    errors = [local_error(scheme, noise, tau) for tau in (0.02, 0.01)]
    assert np.log2(errors[0] / errors[1]) > order - 0.35
    # The transition costs twice, and that is far more than two steps of the other would give.
    if scheme == splitting.CHIN:
        assert errors[0] < 0.05 * local_error(splitting.STRANG, noise, 0.02)


@pytest.mark.parametrize("scheme", [splitting.STRANG, splitting.CHIN], ids=["Strang", "Chin"])
@pytest.mark.parametrize("tau", [0.002, 0.02, 0.1])
@pytest.mark.parametrize("noise", [0.3, 1.5])
def test_the_error_that_is_told_is_that_of_the_moments(scheme, tau, noise):
    """A Gaussian, f = 0, h = c x with a c for which the density would stay as it is: the error of the mean in deviations and of
    the variance relative to itself, both known from matrices of two rows."""
    variance = 0.3
    c = np.sqrt(G) / variance
    b, slope = c * X * noise * np.sqrt(tau) - 0.5 * c**2 * X**2 * tau, c * noise * np.sqrt(tau) - c**2 * X * tau
    diffusion = generator_of_diffusion()
    density = np.exp(-0.5 * X**2 / variance)
    exact = expm(tau * diffusion + np.diag(b)) @ density
    transition = expm(tau / (len(scheme.shares) - 1) * diffusion)
    values = density
    for j, (share, undone) in enumerate(scheme.factors):
        values = transition @ values if j else values
        values = values * np.exp(splitting.made_up(share * b, 12 * undone * tau * G * slope**2))
    (mean, spread), (true_mean, true_spread) = (moments(one) for one in (values, exact))
    error = max(abs(mean - true_mean) / np.sqrt(true_spread), abs(spread / true_spread - 1))
    terms = splitting.terms(b, values, [np.zeros(SIZE)], np.array([[G / CELL**2]]), scheme)
    told = splitting.error(scheme, terms, tau)
    assert 0.1 * told < error < 2 * told


def generator_of_diffusion() -> np.ndarray:
    frequencies = 2 * np.pi * np.fft.fftfreq(SIZE, CELL)
    return 0.5 * G * np.fft.ifft(-(frequencies[:, None] ** 2) * np.fft.fft(np.eye(SIZE), axis=0), axis=0).real


def moments(values: np.ndarray) -> tuple[float, float]:
    mean = X @ values / values.sum()
    return mean, (X - mean) ** 2 @ values / values.sum()


def test_differences_are_of_sixth_order_and_the_same_along_each_axis():
    x = np.linspace(-2.0, 2.0, 41)
    cell = x[1] - x[0]
    values = x**6 - 3 * x**2 + x
    slope = differences(values, 0) / cell
    assert np.allclose(slope[3:-3], (6 * x**5 - 6 * x + 1)[3:-3], rtol=0, atol=1e-11)
    assert np.allclose(differences(x, 0), cell, rtol=1e-12)
    plane = np.sin(x)[:, None] * values
    for one, other in zip(splitting.slopes(plane), (plane, plane.T), strict=True):
        assert np.allclose(one, differences(other, 0) if other is plane else differences(other, 0).T, atol=0)


def test_every_second_point_tells_the_same_errors():
    """Of a density with a deviation of 2.2 cells on a lattice of 48 x 40 points."""
    sizes = 48, 40
    z = np.meshgrid(*(np.arange(size) - size // 2.0 for size in sizes), indexing="ij")
    values = np.exp(-0.5 * ((z[0] - 1.3) ** 2 + (z[1] + 0.4) ** 2 + 0.6 * (z[0] - 1.3) * (z[1] + 0.4)) / 2.2**2)
    log = 0.03 * z[0] - 0.02 * z[1] + 1e-3 * z[0] * z[1] - 2e-4 * z[0] ** 3
    flow, spread = [np.sin(0.2 * z[0]) + 0.1 * z[1], np.cos(0.3 * z[1])], np.array([[0.3, 0.1], [0.1, 0.5]])
    thin, apart = splitting.thinned(sizes)
    assert values[thin].shape == (24, 20)
    for scheme in (splitting.STRANG, splitting.CHIN):
        whole = splitting.terms(log, values, flow, spread, scheme)
        own = [part[thin] / step for part, step in zip(flow, apart, strict=True)]
        part = splitting.terms(log[thin], values[thin], own, spread / np.outer(apart, apart), scheme)
        # The differences are those of cells twice as wide.
        assert np.allclose(part, whole, rtol=1e-3)


def test_second_derivatives_of_a_plane_are_those_of_its_formula():
    x, y = np.meshgrid(0.1 * np.arange(30), 0.2 * np.arange(24), indexing="ij")
    slope, second = splitting.bends(np.sin(x) * np.exp(-0.3 * y))
    decay = np.exp(-0.3 * y)
    known = [
        [-np.sin(x) * decay * 0.01, -0.3 * np.cos(x) * decay * 0.02],
        [-0.3 * np.cos(x) * decay * 0.02, 0.09 * np.sin(x) * decay * 0.04],
    ]
    inside = slice(6, -6), slice(6, -6)
    assert np.allclose(slope[1][inside], (-0.3 * np.sin(x) * decay * 0.2)[inside], rtol=0, atol=1e-9)
    for i in range(2):
        for j in range(2):
            assert np.allclose(second[i][j][inside], known[i][j][inside], rtol=0, atol=1e-9)
