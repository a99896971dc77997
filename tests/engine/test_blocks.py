"""A system that falls into independent blocks is filtered block by block, and the result is that of the whole."""

import numpy as np
import pytest

import zakai
from zakai.algebra import choice
from zakai.engine import results
from zakai.engine.driver import filter_from
from zakai.engine.likelihood import log_likelihood
from zakai.errors import ConditionError, InputError


@pytest.fixture(autouse=True)
def blocks_even_of_few_states(monkeypatch):
    """Linear blocks of few states are filtered apart, as those of many are."""
    monkeypatch.setattr(choice, "FEW", 1)


TIMES = np.cumsum([0.1, 0.05, 0.2, 0.1, 0.1, 0.15, 0.05, 0.1, 0.3, 0.1])

# Three systems that have nothing to do with each other: a linear one in two states, a sine that is sampled, a tanh.
LINEAR = dict(state=["p", "v"], drift=["v", "-p - a*v"], observation=["p + v/2"], observation_noise=[["1/4"]])
SINE = dict(state=["s"], drift=["-s/3 + t"], observation=["sin(s)"], observation_noise=[["1/9"]])
TANH = dict(state=["w"], drift=["tanh(w)"], observation=["w", "2*w"], observation_noise=[["1", "1/2"], ["1/2", "1"]])
PRIORS = [([1.0, 0.0], [[1.0, 0.3], [0.3, 0.5]]), ([0.5], [[0.6]]), ([0.2], [[0.8]])]
# Where the states and the observations of the three stand in the whole.
STATES, ROWS = [(2, 0), (1,), (3,)], [(1,), (3,), (0, 2)]


def gaussian(mean, cov):
    return {"kind": "gaussian", "mean": mean, "cov": cov}


def parts(kind):
    common = {"observation_kind": kind, "parameters": {"a": 0.4}}
    return [
        zakai.Model(**one, **common, prior=gaussian(*prior)) for one, prior in zip((LINEAR, SINE, TANH), PRIORS, strict=True)
    ]


def whole(kind, names=None):
    state, drift, observation = [None] * 4, [None] * 4, [None] * 4
    noise, mean, cov = np.full((4, 4), "0", object), np.zeros(4), np.zeros((4, 4))
    for one, prior, places, rows in zip((LINEAR, SINE, TANH), PRIORS, STATES, ROWS, strict=True):
        for k, i in enumerate(places):
            state[i], drift[i], mean[i] = one["state"][k], one["drift"][k], prior[0][k]
            cov[i, list(places)] = prior[1][k]
        for k, i in enumerate(rows):
            observation[i] = one["observation"][k]
            noise[i, list(rows)] = one["observation_noise"][k]
    return zakai.Model(
        state=state, drift=drift, observation=observation, observation_noise=noise.tolist(), observation_kind=kind,
        parameters={"a": 0.4}, prior=gaussian(mean.tolist(), cov.tolist()),
    )  # fmt: skip


def record_of(model, times=TIMES, gaps=True):
    record = zakai.simulate(model, times, seed=4)[1]
    values = record.values.copy()
    if gaps:
        values[2, 1], values[4], values[5:7, 0] = np.nan, np.nan, np.nan
    return zakai.Record(record.times, values, record.kind)


