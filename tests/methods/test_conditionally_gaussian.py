"""Coefficients that depend on what is observed: the filter of Liptser and Shiryaev, against their equations in small steps."""

import numpy as np
import pytest

import zakai

ONE = {
    "state": ["x"], "drift": ["-x + y"], "diffusion": [["0.4*(1 + y**2/5)"]], "observation": ["x*(1 + y**2/9)"],
    "observed": ["y"], "observation_noise": [["0.1*(1 + y**2/8)"]], "prior": {"kind": "gaussian", "mean": [0.5], "cov": [[0.3]]},
}  # fmt: skip
TWO = {
    "state": ["x", "v"], "drift": ["v + sin(z)", "-x*y - v/2 + u"], "diffusion": [["0.2", "0"], ["y/3", "0.5"]],
    "process_noise": [["1", "0.2"], ["0.2", "1"]],
    "observation": ["x + y*v/2", "v*cos(y) - x*z/3 + t/5"], "observed": ["y", "z"],
    "observation_noise": [["0.2 + z**2/20", "0.02*y"], ["0.02*y", "0.3"]],
    "cross_noise": [["0.05", "0.02*z"], ["0.06*cos(z)", "0.1"]],
    "inputs": ["u"], "prior": {"kind": "gaussian", "mean": [0.5, -0.2], "cov": [[0.3, 0.1], [0.1, 0.4]]},
}  # fmt: skip
INPUTS = zakai.Inputs([0.0, 0.37, 0.81], [[1.0], [-2.0], [0.5]])


def coefficients_of_one(t, u, y):
    y = y[0]
    g = np.array([[0.4 * (1 + y**2 / 5)]])
    return (
        np.array([[-1.0]]), np.array([y]), g, np.eye(1), np.array([[1 + y**2 / 9]]), np.zeros(1),
        np.array([[0.1 * (1 + y**2 / 8)]]), np.zeros((1, 1)),
    )  # fmt: skip


def coefficients_of_two(t, u, path):
    y, z = path
    return (
        np.array([[0, 1], [-y, -0.5]]), np.array([np.sin(z), u]), np.array([[0.2, 0], [y / 3, 0.5]]),
        np.array([[1, 0.2], [0.2, 1]]), np.array([[1, y / 2], [-z / 3, np.cos(y)]]), np.array([0, t / 5]),
        np.array([[0.2 + z**2 / 20, 0.02 * y], [0.02 * y, 0.3]]), np.array([[0.05, 0.02 * z], [0.06 * np.cos(z), 0.1]]),
    )  # fmt: skip


def known(t):
    return float(INPUTS.values[np.searchsorted(INPUTS.times, t, "right") - 1, 0])


def small_steps(coefficients, times, increments, mean, cov):
    """Liptser and Shiryaev's equations by Euler's method, of first order in the steps."""
    t, y, total = 0.0, np.zeros(increments.shape[1]), 0.0
    for stop, dy in zip(times, increments, strict=True):
        d = stop - t
        L, l, g, Q, C, c, S, N = coefficients(t, known(t), y)
        K = (cov @ C.T + g @ N) @ np.linalg.inv(S)
        h = C @ mean + c
        total += h @ np.linalg.solve(S, dy) - 0.5 * d * h @ np.linalg.solve(S, h)
        mean = mean + (L @ mean + l) * d + K @ (dy - h * d)
        cov = cov + (L @ cov + cov @ L.T + g @ Q @ g.T - K @ S @ K.T) * d
        t, y = stop, y + dy
    return mean, cov, total


def path_of(keys, count, seed):
    model = zakai.Model(**keys)
    fine = np.linspace(1.0 / count, 1.0, count)
    _, record = zakai.simulate(model, fine, seed=seed, substeps=1, inputs=INPUTS if model.inputs else None)
    return model, fine, record.values


def coarse(model, fine, increments, every):
    path = np.cumsum(increments, axis=0)[every - 1 :: every]
    inputs = INPUTS if model.inputs else None
    values = np.diff(np.concatenate([np.zeros((1, model.m)), path]), axis=0)
    return zakai.Record(fine[every - 1 :: every], values, "increments", inputs)


@pytest.mark.parametrize(("keys", "coefficients"), [(ONE, coefficients_of_one), (TWO, coefficients_of_two)])
def test_it_is_the_filter_of_liptser_and_shiryaev(keys, coefficients):
    model, fine, increments = path_of(keys, 40_000, seed=3)
    prior = keys["prior"]
    mean, cov, total = small_steps(coefficients, fine, increments, np.array(prior["mean"]), np.array(prior["cov"]))
    result = zakai.filter(model, coarse(model, fine, increments, 100))
    assert result.method == "conditionally-gaussian"
    deviations = np.sqrt(np.diagonal(cov))
    assert np.all(np.abs(result.mean[-1] - mean) < 0.01 * deviations)
    assert np.allclose(result.cov[-1], cov, rtol=0, atol=0.01 * cov.max())
    assert abs(result.log_likelihood - total) < 0.05
    assert not result.error_estimate.any()
    # The error falls with the length of the intervals.
    rough = zakai.filter(model, coarse(model, fine, increments, 2000))
    assert np.abs(rough.mean[-1] - mean).max() > np.abs(result.mean[-1] - mean).max()


