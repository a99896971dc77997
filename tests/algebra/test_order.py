"""What "auto" takes for systems of several states: by the work for the accuracy that is asked, and never what would fail."""

import re

import numpy as np
import pytest

import zakai
from zakai.algebra.choice import chosen, faster

PARTICLES = "guided-particles"
RE_ENTRY = {
    "state": ["h", "v", "b"], "drift": ["-v", "1 - b*v**2*exp(-h/3)/2", "0"],
    "diffusion": [["0", "0"], ["0.05", "0"], ["0", "0.01"]],
    "observation": ["sqrt(4 + (h - 1)**2)"], "observation_kind": "samples", "observation_noise": [[0.01]],
    "prior": {"kind": "gaussian", "mean": [20, 4, 0.5], "cov": [0.25, 0.09, 0.04]},
}  # fmt: skip
BATTERY = {
    "state": ["soc", "v1", "v2"], "drift": ["-I/8280", "I/1500 - v1/30", "I/20000 - v2/600"], "inputs": ["I"],
    "diffusion": [["2e-5", "0", "0"], ["0", "1e-4", "0"], ["0", "0", "3e-5"]],
    "observation": ["3.2 + 0.8*soc - 0.3*exp(-20*soc) - v1 - v2 - 0.02*I"], "observation_kind": "samples",
    "observation_noise": [[2.5e-5]], "prior": {"kind": "gaussian", "mean": [0.7, 0, 0], "cov": [0.02, 1e-4, 1e-4]},
}  # fmt: skip
EPIDEMIC = {
    "state": ["s", "i", "b"], "drift": ["-exp(b)*s*i", "exp(b)*s*i - 0.2*i", "-0.1*(b - log(0.5))"],
    "diffusion": [["-0.1*s*i", "0"], ["0.1*s*i", "0"], ["0", "0.2"]], "observation": ["2000*i + 1"],
    "observation_kind": "samples", "observation_family": "negative-binomial", "dispersion": "0.02",
    "prior": {"kind": "gaussian", "mean": [0.95, 0.01, -0.7], "cov": [4e-4, 4e-6, 0.1]},
}  # fmt: skip


def ring(variance):
    """Return a plane in which the distance from the origin is seen."""
    return zakai.Model(
        state=["x", "y"], drift=["-0.1*x", "-0.1*y"], diffusion=[["0.3", "0"], ["0", "0.3"]],
        observation=["sqrt(x**2 + y**2)"], observation_kind="samples", observation_noise=[[variance]],
        prior={"kind": "gaussian", "mean": [2, 0], "cov": [2, 2]},
    )  # fmt: skip


@pytest.mark.parametrize("keys", [RE_ENTRY, BATTERY], ids=["re-entry", "battery"])
def test_three_coupled_states_near_a_linear_system_are_filtered_by_a_tensor_train_and_why_says_so(keys):
    model = zakai.Model(**keys)
    for tolerance in (None, 1e-3):
        method, why, _ = chosen(model, "auto", tolerance)
        assert method == "tensor-train" and "a tensor train of rank" in why
        seconds = [float(re.search(rf"{name} ([0-9.]+) s", why)[1]) for name in ("yau-yau", PARTICLES, "tensor-train")]
        assert seconds[2] < seconds[0] and seconds[2] < seconds[1]


def turn(rate=0.15):
    """Return a target that turns at an unknown rate, seen by range and bearing."""
    return zakai.Model(
        state=["px", "py", "vx", "vy", "w"], drift=["vx", "vy", "-w*vy", "w*vx", "-0.1*w"],
        diffusion=[[0, 0, 0], [0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.15]],
        observation=["sqrt(px**2 + py**2)", "atan2(py, px)"], observation_kind="samples",
        observation_noise=[[0.08, 0], [0, 0.003]],
        prior={"kind": "gaussian", "mean": [6, 6, -0.9, 0.4, 0.25], "cov": [1.5, 1.5, 0.4, 0.4, rate]},
    )  # fmt: skip


def test_a_tensor_train_of_large_rank_is_taken_where_the_accuracy_asked_makes_particles_dear():
    assert chosen(turn(), "auto")[0] == PARTICLES
    method, why, _ = chosen(turn(), "auto", 5e-3)
    assert method == "tensor-train" and "tensor-train by name" not in why


