"""Known inputs of linear systems: exact for both holds, at times of their own, for every kind of record and use of a filter."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.convention import within_convention
from references.moments import moments
from zakai.errors import ConditionError

KINDS = ["samples", "increments", "rates", "path"]
PRIOR = np.array([0.3, -0.5]), np.array([[0.8, 0.1], [0.1, 0.5]])
KEYS = {
    "state": ["x", "y"],
    "inputs": ["u", "w"],
    "drift": ["-a*x + u*y/4 + w", "-y + x/2 + sin(t)*u"],
    "process_noise": [["1", "1/5"], ["1/5", "1/2"]],
    "diffusion": [["1 + u**2/10", "0"], ["0", "1"]],
    "observation": ["x + b*u", "x - 2*y + u*w*x/10"],
    "observation_noise": [["1/2", "1/10"], ["1/10", "1/3"]],
    "parameters": {"a": 0.8, "b": 1.0},
    "prior": {"kind": "gaussian", "mean": PRIOR[0].tolist(), "cov": PRIOR[1].tolist()},
}


def coefficients(t, inputs):
    """Return the coefficients of the system above, written by hand."""
    u, w = inputs
    g, Q = np.diag([1 + u * u / 10, 1.0]), np.array([[1, 0.2], [0.2, 0.5]])
    L, C = np.array([[-0.8, u / 4], [0.5, -1.0]]), np.array([[1.0, 0.0], [1 + u * w / 10, -2.0]])
    S = np.array([[0.5, 0.1], [0.1, 1 / 3]])
    return L, np.array([w, np.sin(t) * u]), g @ Q @ g.T, C, np.array([u, 0.0]), S, np.zeros((2, 2))


def driven(kind, hold, **more):
    """Return the system above."""
    return zakai.Model(**{**KEYS, **more}, input_hold=hold, observation_kind=kind)


def record_of(kind, count=12, gaps=True):
    """Return observations at irregular times, two coordinates missing, and inputs at times of their own."""
    draw = np.random.default_rng(4)
    times = np.cumsum(10.0 ** draw.uniform(-2, -0.2, count))
    values = 0.5 * draw.normal(size=(count, 2))
    if gaps and kind != "path":
        values[2], values[4, 1] = np.nan, np.nan
    inputs = zakai.Inputs(np.concatenate([[0.0], np.cumsum(draw.uniform(0.02, 0.4, 60))]), draw.normal(size=(61, 2)))
    assert inputs.times[-1] > times[-1]
    return zakai.Record(times, values, kind, inputs)


def numbers(result, first=1):
    """Return what a result says, as one array."""
    count = len(result.times)
    return np.column_stack([result.mean, result.cov.reshape(count, -1), result.log_likelihood_increments])[first:]


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("kind", KINDS)
def test_it_agrees_with_the_moment_equations(kind, hold):
    record = record_of(kind)
    result = zakai.filter(driven(kind, hold), record)
    mean, cov, evidence = moments(record, kind, hold, PRIOR, coefficients)
    assert result.method == "kalman-bucy" and not within_convention(result.warnings)
    np.testing.assert_allclose(result.mean[1:], mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.cov[1:], cov, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.cumsum(result.log_likelihood_increments)[1:], evidence, rtol=0, atol=1e-9)


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_kinks_and_jumps_of_time_and_inputs_are_integrated(hold):
    drift = ["-x + max(u, 0)*y + heaviside(t - 1/3)", "-y + sinc(w) + sign(sin(20*t))"]
    model, record = driven("samples", hold, drift=drift, diffusion=None), record_of("samples", 5)

    def equations(t, inputs):
        u, w = inputs
        rate = np.array([[-1.0, max(u, 0.0)], [0.0, -1.0]])
        push = np.array([float(t > 1 / 3), np.sinc(w / np.pi) + np.sign(np.sin(20 * t))])
        return rate, push, np.array([[1, 0.2], [0.2, 0.5]]), *coefficients(t, inputs)[3:]

    # Cuts where the coefficients jump leave the inputs as they are.
    jumps = np.concatenate([[1 / 3], np.pi / 20 * np.arange(1, 20)])
    at = np.unique(np.concatenate([record.inputs.times, jumps]))
    cut = zakai.Record(record.times, record.values, "samples", zakai.Inputs(at, record.inputs.at(at, hold)))
    result = zakai.filter(model, record)
    assert result.method == "kalman-bucy" and not result.warnings
    mean, cov, _ = moments(cut, "samples", hold, PRIOR, equations)
    np.testing.assert_allclose(result.mean[1:], mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.cov[1:], cov, rtol=0, atol=1e-9)


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("kind", KINDS)
def test_online_in_batches_and_after_a_checkpoint_the_numbers_are_those_of_a_record(kind, hold, tmp_path, monkeypatch):
    model, record = driven(kind, hold), record_of(kind)
    expected = numbers(zakai.filter(model, record))
    monkeypatch.setattr("zakai.engine.loop.CHUNK", 5)
    again = zakai.filter(driven(kind, hold), [record, record])[1]
    assert numbers(again).tobytes() == expected.tobytes()
    online, rows = zakai.online(model), []
    for k, (time, value) in enumerate(zip(record.times, record.values)):
        if k == 6:
            online.save(tmp_path / "state")
            online = zakai.online(model)
            online.restore(tmp_path / "state")
        # Only the inputs that decide u until this time are known.
        one = online.update(float(time), value, record.inputs.part(0.0 if k == 0 else float(record.times[k - 1]), float(time)))
        rows.append([*one.mean, *one.cov.ravel(), one.log_likelihood_increment])
    assert np.array(rows).tobytes() == expected.tobytes()


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_times_of_inputs_that_change_nothing_change_the_result_by_rounding(hold):
    model, record = driven("increments", hold), record_of("increments")
    at = np.sort(np.concatenate([record.inputs.times, np.linspace(0.011, 2.0, 200)]))
    more = zakai.Inputs(at, record.inputs.at(at, hold))
    changed = zakai.filter(model, zakai.Record(record.times, record.values, "increments", more))
    np.testing.assert_allclose(numbers(changed), numbers(zakai.filter(model, record)), rtol=0, atol=1e-12)


def test_increments_end_before_an_input_jumps_and_samples_are_taken_after():
    keys = {"state": ["x"], "inputs": ["u"], "drift": ["0"], "process_noise": [["0"]], "observation": ["x + u"]}
    keys["prior"] = {"kind": "gaussian", "mean": [1.0], "cov": [[0.0]]}
    inputs = zakai.Inputs([0.0, 1.0], [2.0, 5.0])
    for kind, level in (("samples", 6.0), ("increments", 3.0)):
        model = zakai.Model(**keys, observation_kind=kind)
        found = zakai.filter(model, zakai.Record([1.0], [[level]], kind, inputs)).log_likelihood
        best = -0.5 * np.log(2 * np.pi) if kind == "samples" else 0.5 * level**2
        assert found == pytest.approx(best, abs=1e-12)
    path = zakai.Record([0.5, 1.0], [[np.nan], [3.0]], "path", inputs)
    assert zakai.filter(zakai.Model(**keys, observation_kind="path"), path).log_likelihood == pytest.approx(4.5, abs=1e-12)


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_gradients_agree_with_differences(kind, hold):
    model, record = driven(kind, hold), record_of(kind)
    likelihood = zakai.log_likelihood(model, record)
    value, gradient = likelihood.value_and_gradient([0.8, 1.0])
    assert value == pytest.approx(zakai.filter(model, record).log_likelihood, abs=1e-11)
    for i, shift in enumerate(1e-5 * np.eye(2)):
        above, below = likelihood(np.array([0.8, 1.0]) + shift), likelihood(np.array([0.8, 1.0]) - shift)
        assert gradient[i] == pytest.approx((above - below) / 2e-5, rel=1e-7, abs=1e-7)


def test_the_smoother_and_the_forecast_follow_the_inputs():
    """Against the joint law of the state at all times, by conditioning one large Gaussian."""
    model, record = driven("samples", "zero"), record_of("samples", 8, gaps=False)
    smoothed = zakai.smooth(model, record)
    assert not smoothed.warnings
    # The joint law from the prior: a step is an affine map with independent noise, taken from records without observations.
    nothing = np.full((1, 2), np.nan)
    mean, cov = PRIOR
    means, blocks, maps = [mean], [[cov]], []
    start = 0.0
    for stop in record.times:

        def moved(m, P, start=start, stop=stop):
            prior = {"kind": "gaussian", "mean": list(m), "cov": P.tolist()}
            part = driven("samples", "zero", prior=prior, start=start)
            one = zakai.filter(part, zakai.Record([stop], nothing, "samples", record.inputs))
            return one.mean[1], one.cov[1]

        zero = np.zeros((2, 2))
        base, noise = moved(np.zeros(2), zero)
        flow = np.column_stack([moved(unit, zero)[0] - base for unit in np.eye(2)])
        maps.append(flow)
        means.append(flow @ means[-1] + base)
        row = [flow @ block for block in blocks[-1]]
        blocks.append([*row, flow @ blocks[-1][-1] @ flow.T + noise])
        start = stop
    size = 2 * len(means)
    joint = np.zeros((size, size))
    for i, row in enumerate(blocks):
        for j, block in enumerate(row):
            joint[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = block
            joint[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = block.T
    H, level, noise = np.zeros((16, size)), [], []
    for k, time in enumerate(record.times):
        _, _, _, C, c, S, _ = coefficients(time, record.inputs.at(time))
        H[2 * k : 2 * k + 2, 2 * k + 2 : 2 * k + 4] = C
        level.append(c)
        noise.append(S)
    spread = H @ joint @ H.T + np.kron(np.eye(8), noise[0])
    gain = np.linalg.solve(spread, H @ joint).T
    wanted = np.ravel(means) + gain @ (record.values.ravel() - np.ravel(level) - H @ np.ravel(means))
    left = joint - gain @ H @ joint
    np.testing.assert_allclose(smoothed.mean.ravel(), wanted, rtol=0, atol=1e-9)
    for k in range(9):
        np.testing.assert_allclose(smoothed.cov[k], left[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], rtol=0, atol=1e-9)
    later = record.times[-1] + np.array([0.1, 0.35])
    longer = zakai.Record([*record.times, *later], [*record.values, *nothing, *nothing], "samples", record.inputs)
    ahead = zakai.filter(model, record).forecast(later)
    assert ahead.mean[1:].tobytes() == zakai.filter(model, longer).mean[-2:].tobytes()


def test_the_heated_room_is_filtered_exactly():
    model = zakai.load_model("gallery:heated-room")
    inputs = zakai.Inputs(0.25 * np.arange(40), np.column_stack([np.arange(40) % 3 == 0, 5 + np.cos(np.arange(40) / 4)]))
    truth, record = zakai.simulate(model, 0.1 * np.arange(1, 80), seed=1, inputs=inputs)
    result = zakai.filter(model, record)
    assert result.method == "kalman-bucy" and not result.warnings
    score = (truth.values[1:] - result.mean[1:]) / np.sqrt(result.variance[1:])
    assert np.abs(score).max() < 4.5 and 0.6 < np.mean(score**2) < 1.6
    fitted = zakai.fit(model, record, parameters=["gain"])
    assert abs(fitted.estimates["gain"] - 4.0) < 4 * fitted.standard_errors["gain"] < 2.0


def test_an_input_in_the_observation_of_a_benes_system_agrees_with_the_shifted_record():
    keys = {"state": ["x"], "observation_kind": "samples", "prior": {"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}}
    model = zakai.Model(**keys, drift=["tanh(x)"], observation=["x + u"], inputs=["u"])
    plain = zakai.Model(**keys, drift=["tanh(x)"], observation=["x"])
    times, values = np.array([0.1, 0.4, 0.5]), np.array([[0.3], [-0.4], [0.9]])
    inputs = zakai.Inputs([0.0, 0.2, 0.45], [1.0, -2.0, 0.5])
    for method in ("benes", "hu-yau"):
        found = zakai.filter(model, zakai.Record(times, values, "samples", inputs), method)
        shifted = zakai.Record(times, values - inputs.at(times), "samples")
        np.testing.assert_allclose(numbers(found), numbers(zakai.filter(plain, shifted, method)), rtol=0, atol=1e-11)


@pytest.mark.parametrize("method", ["benes", "hu-yau"])
@pytest.mark.parametrize("change", [{"drift": ["tanh(x) + u"]}, {"drift": ["tanh(x)"], "diffusion": [["1 + u**2"]]}])
def test_an_input_that_changes_the_gauge_is_refused(method, change):
    keys = {"state": ["x"], "observation": ["x"], "inputs": ["u"], "prior": {"kind": "gaussian", "mean": [0], "cov": [1]}}
    model = zakai.Model(**keys, **change)
    record = zakai.Record([0.1], [[0.0]], "increments", zakai.Inputs([0.0], [1.0]))
    with pytest.raises(ConditionError, match=f"{method} does not hold: .*u"):
        zakai.filter(model, record, method)
