"""The compiled loop of `extended-kalman-bucy`: the same figures as its equations in NumPy, for every kind of formula."""

from dataclasses import replace

import numpy as np
import pytest

import zakai
from zakai.methods.gaussian.extended import filter as extended
from zakai.records.schedule import schedule_of

RNG = np.random.default_rng(0)
TURN = {
    "state": ["x", "y", "v", "p", "w"], "drift": ["v*cos(p)", "v*sin(p)", "0", "w", "0"],
    "diffusion": [[0, 0], [0, 0], [0.1, 0], [0, 0], [0, "0.05 + x**2/300"]],
    "observation": ["sqrt(x**2 + y**2)", "atan2(y, x)"], "observation_kind": "samples",
    "observation_noise": [["0.01 + x**2/3000", 0.001], [0.001, 0.0004]], "periodic": ["p"],
    "prior": {"kind": "gaussian", "mean": [-5, 3, 1, -1.5, 0.2], "cov": [0.1, 0.1, 0.04, 0.04, 0.01]},
}  # fmt: skip
SWING = {
    "state": ["a", "b"], "drift": ["b", "-sin(a) - b/5 + u*t"], "diffusion": [[0], [0.5]], "observation": ["sin(a)*u", "b"],
    "observation_kind": "increments",
    "observation_noise": [[0.1, 0.01], [0.01, "0.1*(2 + sin(9*t))"]], "inputs": ["u"], "input_hold": "linear",
    "prior": {"kind": "gaussian", "mean": [0, 1], "cov": [0.3, 0.0]},
}  # fmt: skip
KINKS = {
    "state": ["x", "y"],
    "drift": ["-sign(x) - abs(y)/5 + floor(y)/9", "max(x, min(y, 1)) - y + heaviside(x)/5 + log1p(x**2)*exp(-y**2)"],
    "observation": ["x + tanh(y)"], "observation_kind": "samples", "observation_noise": [[0.2]],
    "prior": {"kind": "gaussian", "mean": [0.4, 0.3], "cov": [[0.3, 0.1], [0.1, 0.3]]},
}  # fmt: skip
STIFF = {
    "state": ["a", "b"], "drift": ["-3000*a + b**3", "-b"], "observation": ["a + b"], "observation_kind": "samples",
    "prior": {"kind": "gaussian", "mean": [0, 1], "cov": [0.3, 0.1]},
}  # fmt: skip

TABLES = {
    "state": ["x", "y"], "drift": ["-slope(x) + sinc(3*y)", "ring(x + y)/3 - y"], "observation": ["depth(x) + y", "sinc(x - 9)"],
    "observation_kind": "samples", "observation_noise": [[0.2, 0], [0, 0.1]],
    "tables": {
        "slope": {"x": [-1.0, 0, 1.5, 2], "values": [-3.0, 0, 1, 6], "kind": "linear"},
        "depth": {"x": [-1.0, 0, 0.7, 1.5, 2], "values": [-3.0, 0, 1, 6, 5], "kind": "cubic"},
        "ring": {"x": [0.0, 1, 2.5, 3, 4], "values": [1.0, 0, 2, -1, 1], "kind": "cubic", "periodic": True},
    },
    "prior": {"kind": "gaussian", "mean": [0.4, 0.3], "cov": [[0.6, 0.1], [0.1, 0.3]]},
}  # fmt: skip


def record_of(model, count, scale):
    times = np.cumsum(RNG.exponential(scale, count))
    inputs = zakai.Inputs(np.linspace(0, times[-1], 13), np.sin(np.arange(13.0))) if model.inputs else None
    values = RNG.normal(size=(count, model.m))
    values[3, 0], values[5] = np.nan, np.nan
    return zakai.Record(times, values, model.observation_kind, inputs)


@pytest.mark.parametrize("substeps", [1, 2])
@pytest.mark.parametrize("keys", [TURN, SWING, KINKS, STIFF, TABLES, {**SWING, "observation_kind": "path"}])
def test_the_compiled_loop_is_the_step_in_numpy(keys, substeps):
    model = zakai.Model(**keys)
    schedule, values = schedule_of(model, record_of(model, 20, 0.2))
    prepared = extended.prepare(model, schedule, model.theta(), substeps=substeps)
    assert prepared.loop is not None
    plain = replace(prepared, loop=None)
    state = extended.init(prepared, model.prior)
    for k in range(len(schedule)):
        found, info = extended.step(prepared, k, state, values[k])
        expected, plain_info = extended.step(plain, k, state, values[k])
        size = np.abs(expected.cov).max()
        assert np.allclose(found.mean, expected.mean, rtol=1e-10, atol=1e-10)
        assert np.allclose(found.cov, expected.cov, rtol=0, atol=1e-11 * size)
        assert np.isclose(info.log_likelihood_increment, plain_info.log_likelihood_increment, rtol=1e-9, atol=1e-9)
        for name, figure in plain_info.health.items():
            assert np.isclose(info.health[name], figure, rtol=1e-6, atol=1e-9), name
        state = found