def test_a_tensor_train_is_not_taken_where_its_rank_would_meet_its_limit():
    method, why, _ = chosen(turn(rate=2.0), "auto", 5e-3)
    assert method == PARTICLES and re.search(r"a tensor train of rank \d+\), which would not hold the density", why)


@pytest.mark.parametrize("keys", [EPIDEMIC], ids=["epidemic"])
def test_three_coupled_states_are_filtered_by_particles_unless_more_accuracy_is_asked_than_is_cheap(keys):
    model = zakai.Model(**keys)
    method, why, _ = chosen(model, "auto")
    assert method == PARTICLES
    seconds = [float(re.search(rf"{name} ([0-9.]+) s", why)[1]) for name in ("yau-yau", PARTICLES)]
    assert seconds[0] > 3 * seconds[1] and "tensor-train by name" in why
    method, why, _ = chosen(model, "auto", 1e-3)
    assert method == "yau-yau" and "tensor-train by name" in why


def test_the_tolerance_of_a_call_is_the_accuracy_that_is_asked():
    model = zakai.Model(**RE_ENTRY)
    online = zakai.online(model, "auto", tolerance=2e-3)
    assert online.method == "tensor-train"
    model = zakai.Model(**EPIDEMIC)
    assert zakai.online(model, "auto", tolerance=2e-3).method == "yau-yau"
    assert zakai.online(model, "auto", tolerance=0.05).method == PARTICLES


def test_a_body_that_falls_is_filtered_to_its_end_where_a_grid_loses_it():
    model = zakai.Model(**RE_ENTRY)
    times = np.cumsum(np.random.default_rng(2).uniform(0.05, 0.25, 35))
    truth, record = zakai.simulate(model, times, seed=3)
    result = zakai.filter(model, record, keep="moments")
    apart = (result.mean[1:] - truth.values[-len(times) :]) / np.sqrt(result.variance[1:])
    assert result.method == "tensor-train" and not result.warnings and np.sqrt(np.mean(apart**2)) < 2.0


def test_two_states_are_filtered_on_a_grid_until_a_sensor_is_too_precise_for_it():
    assert chosen(ring(0.01), "auto")[0] == "yau-yau"
    assert chosen(ring(1e-4), "auto")[0] == "yau-yau"
    method, why, _ = chosen(ring(1e-8), "auto")
    assert method == PARTICLES and "which would not hold the density" in why


def test_the_scale_of_the_states_decides_nothing():
    def of(scale):
        return zakai.Model(
            state=["x", "y"], drift=["-0.1*x", "-0.1*y"], diffusion=[[0.3 * scale, "0"], ["0", 0.3 * scale]],
            observation=["sqrt(x**2 + y**2)"], observation_kind="samples", observation_noise=[[1e-8 * scale**2]],
            prior={"kind": "gaussian", "mean": [2 * scale, 0], "cov": [2 * scale**2, 2 * scale**2]},
        )  # fmt: skip

    assert {chosen(of(scale), "auto")[1] for scale in (1.0, 1024.0, 2.0**-12)} == {chosen(ring(1e-8), "auto")[1]}


def test_a_sum_is_taken_first_where_three_states_are_seen_by_one_of_them():
    keys = {"state": ["x", "v", "a"], "drift": ["v", "a", "-a"], "diffusion": [["0"], ["0"], ["0.5"]],
            "observation_kind": "samples", "prior": {"kind": "gaussian", "mean": [3, -0.5, 0], "cov": [0.2] * 3}}  # fmt: skip
    assert chosen(zakai.Model(**keys, observation=["sqrt(1 + x**2)"]), "auto")[0] == "general-direct"
    assert chosen(zakai.Model(**keys, observation=["sqrt(1 + x**2 + v**2)"]), "auto")[0] == "tensor-train"


