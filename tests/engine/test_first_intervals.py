"""What "auto" takes where the first interval shows that a density of several states would need too much work."""

import numpy as np
import pytest

import zakai

PARTICLES = "guided-particles"


def oscillator(rate=50):
    """Return a relaxation oscillator, which jumps where x falls below one."""
    return zakai.Model(
        state=["x", "v"], drift=["v", f"{rate}*(1 - x**2)*v - x"], diffusion=[["0"], ["0.5"]], observation=["x"],
        observation_kind="samples", observation_noise=[[0.01]],
        prior={"kind": "gaussian", "mean": [1.5, 0], "cov": [0.1, 0.1]},
    )  # fmt: skip


def motor():
    """Return a motor with dry friction, and the record of its speed."""
    model = zakai.Model(
        state=["w", "i"], drift=["5*i - 0.5*w - 2*tanh(w/0.02)", "20*(u - i - 0.2*w)"], diffusion=[["0.3", "0"], ["0", "0.3"]],
        inputs=["u"], observation=["w"], observation_kind="samples", observation_noise=[[0.01]],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.2]},
    )  # fmt: skip
    at = np.linspace(0, 1, 9)
    return model, zakai.Record([0.1, 0.2, 0.3], [[-0.7], [0.0], [-0.1]], "samples", inputs=zakai.Inputs(at, np.sin(2 * at)))


def record_of(length, rows=2, start=False):
    times = length * np.arange(0 if start else 1, rows + 1)
    return zakai.Record(times, 1.3 + 0.1 * np.sin(5.0 * np.arange(len(times)))[:, None], "samples")


def test_a_stiff_system_is_filtered_by_particles_where_its_intervals_are_long():
    short, long = (zakai.filter(oscillator(), record_of(length), keep="moments") for length in (0.01, 0.1))
    assert short.method == "yau-yau" and long.method == PARTICLES
    assert "yau-yau holds too, but over the first interval it takes more than 0." in long.why
    assert zakai.filter(oscillator(2), record_of(0.1), keep="moments").method == "yau-yau"


def stiff(first=0.004):
    """Return a pair with a fast state, and a record whose first interval is shorter than the others."""
    model = zakai.Model(
        state=["a", "b"], drift=["-a + 0.5*b/(1 + b) + 0.4", "200*(a**2 - b)"], diffusion=[["0.3", "0"], ["0", "0.1"]],
        observation=["a"], observation_kind="samples", observation_noise=[[0.01]],
        prior={"kind": "gaussian", "mean": [0.6, 0.4], "cov": [0.02, 0.01]},
    )  # fmt: skip
    times = np.cumsum([first, 0.05, 0.3, 0.15, 0.4, 0.05, 0.1, 0.3, 0.2, 0.2])
    return model, zakai.Record(times, 0.6 + 0.1 * np.cos(np.arange(10.0))[:, None], "samples")


def test_a_stiff_system_is_filtered_by_particles_where_later_intervals_are_long():
    model, record = stiff()
    result = zakai.filter(model, record, keep="moments")
    assert result.method == PARTICLES and "the typical length of the first 8, it takes more than" in result.why
    assert zakai.filter(model, zakai.Record(0.004 * np.arange(1, 4), record.values[:3], "samples")).method == "yau-yau"


def test_an_online_filter_takes_the_other_method_when_a_record_until_then_does(tmp_path):
    model, record = stiff()
    online, methods = zakai.online(model), []
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), 1):
        estimate = online.update(float(time), value.tolist())
        part = zakai.filter(model, zakai.Record(record.times[:k], record.values[:k], "samples"), keep="moments")
        assert np.array_equal(estimate.mean, part.mean[-1]) and online.method == part.method
        methods.append(online.method)
        online.save(tmp_path / "filter")
        online = zakai.online(model)
        online.restore(tmp_path / "filter")
    assert methods[0] == "yau-yau" and methods[-1] == PARTICLES and methods == sorted(methods, reverse=True)