def check_whole_and_parts(kind, times=TIMES):
    model = whole(kind)
    record = record_of(model, times)
    result = zakai.filter(model, record)
    alone = [
        zakai.filter(part, zakai.Record(times, record.values[:, list(rows)], kind))
        for part, rows in zip(parts(kind), ROWS, strict=True)
    ]
    assert result.state == ("v", "s", "p", "w") and len(result.blocks) == 3
    expected = np.zeros((len(times) + 1, 4, 4))
    for one, places in zip(alone, STATES, strict=True):
        assert np.allclose(result.mean[:, places], one.mean, rtol=0, atol=1e-10)
        expected[np.ix_(range(len(expected)), places, places)] = one.cov
    assert np.allclose(result.cov, expected, rtol=0, atol=1e-10)
    assert np.allclose(result.variance, np.diagonal(expected, axis1=1, axis2=2), rtol=0, atol=1e-10)
    increments = sum(one.log_likelihood_increments for one in alone)
    assert np.allclose(result.log_likelihood_increments, increments, rtol=0, atol=1e-9)
    last, x = result.density(-1), np.random.default_rng(0).normal(size=(5, 4))
    logs = sum(one.density(-1).log_density(x[:, list(places)]) for one, places in zip(alone, STATES, strict=True))
    assert np.allclose(last.log_density(x), logs, rtol=0, atol=1e-7)
    assert last.names == model.state and last.marginal(["w", "p"]).names == ("w", "p")
    for name in {name for one in alone for name in one.health}:
        values = np.array([one.health[name] for one in alone if name in one.health])
        worst = values.min(axis=0) if name == "std_in_spacings" else values.max(axis=0)
        # The depth to which tails are accurate is the logarithm of a rounding error, which differs with the increments of a path;
        # so do figures that are rounding, some 1e-9 of the tolerance.
        relative = 1e-3 if name == "tail_depth" else 1e-6
        assert np.allclose(result.health[name], worst, rtol=relative, atol=1e-8, equal_nan=True), name
    return model, record, result


def test_a_sampled_system_of_three_blocks_is_its_parts():
    times = np.concatenate([[0.0], TIMES])  # a sample at the start itself too
    _, _, result = check_whole_and_parts("samples", times)
    assert result.method == "blocks: kalman-bucy, limited-direct, benes"
    assert "(v, p) by kalman-bucy; s by limited-direct; w by benes" in result.why
    assert [block.state for block in result.blocks] == [("v", "p"), ("s",), ("w",)]
    assert any(name.startswith("benes for w") for name in result.conditions)


@pytest.mark.parametrize("kind", ["increments", "path", "rates"])
def test_other_kinds_of_observations_are_those_of_the_parts_too(kind, monkeypatch):
    # sin is observed where q must be quadratic: sin^2 + cos^2 is.
    monkeypatch.setitem(SINE, "observation", ["2*cos(s)", "2*sin(s)"])
    monkeypatch.setitem(SINE, "observation_noise", [["1", "0"], ["0", "1"]])
    monkeypatch.setitem(TANH, "observation", ["w"])
    monkeypatch.setitem(TANH, "observation_noise", [["1/2"]])
    monkeypatch.setattr(f"{__name__}.ROWS", [(1,), (3, 0), (2,)])
    check_whole_and_parts(kind)


def pairs(count, means, names="x"):
    """`count` pairs of states with the same equations, all of it linear."""
    state = [f"{names}{i}{k}" for i in range(count) for k in "ab"]
    drift = [f for i in range(count) for f in (f"{state[2 * i + 1]}", f"-{state[2 * i]} - {state[2 * i + 1]}/2")]
    cov = np.kron(np.eye(count), [[1.0, 0.2], [0.2, 0.7]])
    observation = [state[2 * i] for i in range(count)]
    return zakai.Model(state=state, drift=drift, observation=observation, prior=gaussian(list(means), cov.tolist()))


def test_linear_blocks_are_one_kalman_bucy_filter():
    model = pairs(2, np.linspace(-1, 1, 4))
    record = record_of(model)
    blocks, one = zakai.filter(model, record), zakai.filter(model, record, "kalman-bucy")
    assert blocks.method == "blocks: 2 x kalman-bucy" and one.method == "kalman-bucy"
    assert np.allclose(blocks.mean, one.mean, rtol=0, atol=1e-11)
    assert np.allclose(blocks.cov, one.cov, rtol=0, atol=1e-11)
    assert np.allclose(blocks.log_likelihood_increments, one.log_likelihood_increments, rtol=0, atol=1e-11)
    x = np.random.default_rng(0).normal(size=(4, 4))
    for k in (0, 3, -1):
        assert np.allclose(blocks.density(k).log_density(x), one.density(k).log_density(x), rtol=0, atol=1e-8)