@pytest.mark.parametrize("keys", [TURN, SWING, TABLES])
def test_record_online_batch_and_restart_agree_to_the_bit(keys):
    model = zakai.Model(**keys)
    record = record_of(model, 40, 0.2)
    whole = zakai.filter(model, record, "extended-kalman-bucy")
    many = zakai.filter(model, [record, record], "extended-kalman-bucy")
    assert all(np.array_equal(one.mean, whole.mean) and np.array_equal(one.cov, whole.cov) for one in many)
    online = zakai.online(model, "extended-kalman-bucy")
    for k, (t, row) in enumerate(zip(record.times, record.values, strict=True)):
        estimate = online.update(t, row, **({"inputs": record.inputs} if model.inputs else {}))
        assert np.array_equal(estimate.mean, whole.mean[k + 1]), k
        assert np.array_equal(estimate.cov, whole.cov[k + 1])


def test_derivatives_are_those_of_differences_where_noise_and_angles_depend_on_the_state():
    keys = {**TURN, "parameters": {"a": 0.05, "b": 0.01}}
    keys["diffusion"] = [[0, 0], [0, 0], ["a", 0], [0, 0], [0, "a + x**2/300"]]
    keys["observation_noise"] = [["b + x**2/3000", 0.001], [0.001, "b/25"]]
    model = zakai.Model(**keys)
    _, record = zakai.simulate(model, np.linspace(0.2, 4, 20), seed=1)
    function = zakai.log_likelihood(model, record, "extended-kalman-bucy")
    theta = model.theta()
    value, slope = function.value_and_gradient(theta)
    assert np.isclose(value, zakai.filter(model, record, "extended-kalman-bucy").log_likelihood, rtol=1e-10)
    for i, step in enumerate(np.diag(1e-5 * theta)):
        difference = (function.value_and_gradient(theta + step)[0] - function.value_and_gradient(theta - step)[0]) / (2 * step[i])
        assert np.isclose(slope[i], difference, rtol=1e-5)


def plain_filter(record, count):
    """An extended Kalman filter of the coordinated turn with Euler steps, `count` in an interval."""
    x, P, t = np.array([-5, 3, 1, -1.5, 0.2]), np.diag([0.1, 0.1, 0.04, 0.04, 0.01]), 0.0
    for stop, z in zip(record.times, record.values, strict=True):
        d = (stop - t) / count
        for _ in range(count):
            _, _, v, p, w = x
            F = np.eye(5)
            F[0, 2:4], F[1, 2:4], F[3, 4] = [d * np.cos(p), -d * v * np.sin(p)], [d * np.sin(p), d * v * np.cos(p)], d
            x = x + d * np.array([v * np.cos(p), v * np.sin(p), 0, w, 0])
            P = F @ P @ F.T + d * np.diag([0, 0, 0.01, 0, 0.0025])
        r = np.hypot(x[0], x[1])
        H = np.array([[x[0] / r, x[1] / r, 0, 0, 0], [-x[1] / r**2, x[0] / r**2, 0, 0, 0]])
        away = z - [r, np.arctan2(x[1], x[0])]
        away[1] = np.angle(np.exp(1j * away[1]))
        V = H @ P @ H.T + np.diag([0.01, 0.0004])
        K = P @ H.T @ np.linalg.inv(V)
        x, P, t = x + K @ away, (np.eye(5) - K @ H) @ P, stop
    return x, P


def test_a_coordinated_turn_is_that_of_a_plain_filter_with_short_steps():
    plain = {**TURN, "periodic": [], "observation_noise": [[0.01, 0], [0, 0.0004]]}
    plain["diffusion"] = [[0, 0], [0, 0], [0.1, 0], [0, 0], [0, 0.05]]
    plain["prior"] = {**TURN["prior"], "mean": [-5, 1, 1, -1.5, 0.2]}
    model = zakai.Model(**{**plain, "prior": TURN["prior"]})
    _, record = zakai.simulate(model, np.linspace(0.1, 9, 90), seed=3, initial=[-5, 1, 1, -1.5, 0.2])
    assert record.values[:, 1].min() < -3 and record.values[:, 1].max() > 2.5
    mean, cov = plain_filter(record, 400)
    found = zakai.filter(model, record, "extended-kalman-bucy", substeps=8)
    assert np.allclose(found.mean[-1], mean, rtol=0, atol=0.02 * np.sqrt(np.diagonal(cov)))
    assert np.allclose(found.cov[-1], cov, rtol=0, atol=0.02 * cov.max())


def test_tables_and_sinc_are_those_of_the_formulas_that_they_stand_for():
    model = zakai.Model(
        state=["x"], drift=["-depth(x) + sinc(x)"], observation=["depth(x)"], observation_kind="samples",
        tables={"depth": {"x": [-3.0, 0, 3], "values": [-3.0, 0, 6], "kind": "linear"}},
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.01]]},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.2], [[2.0], [1.9]], "samples")
    found = zakai.filter(model, record, "extended-kalman-bucy")
    straight = zakai.Model(
        state=["x"], drift=["-2*x + sin(x)/x"], observation=["2*x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.01]]},
    )  # fmt: skip
    assert np.allclose(found.mean, zakai.filter(straight, record, "extended-kalman-bucy").mean, rtol=0, atol=1e-12)