def test_a_list_of_records_an_online_filter_and_a_restart_choose_as_a_record_does(tmp_path):
    lengths = (0.01, 0.1)
    alone = [zakai.filter(oscillator(), record_of(length), keep="moments") for length in lengths]
    together = zakai.filter(oscillator(), [record_of(length) for length in lengths], keep="moments")
    for length, one, other in zip(lengths, alone, together, strict=True):
        record = record_of(length)
        assert one.method == other.method == zakai.prepare(oscillator(), record)._plan.method
        assert np.array_equal(one.mean, other.mean)
        online = zakai.online(oscillator())
        for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), 1):
            estimate = online.update(float(time), value.tolist())
            assert np.array_equal(estimate.mean, one.mean[k]) and online.method == one.method
            online.save(tmp_path / "filter")
            online = zakai.online(oscillator())
            online.restore(tmp_path / "filter")


def test_a_sample_at_the_start_is_used_again_when_the_first_interval_is_known(tmp_path):
    record = record_of(0.1, start=True)
    result, online = zakai.filter(oscillator(), record, keep="moments"), zakai.online(oscillator())
    first = online.update(0.0, record.values[0].tolist())
    online.save(tmp_path / "filter")
    online = zakai.online(oscillator())
    online.restore(tmp_path / "filter")
    for k in range(1, len(record)):
        estimate = online.update(float(record.times[k]), record.values[k].tolist())
        assert np.array_equal(estimate.mean, result.mean[k + 1])
    assert online.method == result.method == PARTICLES
    assert np.allclose(first.density.mean(), result.mean[1], atol=0.02)  # by the other method, before the choice


def test_known_inputs_count():
    model, record = motor()
    result, online = zakai.filter(model, record, keep="moments"), zakai.online(model, inputs=record.inputs)
    assert result.method == PARTICLES and not result.warnings
    assert np.array_equal(online.update(0.1, [-0.7]).mean, result.mean[1])


def test_a_tensor_train_of_many_substeps_is_left():
    model = zakai.Model(
        state=["x", "y", "z"], drift=["10*(y - x)", "x*(28 - z) - y", "x*y - 8*z/3"], diffusion=np.eye(3).tolist(),
        observation=["x"], observation_kind="samples", observation_noise=[[1]],
        prior={"kind": "gaussian", "mean": [1, 1, 25], "cov": [4, 4, 4]},
    )  # fmt: skip
    method = [zakai.filter(model, zakai.Record([length], [[1.0]], "samples"), keep="moments").method for length in (0.02, 1.0)]
    assert method == ["tensor-train", PARTICLES]


@pytest.mark.parametrize("method", ["yau-yau", "tensor-train"])
def test_a_method_that_is_named_is_taken(method):
    assert zakai.filter(oscillator(2), record_of(0.01, 1), method, keep="moments").method == method


def test_auto_takes_another_method_where_one_loses_the_density_later():
    # A cell with a fast voltage that follows a current in steps: the grid loses it where the current ends, long after the start.
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.choice([2, 5, 10, 30], 60)) / 60.0
    current = np.where(rng.random(61) < 0.7, rng.uniform(0, 0.12, 61), 0)
    model = zakai.Model(
        state=["charge", "voltage"], drift=["-I/2.5", "60*I - 60*voltage/0.9"], diffusion=[["0.01", "0"], ["0", "0.02"]],
        observation=["3.2 + 0.55*charge + 0.25*exp(-20*(1 - charge)) - 0.35*exp(-15*charge) - 0.05*voltage"], inputs=["I"],
        observation_noise=[["0.012**2"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.7, 0], "cov": [0.03, 0.01]},
    )  # fmt: skip
    inputs = zakai.Inputs(np.append(0.0, times), current[:, None])
    record = zakai.simulate(model, times[:22], seed=5, inputs=inputs, initial=[0.82, 0])[1]
    assert any("the density was lost" in sentence for sentence in zakai.filter(model, record, "yau-yau").warnings)
    result, other = zakai.filter(model, record), zakai.filter(model, record, "tensor-train")
    assert result.method != "yau-yau" and "yau-yau holds too, but loses the density at t = 2.8" in result.why
    assert not result.warnings
    assert (np.abs(result.mean - other.mean) < 0.02 * np.sqrt(other.variance)).all()