def test_a_particle_filter_of_the_same_path_agrees():
    model, fine, increments = path_of({**ONE, "observation_noise": [["0.1"]]}, 500, seed=8)
    rng = np.random.default_rng(1)
    x, weights, y, d = rng.normal(0.5, np.sqrt(0.3), 40_000), np.zeros(40_000), 0.0, fine[0]
    for (dy,) in increments:
        h = x * (1 + y**2 / 9)
        weights += (h * dy - 0.5 * h**2 * d) / 0.1
        x = x + (-x + y) * d + 0.4 * (1 + y**2 / 5) * np.sqrt(d) * rng.normal(size=len(x))
        y += dy
    shares = np.exp(weights - weights.max())
    shares /= shares.sum()
    result = zakai.filter(model, zakai.Record(fine, increments, "increments"))
    assert np.isclose(result.mean[-1, 0], shares @ x, atol=0.03 * np.sqrt(result.variance[-1, 0]))
    assert np.isclose(result.log_likelihood, np.log(np.mean(np.exp(weights))), atol=0.05)


@pytest.mark.parametrize("kind", ["increments", "path", "rates"])
@pytest.mark.parametrize("keys", [ONE, TWO])
def test_record_online_batch_and_restart_agree_to_the_bit(keys, kind, tmp_path):
    model = zakai.Model(**{**keys, "observation_kind": kind})
    times = np.cumsum(np.tile([0.02, 0.05, 0.01], 8))
    inputs = INPUTS if model.inputs else None
    _, record = zakai.simulate(model, times, seed=2, inputs=inputs)
    whole = zakai.filter(model, record)
    assert all(np.array_equal(one.mean, whole.mean) for one in zakai.filter(model, [record, record]))
    online = zakai.online(model)
    for k, (t, row) in enumerate(zip(record.times, record.values, strict=True)):
        if k == 12:
            online.save(tmp_path / "state")
            online = zakai.online(model)
            online.restore(tmp_path / "state")
        estimate = online.update(t, row, **({} if inputs is None else {"inputs": inputs}))
        assert np.array_equal(estimate.mean, whole.mean[k + 1]), k
        assert np.array_equal(estimate.cov, whole.cov[k + 1])


def test_without_dependence_on_the_path_it_is_the_kalman_bucy_filter():
    linear = {**ONE, "drift": ["-x"], "diffusion": [["0.4"]], "observation": ["x"], "observation_noise": [["0.1"]]}
    plain = zakai.Model(**linear)
    _, record = zakai.simulate(plain, np.linspace(0.05, 1, 20), seed=1)
    assert zakai.filter(plain, record).method == "kalman-bucy"
    almost = zakai.Model(**{**linear, "drift": ["-x + y/10**12"]})
    found, expected = zakai.filter(almost, record), zakai.filter(plain, record)
    assert found.method == "conditionally-gaussian"
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=1e-9)
    assert np.isclose(found.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-9)


def test_smoothing_and_draws_use_the_path():
    model = zakai.Model(**ONE)
    _, record = zakai.simulate(model, np.linspace(0.02, 1, 50), seed=1)
    smoothed, filtered = zakai.smooth(model, record), zakai.filter(model, record)
    assert np.allclose(smoothed.mean[-1], filtered.mean[-1], rtol=0, atol=1e-9)
    assert np.all(smoothed.variance[:-1] < filtered.variance[:-1] + 1e-12)
    draws = smoothed.sample_paths(4000, seed=1)
    assert np.allclose(draws.mean(axis=0), smoothed.mean, rtol=0, atol=0.06)
    assert np.isclose(np.var(draws[:, 20, 0]), smoothed.variance[20, 0], rtol=0.1)


def test_a_mixture_stays_exact():
    mixture = {"kind": "mixture", "weights": [0.3, 0.7], "means": [[-1.0], [1.0]], "covs": [[[0.2]], [[0.3]]]}
    model = zakai.Model(**{**ONE, "prior": mixture})
    _, record = zakai.simulate(model, np.linspace(0.02, 1, 50), seed=1)
    parts = [
        zakai.filter(zakai.Model(**{**ONE, "prior": {"kind": "gaussian", "mean": mean, "cov": cov}}), record)
        for mean, cov in zip(mixture["means"], mixture["covs"], strict=True)
    ]
    shares = np.array([0.3, 0.7]) * np.exp([part.log_likelihood for part in parts])
    result = zakai.filter(model, record)
    assert np.isclose(result.log_likelihood, np.log(shares.sum()), rtol=0, atol=1e-8)
    mean = sum(share * part.mean[-1] for share, part in zip(shares / shares.sum(), parts, strict=True))
    assert np.allclose(result.mean[-1], mean, rtol=0, atol=1e-8)