def test_a_log_likelihood_of_three_states_has_a_gradient():
    model = zakai.Model(
        state=["x", "y", "z"], drift=["a*(y - x)", "x - y - x**3/5", "-z + x*y/5"], diffusion=np.eye(3).tolist(),
        parameters={"a": 1.0}, observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0, 0, 0], "cov": [0.5] * 3},
    )  # fmt: skip
    assert zakai.filter(model, zakai.Record([0.2], [[0.1]], "samples"), keep="moments").method == "tensor-train"
    assert zakai.log_likelihood(model, zakai.Record([0.2], [[0.1]], "samples"))._plan.method == "yau-yau"


def test_an_input_couples_nothing():
    """Two coordinates of an animal with a class of accuracy a row are two blocks of two states."""
    state, drift = ["x", "u", "y", "v"], ["u", "-0.5*u", "v", "-0.5*v"]
    model = zakai.Model(
        state=state, drift=drift, diffusion=[["0", "0"], ["1", "0"], ["0", "0"], ["0", "1"]], inputs=["accuracy"],
        observation=["x", "y"], observation_noise=[["accuracy**2", "0"], ["0", "accuracy**2"]], observation_kind="samples",
        observation_family="student-t", degrees_of_freedom=3, prior={"kind": "gaussian", "mean": [0] * 4, "cov": [1] * 4},
    )  # fmt: skip
    analysis = zakai.analyze(model)
    assert analysis.division is not None and [len(block.names) for block in analysis.division.blocks] == [2, 2]
    assert PARTICLES not in analysis.recommended


def test_the_expected_number_of_particles_is_that_of_the_method():
    from zakai.algebra.expected_work import expected_work

    model = zakai.Model(**EPIDEMIC)
    _, record = zakai.simulate(model, np.arange(1, 21) * 0.1, seed=1)
    result = zakai.filter(model, record, PARTICLES, tolerance=0.05, keep="moments")
    count = int(np.nanmin(result.health["particles"]))  # it begins with more
    assert f"{float(f'{count:.2g}'):,.0f} particles" in str(expected_work(PARTICLES, model, 0.05))


def test_a_faster_method_is_named_where_a_third_of_the_time_is_expected():
    assert faster(ring(0.01), "yau-yau", 1.0) == PARTICLES
    assert faster(ring(0.01), "yau-yau", 0.02) is None
    assert faster(ring(0.01), PARTICLES, 0.1) is None  # a grid of twice the points along an axis needs longer
    assert faster(ring(1e-8), PARTICLES, 10.0) is None  # a grid would not hold it
    assert faster(zakai.Model(**EPIDEMIC), PARTICLES, 10.0) is None  # a grid needs more
    assert faster(zakai.Model(**RE_ENTRY), PARTICLES, 10.0) == "tensor-train"
    assert faster(zakai.load_model("gallery:cubic-sensor"), "yau-yau", 10.0) is None


def test_a_prior_by_a_formula_counts_as_the_gaussian_that_it_is():
    def of(variance, prior):
        return zakai.Model(
            state=["x", "y"], drift=["-0.1*x", "-0.1*y"], diffusion=[["0.3", "0"], ["0", "0.3"]],
            observation=["sqrt(x**2 + y**2)"], observation_kind="samples", observation_noise=[[variance]], prior=prior,
        )  # fmt: skip

    formula = {"kind": "density", "log_density": "-(x - 2)**2/4 - y**2/4"}
    assert chosen(of(1e-8, formula), "auto")[0] == PARTICLES and chosen(of(1e-2, formula), "auto")[0] == "yau-yau"


def test_the_information_of_a_law_stands_for_the_noise_of_a_sensor():
    from zakai.algebra.expected_work import curvature

    def of(**keys):
        return zakai.Model(
            state=["x", "y"], drift=["-0.1*x", "-0.1*y"], diffusion=[["0.3", "0"], ["0", "0.3"]], observation_kind="samples",
            prior={"kind": "gaussian", "mean": [2, 0], "cov": [0.2, 0.2]}, **keys,
        )  # fmt: skip

    distance = "sqrt(x**2 + y**2 + 1)"
    counts = of(observation=[f"10000*{distance}"], observation_family="poisson")  # with the variance 10000 sqrt(5) at the mean
    gaussian = of(observation=[distance], observation_noise=[["sqrt(5)/10000"]])
    assert curvature(counts) == pytest.approx(curvature(gaussian), rel=1e-3) and curvature(counts) > 1.0
