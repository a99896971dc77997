"""Gaussian sums of models with inputs, tables, kinks and log densities: against dense Bayes and Kalman filters in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from methods.test_line_features import TIMES, dense, error, model_of, normal, samples

LENGTHS = np.diff(TIMES, prepend=0.0)
INPUTS = zakai.Inputs([0.0, 0.07, 0.2, 0.61, 1.3, 1.8], [1.0, -2.0, 3.0, 0.0, 2.0, -1.0])
VALUES = [0.3, -0.6, 0.02, 0.7, -0.4, 0.9, 0.0]


def held(t, hold, before=False):
    times, column = INPUTS.times, INPUTS.values[:, 0]
    if hold == "linear":
        return float(np.interp(t, times, column))
    return float(column[np.searchsorted(times, t, side="left" if before else "right") - 1])


def kalman(hold, kind):
    """Runge and Kutta's method between the cuts, for f = -x + u, g = 1 + u/10, h = 2 x + u, S = 0.1."""
    m, P, rows, last, observed = 0.2, 0.5, [], 0.0, kind != "samples"
    for time, value in zip(TIMES, VALUES, strict=True):
        cuts = np.unique([last, time, *INPUTS.times[(INPUTS.times > last) & (INPUTS.times < time)]])
        evidence, rate = 0.0, value / (time - last)
        for a, b in zip(cuts[:-1], cuts[1:], strict=True):

            def slope(t, y, a=a, b=b, rate=rate):
                u = held(min(max(t, a), np.nextafter(b, a)), hold)
                h, gain = 2 * y[0] + u, observed * 20 * y[1]
                gained = observed * (h * rate - 0.5 * (h * h + 4 * y[1])) / 0.1
                return np.array([u - y[0] + gain * (rate - h), (1 + u / 10) ** 2 - 2 * y[1] - 0.1 * gain**2, gained])

            y, step = np.array([m, P, evidence]), (b - a) / 100
            for t in a + step * np.arange(100):
                one = slope(t, y)
                two = slope(t + step / 2, y + step / 2 * one)
                three = slope(t + step / 2, y + step / 2 * two)
                y = y + step / 6 * (one + 2 * two + 2 * three + slope(t + step, y + step * three))
            m, P, evidence = y
        if kind == "samples":
            spread, away = 4 * P + 0.1, value - 2 * m - held(time, hold)
            evidence = -0.5 * away**2 / spread - 0.5 * np.log(2 * np.pi * spread)
            m, P = m + 2 * P / spread * away, P * 0.1 / spread
        rows.append((m, P, evidence))
        last = time
    return np.array(rows)


def estimated(result):
    return max(np.nanmax(result.health[figure]) for figure in ("mean_error", "deviation_error", "evidence_error"))


@pytest.mark.parametrize("kind", ["samples", "increments"])
@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_inputs_of_a_linear_system_are_those_of_the_kalman_filter(hold, kind):
    keys = {"diffusion": [["1 + u/10"]], "observation_noise": [["0.1"]], "inputs": ["u"], "input_hold": hold}
    model = model_of("-x + u", "2*x + u", observation_kind=kind, **keys)
    record = zakai.Record(TIMES, np.array(VALUES)[:, None], kind, INPUTS)
    assert error(zakai.filter(model, record, "gaussian-sum"), kalman(hold, kind)) < 1e-6


def test_inputs_of_a_nonlinear_observation_are_those_of_dense_bayes():
    model = model_of("-x + u", "tanh(x + u/4)", inputs=["u"], observation_noise=[["0.1 + u**2/50"]])
    result = zakai.filter(model, samples(TIMES, VALUES, INPUTS), "gaussian-sum")
    ends = np.unique([*TIMES, *INPUTS.times[(INPUTS.times > 0) & (INPUTS.times < TIMES[-1])]])
    starts = np.concatenate([[0.0], ends[:-1]])

    def likelihood(t):
        if t not in TIMES:
            return lambda x: np.ones(len(x))
        u, z = held(t, "zero"), VALUES[list(TIMES).index(t)]
        return lambda x: normal(np.tanh(x + u / 4), 0.1 + u**2 / 50)(z)

    x = np.linspace(-6, 6, 241)
    rows = dense(
        x, lambda k: -x + held(starts[k], "zero"), np.ones(len(x)), [likelihood(t) for t in ends], ends - starts, normal(0.2, 0.5)
    )
    last = np.searchsorted(ends, TIMES)
    rows[:, 2] = np.cumsum(rows[:, 2])
    expected = rows[last]
    expected[:, 2] = np.diff(expected[:, 2], prepend=0.0)
    assert error(result, expected) < min(0.08, 10 * estimated(result)) and not result.warnings