def test_derivatives_are_those_of_differences():
    noise, parameters = [["b*(1 + y**2/8)"]], {"a": 1, "b": 0.1}
    model = zakai.Model(**{**ONE, "drift": ["-a*x + y"], "observation_noise": noise, "parameters": parameters})
    _, record = zakai.simulate(model, np.linspace(0.02, 1, 50), seed=1)
    function, theta = zakai.log_likelihood(model, record), model.theta()
    _, slope = function.value_and_gradient(theta)
    for i, step in enumerate(np.diag(1e-5 * theta)):
        difference = (function.value_and_gradient(theta + step)[0] - function.value_and_gradient(theta - step)[0]) / (2 * step[i])
        assert np.isclose(slope[i], difference, rtol=1e-5)


@pytest.mark.parametrize("method", ["kalman-bucy", "yau-yau", "extended-kalman-bucy", "general-direct", "particle"])
def test_other_methods_refuse_and_name_it(method):
    model = zakai.Model(**ONE)
    with pytest.raises(zakai.ConditionError, match="conditionally-gaussian"):
        zakai.filter(model, zakai.Record([0.1], [[0.1]], "increments"), method)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"drift": ["-x**3 + y"]}, "f is affine in x given the path"),
        ({"observation": ["sin(x)*y"]}, "h is affine in x given the path"),
        ({"diffusion": [["x*y"]]}, "g does not depend on the state|do not depend on x"),
    ],
)
def test_what_is_not_conditionally_gaussian_says_what_fails(keys, words):
    model = zakai.Model(**{**ONE, **keys})
    with pytest.raises(zakai.ConditionError, match=words):
        zakai.filter(model, zakai.Record([0.1], [[0.1]], "increments"), "conditionally-gaussian")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"observation_kind": "samples"}, "observed: goes with observation_log_density; samples have no value between"),
        ({"observed": ["y", "z"]}, r"observed: expected 1 names \(one an observation\), got 2"),
        ({"observed": ["x"]}, "observed: the name 'x' is already a state"),
        ({"prior": {"kind": "density", "log_density": "-x**2*y"}}, "unknown name 'y'"),
    ],
)
def test_wrong_names_are_an_error_in_one_line(keys, words):
    with pytest.raises(zakai.InputError, match=words):
        zakai.Model(**{**ONE, **keys})


def test_a_gap_and_a_forecast_say_that_the_path_is_needed():
    model = zakai.Model(**ONE)
    record = zakai.Record([0.1, 0.2, 0.3], [[0.1], [np.nan], [0.2]], "increments")
    with pytest.raises(zakai.InputError, match=r"y is not observed from t = 0.1 to 0.2, and formulas depend on it"):
        zakai.filter(model, record)
    result = zakai.filter(model, zakai.Record([0.1, 0.2], [[0.1], [0.2]], "increments"))
    with pytest.raises(zakai.InputError, match="gives no forecast"):
        result.forecast([0.5])
    with pytest.raises(zakai.InputError, match="residuals: an increment has no law here"):
        result.residuals()


def test_a_coordinate_that_no_formula_contains_may_be_missing():
    keys = {
        "state": ["x"], "drift": ["-x + y"], "observation": ["x", "2*x"], "observed": ["y", "z"],
        "prior": {"kind": "gaussian", "mean": [0.5], "cov": [[0.3]]},
    }  # fmt: skip
    model = zakai.Model(**keys)
    full = zakai.Record([0.1, 0.2], [[0.1, np.nan], [0.2, np.nan]], "increments")
    alone = zakai.Model(**{**keys, "observation": ["x"], "observed": ["y"]})
    expected = zakai.filter(alone, zakai.Record([0.1, 0.2], [[0.1], [0.2]], "increments"))
    assert np.allclose(zakai.filter(model, full).mean, expected.mean, rtol=0, atol=1e-12)


def test_a_simulated_path_obeys_its_own_equation():
    """dy = x dt with x = -y held by strong feedback: y decays, and without feedback it does not."""
    keys = {
        "state": ["x"], "drift": ["-50*(x + y - 1)"], "diffusion": [["0.01"]], "observation": ["x"], "observed": ["y"],
        "observation_noise": [["0.0001"]], "prior": {"kind": "gaussian", "mean": [1.0], "cov": [[1e-6]]},
    }  # fmt: skip
    times = np.linspace(0.01, 3, 300)
    truth, record = zakai.simulate(zakai.Model(**keys), times, seed=1)
    assert truth.values.shape == (301, 1)
    assert np.allclose(np.cumsum(record.values[:, 0])[::50], 1 - np.exp(-times[::50]), rtol=0, atol=0.08)
