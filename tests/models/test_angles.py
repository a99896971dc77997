"""Observed angles in a model: which observations are angles, and the law of an angle."""

import numpy as np
import pytest
import scipy.stats

import zakai
from zakai.models.angles import observed_angles


def model(**keys):
    base = {"state": ["x", "y"], "drift": ["0", "0"], "observation": ["atan2(y, x)", "x"], "observation_kind": "samples"}
    return zakai.Model(**{**base, **keys})


def test_a_sample_of_atan2_is_an_angle_and_others_are_named():
    assert observed_angles(model()) == (True, False)
    assert observed_angles(model(observed_angles=["x"])) == (True, True)
    named = model(observation_names=["bearing", "position"], observed_angles=["position"])
    assert observed_angles(named) == (True, True)
    assert observed_angles(model(observation=["atan2(y, x) - x/2", "1 - atan2(y, x)"])) == (True, True)
    assert observed_angles(model(observation=["atan2(y, x)/2", "sin(atan2(y, x))"])) == (False, False)
    assert observed_angles(model(observation_kind="increments")) == (False, False)
    assert observed_angles(model(observation_family=["von-mises", "gaussian"], concentration="4")) == (False, False)


def test_names_of_observations_are_the_state_or_numbered():
    assert model().observation_names == ("y1", "x")
    clash = model(observation=["sin(x)", "y1"], state=["x", "y1"])
    assert clash.observation_names == ("y1", "y2")
    assert model(observation_names=["bearing", "position"]).observation_names == ("bearing", "position")


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"observed_angles": ["z"]}, "observed_angles: 'z' is no observation.*the observations are y1, x"),
        ({"observed_angles": ["x"], "observation_kind": "increments"}, "observed_angles: is for samples"),
        ({"observed_angles": ["x"], "observation_family": ["gaussian", "poisson"]}, "'x' has the family poisson"),
        ({"observation_names": ["a"]}, "observation_names: expected a list of 2 names"),
        ({"observation_noise": [["1", "1/9"], ["1/9", "1"]]}, r"observation_noise: \[0\]\[1\]: correlates an angle"),
    ],
)
def test_what_is_no_angle_is_an_error_in_one_line(keys, says):
    with pytest.raises(zakai.InputError, match=says):
        model(**keys)


def test_the_keys_survive_a_model_file(tmp_path):
    first = model(observation_names=["bearing", "position"], observed_angles=["position"])
    path = tmp_path / "model.toml"
    path.write_text(first.to_toml())
    second = zakai.load_model(path)
    assert observed_angles(second) == (True, True)
    assert second.observation_names == ("bearing", "position")


@pytest.mark.parametrize("variance", [0.01, 0.5, 3.0, 4.5, 40.0])
@pytest.mark.parametrize("freedom", [None, 1.0, 4.0])
def test_the_law_of_an_angle_is_the_sum_over_its_images(variance, freedom):
    family = {} if freedom is None else {"observation_family": "student-t", "degrees_of_freedom": freedom}
    angle = zakai.Model(
        state=["x"], drift=["0"], observation=["x"], observation_kind="samples", observation_noise=[[variance]],
        observed_angles=["x"], **family,
    )  # fmt: skip
    z, x = np.array([[-3.0], [0.2], [3.1], [9.0]]), np.array([[2.9], [0.1], [-3.1], [-30.0]])
    turns = 2 * np.pi * np.arange(-40_000, 40_001)
    law = scipy.stats.norm if freedom is None else scipy.stats.t(freedom)
    apart = ((z - x) + turns) / np.sqrt(variance)
    expected = np.log(np.sum(law.pdf(apart) / np.sqrt(variance), axis=1))
    found = angle.observation_law.log_density(z, x, 0.0, angle.theta())
    assert np.allclose(found, expected, rtol=0, atol=3e-5)
    # The distribution function is the integral of the density from -pi.
    grid = np.linspace(-np.pi, np.pi, 20_001)
    density = np.exp(angle.observation_law.log_density(grid[:, None], np.full((20_001, 1), 2.9), 0.0, angle.theta()))
    total = scipy.integrate.cumulative_trapezoid(density, grid, initial=0.0)
    assert np.isclose(total[-1], 1.0, atol=1e-5)
    below, upto = angle.observation_law.cdf(grid[:, None], np.full((20_001, 1), 2.9), 0.0, angle.theta())
    assert np.allclose(below[1:, 0], total[1:], rtol=0, atol=2e-4)  # -pi itself is the angle pi
    assert np.array_equal(below, upto)


def test_derivatives_of_the_law_of_an_angle_are_those_of_differences():
    angle = zakai.Model(
        state=["x"], drift=["0"], observation=["a*x"], observation_kind="samples", observation_noise=[["b"]],
        observed_angles=["y1"], observation_family="student-t", degrees_of_freedom="c", parameters={"a": 1.3, "b": 0.8, "c": 1.5},
    )  # fmt: skip
    z, x, theta = np.array([2.0]), np.array([[-2.5], [0.4]]), angle.theta()
    for i in range(3):
        step = np.zeros(3)
        step[i] = 1e-6
        values = [angle.observation_law.log_density(z, x, 0.0, theta + sign * step) for sign in (1, -1)]
        slope = angle.observation_law.log_density(z, x, 0.0, theta + 1e-30j * step / 1e-6).imag / 1e-30
        assert np.allclose(slope, (values[0] - values[1]) / 2e-6, rtol=1e-5)


def test_simulated_angles_lie_in_a_turn():
    angle = model(prior={"kind": "gaussian", "mean": [-3.0, 0.0], "cov": [[0.1, 0], [0, 0.1]]})
    truth, record = zakai.simulate(angle, np.linspace(0.1, 2, 200), seed=1)
    bearing = record.values[:, 0]
    assert np.all((bearing > -np.pi) & (bearing <= np.pi))
    apart = bearing - np.arctan2(truth.values[1:, 1], truth.values[1:, 0])
    spread = np.std(np.angle(np.exp(1j * apart)))
    assert 0.8 < spread < 1.2
