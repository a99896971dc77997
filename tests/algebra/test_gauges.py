"""The gauge e^phi of an exact filter, however the drift is written."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.algebra.gauges import affine_system, gauge

# Each is tanh x, or tanh of another argument, as a quotient; with its own F of which F' is the drift.
QUOTIENTS = {
    "(exp(x) - exp(-x))/(exp(x) + exp(-x))": lambda x: np.log(np.cosh(x)),
    "(exp(2*x) - 1)/(exp(2*x) + 1)": lambda x: np.log(np.cosh(x)),
    "1 - 2/(1 + exp(2*x))": lambda x: np.log(np.cosh(x)),
    "(2*exp(x) - 3*exp(-x))/(2*exp(x) + 3*exp(-x))": lambda x: np.log(2 * np.exp(x) + 3 * np.exp(-x)),
    "sinh(2*x)/(1 + cosh(2*x))": lambda x: np.log(np.cosh(x)),
    "(a*exp(a*x) - a*exp(-a*x))/(exp(a*x) + exp(-a*x))": lambda x: np.log(np.cosh(0.7 * x)),
}


def model(drift):
    prior = {"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]}
    return zakai.Model(state=["x"], drift=[drift], observation=["x"], parameters={"a": 0.7}, prior=prior)


@pytest.mark.parametrize("drift", QUOTIENTS)
def test_a_quotient_of_exponentials_is_a_sum_of_two_exponentials(drift):
    system = model(drift)
    form = gauge(system)
    assert form is not None and form.is_log_cosh
    values = {system.parameter_symbols[0]: 0.7}
    slopes, logs = (np.array(part.subs(values), float)[:, 0] for part in (form.slopes, form.logs))
    offset = float(affine_system(system)[0].offset[0].subs(values))
    x = np.linspace(-2, 2, 9)
    found = np.log(np.exp(np.outer(x, slopes)) @ np.exp(logs)) + offset * x
    difference = found - QUOTIENTS[drift](x)
    assert difference == pytest.approx(np.full(9, difference[0]), abs=1e-12)


def test_a_power_that_is_not_whole_is_no_sum_of_exponentials():
    form = gauge(model("(exp(x) - exp(-x))/(exp(x) + exp(-x))/2"))
    assert form is None or form.slopes is None


def test_a_drift_written_as_a_quotient_is_filtered_as_the_same():
    record = zakai.Record([0.1, 0.3], [[0.2], [-0.1]], "increments")
    results = [zakai.filter(model(drift), record) for drift in ("tanh(x)", "1 - 2/(1 + exp(2*x))")]
    assert [result.method for result in results] == ["benes", "benes"]
    assert results[0].mean == pytest.approx(results[1].mean, abs=1e-12)
    assert results[0].cov == pytest.approx(results[1].cov, abs=1e-12)
    assert results[0].log_likelihood == pytest.approx(results[1].log_likelihood, abs=1e-12)


# tanh(x + delta(t)) - delta'(t): v obeys the equation of delta = 0 in x + delta, and h = x + delta is what is read.
SHIFTS = {
    "tanh(x + sin(t)) - cos(t)": (0.0, np.sin, "sin(t)"),
    "tanh(x + t**2) - 2*t": (0.0, lambda t: t**2, "t**2"),
    "tanh(x + t) - 1": (750.0, lambda t: t, "t"),
    "tanh(x + cosh(t)) - sinh(t)": (0.0, np.cosh, "cosh(t)"),
}


@pytest.mark.parametrize("drift", SHIFTS)
def test_a_shift_in_time_of_any_size_is_the_filter_of_the_state_at_rest(drift):
    start, delta, word = SHIFTS[drift]
    times, dy = np.array([0.1, 0.3]), [[0.2], [-0.1]]
    rest = zakai.filter(model("tanh(x)"), zakai.Record(times, dy, "increments"))
    moving = zakai.Model(
        state=["x"],
        drift=[drift],
        observation=[f"x + {word}"],
        start=start,
        prior={"kind": "gaussian", "mean": [0.3 - delta(start)], "cov": [[0.5]]},
    )
    result = zakai.filter(moving, zakai.Record(start + times, dy, "increments"))
    assert result.method == "benes" and not result.warnings
    assert result.mean[:, 0] + delta(start + np.append(0.0, times)) == pytest.approx(rest.mean[:, 0], abs=1e-8)
    assert result.variance == pytest.approx(rest.variance, abs=1e-8)
    assert result.log_likelihood == pytest.approx(rest.log_likelihood, abs=1e-8)
