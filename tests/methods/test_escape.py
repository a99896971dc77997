"""Drifts that reach infinity, or have a pole, within an interval: one line, or the right answer."""

import re

import numpy as np
import pytest

import zakai


def model_of(drift, mean=0.0, variance=1.0, **keys):
    n = len(drift)
    names = ["x", "y", "z"][:n]
    keys = {"observation": ["x"], "observation_kind": "samples", **keys}
    prior = {"kind": "gaussian", "mean": np.broadcast_to(mean, n).tolist(), "cov": np.broadcast_to(variance, n).tolist()}
    return zakai.Model(state=names, drift=drift, prior=prior, **keys)


def filtered(model, *times, value=0.3):
    return zakai.filter(model, zakai.Record(list(times), [[value]] * len(times), model.observation_kind))


@pytest.mark.parametrize(
    "drift, keys",
    [
        ("x**3", {}),
        ("x**2", {}),
        ("exp(x)", {}),
        ("x*abs(x)", {}),
        ("x**3 - x", {"mean": 2.0, "variance": 0.25}),
        ("x**3", {"observation_kind": "increments"}),
        ("x**3", {"diffusion": [["0"]]}),
        ("x**3", {"diffusion": [["1 + x**2/4"]]}),
        ("t*x**3", {}),
        ("a*x**3", {"parameters": {"a": 1.0}}),
        ("x*(1 + x**2)", {"diffusion": [["1 + x**2"]]}),  # x = tan(v)
        ("x**3", {"mean": 3.0, "variance": 0.1, "domain": {"x": {"lower": 0.0}}, "diffusion": [["x"]]}),
        ("x**3", {"mean": 3.0, "variance": 0.1, "domain": {"x": {"lower": 0.0, "boundary": "reflecting"}}}),
    ],
)
def test_a_drift_that_reaches_infinity_is_refused_by_its_key_and_formula(drift, keys):
    with pytest.raises(
        zakai.InputError, match=r"drift\[0\] = .*takes x to infinity between t = 0 and 1 with .*; give"
    ) as refused:
        filtered(model_of([drift], **keys), 1.0)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "drift, row, states",
    [
        (["x**3", "-y"], 0, "x"),
        (["y", "x**3"], 1, "x, y"),
        (["x**2 + 1", "x - y"], 0, "x"),
        (["x*y", "y**2"], 1, "x, y"),
        (["x**3 + y", "-y", "x - z"], 0, "x"),
    ],
)
def test_several_states_that_reach_infinity_are_named(drift, row, states):
    with pytest.raises(zakai.InputError, match=rf"drift\[{row}\] = .* takes {states} to infinity between t = 0 and 1"):
        filtered(model_of(drift), 1.0)


@pytest.mark.parametrize(
    "drift, keys, words",
    [
        ("1/x", {}, r"drift\[0\] = 1/x is infinite at x = 0; no path crosses it, .* give \[domain\] x = \{ lower = 0 \}"),
        ("1/x", {"mean": -2.0, "variance": 0.1}, r"comes close to it between t = 0 and 1; give \[domain\] x = \{ upper = 0 \}"),
        ("1/x", {"observation_kind": "increments"}, "no path crosses it"),
        ("1/(x - 1)", {}, r"= 1/\(x - 1\) is infinite at x = 1; no path crosses it"),
        ("-tan(x)", {}, r"no path crosses .*\{ lower = -1.5708, upper = 1.5708 \}"),
        ("tan(x)", {}, r"infinite at x = -?1.5708, which paths reach between t = 0 and 1 with probability"),
        ("-1/x", {}, r'which paths reach .*\{ lower = 0, boundary = "reflecting" \} if x is reflected there'),
        ("1/x**2", {}, "which paths reach"),
        ("0", {"diffusion": [["1/x"]]}, r"diffusion\[0\] = 1/x is infinite at x = 0"),
    ],
)
def test_a_pole_in_the_density_is_refused_with_the_domain_that_serves(drift, keys, words):
    with pytest.raises(zakai.InputError, match=words):
        filtered(model_of([drift], **keys), 1.0)


def test_particles_are_refused_as_grids_are():
    model, record = model_of(["x**3 + y", "-y"]), zakai.Record([1.0], [[0.3]], "samples")
    with pytest.raises(zakai.InputError, match=r"drift\[0\] = x\*\*3 \+ y takes x to infinity between t = 0 and 1"):
        zakai.filter(model, record, "guided-particles")
    near = model_of(["x**3 + y", "-y"], variance=0.01)
    assert np.isfinite(zakai.filter(near, zakai.Record([0.05], [[0.3]], "samples"), "guided-particles").mean).all()


@pytest.mark.parametrize("drift, mean", [(["x**2", "x - y"], [0.5, 0.0]), (["-x", "y**3 - y + x/5"], [0.0, 1.2])])
def test_a_tensor_train_refuses_what_reaches_infinity(drift, mean):
    noise = [["0.5", "0"], ["0", "0.5"]]
    model = model_of(drift, mean, 0.3, diffusion=noise, observation=["sin(x) + y"], observation_noise=[["0.5"]])
    record = zakai.Record(0.5 * np.arange(1, 8), np.zeros((7, 1)), "samples")
    with pytest.raises(zakai.InputError, match="to infinity between t = "):
        zakai.filter(model, record, "tensor-train")


