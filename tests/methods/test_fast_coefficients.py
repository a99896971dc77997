"""Coefficients that vary within an interval are integrated, or a warning says that they are not."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import zakai


def walk(noise, kind="samples", read="1"):
    return zakai.Model(
        state=["x"],
        drift=["0"],
        observation=["x"],
        process_noise=[[noise]],
        observation_kind=kind,
        observation_noise=[[read]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1.0]]},
    )


def test_a_short_pulse_of_noise_in_a_long_interval_is_not_missed():
    record = zakai.Record([10.0, 20.0], [[1.0], [2.0]], "samples")
    result = zakai.filter(walk("1/100 + 100*exp(-10000*(t - 5.3)**2)"), record)
    predicted = 1 + 0.1 + np.sqrt(np.pi)
    first = predicted / (predicted + 1)
    second = (first + 0.1) / (first + 1.1)
    assert result.variance[1:, 0] == pytest.approx([first, second], rel=1e-12) and not result.warnings


def test_a_flow_that_is_not_resolved_is_reported():
    record = zakai.Record([10.0], [[1.0]], "samples")
    result = zakai.filter(walk("2 + sin(1000000*t)"), record)
    assert "the coefficients vary so fast within an interval" in result.warnings[0]


def test_a_narrow_peak_of_noise_is_integrated():
    record = zakai.Record([10.0], [[1.0]], "samples")
    result = zakai.filter(walk("1/((t - 5)**2 + 1e-9)"), record)
    predicted = 1 + 2 * np.sqrt(1e9) * np.arctan(5 * np.sqrt(1e9))
    assert result.variance[1, 0] == pytest.approx(predicted / (predicted + 1), rel=1e-12) and not result.warnings


NOISES = {"wave": (1.0, 0.9, 50.0), "slower wave": (0.2, 0.15, 62.8)}


@pytest.mark.parametrize("length", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("name", NOISES)
def test_an_oscillating_noise_of_increments_is_integrated(name, length):
    """S = a + b sin(w t): the equations of Kalman and Bucy with y linear between observations, by SciPy."""
    a, b, w = NOISES[name]
    model = zakai.Model(
        state=["x"],
        drift=["-x/2"],
        observation=["2*x + 1/3"],
        observation_noise=[[f"{a} + {b}*sin({w}*t)"]],
        prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.7]]},
    )
    increments = length * np.array([0.6, -0.3, 1.2])
    result = zakai.filter(model, zakai.Record(length * np.arange(1, 4), increments[:, None], "increments"), "kalman-bucy")

    state = np.array([0.4, 0.7, 0.0])
    for k, dy in enumerate(increments):

        def slope(t, z, rate=dy / length):
            m, P, _ = z
            S, h = a + b * np.sin(w * t), 2 * m + 1 / 3
            return [-m / 2 + 2 * P / S * (rate - h), -P + 1 - 4 * P**2 / S, (h * rate - (h**2 + 4 * P) / 2) / S]

        ends = (k * length, (k + 1) * length)
        state = solve_ivp(slope, ends, state, method="DOP853", rtol=1e-12, atol=1e-13, max_step=0.01).y[:, -1]
        assert [result.mean[k + 1, 0], result.variance[k + 1, 0]] == pytest.approx(state[:2], abs=1e-10)
    assert result.log_likelihood == pytest.approx(state[2], abs=1e-10)


def test_noise_that_is_none_between_the_observations_is_refused():
    record = zakai.Record([1.0, 2.0], [[np.nan], [np.nan]], "samples")
    with pytest.raises(zakai.errors.InputError, match="process_noise: is not positive semidefinite at t = 0"):
        zakai.filter(walk("cos(2*pi*t) - 1/5"), record)
    # The noise of samples is needed at their times only.
    zakai.filter(walk("1", read="cos(2*pi*t)"), record)
    increments = zakai.Record([1.0, 2.0], [[0.1], [0.2]], "increments")
    with pytest.raises(zakai.errors.InputError, match="observation_noise: is not positive definite at t = 0"):
        zakai.filter(walk("1", "increments", "cos(2*pi*t)"), increments)