POINTS = np.array([-4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 4.0])
LEVELS = np.array([-1.5, -1.2, -0.8, 0.1, 0.7, 1.2, 1.4])
TABLE = {"depth": {"x": POINTS.tolist(), "values": LEVELS.tolist()}}
LAWS = {
    "a table": (
        {"observation": "depth(x)", "tables": TABLE, "observation_noise": [["0.1"]]},
        lambda z: lambda x: normal(np.interp(x, POINTS, LEVELS), 0.1)(z),
    ),
    "a kink": (
        {"observation": "min(x, 2*x)", "observation_noise": [["0.1"]]}, lambda z: lambda x: normal(np.minimum(x, 2 * x), 0.1)(z)
    ),
    "two modes": (
        {"observation": None, "observation_log_density": "log(exp(-2*(z - x)**2) + exp(-2*(z + x)**2)) - log(2*pi)/2",
         "observed": ["z"]},
        lambda z: lambda x: (np.exp(-2 * (z - x) ** 2) + np.exp(-2 * (z + x) ** 2)) / np.sqrt(2 * np.pi),
    ),
    "Laplace": (
        {"observation": None, "observation_log_density": "-3*abs(z - x) + log(1.5)", "observed": ["z"]},
        lambda z: lambda x: 1.5 * np.exp(-3 * np.abs(z - x)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
def test_the_error_of_a_law_is_within_ten_times_its_estimate(name):
    keys, law = LAWS[name]
    result = zakai.filter(model_of(**keys), samples(TIMES, VALUES), "gaussian-sum")
    x = np.linspace(-6, 6, 481)
    expected = dense(x, -x, np.ones(len(x)), [law(z) for z in VALUES], LENGTHS, normal(0.2, 0.5))
    assert error(result, expected) < min(0.05, 10 * estimated(result))


def test_a_density_that_its_parts_do_not_integrate_warns():
    keys = {"observation": None, "observation_log_density": "-((z - x)/0.04)**4 - log(0.072512)", "observed": ["z"]}
    result = zakai.filter(model_of(**keys), samples(TIMES, VALUES), "gaussian-sum")
    x = np.linspace(-5, 5, 1001)
    likelihoods = [lambda x, z=z: np.exp(-(((z - x) / 0.04) ** 4)) / 0.072512 for z in VALUES]
    expected = dense(x, -x, np.ones(len(x)), likelihoods, LENGTHS, normal(0.2, 0.5))
    assert error(result, expected) > 0.05 and any("quadrature" in warning for warning in result.warnings)


def test_a_table_of_another_state_far_from_the_origin_counts():
    table = {"depth": {"x": [100.0, 150.0, 200.0], "values": [0.0, 5.0, 30.0]}}
    prior = {"kind": "gaussian", "mean": [0.0, 150.0], "cov": [[1e-6, 0.0], [0.0, 100.0]]}
    keys = {"observation_kind": "samples", "observation_noise": [["0.1"]], "tables": table, "prior": prior}
    model = zakai.Model(state=["a", "x"], drift=["0", "0"], observation=["a + depth(x)"], **keys)
    result = zakai.filter(model, samples([0.1], [7.0]), "gaussian-sum")
    assert result.mean[1, 1] == pytest.approx(154.0, abs=0.1)
    beyond = zakai.filter(model, samples([0.1], [29.9]), "gaussian-sum")
    assert any("outside_tables" in warning for warning in beyond.warnings)


REFUSED = {
    "an input in phi": ({"drift": "u*tanh(x)", "inputs": ["u"]}, "phi would depend on the input u"),
    "an input in the energy of increments": (
        {"drift": "0", "observation": "u*abs(x)", "inputs": ["u"], "observation_kind": "increments"},
        "increments depend on inputs",
    ),
    "a table in f": ({"drift": "-x + depth(x)", "tables": TABLE}, "what a sample depends on"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_hold_is_refused_with_another_method(name):
    keys, words = REFUSED[name]
    model = model_of(**keys)
    record = zakai.Record([0.1], [[0.1]], model.observation_kind, INPUTS if model.inputs else None)
    with pytest.raises(zakai.ConditionError, match=words) as caught:
        zakai.filter(model, record, "gaussian-sum")
    assert "yau-yau holds" in str(caught.value).splitlines()[1]