def test_names_and_their_order_do_not_matter():
    means = np.linspace(-1, 1, 6)
    model, other = pairs(3, means), pairs(3, means, names="other_")
    record = record_of(model)
    first, second = zakai.filter(model, record), zakai.filter(other, record)
    assert np.array_equal(first.mean, second.mean) and first.log_likelihood == second.log_likelihood
    order = [2, 0, 1]
    places = [2 * i + k for i in order for k in (0, 1)]
    turned = zakai.filter(pairs(3, means[places]), zakai.Record(record.times, record.values[:, order], record.kind))
    assert np.allclose(turned.mean, first.mean[:, places], rtol=0, atol=1e-12)
    assert np.allclose(turned.log_likelihood, first.log_likelihood, rtol=0, atol=1e-11)


def test_two_spirals_are_one_system_of_two_states():
    state = ["x", "y"]
    model = zakai.Model(
        state=state, drift=["0", "0"], observation=[f"{s}*{f}({s})" for s in state for f in ("sin", "cos")],
        observation_kind="samples", prior=gaussian([0.5, 1.0], [0.5, 0.3]),
    )  # fmt: skip
    record = record_of(model, gaps=False)
    blocks, one = zakai.filter(model, record), zakai.filter(model, record, "limited-direct")
    assert blocks.method == "blocks: 2 x limited-direct" and one.method == "limited-direct"
    assert np.allclose(blocks.mean, one.mean, rtol=0, atol=1e-8) and np.allclose(blocks.cov, one.cov, rtol=0, atol=1e-8)
    assert np.allclose(blocks.log_likelihood_increments, one.log_likelihood_increments, rtol=0, atol=1e-8)


def sines(count, **keys):
    state = [f"x{i}" for i in range(count)]
    prior = gaussian([0.5] * count, [0.5] * count)
    plain = dict(drift=["0"] * count, observation=[f"sin({s})" for s in state], observation_kind="samples", prior=prior)
    return zakai.Model(**{"state": state, **plain, **keys})


def test_a_named_method_is_taken_block_by_block_where_it_holds_only_so():
    model = sines(5)
    result = zakai.filter(model, record_of(model), "limited-direct", kernel="power-series")
    assert result.method == "blocks: 5 x limited-direct" and "the method asked for holds for each" in result.why
    assert result.mean.shape == (len(TIMES) + 1, 5)
    with pytest.raises(ConditionError, match="benes does not hold: .* nor block by block"):
        zakai.filter(model, record_of(model), "benes")


def test_an_option_goes_to_the_blocks_whose_method_has_it():
    model = whole("samples")
    record = record_of(model)
    with pytest.raises(InputError, match='option kernel: "exact" is neither "flow" nor "power-series"'):
        zakai.filter(model, record, kernel="exact")
    wrong = 'none of kalman-bucy and limited-direct and benes has an option "speed"; the options are .*kernel'
    with pytest.raises(InputError, match=wrong):
        zakai.filter(model, record, speed=3)


def test_a_prior_that_couples_blocks_joins_them():
    model = pairs(3, np.zeros(6))
    record = record_of(model)
    coupled = model.prior.cov.copy()
    coupled[0, 2] = coupled[2, 0] = 0.6
    mixed = type(model.prior)(model.prior.mean, coupled)
    result = filter_from(mixed, model, record)
    assert result.method == "blocks: 2 x kalman-bucy" and result.model is None
    expected = filter_from(mixed, model, record, "kalman-bucy")
    assert np.allclose(result.cov, expected.cov, rtol=0, atol=1e-11) and abs(result.cov[-1, 0, 2]) > 1e-3
    both = filter_from([mixed, model.prior], model, [record, record])
    assert np.allclose(both[0].mean, result.mean, rtol=0, atol=1e-12) and len(both[1].blocks) == 3


def test_a_block_that_is_not_observed_follows_its_prior():
    model = pairs(3, np.ones(6))
    record = record_of(model)
    seen = zakai.filter(model, record)
    keys = {"state": model.state, "drift": list(model.drift), "prior": model.prior}
    fewer = zakai.Model(**keys, observation=list(model.observation)[:2])
    result = zakai.filter(fewer, zakai.Record(TIMES, record.values[:, :2], record.kind))
    assert np.allclose(result.mean[:, :4], seen.mean[:, :4], rtol=0, atol=1e-12)
    blind = zakai.filter(model, zakai.Record(TIMES, np.where(np.arange(3) == 2, np.nan, record.values), record.kind))
    assert np.allclose(result.mean, blind.mean, rtol=0, atol=1e-12) and np.allclose(result.cov, blind.cov, rtol=0, atol=1e-12)
    assert np.isclose(result.log_likelihood, blind.log_likelihood, rtol=0, atol=1e-11)


