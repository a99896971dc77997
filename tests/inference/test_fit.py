"""Maximum likelihood finds the parameters that made a record, and says so when it cannot."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import zakai
from zakai.inference import maximum

LINE = dict(
    state=["x"],
    drift=["-a*x"],
    observation=["c*x"],
    observation_noise=[["s"]],
    observation_kind="samples",
    parameters={"a": 0.5, "c": 1.0, "s": 0.3},
    prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
)


@pytest.fixture(scope="module")
def line():
    model = zakai.Model(**LINE)
    return model, zakai.simulate(model, 0.1 * np.arange(1, 401), seed=0)[1]


@pytest.fixture(scope="module")
def fitted(line):
    return zakai.fit(*line, parameters=["a", "s"], method="kalman-bucy", start={"a": 2.0, "s": 1.0})


def test_a_fit_finds_what_made_the_record_within_three_standard_errors(fitted):
    assert fitted.converged and fitted.warnings == []
    for name, truth in (("a", 0.5), ("s", 0.3)):
        assert abs(fitted.estimates[name] - truth) < 3 * fitted.standard_errors[name]
    assert fitted.model.theta().tolist() == [fitted.estimates["a"], 1.0, fitted.estimates["s"]]


def test_the_maximum_is_that_of_a_plain_scan(line, fitted):
    model, record = line

    def at(a, s):
        return zakai.filter(model.with_parameters(a=a, s=s), record, "kalman-bucy", keep="moments").log_likelihood

    a, s = fitted.estimates["a"], fitted.estimates["s"]
    da, ds = (0.2 * fitted.standard_errors[name] for name in ("a", "s"))
    values = np.array([[at(a + i * da, s + j * ds) for j in (-1, 0, 1)] for i in (-1, 0, 1)])
    assert values.max() == values[1, 1]
    assert np.isclose(values[1, 1], fitted.log_likelihood, rtol=0, atol=1e-9)
    # The curvature of the scan is the information, to the order of the steps.
    hessian = [(values[2, 1] - 2 * values[1, 1] + values[0, 1]) / da**2, (values[1, 2] - 2 * values[1, 1] + values[1, 0]) / ds**2]
    assert np.allclose(np.linalg.inv(fitted.covariance).diagonal(), -np.array(hessian), rtol=0.01)


def test_the_covariance_is_the_inverse_of_the_hessian(line, fitted):
    likelihood = zakai.log_likelihood(*line, "kalman-bucy", ["a", "s"])
    at = np.array([fitted.estimates["a"], fitted.estimates["s"]])

    def slope(values):
        return likelihood.value_and_gradient(values)[1]

    hessian = np.array([(slope(at + e) - slope(at - e)) / 2e-5 for e in 1e-5 * np.eye(2)])
    assert np.allclose(fitted.covariance, np.linalg.inv(-hessian), rtol=1e-4)


def test_a_fit_prints_its_estimates(fitted):
    page = str(fitted)
    assert "kalman-bucy, 400 observations" in page and "a = " in page and "+-" in page and "converged" in page


def test_a_likelihood_that_does_not_exist_turns_the_search_back(line):
    fitted = zakai.fit(*line, parameters=["s"], method="kalman-bucy", start={"s": 40.0})
    assert fitted.converged and abs(fitted.estimates["s"] - 0.3) < 3 * fitted.standard_errors["s"]


def test_a_parameter_at_its_bound_is_said(line):
    fitted = zakai.fit(*line, parameters=["a", "c"], method="kalman-bucy", start={"c": 1.6}, bounds={"c": (1.5, None)})
    assert fitted.converged and fitted.estimates["c"] == 1.5
    assert np.isnan(fitted.standard_errors["c"]) and fitted.standard_errors["a"] > 0
    assert "at a bound (c = 1.5)" in fitted.warnings[0]


def test_parameters_that_the_record_does_not_tell_apart_have_no_standard_errors(line):
    model = zakai.Model(**{**LINE, "observation": ["c*d*x"], "parameters": {**LINE["parameters"], "d": 1.0}})
    fitted = zakai.fit(model, line[1], parameters=["c", "d"], method="kalman-bucy")
    assert np.isnan(list(fitted.standard_errors.values())).all()
    assert "does not determine c, d" in fitted.warnings[0]


def limited(**values):
    """Return a model whose noise exists for r > q**2, and a record."""
    keys = {**LINE, "observation": ["x"], "process_noise": [["q"]]}
    times = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.3, 100))
    true = zakai.Model(**{**keys, "observation_noise": [["r"]], "parameters": {"a": 0.5, "q": 1.0, "r": 0.02}})
    model = zakai.Model(**{**keys, "observation_noise": [["r - q**2"]], "parameters": values})
    return model, zakai.simulate(true, times, seed=2)[1]


def test_a_maximum_at_a_limit_of_the_parameters_is_found_and_said():
    model, record = limited(a=3.0, q=2.0, r=5.0)
    fitted = zakai.fit(model, record, ["q", "r"], method="kalman-bucy")
    best = max(
        zakai.filter(model.with_parameters(q=q, r=q**2 + 1e-6), record, "kalman-bucy").log_likelihood
        for q in np.linspace(3.0, 3.5, 11)
    )
    assert not fitted.converged and best - 0.2 < fitted.log_likelihood < best
    assert "a limit of the parameters" in fitted.warnings[0] and "a limit of the parameters" in fitted.message
    assert "q = 3.2" in fitted.warnings[0] and "observation_noise: is not positive definite" in fitted.warnings[0]
    assert len(fitted.warnings) == 1


def test_a_limit_in_the_way_does_not_end_the_search():
    model, record = limited(a=3.0, q=2.0, r=5.0)
    fitted = zakai.fit(model, record, method="kalman-bucy")
    near = zakai.fit(model.with_parameters(a=0.5, q=1.0, r=1.1), record, method="kalman-bucy")
    assert fitted.converged and near.converged
    assert np.isclose(fitted.log_likelihood, near.log_likelihood, rtol=0, atol=1e-6)


def test_a_fit_that_does_not_converge_says_so(line, monkeypatch):
    monkeypatch.setattr(maximum, "ITERATIONS", 1)
    monkeypatch.setattr(maximum, "NEAR", 0.0)
    fitted = zakai.fit(*line, parameters=["a"], method="kalman-bucy", start={"a": 2.0})
    assert not fitted.converged and "did not converge" in fitted.warnings[0] and "not converged" in str(fitted)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"parameters": ["b"]}, 'there is no "b"'),
        ({"parameters": "a"}, "not a list of names"),
        ({"parameters": []}, "at least one"),
        ({"parameters": ["a"], "start": {"s": 1.0}}, "not among the parameters"),
        ({"parameters": ["a"], "start": {"a": "x"}}, "not a number"),
        ({"parameters": ["a"], "bounds": {"a": (1, 0)}}, "not below"),
        ({"parameters": ["a"], "bounds": {"a": 1}}, "not a pair"),
        ({"parameters": ["a"], "bounds": {"a": (1, 2)}}, "outside its bounds"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(line, arguments, words):
    with pytest.raises(zakai.InputError, match=words) as raised:
        zakai.fit(*line, method="kalman-bucy", **arguments)
    assert "\n" not in str(raised.value)


def test_a_model_without_parameters_has_nothing_to_fit():
    model = zakai.load_model("gallery:spiral-sensor")
    if not model.parameters:
        record = zakai.simulate(model, [0.1, 0.2], seed=0)[1]
        with pytest.raises(zakai.InputError, match="has none"):
            zakai.fit(model, record)


@pytest.mark.parametrize(
    ("keys", "truth", "method", "count"),
    [
        (dict(drift=["a*tanh(a*x)"], observation=["c*x"], parameters={"a": 0.8, "c": 1.0}), {"a": 0.8, "c": 1.0}, "benes", 300),
        (
            dict(drift=["t/40*x"], observation=["c*x*sin(x)", "c*x*cos(x)"], parameters={"c": 1.0}),
            {"c": 1.0}, "limited-direct", 150,
        ),
    ],
)  # fmt: skip
def test_nonlinear_systems_are_fitted(keys, truth, method, count):
    prior = {"kind": "gaussian", "mean": [0.5], "cov": [[0.5]]}
    model = zakai.Model(state=["x"], prior=prior, **keys)
    _, record = zakai.simulate(model, 0.02 * np.arange(1, count + 1), seed=4)
    fitted = zakai.fit(model, record, method=method, start={name: 1.3 * value for name, value in truth.items()})
    assert fitted.converged and fitted.warnings == []
    for name, value in truth.items():
        assert abs(fitted.estimates[name] - value) < 3 * fitted.standard_errors[name]
    scan = [
        zakai.filter(fitted.model.with_parameters(c=fitted.estimates["c"] + shift), record, method).log_likelihood
        for shift in (-1e-2, 0.0, 1e-2)
    ]
    assert scan[1] == max(scan) and np.isclose(scan[1], fitted.log_likelihood, rtol=0, atol=1e-9)


def test_the_likelihood_of_a_double_well_and_its_gradient_are_right():
    """Samples .1 to .5 apart: a plain sum over a fine grid with the matrix exponential is the reference."""
    model = zakai.Model(
        state=["x"], drift=["k*(x - x**3)"], process_noise=[["0.49"]], observation=["x"], observation_noise=[["0.2"]],
        observation_kind="samples", parameters={"k": 1.0}, prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.05]]},
    )  # fmt: skip
    times = np.cumsum(np.random.default_rng(2).uniform(0.1, 0.5, 25))
    record = zakai.simulate(model, times, seed=3)[1]
    x = np.linspace(-2.6, 2.6, 129)
    d = x[1] - x[0]
    offset = np.subtract.outer(np.arange(129), np.arange(129)) + 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        second = np.where(offset == 0, np.pi**2 / 3, 2 * (-1.0) ** offset / offset**2) / d**2

    def reference(k):
        f, slope = k * (x - x**3), k * (1 - 3 * x**2)
        gauge = np.exp(k * (x**2 / 2 - x**4 / 4) / 0.49)
        rates, modes = np.linalg.eigh(0.245 * second + np.diag(0.5 * (f**2 / 0.49 + slope)))
        p, total, before = np.exp(-0.5 * (x - 0.5) ** 2 / 0.05), 0.0, 0.0
        p /= p.sum() * d
        for time, (z,) in zip(times, record.values, strict=True):
            p = gauge * (modes @ (np.exp(-(time - before) * rates) * (modes.T @ (p / gauge))))
            p = p * np.exp(-0.5 * (z - x) ** 2 / 0.2) / np.sqrt(0.4 * np.pi)
            mass, before = p.sum() * d, time
            p, total = p / mass, total + np.log(mass)
        return total

    likelihood = zakai.log_likelihood(model, record)
    value, (slope,) = likelihood.value_and_gradient([1.0])
    assert np.isclose(value, reference(1.0), rtol=0, atol=1e-6)
    assert np.isclose(slope, (reference(1 + 1e-4) - reference(1 - 1e-4)) / 2e-4, rtol=1e-5)
    fitted = zakai.fit(model, record)
    assert fitted.converged and reference(fitted.estimates["k"]) >= value - 1e-6


@pytest.mark.filterwarnings("ignore:log_likelihood")  # one jump of the drift is not resolved
@pytest.mark.parametrize("jump", ["sign(x - b)", "heaviside(x - b)", "floor(x - b)"])
def test_the_place_of_a_jump_has_no_gradient(jump):
    model = zakai.Model(
        state=["x"], drift=[f"-k*x + {jump}/2"], observation=["x"], observation_kind="samples", observation_noise=[[0.1]],
        prior={"kind": "gaussian", "mean": [0.2], "cov": [[0.2]]}, parameters={"k": 1.0, "b": 0.1},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.3], [[0.1], [0.3]], "samples")
    for refused in (lambda: zakai.fit(model, record), lambda: zakai.log_likelihood(model, record).value_and_gradient([1, 0.1])):
        with pytest.raises(zakai.InputError, match="place of a jump.* depends on b"):
            refused()
    assert np.isfinite(zakai.log_likelihood(model, record)([1.0, 0.1]))
    assert np.isfinite(zakai.log_likelihood(model, record, parameters=["k"]).value_and_gradient([1.0])[1]).all()


@pytest.mark.parametrize(("last", "said"), [(0.9, False), (40.0, True)])
def test_a_log_likelihood_beyond_the_bounds_of_its_health_figures_warns(last, said):
    model = zakai.Model(
        state=["x"], drift=["a*x - x**3"], diffusion=[["1/2"]], observation=["x**3"], observation_kind="samples",
        observation_noise=[["1/10"]], prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}, parameters={"a": 1.0},
    )  # fmt: skip
    likelihood = zakai.log_likelihood(model, zakai.Record([0.3, 0.7, 1.0], [[0.2], [0.5], [last]], "samples"))
    for call in (likelihood, likelihood.value_and_gradient):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            call([1.0])
        assert [("tail_depth" in str(warning.message), warning.filename) for warning in found] == [(True, __file__)] * said


@pytest.mark.parametrize(
    "law",
    [
        {"observation_family": "student-t", "degrees_of_freedom": "p", "observation_noise": [["0.1"]]},
        {"observation_family": "von-mises", "concentration": "p"},
        {"observation": None, "observed": ["z"], "observation_log_density": "-(z - x)**2*p/2 + log(p/6.283185307179586)/2"},
    ],
    ids=["degrees of freedom", "concentration", "log density"],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_parameters_of_the_law_of_samples_have_gradients(law):
    keys = {key: value for key, value in {**LINE, "observation_noise": None, "observation": ["x"], **law}.items() if value}
    model = zakai.Model(**(keys | {"parameters": {"a": 0.5, "p": 4.0}, "drift": ["-a*x - x**3"]}))
    record = zakai.Record([0.2, 0.5, 0.6, 1.1], [[0.5], [1.4], [-0.3], [0.2]], "samples")
    likelihood, at = zakai.log_likelihood(model, record), np.array([0.5, 4.0])
    steps = np.diag([1e-4, 1e-3])
    expected = [(float(likelihood(at + h)) - float(likelihood(at - h))) / (2 * h.sum()) for h in steps]
    assert min(np.abs(expected)) > 1e-3
    np.testing.assert_allclose(likelihood.value_and_gradient(at)[1], expected, rtol=1e-4)


@pytest.mark.parametrize("start", [{"r": 3.0, "s": 3.0}, {"r": 8.0, "s": 10.0}, {"r": 1.0, "s": 10.0}, {"r": -3.0, "s": 3.0}])
def test_a_standard_deviation_keeps_the_sign_of_its_start(start):
    model = zakai.Model(
        state=["x"],
        drift=["-x"],
        diffusion=[["s"]],
        observation=["x"],
        observation_noise=[["r**2"]],
        observation_kind="samples",
        parameters={"r": 0.145, "s": 0.41},
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.2]]},
    )
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 61), seed=1)
    found = zakai.fit(model, record, start=start, method="kalman-bucy")
    r, s = np.sign(start["r"]), np.sign(start["s"])
    assert np.allclose([r * found.estimates["r"], s * found.estimates["s"]], [0.127105, 0.494795], rtol=1e-4)
    plain = zakai.fit(model, record, start={"r": 0.1, "s": 0.4}, method="kalman-bucy")
    assert np.allclose(found.covariance, plain.covariance * np.outer([r, s], [r, s]), rtol=1e-3)


def test_signs_that_only_change_together_are_those_of_the_start():
    """The cross noise s c, the noise s^2 and c^2 < 1: (s, c) and (-s, -c) are one system."""
    model = zakai.Model(
        state=["x"],
        drift=["-x"],
        diffusion=[["s"]],
        observation=["x"],
        cross_noise=[["c"]],
        parameters={"s": 0.8, "c": 0.6},
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.5]]},
    )
    _, record = zakai.simulate(model, 0.05 * np.arange(1, 401), seed=4)
    from zakai.inference.maximum import Found, with_signs_of

    function, values = zakai.log_likelihood(model, record, "kalman-bucy").value_and_gradient, np.array([0.8, 0.6])
    mirrored = Found(-values, function(values)[0], np.eye(2), True, "", "", 1, None)
    box = np.array([[-np.inf, np.inf]] * 2)
    assert np.array_equal(with_signs_of(np.array([0.5, 0.5]), mirrored, function, box).values, values)
    assert np.array_equal(with_signs_of(np.array([0.5, -0.5]), mirrored, function, box).values, -values)  # s alone is not even
    assert np.array_equal(with_signs_of(np.array([0.5, 0.5]), mirrored, function, np.array([[-np.inf, 0.0]] * 2)).values, -values)


def test_profile_intervals_are_where_the_likelihood_has_fallen():
    model = zakai.Model(
        state=["x"], drift=["-a*x"], diffusion=[["s"]], observation=["x"], observation_kind="samples",
        observation_noise=[["0.01"]], parameters={"a": 1, "s": 1}, prior={"kind": "gaussian", "mean": [0], "cov": [[0.5]]},
    )  # fmt: skip
    record = zakai.simulate(model, np.arange(0.2, 12, 0.2), seed=4)[1]
    fitted = zakai.fit(model, record)
    likelihood = zakai.log_likelihood(model, record)
    found = fitted.intervals(0.9)
    drop = 1.6448536269514722**2 / 2
    for i, name in enumerate(("a", "s")):
        for end in found[name]:  # the largest value over the other parameter, by brute force
            grid = fitted.estimates["s" if i == 0 else "a"] * np.linspace(0.3, 1.8, 301)
            highest = max(likelihood([end, other] if i == 0 else [other, end]) for other in grid)
            assert fitted.log_likelihood - highest == pytest.approx(drop, abs=0.02)
    assert found["a"][0] < fitted.estimates["a"] < found["a"][1]
    wide = fitted.intervals()
    assert all(wide[name][0] < found[name][0] and wide[name][1] > found[name][1] for name in found)
    with pytest.raises(zakai.InputError, match="intervals: level is 95"):
        fitted.intervals(95)


def test_an_end_of_an_interval_is_a_bound_or_infinite_where_the_likelihood_does_not_fall():
    model = zakai.Model(
        state=["x"], drift=["-x + b*x**2/100"], observation=["x"], observation_kind="samples", observation_noise=[["0.5"]],
        parameters={"b": 0}, prior={"kind": "gaussian", "mean": [0], "cov": [[0.5]]},
    )  # fmt: skip
    record = zakai.simulate(model, [0.2, 0.4, 0.8], seed=4)[1]
    low, high = zakai.fit(model, record, bounds={"b": (-0.5, 0.7)}).intervals()["b"]
    assert (low, high) == (-0.5, 0.7)


@pytest.mark.parametrize("start", [{"tau": 50.0, "sigma": 0.01}, {"tau": 100.0, "sigma": 5.0}, {"tau": 0.02, "sigma": 30.0}])
def test_a_far_start_leads_to_the_maximum_and_keeps_the_signs(start):
    model = zakai.Model(
        state=["x"], drift=["-x/tau"], diffusion=[["sigma"]], observation=["x"], observation_kind="samples",
        observation_noise=[["0.01"]], parameters={"tau": 1, "sigma": 1}, prior={"kind": "gaussian", "mean": [0], "cov": [[0.5]]},
    )  # fmt: skip
    record = zakai.simulate(model, np.arange(0.1, 20.05, 0.1), seed=2)[1]
    near, far = zakai.fit(model, record), zakai.fit(model, record, start=start)
    assert far.converged and far.warnings == []
    assert far.log_likelihood == pytest.approx(near.log_likelihood, abs=1e-3)
    assert far.estimates["tau"] == pytest.approx(near.estimates["tau"], rel=1e-3)


def test_a_start_from_a_plateau_leads_to_the_maximum():
    # With tau = 0.02 a state is forgotten between two observations: only sigma^2 tau counts, and the search ends anywhere.
    model = zakai.Model(
        state=["x"], drift=["-x/tau"], diffusion=[["sigma"]], observation=["x"], observation_kind="samples",
        observation_noise=[[0.01]], prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
        parameters={"tau": 1.0, "sigma": 1.0},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 201), seed=0)
    near, far = zakai.fit(model, record), zakai.fit(model, record, start={"tau": 0.02, "sigma": 30.0})
    assert near.converged and not near.warnings
    assert far.converged and not far.warnings
    assert far.log_likelihood == pytest.approx(near.log_likelihood, abs=1e-4)
    assert far.estimates == pytest.approx(near.estimates, rel=1e-3)


def test_a_fit_that_takes_long_is_announced(monkeypatch, caplog):
    from zakai import _progress

    monkeypatch.setattr(_progress, "FIRST", 0.001)
    model = zakai.Model(
        state=["x"], drift=["-a*x"], observation=["x"], observation_kind="samples", parameters={"a": 1.0},
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    zakai.fit(model, zakai.Record([0.5, 1.0, 1.5], [0.4, 0.3, 0.1], "samples"))
    assert re.search(r"fit: the search for the largest log-likelihood by a takes (at most )?about \d+ to \d+ s more", caplog.text)


def test_filters_of_a_fit_are_not_announced_one_by_one(monkeypatch, caplog):
    from zakai.engine import batch

    for name in ("FIRST", "EARLY", "SURE", "LONG"):
        monkeypatch.setattr(batch, name, 0.0)
    model = zakai.Model(
        state=["x"], drift=["-a*x"], observation=["x"], observation_kind="samples", parameters={"a": 1.0},
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    record = zakai.Record(np.arange(1, 200) * 0.05, np.sin(np.arange(1, 200)), "samples")
    zakai.filter(model, record, "guided-particles", particles=500)
    assert "more observations take" in caplog.text
    caplog.clear()
    zakai.fit(model, record, method="guided-particles", particles=500)
    assert "more observations take" not in caplog.text


def test_a_fit_on_grids_of_two_states_ends_where_their_accuracy_does(monkeypatch):
    from zakai.engine.likelihood import LogLikelihood

    model = zakai.Model(
        state=["x", "v"], drift=["v", "x - x**3 - 0.3*v"], diffusion=[["0"], ["s"]], observation=["x"],
        observation_noise=[["0.05"]], observation_kind="samples", parameters={"s": 0.5},
        prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [0.1, 0.1]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.arange(1, 21) * 0.25, seed=3)
    likelihood, calls, evaluated = zakai.log_likelihood(model, record, "yau-yau"), [], LogLikelihood._evaluated

    def counted(self, *given, **keys):
        calls.append(keys)
        return evaluated(self, *given, **keys)

    monkeypatch.setattr(LogLikelihood, "_evaluated", counted)
    fitted = zakai.fit(model, record, method="yau-yau", start={"s": 0.8})
    assert fitted.converged and len(calls) <= 12 and all(keys == {"own": False} for keys in calls)
    _, gradient = likelihood.value_and_gradient(list(fitted.estimates.values()))
    assert np.sqrt(gradient @ fitted.covariance @ gradient) < 0.02  # standard errors from the maximum
