"""Coefficients that do much within an interval: seen, or said not to be."""

import numpy as np
import pytest

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


@pytest.mark.slow
def test_a_short_pulse_of_noise_in_a_long_interval_is_not_missed():
    record = zakai.Record([10.0, 20.0], [[1.0], [2.0]], "samples")
    result = zakai.filter(walk("1/100 + 100*exp(-10000*(t - 5.3)**2)"), record)
    predicted = 1 + 0.1 + np.sqrt(np.pi)
    first = predicted / (predicted + 1)
    second = (first + 0.1) / (first + 1.1)
    assert result.variance[1:, 0] == pytest.approx([first, second], rel=1e-12) and not result.warnings


def test_a_flow_that_is_not_resolved_is_said_to_be():
    record = zakai.Record([10.0], [[1.0]], "samples")
    result = zakai.filter(walk("1/((t - 5)**2 + 1e-9)"), record)
    assert "the coefficients vary so fast within an interval" in result.warnings[0]


def test_noise_that_is_none_between_the_readings_is_refused():
    record = zakai.Record([1.0, 2.0], [[np.nan], [np.nan]], "samples")
    with pytest.raises(zakai.errors.InputError, match="process_noise: is not positive semidefinite at t = 0"):
        zakai.filter(walk("cos(2*pi*t) - 1/5"), record)
    # Of samples the noise is asked for at their times alone.
    zakai.filter(walk("1", read="cos(2*pi*t)"), record)
    increments = zakai.Record([1.0, 2.0], [[0.1], [0.2]], "increments")
    with pytest.raises(zakai.errors.InputError, match="observation_noise: is not positive definite at t = 0"):
        zakai.filter(walk("1", "increments", "cos(2*pi*t)"), increments)