def test_records_of_a_list_and_what_is_kept_and_progress():
    model = pairs(2, np.linspace(-1, 1, 4))
    first, second = record_of(model), record_of(model, gaps=False)
    reported = []
    both = zakai.filter(model, [first, second], progress=lambda done, total: reported.append((done, total)), keep="moments")
    assert reported[-1] == (20, 20) and all(done <= total for done, total in reported) and reported == sorted(reported)
    for result, record in zip(both, (first, second), strict=True):
        assert result.record is record and result.model is model
        assert np.allclose(result.mean, zakai.filter(model, record).mean, rtol=0, atol=1e-12)
        with pytest.raises(InputError, match='keep="densities" keeps them'):
            result.density(0)


def test_the_same_warning_of_many_blocks_is_said_once():
    count = 12
    state = [f"x{i}" for i in range(count)]
    model = zakai.Model(
        state=state, drift=[f"-{s}" for s in state], observation=state, observation_kind="path",
        prior=gaussian([0.0] * count, [1.0] * count),
    )  # fmt: skip
    record = zakai.simulate(model, TIMES, seed=0)[1]
    values = record.values.copy()
    values[3], values[5, 4], values[7, 7:] = np.nan, np.nan, np.nan
    warnings = zakai.filter(model, zakai.Record(TIMES, values, "path")).warnings
    assert len(warnings) == 1
    assert warnings[0].startswith("x0: at 1 of 10 times a path is observed after a gap")
    assert warnings[0].endswith("the same, in other numbers, of 11 more blocks: x1, x2, x3 and 8 more")
    same = np.where(np.arange(10)[:, None] == 3, np.nan, record.values)
    reported = zakai.filter(model, zakai.Record(TIMES, same, "path")).warnings
    assert len(reported) == 1 and reported[0].startswith("x0, x1, x2 and 9 more (12 blocks): at 1 of 10 times")


def test_a_result_is_stored_and_its_covariances_are_not_where_they_are_many(tmp_path, monkeypatch):
    model = pairs(2, np.zeros(4))
    result = zakai.filter(model, record_of(model))
    result.save(tmp_path / "few.nc")
    again = zakai.load_result(tmp_path / "few.nc")
    assert np.array_equal(again.cov, result.cov) and again.method == "blocks: 2 x kalman-bucy"
    many = pairs(20, np.zeros(40))
    result = zakai.filter(many, record_of(many, gaps=False))
    result.save(tmp_path / "many.nc")
    again = zakai.load_result(tmp_path / "many.nc")
    assert np.array_equal(again.variance, result.variance)
    with pytest.raises(InputError, match="the covariances of 40 states were not stored"):
        _ = again.cov
    monkeypatch.setattr(results, "_MOST_ASSEMBLED", 1000)
    with pytest.raises(InputError, match="see `variance`"):
        _ = result.cov
    assert result.blocks[3].cov.shape == (11, 2, 2) and result.density(-1).cov().shape == (40, 40)


def decaying():
    state = ["x", "y", "z"]
    return zakai.Model(
        state=state, drift=["-a*x", "-a*y", "-b*z"], observation=[f"2*{s}" for s in state],
        parameters={"a": 0.7, "b": 0.7}, prior=gaussian([1.0] * 3, [0.5] * 3),
    )  # fmt: skip


def test_the_likelihood_of_blocks_is_their_sum_at_any_parameters():
    model = decaying()
    record = record_of(model)
    likelihood = log_likelihood(model, record)
    result = zakai.filter(model, record)
    assert result.method == "blocks: 3 x kalman-bucy"
    assert np.isclose(likelihood(model.theta()), result.log_likelihood, rtol=0, atol=1e-10)
    # The three blocks are equal at the model's own values only.
    other = zakai.filter(model.with_parameters(a=0.5, b=0.9), record)
    assert np.isclose(likelihood([0.5, 0.9]), other.log_likelihood, rtol=0, atol=1e-9)
    assert abs(other.log_likelihood - result.log_likelihood) > 1e-3


