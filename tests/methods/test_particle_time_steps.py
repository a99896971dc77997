"""When `guided-particles` measures its time step again, and when it moves the past, seen from means and health figures."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

PARTICLES = "guided-particles"
FASTER_AT_4 = "-(1 + 200/(1 + exp(-40*({} - 4))))*x - 0.1*v"


def test_the_past_is_moved_only_where_the_state_remembers_it():
    # Precise observations leave few ancestors, but neither state remembers more than a few intervals.
    model = zakai.Model(
        state=["x", "y"], drift=["-x - x**3", "-y + x"], diffusion=[["1", "0"], ["0", "1"]], observation=["x"],
        observation_kind="samples", observation_noise=[["0.003"]],
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [0.3, 0.3]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.arange(1, 61) * 0.4, seed=3)
    result = zakai.filter(model, record, PARTICLES, particles=500, split=False, keep="moments")
    assert np.nanmin(result.health["founders"]) < 50  # lineages of the start are lost
    assert np.nansum(result.health["moved"]) <= 2


def test_a_measured_time_step_is_kept_while_it_is_right():
    # The state forgets all in an interval, so that without observations the shift of the mean is nearly that of the last one.
    model = zakai.Model(
        state=["x"], drift=["-10*x - x**3"], diffusion=[["2"]], observation=["x"], observation_kind="samples",
        observation_noise=[["0.1"]], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.2]},
    )  # fmt: skip
    record = zakai.Record(np.arange(1.0, 41.0), np.full((40, 1), np.nan), "samples")
    result = zakai.filter(model, record, PARTICLES, particles=1000, keep="moments")
    shift = (result.health["time_error"] * np.sqrt(result.variance[:, 0]))[1:]
    kept = np.isclose(shift[1:], shift[:-1], rtol=0.2)
    assert 10 < kept.sum() < 39  # some are kept, and not for ever


@pytest.mark.filterwarnings("ignore")
def test_a_time_step_is_measured_again_where_the_motion_becomes_faster():
    keys = {
        "drift": ["v", FASTER_AT_4.format("t")], "diffusion": [["0"], ["0.05"]], "observation": ["x"],
        "observation_kind": "samples", "observation_noise": [["0.01"]],
    }  # fmt: skip
    model = zakai.Model(state=["x", "v"], prior={"kind": "gaussian", "mean": [1.0, 0.0], "cov": [0.01, 0.01]}, **keys)
    _, record = zakai.simulate(model, np.arange(1, 51) * 0.1, seed=3, substeps=200)
    result, exact = zakai.filter(model, record, PARTICLES, particles=2000), zakai.filter(model, record, "kalman-bucy")
    apart = np.abs(result.mean - exact.mean)[1:] / np.sqrt(exact.variance[1:])
    assert apart.max() < 0.5  # with the step of the slow motion it is more than three


@pytest.mark.filterwarnings("ignore")
def test_a_time_step_is_measured_again_where_the_drift_becomes_steeper_at_the_same_speed():
    # The first state is the time: it moves by many of its deviations in an interval, always at the same speed.
    prior = {"kind": "gaussian", "mean": [0.0, 0.0, 0.0], "cov": [1e-6, 1.0, 1.0]}
    model = zakai.Model(
        state=["c", "x", "v"], drift=["1", "v", FASTER_AT_4.format("c")], diffusion=[["0"], ["0"], ["0.5"]], observation=["x"],
        observation_kind="samples", observation_noise=[["1.0"]], prior=prior,
    )  # fmt: skip
    clock = zakai.Model(
        state=["x", "v"], drift=["v", FASTER_AT_4.format("t")], diffusion=[["0"], ["0.5"]], observation=["x"],
        observation_kind="samples", observation_noise=[["1.0"]],
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    _, record = zakai.simulate(clock, np.arange(1, 51) * 0.1, seed=3, substeps=200)
    result = zakai.filter(model, record, PARTICLES, particles=2000, split=False)
    exact = zakai.filter(clock, record, "kalman-bucy")
    apart = np.abs(result.mean[:, 1:] - exact.mean)[1:] / np.sqrt(exact.variance[1:])
    assert apart.max() < 0.3


def test_fields_that_do_not_commute_are_guided_to_a_precise_observation():
    # The order in which they act is drawn: it has no direction that the guide could follow.
    model = zakai.Model(
        state=["x", "y"], drift=["-x - x**3/5", "-y - y**3/5"], diffusion=[["0.5", "0"], ["0", "0.5*x"]], observation=["x", "y"],
        observation_kind="samples", observation_noise=[["2e-3", "0"], ["0", "2e-3"]],
        prior={"kind": "gaussian", "mean": [1.5, 0.0], "cov": [0.01, 0.01]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.arange(1, 9) * 0.2, seed=2, substeps=200)
    result = zakai.filter(model, record, PARTICLES, particles=1000)
    assert np.nansum(result.health["guided"]) == 8
    assert np.nansum(result.health["tempering_levels"]) == 0
    assert np.nanmin(result.health["effective_sample_size"]) > 300


def test_noise_that_decays_within_an_interval_is_not_lost_in_the_first_one():
    model = zakai.Model(
        state=["x"], drift=["-100*x - x**3"], observation=["x"], observation_kind="samples", observation_noise=[[100.0]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[0.01]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.9], [0.0], "samples"), "guided-particles")
    assert result.variance[1, 0] == pytest.approx(1 / 200, rel=0.2)  # stationary


def test_the_noise_of_a_substep_in_which_an_input_jumps_has_the_rates_of_both_sides():
    # The rate falls from 3 to 0.2 within the interval, of which one substep is one half.
    model = zakai.Model(
        state=["x", "y"], drift=["-q*x", "-q*(y - x)"], diffusion=[["1", "0"], ["0", "0.5"]], observation=["x"], inputs=["q"],
        observation_kind="samples", observation_noise=[["0.2"]],
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    inputs = zakai.Inputs([0.0, 0.7, 1.3], [3.0, 0.2, 3.0])
    record = zakai.Record([0.5, 1.0, 1.5], [np.nan, 2.0, np.nan], "samples", inputs=inputs)
    result, exact = zakai.filter(model, record, PARTICLES, particles=20000), zakai.filter(model, record, "kalman-bucy")
    assert np.abs(np.sqrt(result.variance / exact.variance)[1:] - 1.0).max() < 0.02
    assert (np.abs(result.mean - exact.mean)[1:] / np.sqrt(exact.variance[1:])).max() < 0.03


@pytest.mark.parametrize("beside", [-1e-14, 0.0, 1e-15])
def test_an_input_that_is_given_at_the_middle_of_a_substep_leaves_all_of_its_noise(beside):
    model = zakai.Model(
        state=["a", "w"], drift=["w - a**3", "T"], diffusion=[["0"], ["0.5"]], observation=["w"], inputs=["T"],
        observation_kind="samples", observation_noise=[["0.01"]],
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [0.01, 0.0025]},
    )  # fmt: skip
    times = 0.2 * np.arange(1, 11)
    inputs = zakai.Inputs(np.append(0.0, 0.1 * np.arange(1, 20) + beside), np.zeros(20))
    result = zakai.filter(model, zakai.Record(times, np.full(10, np.nan), "samples", inputs=inputs), PARTICLES, particles=20000)
    assert result.variance[1:, 1] == pytest.approx(0.0025 + 0.25 * times, rel=0.05)


def test_dry_friction_near_rest_needs_no_shorter_steps_than_the_noise():
    # Near zero every step is too long for the sign of the velocity, relative to the velocity.
    model = zakai.Model(
        state=["v"], drift=["-0.4*v - sign(v)"], diffusion=[["0.3"]], observation=["v"], observation_kind="samples",
        observation_noise=[["0.01"]], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.1]},
    )  # fmt: skip
    record = zakai.Record(0.25 * np.arange(1, 9), [0.1, 0.05, -0.1, 0.0, 0.1, 0.2, 0.1, 0.0], "samples")
    result, exact = zakai.filter(model, record, PARTICLES, particles=5000), zakai.filter(model, record, "yau-yau")
    assert (np.abs(result.mean - exact.mean)[1:] / np.sqrt(exact.variance[1:])).max() < 0.06


def test_a_stiff_state_that_particles_carry_as_a_gaussian_is_judged_by_its_deviation_at_the_end():
    model = zakai.Model(
        state=["s", "v"], drift=["-0.2", "(0.02 - v)/0.02"], diffusion=[["0.05", "0"], ["0", "0.01"]],
        observation=["exp(s) - v"], observation_kind="samples", observation_noise=[["0.0004"]],
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [0.01, 1e-2]},
    )  # fmt: skip
    record = zakai.Record([0.25, 0.3, 0.5, 1.0], [0.9, 0.95, 0.9, 0.8], "samples")
    result, exact = zakai.filter(model, record, PARTICLES, particles=20000), zakai.filter(model, record, "yau-yau")
    assert result.health["linear_states"][1] == 1
    assert (np.abs(result.mean - exact.mean)[1:] / np.sqrt(exact.variance[1:])).max() < 0.05
    assert np.nanmax(result.health["time_error"]) < 0.05


STIFF = {
    "state": ["s", "v"], "diffusion": [["0.1", "0"], ["0", "0.02"]], "inputs": ["I"], "observation": ["s - v"],
    "observation_kind": "samples", "observation_noise": [["0.001"]],
    "prior": {"kind": "gaussian", "mean": [0.0, 0.0], "cov": [0.01, 0.01]},
}  # fmt: skip
INPUT_TIMES = [0.0, 0.2, 0.25, 0.75, 1.25, 1.3, 1.5, 2.0]
CURRENT = [0.0, 0.1, 0.0, 0.06, 0.12, 0.02, 0.1, 0.0]


def _stiff_record() -> zakai.Record:
    """Return samples before and after jumps of an input, 3 to 33 time constants apart."""
    values = [0.02, -0.05, np.nan, 0.03, np.nan, np.nan, 0.1, -0.1]
    return zakai.Record([*INPUT_TIMES[1:], 2.2], values, "samples", inputs=zakai.Inputs(INPUT_TIMES, CURRENT))


@pytest.mark.parametrize("drift", [["-0.3*s", "60*I - 66*v"], ["-0.3*s + 20*v", "60*I - 66*v - 10*s"]])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_stiff_affine_drift_is_integrated_exactly_between_the_times_of_inputs(drift, seed):
    model, record = zakai.Model(drift=drift, **STIFF), _stiff_record()
    result, exact = zakai.filter(model, record, PARTICLES, seed=seed, split=False), zakai.filter(model, record, "kalman-bucy")
    assert (np.abs(result.mean - exact.mean)[1:] / np.sqrt(exact.variance[1:])).max() < 0.06
    assert np.abs(np.sqrt(result.variance / exact.variance)[1:] - 1.0).max() < 0.03
    assert np.nanmax(result.health["time_error"]) == 0.0
    assert np.nanmax(result.health["substeps"]) < 12


@pytest.mark.parametrize("split", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_stiff_linear_state_beside_another_one_follows_its_input(split, seed):
    # The second state does not depend on the first: between samples it is that of an Ornstein-Uhlenbeck process.
    model, record = zakai.Model(drift=["-0.3*s - s**3", "60*I - 66*v"], **STIFF), _stiff_record()
    result = zakai.filter(model, record, PARTICLES, seed=seed, split=split)
    for k, length in ((3, 0.5), (5, 0.05), (6, 0.2)):  # rows without a sample
        decayed = np.exp(-66 * length)
        mean = result.mean[k - 1, 1] * decayed + 60 / 66 * CURRENT[k - 1] * (1 - decayed)
        variance = result.variance[k - 1, 1] * decayed**2 + 0.02**2 / 132 * (1 - decayed**2)
        assert result.mean[k, 1] == pytest.approx(mean, abs=(0.002 if split else 0.06) * np.sqrt(variance))
        assert result.variance[k, 1] == pytest.approx(variance, rel=0.002 if split else 0.08)


def test_a_stiff_state_that_follows_another_one_keeps_its_correlation_with_it():
    # At rates of 66 v is that of 30 sin(s) within a sixtieth of a unit of time: of the variance given s little is left.
    model = zakai.Model(drift=["-0.3*s", "60*I - 66*v + 30*sin(s)"], **STIFF)
    record = zakai.Record(INPUT_TIMES[1:], np.full(7, np.nan), "samples", inputs=_stiff_record().inputs)
    result = zakai.filter(model, record, PARTICLES, particles=20000, split=False)
    exact = zakai.filter(model, record, "tensor-train")
    direction = np.array([30 / 66, -1.0])
    own, known = (np.einsum("i,kij,j->k", direction, one.cov, direction)[1:] for one in (result, exact))
    assert own == pytest.approx(known, rel=0.1)