def test_a_tensor_train_without_finite_bounds_is_lost_with_a_warning():
    noise = [["0.5", "0"], ["0", "0.5"]]
    drift, mean = ["x*y", "x**2 - y"], [0.5, 0.0]
    model = model_of(drift, mean, 0.3, diffusion=noise, observation=["sin(x) + y"], observation_noise=[["0.5"]])
    result = zakai.filter(model, zakai.Record([0.5, 1.0], np.zeros((2, 1)), "samples"), "tensor-train")
    assert np.isfinite(result.mean[1:]).all() or any("lost at t = " in words for words in result.warnings)


def test_a_pole_in_the_density_of_two_states_is_refused():
    with pytest.raises(zakai.InputError, match=r"drift\[0\] = y/x is infinite within the density at t = 0, as at x = "):
        filtered(model_of(["y/x", "-y"]), 1.0)


def reference(f, G, length, value, mean, variance, ends, count):
    """The posterior moments and the evidence of one sample, S = 1, by implicit differences on a uniform grid, without flux."""
    from scipy.linalg import solve_banded

    x = np.linspace(*ends, count)
    s, steps = x[1] - x[0], 2000
    p = np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
    middle = 0.5 * (x[1:] + x[:-1])
    drift, noise = f(middle), G(x)
    out, into = -drift / 2 - noise[:-1] / (2 * s), -drift / 2 + noise[1:] / (2 * s)  # -flux = into p[i + 1] + out p[i]
    main = np.zeros(count)
    main[:-1] += out / s
    main[1:] -= into / s
    banded, h = np.zeros((3, count)), 0.5 * length / steps
    banded[0, 1:], banded[1], banded[2, :-1] = -h * into / s, 1 - h * main, h * out / s
    for _ in range(steps):
        right = p + h * main * p
        right[:-1] += h * into / s * p[1:]
        right[1:] -= h * out / s * p[:-1]
        p = solve_banded((1, 1), banded, right)
    product = p * np.exp(-0.5 * (value - x) ** 2) / np.sqrt(2 * np.pi)
    total = product.sum() * s
    first = (product @ x) * s / total
    return first, (product @ (x - first) ** 2) * s / total, np.log(total)


@pytest.mark.parametrize(
    "drift, length, variance",
    [("x**3", 0.1, 0.01), ("x**3", 0.01, 0.25), ("x**3 - x", 0.2, 0.01), ("exp(x)", 0.1, 0.04), ("x**2", 0.2, 0.04)],
)
def test_an_interval_too_short_for_infinity_is_answered(drift, length, variance):
    model = model_of([drift], variance=variance)
    result = filtered(model, length)
    f = {"x**3": lambda x: x**3, "x**3 - x": lambda x: x**3 - x, "exp(x)": np.exp, "x**2": lambda x: x**2}[drift]
    deviation = np.sqrt(variance + length)
    expected = reference(f, np.ones_like, length, 0.3, 0.0, variance, (-9 * deviation, 9 * deviation), 6001)
    found = result.mean[-1, 0], result.variance[-1, 0], result.log_likelihood
    assert np.allclose(found, expected, rtol=0, atol=2e-6)
    assert not result.warnings


def test_the_half_line_that_the_message_proposes_is_answered():
    """The radius of a Brownian motion in three dimensions: p(x | a) = x / a (phi(x - a) - phi(x + a))."""
    result = filtered(model_of(["1/x"], mean=3.0, variance=0.04, domain={"x": {"lower": 0.0}}), 1.0)
    x, a = np.linspace(1e-6, 12.0, 4001)[:, None], np.linspace(1.6, 4.4, 281)
    transition = -x / a * np.expm1(-2 * a * x) * np.exp(-0.5 * (x - a) ** 2)
    p = transition @ np.exp(-0.5 * (a - 3.0) ** 2 / 0.04) * np.exp(-0.5 * (0.3 - x[:, 0]) ** 2)
    assert np.isclose(result.mean[-1, 0], (p @ x[:, 0]) / p.sum(), atol=1e-5)


@pytest.mark.parametrize(
    "drift, keys",
    [
        (["-x**3"], {}),
        (["-sinh(x)"], {}),
        (["x/(x**2 + 1)"], {}),
        (["x - x**3"], {}),
        (["tan(x)"], {"variance": 0.01}),
        (["y - x**3", "-x"], {}),
        (["y", "(1 - x**2)*y - x"], {}),
        (["x**3", "x - y"], {"variance": 0.01}),
        (["10*(y - x)", "x*(28 - z) - y", "x*y - 8/3*z"], {"variance": 0.1}),
    ],
)
def test_what_does_not_escape_is_answered_without_a_warning(drift, keys):
    result = filtered(model_of(drift, **keys), 0.02, 0.05)
    assert np.isfinite(result.mean).all() and not result.warnings