def test_the_gradient_of_blocks_is_that_of_the_whole():
    model = decaying()
    record = record_of(model)
    gradients = [log_likelihood(model, record, method).value_and_gradient(model.theta())[1] for method in ("auto", "kalman-bucy")]
    assert np.allclose(*gradients, rtol=0, atol=1e-8) and abs(gradients[0][0] - gradients[0][1]) > 0.01


def test_a_splitting_system_is_fitted_as_the_whole_is():
    model = pairs(3, np.linspace(-1, 1, 6))
    keys = {"state": model.state, "observation": list(model.observation), "prior": model.prior}
    free = zakai.Model(**keys, drift=[f"{f} - a*{s}" for f, s in zip(model.drift, model.state)], parameters={"a": 0.2})
    record = zakai.simulate(free, np.arange(1, 101) / 10, seed=2)[1]
    blocks, one = zakai.fit(free, record), zakai.fit(free, record, method="kalman-bucy")
    assert blocks.converged and blocks.method == "blocks: 3 x kalman-bucy"
    assert np.isclose(blocks.estimates["a"], one.estimates["a"], rtol=0, atol=1e-5)
    assert np.isclose(blocks.standard_errors["a"], one.standard_errors["a"], rtol=1e-3)


@pytest.mark.parametrize("smooth", [False, True])
def test_features_of_models_are_those_of_their_blocks(smooth):
    """Noise that depends on the state, counts and a reflecting end, each in a block of its own."""
    parts = [
        {"state": "x", "drift": "1 - x", "diffusion": "0.3*sqrt(1 + x**2)", "observation": "x", "noise": "0.1 + x**2/20"},
        {"state": "y", "drift": "-y", "diffusion": "1", "observation": "2*exp(y)", "family": "poisson"},
        {"state": "z", "drift": "-z", "diffusion": "0.5", "observation": "z", "noise": "0.1", "domain": {"lower": 0.0}},
    ]

    def model(parts):
        n = len(parts)
        return zakai.Model(
            state=[part["state"] for part in parts], drift=[part["drift"] for part in parts],
            diffusion=[[part["diffusion"] if i == j else "0" for j in range(n)] for i, part in enumerate(parts)],
            observation=[part["observation"] for part in parts], observation_kind="samples",
            observation_noise=[[part.get("noise", "1") if i == j else "0" for j in range(n)] for i, part in enumerate(parts)],
            observation_family=[part.get("family", "gaussian") for part in parts],
            domain={p["state"]: {**p["domain"], "boundary": "reflecting"} for p in parts if "domain" in p},
            prior={"kind": "gaussian", "mean": [1.0] * n, "cov": (0.01 * np.eye(n)).tolist()},
        )  # fmt: skip

    whole, run = model(parts), zakai.smooth if smooth else zakai.filter
    _, record = zakai.simulate(whole, np.arange(1, 11) / 5, seed=2)
    values = record.values.copy()
    values[3, 0] = values[5:7, 1] = np.nan
    result = run(whole, zakai.Record(record.times, values, "samples"))
    assert [block.state for block in result.blocks] == [(part["state"],) for part in parts]
    for i, part in enumerate(parts):
        alone = run(model([part]), zakai.Record(record.times, values[:, [i]], "samples"))
        assert np.array_equal(result.mean[:, i], alone.mean[:, 0])
        assert np.array_equal(result.variance[:, i], alone.variance[:, 0])


def test_a_stored_result_of_a_smoother_says_so_when_it_is_read(tmp_path):
    model = pairs(2, np.zeros(4))
    result = zakai.smooth(model, record_of(model))
    result.save(tmp_path / "smoothed.nc")
    again = zakai.load_result(tmp_path / "smoothed.nc")
    assert isinstance(again, zakai.SmoothingResult) and again.to_dataset().attrs["kind"] == "smoothed"
    assert np.array_equal(again.mean, result.mean)
    with pytest.raises(InputError, match="sample_paths: a result that was read from a file"):
        again.sample_paths(2)
