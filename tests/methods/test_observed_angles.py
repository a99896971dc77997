"""Angles that are observed: a record whose angle crosses half a turn has the posterior of one whose angle does not."""

import numpy as np
import pytest

import zakai

TIMES = np.cumsum(np.tile([0.2, 0.25, 0.3], 8))


def bearing(sensor, **keys):
    """A target that passes behind the sensor; bearings are counted from the positive or from the negative axis."""
    angle = "atan2(y, x)" if sensor == "front" else "atan2(-y, -x)"
    return zakai.Model(**{
        "state": ["x", "y"], "drift": ["0.1", "0.8"], "diffusion": [["0.3", "0"], ["0", "0.3"]],
        "observation": ["sqrt(x**2 + y**2)", angle], "observation_kind": "samples",
        "observation_noise": [["0.01", "0"], ["0", "0.0025"]],
        "prior": {"kind": "gaussian", "mean": [-5, -3], "cov": [[0.25, 0], [0, 0.25]]}, **keys,
    })  # fmt: skip


def turned(record):
    values = record.values.copy()
    values[:, 1] = np.angle(np.exp(1j * (values[:, 1] + np.pi)))
    return zakai.Record(record.times, values, "samples")


CASES = [
    ("yau-yau", {}),
    ("general-direct", {}),
    ("extended-kalman-bucy", {}),
    ("yau-yau", {"observation_family": ["gaussian", "student-t"], "degrees_of_freedom": "4"}),
]


@pytest.mark.parametrize(("method", "keys"), CASES)
def test_a_bearing_that_crosses_half_a_turn_changes_nothing(method, keys):
    front, back = bearing("front", **keys), bearing("back", **keys)
    _, record = zakai.simulate(front, TIMES, seed=1)
    assert record.values[:, 1].min() < -3 and record.values[:, 1].max() > 3
    found, expected = zakai.filter(front, record, method), zakai.filter(back, turned(record), method)
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=1e-9)
    assert np.allclose(found.cov, expected.cov, rtol=0, atol=1e-9)
    assert np.isclose(found.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-9)


def line(noise, **keys):
    return zakai.Model(**{
        "state": ["x"], "drift": ["-x/4"], "diffusion": [["2"]], "observation": ["x"], "observation_kind": "samples",
        "observation_noise": [[noise]], "prior": {"kind": "gaussian", "mean": [0], "cov": [[0.5]]}, **keys,
    })  # fmt: skip


@pytest.mark.parametrize("method", ["kalman-bucy", "limited-direct", "general-direct", "yau-yau", "extended-kalman-bucy"])
def test_a_precise_angle_is_that_of_the_record_without_turns(method):
    angle, number = line("1/50", observed_angles=["x"]), line("1/50")
    times = np.linspace(0.1, 6, 60)
    truth, record = zakai.simulate(angle, times, seed=2)
    path = truth.values[1:]
    assert np.abs(path).max() > np.pi  # or nothing is wrapped
    values = path + np.angle(np.exp(1j * (record.values - path)))
    expected = zakai.filter(number, zakai.Record(times, values, "samples"), "kalman-bucy")
    found = zakai.filter(angle, record, method)
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=2e-4)
    assert np.allclose(found.variance, expected.variance, rtol=0, atol=2e-4)
    assert np.isclose(found.log_likelihood, expected.log_likelihood, rtol=0, atol=2e-3)


def brute_force(record, variance):
    """The posterior mean and the evidence by sums over a fine grid and over images, for one state."""
    x = np.linspace(-14, 14, 3001)
    p = np.exp(-(x**2))
    p, total, previous = p / p.sum(), 0.0, 0.0
    for t, (z,) in zip(record.times, record.values, strict=True):
        a = np.exp(-(t - previous) / 4)
        kernel = np.exp(-((x[:, None] - a * x) ** 2) / (2 * 8 * (1 - a * a)))
        p = (kernel / kernel.sum(axis=0)) @ p
        images = (z - x)[:, None] + 2 * np.pi * np.arange(-9, 10)
        p = p * np.exp(-(images**2) / (2 * variance)).sum(axis=1) / np.sqrt(2 * np.pi * variance)
        total, previous, p = total + np.log(p.sum()), t, p / p.sum()
    return p @ x, total


# A Gaussian sum merges the images of a wide angle to few components.
@pytest.mark.parametrize(
    ("method", "error"), [("limited-direct", 1e-4), ("general-direct", 5e-2), ("yau-yau", 1e-4), ("auto", 1e-4)]
)
def test_a_wide_angle_has_the_sum_over_its_images(method, error):
    model = line("2", observed_angles=["x"])
    _, record = zakai.simulate(model, np.linspace(0.3, 4.5, 15), seed=5)
    mean, evidence = brute_force(record, 2.0)
    found = zakai.filter(model, record, method)
    assert np.isclose(found.mean[-1, 0], mean, rtol=0, atol=error)
    assert np.isclose(found.log_likelihood, evidence, rtol=0, atol=error)


@pytest.mark.parametrize("method", ["kalman-bucy", "extended-kalman-bucy", "ekf", "ukf", "enkf"])
def test_one_gaussian_warns_of_another_image(method):
    model, narrow = line("2", observed_angles=["x"]), line("1/50", observed_angles=["x"], diffusion=[["0.5"]])
    _, record = zakai.simulate(model, np.linspace(0.3, 4.5, 15), seed=5)
    assert any("another image" in words for words in zakai.filter(model, record, method).warnings)
    _, record = zakai.simulate(narrow, np.linspace(0.1, 1.5, 15), seed=5)
    assert not any("another image" in words for words in zakai.filter(narrow, record, method).warnings)


def test_smoothing_residuals_and_online_know_of_turns():
    angle, number = line("1/50", observed_angles=["x"]), line("1/50")
    times = np.linspace(0.1, 3, 30)
    truth, record = zakai.simulate(angle, times, seed=2)
    values = truth.values[1:] + np.angle(np.exp(1j * (record.values - truth.values[1:])))
    plain = zakai.Record(times, values, "samples")
    found, expected = zakai.smooth(angle, record, "kalman-bucy"), zakai.smooth(number, plain, "kalman-bucy")
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=1e-9)
    online = zakai.online(angle, "kalman-bucy")
    for t, z in zip(times, record.values, strict=True):
        last = online.update(t, z)
    assert np.array_equal(last.mean, zakai.filter(angle, record, "kalman-bucy").mean[-1])
    residuals = zakai.filter(angle, record, "yau-yau").residuals()
    # Counted from -pi: the integral of the predictive law over a turn that begins there.
    assert np.all((residuals > 0) & (residuals < 1))
    # An observation may be given with any number of turns.
    again = zakai.Record(times, record.values + 4 * np.pi, "samples")
    assert np.allclose(zakai.filter(angle, again, "yau-yau").mean, zakai.filter(angle, record, "yau-yau").mean, atol=1e-9)


def test_a_state_on_the_circle_may_be_observed_itself():
    model = zakai.Model(
        state=["a"], periodic=["a"], drift=["1"], diffusion=[["0.5"]], observation=["a"], observation_kind="samples",
        observation_noise=[["0.04"]], observed_angles=["a"], prior={"kind": "gaussian", "mean": [0], "cov": [[0.3]]},
    )  # fmt: skip
    truth, record = zakai.simulate(model, np.linspace(0.2, 8, 40), seed=3)
    result = zakai.filter(model, record)
    apart = np.angle(np.exp(1j * (result.mean - truth.values)))
    assert np.sqrt(np.mean(apart**2)) < 0.25
    assert not result.warnings
