"""Simulated paths with state-dependent noise, domains, inputs and correlated noise, against exact laws."""

import numpy as np
import pytest
from scipy import stats

import zakai
from zakai.errors import InputError
from zakai.simulation.simulate import simulate

SAMPLES = {"state": ["x"], "observation": ["x"], "observation_kind": "samples"}


def ends(model, count, initial, time):
    return np.array([simulate(model, [time], seed=1000 + s, initial=[initial])[0].values[-1, 0] for s in range(count)])


def test_cox_ingersoll_ross_has_its_exact_transition():
    model = zakai.load_model("gallery:cox-ingersoll-ross")
    a, b, s, x0, t = 1.0, 2.0, 1.0, 0.5, 1.0
    scale = s**2 * (1 - np.exp(-a * t)) / (4 * a)
    exact = stats.ncx2(4 * a * b / s**2, x0 * np.exp(-a * t) / scale, scale=scale)
    assert stats.kstest(ends(model, 900, x0, t), exact.cdf).pvalue > 1e-3


def test_geometric_brownian_motion_is_lognormal_and_stays_positive():
    model = zakai.load_model("gallery:geometric-brownian-motion").with_parameters(sigma=1.0)
    exact = stats.lognorm(1.0, scale=np.exp(0.05 - 0.5))
    assert stats.kstest(ends(model, 900, 1.0, 1.0), exact.cdf).pvalue > 1e-3
    # Steps that would leave the domain are halved.
    wild = model.with_parameters(sigma=3.0)
    assert (simulate(wild, np.arange(1, 200) * 0.2, seed=0, initial=[1.0], substeps=1)[0].values > 0).all()


def test_reflected_brownian_motion_is_uniform_in_the_long_run():
    model = zakai.Model(**SAMPLES, drift=["0"], domain={"x": {"lower": -1, "upper": 2, "boundary": "reflecting"}})
    truth, _ = simulate(model, np.arange(1, 600) * 4.0, seed=0, initial=[0.0], substeps=200)
    assert stats.kstest((truth.values[1:, 0] + 1) / 3, "uniform").pvalue > 1e-3


def test_a_path_that_leaves_a_natural_domain_is_an_error_that_says_why():
    model = zakai.Model(**SAMPLES, drift=["-1"], diffusion=[["0.1"]], domain={"x": {"lower": 0}})
    with pytest.raises(InputError, match='domain: the path leaves it at t = 1.1.*give boundary = "reflecting"'):
        simulate(model, [2.0], initial=[1.0])
    with pytest.raises(InputError, match="initial: x = -1 is outside of its domain"):
        simulate(model, [2.0], initial=[-1.0])


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_inputs_act_at_times_of_their_own(hold):
    model = zakai.Model(**SAMPLES, drift=["u"], process_noise=[["0"]], inputs=["u"], input_hold=hold)
    inputs = zakai.Inputs([0.0, 0.35, 0.7, 1.5], [1.0, -2.0, 4.0, 0.0])
    truth, record = simulate(model, [0.5, 1.0, 1.5], initial=[0.0], inputs=inputs, substeps=1 if hold == "zero" else 4000)
    exact = {"zero": [0.35 - 0.3, 0.35 - 0.7 + 1.2, 0.35 - 0.7 + 3.2], "linear": None}[hold]
    if exact is None:
        fine = np.linspace(0, 1.5, 150_001)
        slopes = np.interp((fine[1:] + fine[:-1]) / 2, inputs.times, inputs.values[:, 0])
        exact = np.interp([0.5, 1.0, 1.5], fine, np.append(0.0, np.cumsum(np.diff(fine) * slopes)))
    np.testing.assert_allclose(truth.values[1:, 0], exact, atol=1e-12 if hold == "zero" else 1e-3)
    assert record.inputs is inputs


def test_inputs_that_are_missing_or_too_short_are_named():
    model = zakai.load_model("gallery:heated-room")
    with pytest.raises(InputError, match="heater, outdoor of gallery:heated-room are missing"):
        simulate(model, [1.0])
    with pytest.raises(InputError, match="1 columns; gallery:heated-room has 2"):
        simulate(model, [1.0], inputs=zakai.Inputs([0.0], [1.0]))
    with pytest.raises(InputError, match="first time 0.5 is after the start 0"):
        simulate(model, [1.0], inputs=zakai.Inputs([0.5], [[1.0, 2.0]]))
    linear = zakai.Model(**SAMPLES, drift=["u"], inputs=["u"], input_hold="linear")
    with pytest.raises(InputError, match="last time 0.5 is before 1"):
        simulate(linear, [1.0], initial=[0.0], inputs=zakai.Inputs([0.0, 0.5], [1.0, 2.0]))


def test_correlated_noise_has_its_covariance_and_leaves_the_path_alone():
    keys = {"state": ["x"], "drift": ["0"], "observation": ["0"], "process_noise": [["2"]], "observation_noise": [["3"]]}
    times = np.arange(1, 40_001) * 1e-3
    truth, record = simulate(zakai.Model(**keys, cross_noise=[["-1.5"]]), times, seed=0, initial=[0.0], substeps=1)
    steps = np.column_stack([np.diff(truth.values[:, 0]), record.values[:, 0]])
    np.testing.assert_allclose(steps.T @ steps / times[-1], [[2, -1.5], [-1.5, 3]], rtol=0.05)
    assert np.array_equal(simulate(zakai.Model(**keys), times, seed=0, initial=[0.0], substeps=1)[0].values, truth.values)


def test_samples_come_from_the_family():
    model = zakai.Model(state=["x"], drift=["0"], process_noise=[["0"]], observation=["exp(x)"], observation_kind="samples",
                        observation_family="poisson")  # fmt: skip
    _, record = simulate(model, np.arange(20_000.0), seed=1, initial=[0.5], substeps=1)
    assert record.values.mean() == pytest.approx(np.exp(0.5), rel=0.04) == record.values.var()
    assert (record.values == np.floor(record.values)).all()
