"""Transitions of linear-quadratic equations against the Riccati equations, integrated here by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from zakai.numerics.flow import Coefficients, at, compose, integrate, motion, spread_first

RNG = np.random.default_rng(3)


def system(n, varying=True, rate=3.0, scale=None):
    """Coefficients with an oscillating L, offset, S and G, which has no inverse for n > 1; `scale` changes the units of x."""
    rng = np.random.default_rng(n)
    L0, L1 = 0.5 * rng.standard_normal((2, n, n))
    root = rng.standard_normal((n, max(1, n - 1)))
    C, c, offset = rng.standard_normal((2, n)), rng.standard_normal(2), rng.standard_normal(n)
    unit = np.ones(n) if scale is None else np.asarray(scale)

    def coefficients(t, rows):
        t = np.asarray(t)
        wave = np.cos(rate * t) if varying else 0.0 * t
        S = (1 + 0.6 * wave)[:, None, None]
        L = (L0 + wave[:, None, None] * L1) * (unit[:, None] / unit)
        G = (1 + 0.5 * wave**2)[:, None, None] * (unit[:, None] * (root @ root.T) * unit)
        H = C / unit
        gain = H.T / S
        linear = np.concatenate([-(gain @ c)[:, :, None], gain], axis=2)
        constant = np.concatenate([-0.5 * (c @ c) / S[:, :, 0], c / S[:, :, 0]], axis=1)
        forcing = np.zeros((len(t), n, 3), L.dtype)
        forcing[:, :, 0] = unit * offset * (1 + t[:, None] * varying)
        return Coefficients(L, forcing, G, -0.5 * gain @ H, linear, constant)

    return coefficients


def reference(coefficients, start, stop, mean, cov, inputs):
    """Mean, covariance and log-mass of a Gaussian after the interval."""
    n = len(mean)

    def slope(t, z):
        m, P = z[:n], z[n : n + n * n].reshape(n, n)
        L, l, G, Q, p, r = (a[0] for a in coefficients(np.array([t]), np.zeros(1, int)))
        l, p, r = l @ inputs, p @ inputs, r @ inputs
        mass = np.trace(Q @ P) + m @ Q @ m + p @ m + r + np.trace(L)
        return np.concatenate([L @ m + l + P @ (2 * Q @ m + p), (L @ P + P @ L.T + G + 2 * P @ Q @ P).ravel(), [mass]])

    z = solve_ivp(slope, (start, stop), np.concatenate([mean, cov.ravel(), [0.0]]), method="DOP853", rtol=1e-12, atol=1e-13)
    return z.y[:n, -1], z.y[n:-1, -1].reshape(n, n), z.y[-1, -1]


def weighed(transition, mean, cov, inputs):
    """The same by the transition: Bayes' rule by completing the square."""
    g = transition.vector @ inputs
    new = np.linalg.inv(np.linalg.inv(cov) + transition.information)
    middle = new @ (np.linalg.solve(cov, mean) + g)
    away = middle - mean
    mass = g @ middle - middle @ transition.information @ middle / 2 - away @ np.linalg.solve(cov, away) / 2
    mass += (np.linalg.slogdet(new)[1] - np.linalg.slogdet(cov)[1]) / 2 + inputs @ transition.constant @ inputs
    Psi = transition.map
    return Psi @ middle + transition.offset @ inputs, Psi @ new @ Psi.T + transition.noise, mass


def spread(flow, mean, cov, inputs):
    """The same by the equation for grids, centred at the mean."""
    moved = motion(flow, mean, inputs)
    wide = np.linalg.inv(cov + flow.spread)
    precision = wide - 2 * flow.curvature
    xi = np.linalg.solve(precision, moved.tilt)
    mass = moved.log_mass + moved.tilt @ xi / 2 + (np.linalg.slogdet(wide)[1] - np.linalg.slogdet(precision)[1]) / 2
    return moved.centre + flow.map @ xi, flow.map @ np.linalg.inv(precision) @ flow.map.T, mass + flow.log_volume


@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_both_forms_agree_with_the_riccati_equations(n, varying):
    coefficients = system(n, varying)
    starts, stops = np.array([0.0, 0.3, 0.302]), np.array([0.3, 0.302, 1.4])
    found = integrate(coefficients, starts, stops, not varying)
    assert found.error.max() <= 1e-11
    root = RNG.standard_normal((n, n))
    mean, cov, inputs = RNG.standard_normal(n), root @ root.T + 0.1 * np.eye(n), np.array([1.0, 0.7, -0.4])
    for k in range(3):
        expected = reference(coefficients, starts[k], stops[k], mean, cov, inputs)
        transition = at(found.transition, k)
        for result in (weighed(transition, mean, cov, inputs), spread(spread_first(transition), mean, cov, inputs)):
            for a, b in zip(result, expected, strict=True):
                assert a == pytest.approx(b, abs=2e-11)


def gathered(covariance, start, stop):
    """The noise that a state without drift gathers in one interval, and the error that is reported."""

    def coefficients(t, rows):
        zero = np.zeros((len(t), 1, 1))
        return Coefficients(zero, zero, covariance(t)[:, None, None], zero, zero, zero[:, 0])

    found = integrate(coefficients, np.array([start]), np.array([stop]), False)
    return found.transition.noise[0, 0, 0], found.error[0]