def test_growth_like_x_log_x_is_no_explosion():
    from zakai.methods.line.domain import check_escape

    model = model_of(["x*log(x**2 + 1)"])
    prepared = zakai.methods.grid.yau_yau.prepare(model, _schedule(model, 1.0), model.theta())
    x = np.linspace(-8.0, 8.0, 801)
    check_escape(prepared, 0, x, np.exp(-0.5 * x**2))  # d log x / dt = 2 log x: finite at every time


def _schedule(model, *times):
    from zakai.records.schedule import schedule_of

    return schedule_of(model, zakai.Record(list(times), [[0.3]] * len(times), "samples"))[0]


def test_the_probability_of_an_explosion_is_the_exact_one():
    """dx = x (1 + x^2) dt + (1 + x^2) dv is x = tan(v), which explodes when v leaves (-pi/2, pi/2)."""
    from zakai.numerics.escape import Ends, escape

    none = Ends(-np.inf, np.inf, np.zeros(0), np.zeros((0, 2)))
    starts, found = escape(lambda x, t: (x * (1 + x**2), (1 + x**2) ** 2), none, 0.0, 1.0, 1.0, True)
    k = np.arange(40)
    stays = np.sum(4 / np.pi * (-1.0) ** k / (2 * k + 1) * np.exp(-((2 * k + 1) ** 2) / 2))  # on (-pi/2, pi/2), from 0
    assert np.isclose(np.interp(0.0, starts, found[:, 0]), 1 - stays, atol=0.01)


def test_a_record_stops_at_the_interval_that_escapes_and_an_online_filter_goes_on():
    model = model_of(["x**3"], variance=0.01)
    with pytest.raises(zakai.InputError, match="between t = 0.1 and 3 "):
        filtered(model, 0.05, 0.1, 3.0)
    online = zakai.online(model)
    first = online.update(0.05, [0.3])
    with pytest.raises(zakai.InputError, match="takes x to infinity between t = 0.05 and 4 "):
        online.update(4.0, [0.3])
    assert online.update(0.1, [0.3]).time == 0.1 > first.time


def test_a_fit_passes_by_values_that_explode():
    model = model_of(["a*x**3 - x"], variance=0.1, parameters={"a": -0.5})
    _, record = zakai.simulate(model, np.arange(0.5, 4.1, 0.5), seed=2)
    assert np.isfinite(zakai.fit(model, record, parameters=["a"], start={"a": 0.05}).log_likelihood)


@pytest.mark.parametrize("method", ["extended-kalman-bucy", "ekf", "ukf", "enkf", "particle"])
def test_a_method_without_a_density_says_that_the_drift_leads_to_infinity(method):
    prior = {"kind": "gaussian", "mean": [2.0], "cov": [[1.0]]}
    model = zakai.Model(state=["x"], drift=["x**3"], observation=["x"], observation_kind="samples", prior=prior)
    result = zakai.filter(model, zakai.Record([0.5, 1.0], [2.0, 2.2], "samples"), method)
    # dx = x^3 dt reaches infinity by t = 0.5 from every x > 1: of N(2, 1) a share of 0.84.
    found = [re.search(r"takes x to infinity between t = 0 and 0.5 with probability ([.\d]+)", text) for text in result.warnings]
    assert [0.75 < float(one[1]) < 0.9 for one in found if one] == [True]
    tame = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", prior=prior)
    assert not any("infinity" in text for text in zakai.filter(tame, zakai.Record([0.5], [2.0], "samples"), method).warnings)


@pytest.mark.parametrize("method", ["hu-yau", "general-direct"])
@pytest.mark.parametrize(("drift", "mean"), [(["1/x", "-y"], 1.0), (["1/x", "x - y"], 1.0), (["-tan(x)", "-y"], 0.2)])
def test_a_method_that_integrates_over_all_states_does_not_hold_beside_a_pole(drift, mean, method):
    prior = {"kind": "gaussian", "mean": [mean, 0.5], "cov": [0.01, 0.1]}
    model = zakai.Model(state=["x", "y"], drift=drift, observation=["x", "y"], observation_kind="increments", prior=prior)
    record = zakai.Record([0.1, 0.2], [[0.1, 0.2], [0.1, 0.2]], "increments")
    with pytest.raises(zakai.ConditionError, match=r"f is finite at all states \((x|cos\(x\)) vanishes\)"):
        zakai.filter(model, record, method)


def test_a_block_beside_a_pole_names_the_domain():
    prior = {"kind": "gaussian", "mean": [1.0, 0.5], "cov": [0.01, 0.1]}
    model = zakai.Model(state=["x", "y"], drift=["1/x", "-y"], observation=["x", "y"], observation_kind="increments", prior=prior)
    with pytest.raises(zakai.InputError, match=r"block x: drift\[0\] = 1/x is infinite at .*give \[domain\] x = \{ lower = 0 \}"):
        zakai.filter(model, zakai.Record([0.1], [[0.1, 0.2]], "increments"))
