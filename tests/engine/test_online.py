"""One observation in, one estimate out: the same numbers as a whole record gives, whatever comes in."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest

import zakai

WALK = dict(state=["x"], drift=["-x/2"], observation=["2*x"], prior={"kind": "gaussian", "mean": [0.3], "cov": [[2.0]]})
TIMED = dict(WALK, drift=["cos(t) - x/2"], observation_noise=[["1 + sin(t)/2"]])
TWO = dict(
    state=["x", "v"],
    drift=["v", "-x - v/2"],
    observation=["x", "v"],
    observation_noise=[["1/2", "1/8"], ["1/8", "1/3"]],
    prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]},
)
CUBIC = dict(state=["x"], drift=["cos(x)"], observation=["x**3"], prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.5]]})


def simulated(model, times, seed=1, gaps=()):
    _, record = zakai.simulate(model, times, seed=seed)
    values = record.values.copy()
    for row, column in gaps:
        values[row, column] = np.nan
    return zakai.Record(record.times, values, record.kind)


def estimates_of(online, record):
    return [online.update(time, value) for time, value in zip(record.times, record.values, strict=True)]


def compare(model, record, method, tolerance=1e-12, **options):
    """Assert that an online filter returns the numbers of the filter of a record; return the online filter."""
    whole = zakai.filter(model, record, method, **options)
    online = zakai.online(model, method, **options)
    estimates = estimates_of(online, record)
    assert online.method == whole.method
    assert np.allclose([e.time for e in estimates], record.times, rtol=0, atol=0)
    assert np.allclose([e.mean for e in estimates], whole.mean[1:], rtol=tolerance, atol=tolerance)
    assert np.allclose([e.cov for e in estimates], whole.cov[1:], rtol=tolerance, atol=tolerance)
    found = [e.log_likelihood_increment for e in estimates]
    assert np.allclose(found, whole.log_likelihood_increments[1:], rtol=tolerance, atol=tolerance)
    assert set(estimates[-1].health) == set(whole.health)
    ours, theirs = estimates[-1].density, whole.density(-1)
    assert np.allclose(ours.quantile([0.1, 0.9]), theirs.quantile([0.1, 0.9]), rtol=1e-9, atol=1e-9)
    assert np.allclose(estimates[-1].interval(0.8), ours.quantile([0.1, 0.9]).T)
    return online


UNIFORM, IRREGULAR = np.arange(1, 41) / 20, np.cumsum(np.tile([0.05, 0.013, 0.4, 0.05, 0.05], 5))


@pytest.mark.parametrize("kind", ["increments", "path", "rates", "samples"])
def test_every_kind_of_observation_with_gaps_gives_what_a_record_gives(kind):
    model = zakai.Model(**TWO, observation_kind=kind)
    record = simulated(model, UNIFORM, gaps=[(3, 0), (4, 0), (4, 1), (9, 1), (10, 1)])
    compare(model, record, "kalman-bucy")


@pytest.mark.parametrize("kind", ["path", "samples"])
def test_irregular_times_of_a_system_that_depends_on_time_give_what_a_record_gives(kind):
    model = zakai.Model(**TIMED, observation_kind=kind)
    compare(model, simulated(model, IRREGULAR, gaps=[(2, 0), (7, 0)]), "extended-kalman-bucy")


def test_steps_that_repeat_and_then_change_give_what_a_record_gives():
    model = zakai.Model(**TIMED, observation_kind="increments")
    times = np.concatenate([UNIFORM, UNIFORM[-1] + IRREGULAR, UNIFORM[-1] + IRREGULAR[-1] + np.arange(1, 20) / 10])
    compare(model, simulated(model, times), "extended-kalman-bucy", 1e-11)


@pytest.mark.parametrize("kind", ["increments", "path", "rates", "samples"])
def test_lengths_that_never_repeat_give_what_a_record_gives(kind):
    model = zakai.Model(**TWO, observation_kind=kind)
    lengths = np.random.default_rng(4).permutation(np.geomspace(0.04, 6.0, 20))
    compare(model, simulated(model, np.cumsum(lengths), gaps=[(3, 0), (4, 1), (14, 0), (14, 1)]), "kalman-bucy", 1e-11)


@pytest.mark.parametrize(
    ("drift", "method", "options"),
    [("tanh(x)", "benes", {}), ("-x/4", "hu-yau", {"theorem": "theorem-6"})],
)
def test_lengths_that_never_repeat_are_those_of_every_family(drift, method, options):
    model = zakai.Model(**dict(WALK, drift=[drift]), observation_kind="increments")
    lengths = np.random.default_rng(5).permutation(np.geomspace(0.05, 0.3, 8))
    compare(model, simulated(model, np.cumsum(lengths)), method, 1e-10, **options)


def test_a_sample_at_the_start_gives_what_a_record_gives():
    model = zakai.Model(**WALK, observation_kind="samples")
    compare(model, simulated(model, np.concatenate([[0.0], UNIFORM])), "kalman-bucy")


def test_a_prediction_is_an_observation_of_nothing_and_leaves_the_filter_alone():
    model = zakai.Model(**WALK, observation_kind="samples")
    record = simulated(model, UNIFORM[:4], gaps=[(3, 0)])
    whole, online = zakai.filter(model, record, "kalman-bucy"), zakai.online(model, "kalman-bucy")
    assert np.allclose(online.predict(0.0).mean, [0.3]) and np.allclose(online.last.cov, [[2.0]])
    estimates_of(online, zakai.Record(record.times[:3], record.values[:3], "samples"))
    for _ in range(2):
        ahead = online.predict(record.times[3])
        assert np.allclose(ahead.mean, whole.mean[4], rtol=0, atol=1e-13) and abs(ahead.log_likelihood_increment) < 1e-14
        assert online.time == record.times[2]
    assert np.array_equal(online.predict(online.time).mean, online.last.mean)
    with pytest.raises(zakai.InputError, match="before"):
        online.predict(0.01)


def test_what_cannot_be_used_is_one_line_and_leaves_the_filter_as_it_was():
    model = zakai.Model(**TWO, observation_kind="increments")
    record = simulated(model, UNIFORM[:6])
    one, other = zakai.online(model), zakai.online(model)
    for time, value in zip(record.times, record.values, strict=True):
        for wrong, bad, words in [
            (time, [1.0], "1 column"),
            (time, [1.0, 2.0, 3.0], "3 columns"),
            (time, [1.0, np.inf], "observation 2 is inf"),
            (time, [1e300, 1.0], "1e"),
            (time, ["1", 2.0], "'1'"),
            (time, [True, 2.0], "True"),
            (time, "ab", "column"),
            (one.time, value, "start" if one.time == 0 else "repeats"),
            (one.time - 0.25, value, "start" if one.time == 0 else "late by 0.25"),
            (np.nan, value, "nan"),
            (np.inf, value, "inf"),
            (None, value, "None"),
            ("1", value, "'1'"),
        ]:
            with pytest.raises(zakai.InputError, match=words) as caught:
                one.update(wrong, bad)
            assert "\n" not in str(caught.value)
        assert np.array_equal(one.update(time, value).mean, other.update(time, list(value)).mean)


def test_a_reading_that_would_leave_no_number_is_refused():
    model = zakai.Model(**WALK, observation_kind="samples")
    online = zakai.online(model, "kalman-bucy")
    online.update(0.1, 0.2)
    before = online.last.mean.copy()
    estimate = online.predict(0.2)
    with pytest.raises(zakai.InputError):
        online.update(0.2, 1e151)
    assert np.array_equal(online.last.mean, before)
    assert np.isfinite(online.update(0.2, 1e140).mean).all() and np.isfinite(estimate.mean).all()


def test_a_gap_of_any_length_is_filtered():
    model = zakai.Model(**WALK, observation_kind="samples")
    online = zakai.online(model, "kalman-bucy")
    online.update(0.1, 0.2)
    after = online.update(1e4, 0.4)
    # The law of the state has long been forgotten: variance 1 / (2 * 1/2) = 1 before the sample.
    assert np.isclose(after.cov[0, 0], 1 / (1 + 4)) and np.isclose(after.mean[0], 2 * 0.4 / 5)
    assert np.isfinite(online.update(1e4 + 0.1, 0.1).mean).all()


@pytest.mark.parametrize("time", [1e12, 1e150])
@pytest.mark.parametrize("name", ["kalman-bucy-1d", "benes", "spiral-sensor"])
def test_an_enormous_gap_is_filtered_or_refused_in_one_line_and_then_leaves_the_filter_as_it_was(name, time):
    model = zakai.load_model(f"gallery:{name}")
    online, other = zakai.online(model), zakai.online(model)
    for one in (online, other):
        one.update(0.1, [0.1] * model.m)
    try:
        estimate = online.update(time, [0.1] * model.m)
        assert np.isfinite(estimate.mean).all() and (np.diag(estimate.cov) > 0).all()
    except zakai.InputError as error:
        assert "\n" not in str(error)
        assert np.array_equal(online.update(0.2, [0.1] * model.m).mean, other.update(0.2, [0.1] * model.m).mean)


def test_an_option_that_needs_all_times_is_refused():
    with pytest.raises(zakai.InputError, match="one-shot"):
        zakai.online(zakai.Model(**WALK, observation_kind="increments"), "hu-yau", form="one-shot")
    with pytest.raises(zakai.InputError, match="no option"):
        zakai.online(zakai.Model(**WALK, observation_kind="increments"), "kalman-bucy", points=3)
    with pytest.raises(zakai.InputError, match="Model"):
        zakai.online("gallery:benes")


def test_many_filters_in_threads_do_not_disturb_each_other():
    model = zakai.Model(**TIMED, observation_kind="increments")
    other = zakai.Model(**TWO, observation_kind="samples")
    records = [simulated(m, UNIFORM, seed) for seed in range(3) for m in (model, other)]
    alone = [[e.mean.copy() for e in estimates_of(zakai.online(m), r)] for m, r in zip([model, other] * 3, records, strict=True)]
    found = [[] for _ in records]

    def work(index):
        online = zakai.online((model, other)[index % 2])
        found[index] = [e.mean.copy() for e in estimates_of(online, records[index])]

    threads = [Thread(target=work, args=(index,)) for index in range(len(records))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(a, b) for a, b in zip(alone, found, strict=True))


def test_one_filter_that_threads_share_takes_every_reading_once():
    model = zakai.Model(**WALK, observation_kind="samples")
    online, late = zakai.online(model, "kalman-bucy"), []

    def work():
        for time in UNIFORM:
            try:
                online.update(time, 0.1)
            except zakai.InputError as error:
                late.append(str(error))

    threads = [Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert online.time == UNIFORM[-1] and len(late) >= len(UNIFORM)


def test_a_system_of_blocks_is_filtered_block_by_block():
    model = zakai.Model(
        state=["x", "v"],
        drift=["-x", "cos(t) - v/3"],
        observation=["x", "v/2"],
        observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [[1.0, 0.0], [0.0, 2.0]]},
    )
    record = simulated(model, UNIFORM[:12], gaps=[(3, 0), (4, 1)])
    online = zakai.online(model, "extended-kalman-bucy")
    whole = zakai.filter(model, record, "extended-kalman-bucy")
    estimates = estimates_of(online, record)
    assert np.allclose([e.mean for e in estimates], whole.mean[1:], rtol=0, atol=1e-12)
    assert np.allclose([e.cov for e in estimates], whole.cov[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "method", "tolerance"),
    [
        (dict(WALK, observation=["x*sin(x)", "x*cos(x)"]), "limited-direct", 1e-12),
        (CUBIC, "kolmogorov-series", 1e-12),
        (dict(WALK, observation=["sin(x)"]), "yau-yau", 1e-12),
    ],
)
def test_what_is_not_a_gaussian_gives_what_a_record_gives(keys, method, tolerance):
    model = zakai.Model(**keys, observation_kind="increments")
    compare(model, simulated(model, np.arange(1, 61) / 100), method, tolerance)


@pytest.mark.parametrize(
    ("keys", "method", "kind"),
    [(CUBIC, "yau-yau", "increments"), (dict(WALK, observation=["x*sin(x)", "x*cos(x)"]), "auto", "samples")],
)
def test_an_outlier_of_fifty_deviations_neither_breaks_nor_freezes_the_filter(keys, method, kind):
    model = zakai.Model(**keys, observation_kind=kind)
    times = np.arange(1, 61) / 20
    record = simulated(model, times)
    deviation = 1.0 if kind == "samples" else np.sqrt(1 / 20)
    clean, struck, refused = zakai.online(model, method), zakai.online(model, method), []
    for k, (time, value) in enumerate(zip(times, record.values, strict=True)):
        usual = clean.update(time, value)
        try:
            estimate = struck.update(time, value + (50 * deviation if k == 20 else 0.0))
        except zakai.InputError as error:
            refused.append((k, str(error)))
            continue
        assert np.isfinite(estimate.mean).all() and (np.diag(estimate.cov) > 0).all()
    assert [k for k, _ in refused] in ([], [20]) and all("not used" in text for _, text in refused)
    # After two units of time the system has come back.
    assert np.all(abs(estimate.mean - usual.mean) < 3 * np.sqrt(np.diag(usual.cov)))


def test_a_density_that_moves_far_is_the_same_to_the_bit_online():
    model = zakai.Model(
        state=["x"],
        drift=["5*sin(3*t) - x + sin(x)/7"],
        observation=["x"],
        observation_kind="samples",
        observation_noise=[["1/100"]],
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[1.0]]},
    )
    _, record = zakai.simulate(model, 0.05 * np.arange(1, 61), seed=1)
    result, online = zakai.filter(model, record), zakai.online(model)
    found = [online.update(*pair).mean for pair in zip(record.times, record.values, strict=True)]
    assert np.array_equal(found, result.mean[1:])


@pytest.mark.parametrize(
    ("keys", "method"),
    [
        (dict(drift=["x - x**3 + sin(t)"], observation=["x**3"], observation_kind="path"), "yau-yau"),
        (dict(drift=["x - x**3 + sin(t)"], observation=["x", "abs(x)"], observation_kind="samples"), "yau-yau"),
        (dict(drift=["sin(x + t)"], observation=["x"], observation_kind="increments", cross_noise=[["1/10"]]), "yau-yau"),
        (dict(drift=["t*x/40"], observation=["x*sin(x)", "x*cos(x)"], observation_kind="increments"), "limited-direct"),
        (dict(drift=["tanh(x)"], observation=["x + t"], observation_kind="path"), "limited-direct"),
        (dict(drift=["-x + sin(t)"], observation=["x**2"], observation_kind="samples"), "limited-direct"),
    ],
)
def test_one_interval_after_the_other_is_prepared_as_those_of_a_record_to_the_bit(keys, method):
    noise = [["1/9" if i == j else "0" for j in range(len(keys["observation"]))] for i in range(len(keys["observation"]))]
    prior = {"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]}
    model = zakai.Model(state=["x"], observation_noise=noise, prior=prior, **keys)
    record = simulated(model, IRREGULAR[:12], gaps=[(3, 0), (4, 0), (9, 0)])
    whole, online = zakai.filter(model, record, method), zakai.online(model, method)
    for k, estimate in enumerate(estimates_of(online, record), 1):
        assert estimate.mean == whole.mean[k] and estimate.cov == whole.cov[k]
        assert estimate.log_likelihood_increment == whole.log_likelihood_increments[k]
        assert estimate.health == {name: figures[k] for name, figures in whole.health.items()}