ROOT = 1e9**0.5
CASES = {
    "wave": (lambda t: 1 + 0.9 * np.sin(50 * t), 0.0, 0.5, 0.5 + 0.9 * (1 - np.cos(25)) / 50),
    "many waves": (lambda t: 1 + 0.9 * np.sin(50 * t), 0.0, 40.0, 40 + 0.9 * (1 - np.cos(2000)) / 50),
    "inverse of a wave": (lambda t: 1 / (1 + 0.9 * np.sin(50 * t)), 0.0, np.pi / 25 * 3, np.pi / 25 * 3 / np.sqrt(1 - 0.81)),
    "pulse": (lambda t: 1 + np.exp(-(((t - 0.3) / 0.005) ** 2)), 0.0, 0.5, 0.5 + 0.005 * np.sqrt(np.pi)),
    "box": (lambda t: 1 + 5.0 * (np.abs(t - 0.217) < 0.0025), 0.0, 0.5, 0.525),
    "jump": (lambda t: np.where(t < 3.3, 1.0, 2.0), 0.0, 10.0, 16.7),
    "kink": (lambda t: np.abs(t - 3.3), 0.0, 10.0, 3.3**2 / 2 + 6.7**2 / 2),
    "root": (np.sqrt, 0.0, 1.0, 2 / 3),
    "peak": (lambda t: 1 / ((t - 5.1) ** 2 + 1e-9), 0.0, 10.0, ROOT * (np.arctan(4.9 * ROOT) + np.arctan(5.1 * ROOT))),
    "far from zero": (lambda t: 1 + 0.9 * np.sin(50 * (t - 1e4)), 1e4, 1e4 + 0.5, 0.5 + 0.9 * (1 - np.cos(25)) / 50),
}


@pytest.mark.parametrize("name", CASES)
def test_coefficients_that_vary_within_an_interval_are_integrated(name):
    covariance, start, stop, expected = CASES[name]
    value, error = gathered(covariance, start, stop)
    assert value == pytest.approx(expected, rel=2e-11) and error <= 1e-9


def test_what_is_not_resolved_is_reported():
    assert gathered(lambda t: 1 + 0.9 * np.sin(1e6 * t), 0.0, 100.0)[1] > 1e-3
    assert gathered(lambda t: np.log(t - 0.5), 0.0, 1.0)[1] == np.inf


def test_a_transition_depends_on_its_own_interval_to_the_last_bit():
    for n, varying in ((1, True), (3, True), (2, False)):
        coefficients = system(n, varying, rate=40.0)
        edges = np.cumsum(np.geomspace(1e-4, 3.0, 17))
        whole = integrate(coefficients, edges[:-1], edges[1:], not varying)
        for k in range(16):
            alone = integrate(coefficients, edges[k : k + 1], edges[k + 1 : k + 2], not varying)
            assert all(np.array_equal(a[k], b[0]) for a, b in zip(whole.transition, alone.transition, strict=True))
            assert whole.error[k] == alone.error[0]


def test_two_intervals_compose_to_one_of_any_length():
    coefficients = system(3, False)
    lengths = np.array([0.5, 1.0, 100.0, 200.0])
    found = integrate(coefficients, np.zeros(4), lengths, True).transition
    for half in (0, 2):
        both = compose(at(found, half), at(found, half))
        for a, b in zip(both, at(found, half + 1), strict=True):
            assert a == pytest.approx(b, rel=1e-11, abs=1e-11)


def test_the_units_of_the_state_and_of_time_do_not_matter():
    scale = np.array([1e6, 1e-6, 1.0])
    own, other = (integrate(system(3, True, 9.0, s), [0.0], [0.8], False).transition for s in (None, scale))
    for found, expected in (
        (other.map[0] / (scale[:, None] / scale), own.map[0]),
        (other.noise[0] / (scale[:, None] * scale), own.noise[0]),
        (other.information[0] * (scale[:, None] * scale), own.information[0]),
    ):
        assert found == pytest.approx(expected, rel=1e-11, abs=1e-11 * np.abs(expected).max())
    assert other.constant[0] == pytest.approx(own.constant[0], rel=1e-11)


def test_integrators_in_a_row_are_exact():
    """x_1' = x_2, ..., x_5' = noise: the noise that x_1 gathers is t^9 / (9 (4!)^2)."""
    n = 5

    def coefficients(t, rows):
        zero = np.zeros((len(t), n, n))
        L, G = zero + np.eye(n, k=1), zero.copy()
        G[:, -1, -1] = 1.0
        return Coefficients(L, zero[:, :, :1], G, zero, zero[:, :, :1], zero[:, 0, :1])

    for autonomous in (True, False):
        noise = integrate(coefficients, [0.0, 0.0], [1e-3, 5.0], autonomous).transition.noise
        assert noise[:, 0, 0] == pytest.approx(np.array([1e-3, 5.0]) ** 9 / (9 * 24**2), rel=1e-11)


def test_derivatives_pass_by_the_complex_step():
    step = 1e-150

    def coefficients(rate):
        def at_times(t, rows):
            c = system(2, True)(t, rows)
            return c._replace(matrix=c.matrix * np.cos(rate * t)[:, None, None])

        return at_times

    exact = integrate(coefficients(1.3 + 1j * step), [0.2], [1.1], False).transition
    above, below = (integrate(coefficients(1.3 + shift), [0.2], [1.1], False).transition for shift in (1e-5, -1e-5))
    for a, b, c in zip(exact, above, below, strict=True):
        assert a.imag / step == pytest.approx((b - c) / 2e-5, rel=1e-6, abs=1e-8)
