"""The filter for any smooth system: against exact filters, and an independent solver where there are none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai
from references.convention import within_convention
from references.kolmogorov import Box, propagate

STANDARD = {"kind": "gaussian", "mean": [0.5], "cov": [1.0]}


def linear(kind: str, noise: float, until: float, count: int):
    model = zakai.Model(
        state=["x"], drift=["-x/2"], observation=["x"], observation_noise=[[noise]], observation_kind=kind, prior=STANDARD
    )
    return model, zakai.simulate(model, until * np.arange(1, count + 1) / count, seed=1)[1]


def distance(a: zakai.FilterResult, b: zakai.FilterResult) -> float:
    """The largest of: means in deviations, relative variances, evidence."""
    mean = np.abs(a.mean - b.mean) / np.sqrt(b.variance)
    return max(mean.max(), np.abs(a.variance / b.variance - 1).max(), abs(a.log_likelihood - b.log_likelihood))


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6])
def test_samples_of_a_linear_system_give_what_kalman_bucy_gives(tolerance):
    model, record = linear("samples", 0.1, 3.0, 30)
    result = zakai.filter(model, record, "yau-yau", tolerance=tolerance)
    assert not result.warnings
    assert distance(result, zakai.filter(model, record, "kalman-bucy")) < 10 * tolerance


def test_long_intervals_are_followed():
    model, record = linear("samples", 0.1, 20.0, 20)
    result = zakai.filter(model, record, "yau-yau")
    assert not result.warnings
    assert distance(result, zakai.filter(model, record, "kalman-bucy")) < 1e-3


def test_what_the_splitting_leaves_is_estimated_and_held_to_the_tolerance():
    model, record = linear("increments", 0.1, 2.0, 20)
    exact = zakai.filter(model, record, "kalman-bucy")
    for tolerance in (1e-4, 1e-5):
        result = zakai.filter(model, record, "yau-yau", tolerance=tolerance)
        mean, variance = np.abs(result.mean - exact.mean) / np.sqrt(exact.variance), np.abs(result.variance / exact.variance - 1)
        error = np.maximum(mean, variance)
        estimate = result.health["error_estimate"][1:]
        assert not result.warnings
        assert error[1:, 0].max() < 10 * estimate.max()
        assert estimate.max() < 10 * error[1:, 0].max()
        assert error.max() < tolerance


def test_two_states_that_are_sampled_give_what_kalman_bucy_gives():
    model = zakai.Model(
        state=["a", "b"], drift=["-0.3*a + b", "-a - 0.2*b"], process_noise=[[1, 0.3], [0.3, 0.5]], observation=["a"],
        observation_noise=[[0.3]], observation_kind="samples", prior={"kind": "gaussian", "mean": [0.5, 0.5], "cov": [1, 1]},
    )
    record = zakai.simulate(model, 0.2 * np.arange(1, 16), seed=1)[1]
    result = zakai.filter(model, record, "yau-yau")
    assert not result.warnings
    assert distance(result, zakai.filter(model, record, "kalman-bucy")) < 1e-3


def test_a_nonlinear_system_against_an_independent_solver():
    model = zakai.Model(
        state=["x"], drift=["1.5*sin(2*x)"], process_noise=[["0.7"]], observation=["x**2"], observation_noise=[["0.3"]],
        observation_kind="samples", prior={"kind": "density", "log_density": "-2*(x - 0.3)**2 + cos(2*x)"},
    )
    times, values = np.array([0.2, 0.4]), np.array([[0.9], [1.4]])
    result = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau", tolerance=1e-6)
    assert not result.warnings
    box = Box(7.0, 192)
    x = box.x[..., 0]
    u, evidence, start = np.exp(-2 * (x - 0.3) ** 2 + np.cos(2 * x)), 0.0, 0.0
    for stop, z in zip(times, values[:, 0], strict=True):
        u = propagate(
            box, u / (u.sum() * box.cell), start, stop, lambda x, t: 1.5 * np.sin(2 * x), lambda x, t: 3 * np.cos(2 * x[..., 0]),
            lambda t: np.array([[0.7]]), lambda x, t: np.zeros(x.shape[:-1]), 1e-12,
        )
        u = u * np.exp(-((z - x**2) ** 2) / 0.6) / np.sqrt(0.6 * np.pi)
        evidence, start = evidence + np.log(u.sum() * box.cell), stop
        u = u / (u.sum() * box.cell)
    assert abs(result.log_likelihood - evidence) < 1e-6
    got = np.exp(result.density(-1).log_density(x[np.abs(x) < 4.0][:, None]))
    assert np.abs(got - u[np.abs(x) < 4.0]).max() < 3e-6 * u.max()


def test_an_oscillator_whose_noise_is_singular_against_an_independent_solver():
    model = zakai.Model(
        state=["x", "v"], drift=["v", "0.3*(1 - x**2)*v - x"], process_noise=[["0", "0"], ["0", "1"]], observation=["x"],
        observation_noise=[["0.4"]], observation_kind="samples", prior={"kind": "gaussian", "mean": [1, 0], "cov": [0.5, 0.5]},
    )
    record = zakai.Record(np.array([0.5, 1.0]), np.array([[0.9], [0.1]]), "samples")
    result = zakai.filter(model, record, "yau-yau", tolerance=1e-4)
    assert not result.warnings
    box = Box(5.5, 80, (0.0, 0.0))
    x, v = box.x[..., 0], box.x[..., 1]
    u, evidence = np.exp(-((x - 1) ** 2) - v**2), 0.0
    for start, z in ((0.0, 0.9), (0.5, 0.1)):
        u = propagate(
            box, u / (u.sum() * box.cell), start, start + 0.5,
            lambda y, t: np.stack([y[..., 1], 0.3 * (1 - y[..., 0] ** 2) * y[..., 1] - y[..., 0]], axis=-1),
            lambda y, t: 0.3 * (1 - y[..., 0] ** 2), lambda t: np.diag([0.0, 1.0]), lambda y, t: np.zeros(y.shape[:-1]), 1e-9,
        )
        u = u * np.exp(-((z - x) ** 2) / 0.8) / np.sqrt(0.8 * np.pi)
        evidence += np.log(u.sum() * box.cell)
        u = u / (u.sum() * box.cell)
    mean = np.array([(u * x).sum(), (u * v).sum()]) * box.cell
    assert np.abs(result.mean[-1] - mean).max() < 1e-4
    assert abs(result.log_likelihood - evidence) < 1e-4


def test_the_lattice_follows_a_state_that_wanders_far():
    model = zakai.Model(
        state=["x"], drift=["cos(x)"], observation=["x**3"], prior={"kind": "density", "log_density": "-10*x**2"}
    )
    times = 0.001 * np.arange(1, 4001)
    record = zakai.simulate(model, times, seed=0, initial=[0.0])[1]
    usual, fine = (zakai.filter(model, record, "yau-yau", keep="moments", tolerance=tolerance) for tolerance in (1e-4, 1e-7))
    assert not usual.warnings and not fine.warnings
    assert (np.abs(usual.mean - fine.mean) / np.sqrt(fine.variance)).max() < 1e-3
    assert abs(usual.log_likelihood - fine.log_likelihood) < 1e-3


def test_a_reading_far_beyond_the_prior_is_not_passed_over_in_silence():
    model, _ = linear("samples", 0.01, 1.0, 1)
    result = zakai.filter(model, zakai.Record(np.array([0.1]), np.array([[30.0]]), "samples"), "yau-yau")
    assert result.warnings


@pytest.mark.parametrize(
    "options", [{"tolerance": 0}, {"tolerance": "fine"}]
)
def test_an_option_that_makes_no_sense_is_refused(options):
    model, record = linear("samples", 0.1, 1.0, 2)
    with pytest.raises(zakai.InputError, match=f"option {next(iter(options))}"):
        zakai.filter(model, record, "yau-yau", **options)


def test_what_the_method_cannot_do_is_said():
    prior = {"kind": "gaussian", "mean": [0] * 5, "cov": [1] * 5}
    five = zakai.Model(state=list("abcde"), drift=["-a**3"] * 5, observation=["a"], prior=prior)
    with pytest.raises(zakai.ConditionError, match="at most four"):
        zakai.filter(five, zakai.Record(np.array([1.0]), np.array([[0.0]]), "increments"), "yau-yau")
    point = zakai.Model(state=["x"], drift=["cos(x)"], observation=["x"], prior={"kind": "gaussian", "mean": [0], "cov": [0]})
    with pytest.raises(zakai.InputError, match="variance is zero"):
        zakai.filter(point, zakai.Record(np.array([1.0]), np.array([[0.0]]), "increments"), "yau-yau")


def test_the_gradient_with_a_sample_at_the_start_is_that_of_finite_differences():
    model = zakai.Model(
        state=["x"], drift=["a*sin(x)"], observation=["a*x**3"], observation_kind="samples", observation_noise=[["1"]],
        parameters={"a": 0.5}, prior={"kind": "gaussian", "mean": [0.5], "cov": [[1.0]]},
    )  # fmt: skip
    records = [zakai.simulate(model, np.arange(0.0, 4.0), seed=seed)[1] for seed in range(2)]
    evidences = [zakai.log_likelihood(model, record, "yau-yau", parameters=["a"]) for record in records]
    for record, evidence in zip(records, evidences, strict=True):
        assert abs(evidence(np.array([0.5])) - zakai.filter(model, record, "yau-yau").log_likelihood) < 1e-6
        slope = (evidence(np.array([0.5001])) - evidence(np.array([0.4999]))) / 2e-4
        assert np.allclose(evidence.value_and_gradient([0.5])[1], slope, rtol=1e-4)


def test_what_a_try_has_cut_away_is_there_for_the_next():
    """The ninth observation moves the mass to where its first grid has no points."""
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    record = zakai.simulate(model, 0.5 * np.arange(1, 61), seed=1)[1]
    record = zakai.Record(record.times[:10], record.values[:10], "samples")
    near, nearer = (zakai.filter(model, record, "yau-yau", keep="moments", tolerance=one) for one in (1e-8, 1e-9))
    assert np.abs(near.variance / nearer.variance - 1).max() <= 1e-7


def test_a_reading_after_a_long_gap_that_contradicts_what_was_expected():
    model = zakai.load_model("gallery:cubic-sensor")
    result = zakai.filter(model, zakai.Record(np.array([1.0, 101.0]), np.array([[0.1], [0.1]]), "increments"), "yau-yau")
    # The generator with the observation's potential by central differences, y running linearly through each gap.
    x = np.linspace(-2.0, 4.0, 601)
    step = x[1] - x[0]
    drift = np.cos(x)
    one = np.ones(600)
    forward = (np.diag(one, 1) - 2 * np.eye(601) + np.diag(one, -1)) / (2 * step**2)
    forward -= (np.diag(drift[1:], 1) - np.diag(drift[:-1], -1)) / (2 * step)
    p = np.exp(-10 * x**2)
    p /= p.sum()
    for length, increments in zip((1.0, 100.0), result.log_likelihood_increments[1:], strict=True):
        p = expm(length * (forward + np.diag(-0.5 * x**6 + x**3 * 0.1 / length))) @ p
        assert abs(np.log(p.sum()) - increments) < 0.01
        p /= p.sum()
    assert abs(p @ x - result.mean[-1, 0]) < 1e-3 and abs(p @ x**2 - (p @ x) ** 2 - result.variance[-1, 0]) < 1e-3
    assert not within_convention(result.warnings)


