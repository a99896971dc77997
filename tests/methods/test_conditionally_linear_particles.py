"""Particles that carry a Kalman filter, against exact filters, two Kalman filters side by side, and a plain bootstrap filter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

import zakai
from zakai.errors import InputError
from zakai.methods.particles import conditional
from zakai.methods.particles.split import Split

PARTICLES = "guided-particles"
PRIOR = {"kind": "gaussian", "mean": [0.5, -0.5], "cov": [[0.5, 0.2], [0.2, 0.8]]}
SAMPLES = {"observation_kind": "samples"}
PAIR = {
    "state": ["u", "v"], "drift": ["0.8*v - u", "-0.5*v"], "diffusion": [["0.5", "0.2"], ["0", "0.7"]],
    "observation": ["u + v", "v"], "observation_noise": [["0.2", "0"], ["0", "0.3"]], "prior": PRIOR,
}  # fmt: skip
LINEAR = {
    "samples": {**PAIR, **SAMPLES},
    "increments": {**PAIR, "observation_kind": "increments"},
    "path": {**PAIR, "observation_kind": "path"},
    "inputs": {**PAIR, **SAMPLES, "drift": ["0.8*v - u + w", "-0.5*v - w"], "inputs": ["w"]},
    "time": {**PAIR, **SAMPLES, "diffusion": [["0.5 + t/10", "0"], ["0", "0.7"]], "drift": ["-u", "u - v"]},
}
MIXED = {
    "state": ["u", "v"], "drift": ["v - u**3/5", "-v/2"], "diffusion": [["0.6", "0"], ["0", "0.5"]],
    "observation": ["u**2/2 + v"], "observation_noise": [["0.04"]], **SAMPLES,
    "prior": {"kind": "gaussian", "mean": [1.0, 0.0], "cov": [0.5, 0.5]},
}  # fmt: skip


def record_of(model, count=14, step=0.25, seed=3, gaps=True):
    inputs = zakai.Inputs(np.arange(0.0, 20.0, 0.37), np.sin(np.arange(0.0, 20.0, 0.37))) if model.inputs else None
    _, record = zakai.simulate(model, np.arange(1, count + 1) * step, seed=seed, inputs=inputs)
    values = record.values.copy()
    if gaps:
        values[2] = np.nan
        values[4, 0] = np.nan
    return zakai.Record(record.times, values, record.kind, inputs=inputs)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", LINEAR)
def test_a_linear_system_that_is_split_by_hand_agrees_with_the_kalman_filter(name, monkeypatch):
    monkeypatch.setattr(conditional, "split_of", lambda model: Split((1,), ""))
    model = zakai.Model(**LINEAR[name])
    record = record_of(model, step=0.25 if model.observation_kind == "samples" else 0.1)
    result, exact = zakai.filter(model, record, PARTICLES, split=True), zakai.filter(model, record, "kalman-bucy")
    assert (result.health["linear_states"][1:] == 1).all()
    errors, spread = (result.mean - exact.mean)[1:], np.sqrt(exact.variance[1:])
    # A step may be wrong by 0.005 deviations in an interval, which 128 particles do not resolve.
    assert np.abs(errors / np.hypot(result.mean_standard_error[1:], 0.005 * spread)).max() < 4.5
    assert np.sqrt(np.mean((errors / spread) ** 2)) < 0.01
    assert np.allclose(result.cov[1:], exact.cov[1:], atol=0.1 * np.sqrt(exact.variance.max()))
    assert abs(result.log_likelihood - exact.log_likelihood) < 4 * result.log_likelihood_standard_error + 0.02


def bootstrap(record, count, seed, parts=12):
    """Return the means and variances (K, 2) and the log-likelihood of `MIXED` by a plain bootstrap filter with Euler steps."""
    rng = np.random.default_rng(seed)
    u, v = 1.0 + np.sqrt(0.5) * rng.standard_normal(count), np.sqrt(0.5) * rng.standard_normal(count)
    means, variances, total, t = [], [], 0.0, 0.0
    for time, z in zip(record.times, record.values[:, 0], strict=True):
        d = (time - t) / parts
        for _ in range(parts):
            a, b = rng.standard_normal((2, count)) * np.sqrt(d)
            u, v = u + d * (v - u**3 / 5) + 0.6 * a, v - d * v / 2 + 0.5 * b
        t = time
        logs = norm.logpdf(z, u**2 / 2 + v, 0.2) if np.isfinite(z) else np.zeros(count)
        total += logsumexp(logs) - np.log(count)
        w = np.exp(logs - logsumexp(logs))
        x = np.stack([u, v])
        means.append(x @ w)
        variances.append((x - means[-1][:, None]) ** 2 @ w)
        places = np.searchsorted(np.cumsum(w), (np.arange(count) + rng.random()) / count).clip(0, count - 1)
        u, v = u[places], v[places]
    return np.array(means), np.array(variances), total


def test_a_nonlinear_system_agrees_with_a_bootstrap_filter_that_shares_no_code():
    model = zakai.Model(**MIXED)
    record = record_of(model, 8, gaps=False)
    runs = [bootstrap(record, 30_000, seed) for seed in range(2)]
    means, variances = (np.mean([run[i] for run in runs], axis=0) for i in range(2))
    result = zakai.filter(model, record, PARTICLES, particles=4000)
    assert result.health["linear_states"][-1] == 1
    assert np.abs((result.mean[1:] - means) / np.sqrt(variances)).max() < 0.12
    assert np.allclose(result.variance[1:] / variances, 1.0, atol=0.15)
    assert result.log_likelihood == pytest.approx(np.mean([run[2] for run in runs]), abs=0.15)
    drawn = zakai.filter(model, record, PARTICLES, particles=4000, split=False)
    assert result.log_likelihood_standard_error < drawn.log_likelihood_standard_error


def kalman(u, times, values):
    """Return the mean, the variance (K,) and the log-likelihood of dx = -u x dt + u dv, z = x + e, E e^2 = 0.1."""
    m, P, t, out, total = 1.0, 0.5, 0.0, [], 0.0
    for time, z in zip(times, values, strict=True):
        F = np.exp(-u * (time - t))
        m, P, t = F * m, F**2 * P + 0.5 * u * (1.0 - F**2), time
        total += norm.logpdf(z, m, np.sqrt(P + 0.1))
        gain = P / (P + 0.1)
        m, P = m + gain * (z - m), P - gain * P
        out.append((m, P))
    return np.array(out), total


def test_noise_and_rates_that_depend_on_the_particle_give_each_its_own_covariance():
    components = {"weights": [0.5, 0.5], "means": [[0.5, 1.0], [2.0, 1.0]], "covs": [np.diag([1e-10, 0.5])] * 2}
    model = zakai.Model(
        state=["u", "x"], drift=["0", "-u*x"], diffusion=[["0"], ["u"]], observation=["x"], observation_noise=[["0.1"]],
        prior={"kind": "mixture", **components}, **SAMPLES,
    )  # fmt: skip
    record = record_of(model, 10, gaps=False, seed=5)
    result = zakai.filter(model, record, PARTICLES, particles=1000)
    found = [kalman(u, record.times, record.values[:, 0]) for u in (0.5, 2.0)]
    logs = np.array([total for _, total in found]) + np.log(0.5)
    share = np.exp(logs - logsumexp(logs))
    # The shares of the two values are decided by the draws of the prior and by resampling, the moments given u by nothing.
    density = result.density(-1)
    for (moments, _), value, expected in zip(found, (0.5, 2.0), share, strict=True):
        own = np.abs(density.points[:, 0] - value) < 0.1
        assert density.weights[own].sum() == pytest.approx(expected, abs=0.08)
        assert np.allclose(density.points[own, 1], moments[-1, 0], atol=2e-3)
        assert np.allclose(density.covs[own, 0, 0], moments[-1, 1], rtol=1e-2)
    assert result.log_likelihood == pytest.approx(logsumexp(logs), abs=0.2)


def test_the_density_of_linear_states_is_exact_where_the_others_say_nothing_of_them():
    model = zakai.Model(
        state=["u", "a", "b"], drift=["-u", "b", "-a - b/2"], diffusion=np.diag([1.0, 0.3, 0.5]), observation=["sin(u)", "a"],
        observation_noise=[["0.3", "0"], ["0", "0.05"]], **SAMPLES,
        prior={"kind": "gaussian", "mean": [0, 1, 0], "cov": [[0.5, 0, 0], [0, 0.4, 0.1], [0, 0.1, 0.3]]},
    )  # fmt: skip
    alone = zakai.Model(
        state=["a", "b"], drift=["b", "-a - b/2"], diffusion=np.diag([0.3, 0.5]), observation=["a"], observation_noise=[["0.05"]],
        **SAMPLES, prior={"kind": "gaussian", "mean": [1, 0], "cov": [[0.4, 0.1], [0.1, 0.3]]},
    )  # fmt: skip
    record = record_of(model)
    result = zakai.filter(model, record, PARTICLES, particles=300)
    exact = zakai.filter(alone, zakai.Record(record.times, record.values[:, 1:], "samples"), "kalman-bucy")
    # The time step may shift an interval by a hundredth of a standard deviation.
    spread = np.sqrt(exact.variance[1:])
    assert np.all(np.abs(result.mean[1:, 1:] - exact.mean[1:]) < 0.02 * spread)
    assert np.all(np.abs(result.cov[1:, 1:, 1:] - exact.cov[1:]) < 0.04 * spread[:, :, None] * spread[:, None])
    density, expected = result.density(-1).marginal(["a", "b"]), exact.density(-1)
    points = exact.mean[-1] + np.array([[0.0, 0.0], [0.3, -0.2], [-1.0, 1.0]])
    assert np.allclose(density.log_density(points), expected.log_density(points), atol=0.05)
    q = [0.01, 0.5, 0.9]
    assert np.allclose(density.quantile(q), expected.quantile(q), atol=5e-3)
    assert np.allclose(result.density(-1).quantile(q)[:, 1:], expected.quantile(q), atol=5e-3)
    one, other = result.density(-1).marginal("b"), expected.marginal("b")
    assert np.allclose(one.log_density(points[:, 1]), other.log_density(points[:, 1]), atol=0.05)


def test_a_density_of_particles_with_filters_has_the_moments_of_the_result():
    model = zakai.Model(**MIXED)
    result = zakai.filter(model, record_of(model), PARTICLES, particles=2000)
    density = result.density(-1)
    assert np.allclose(density.mean(), result.mean[-1]) and np.allclose(density.cov(), result.cov[-1])
    draws = density.sample(0, 40_000)
    assert np.allclose(draws.mean(axis=0), result.mean[-1], atol=0.02) and np.allclose(np.cov(draws.T), result.cov[-1], atol=0.02)
    smooth = density.smoothed
    assert np.allclose(smooth.mean(), result.mean[-1], atol=1e-9) and np.allclose(smooth.cov(), result.cov[-1], atol=1e-9)
    later = zakai.filter(model.with_prior(density), zakai.Record([0.5], [[np.nan]], "samples"), PARTICLES, particles=2000)
    assert np.allclose(later.mean[0], result.mean[-1], atol=0.06)
    grid = np.linspace(-4, 4, 401)
    assert np.exp(density.marginal("v").log_density(grid)).sum() * 0.02 == pytest.approx(1.0, abs=1e-3)


def test_a_record_a_batch_an_online_filter_a_restart_and_threads_give_equal_bits(tmp_path, monkeypatch):
    from zakai.numerics.particles import chunks

    model = zakai.Model(**MIXED)
    record = record_of(model, 7)
    result = zakai.filter(model, record, PARTICLES, particles=9000)
    monkeypatch.setattr(chunks, "_cores", lambda: 3)
    other = zakai.filter(model, [record_of(model, 5, seed=8), record], PARTICLES, particles=9000)[1]
    online = zakai.online(model, PARTICLES, particles=9000)
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), start=1):
        if k == 4:
            online.save(tmp_path / "state")
            online = zakai.online(model, PARTICLES, particles=9000)
            online.restore(tmp_path / "state")
        estimate = online.update(time, value)
        assert np.array_equal(estimate.mean, result.mean[k]) and np.array_equal(estimate.cov, result.cov[k])
    assert np.array_equal(other.mean, result.mean) and other.log_likelihood == result.log_likelihood


def test_what_is_asked_after_the_record_agrees_with_particles_without_filters():
    model = zakai.Model(**MIXED)
    record = record_of(model, 8)
    results = [zakai.filter(model, record, PARTICLES, particles=3000, split=split) for split in (None, False)]
    spread = np.sqrt(results[0].variance[-1])
    ahead = [result.forecast([record.times[-1] + 1.0]) for result in results]
    assert np.allclose(ahead[0].mean[-1], ahead[1].mean[-1], atol=0.25 * spread)
    assert np.allclose(ahead[0].cov[-1], ahead[1].cov[-1], atol=0.12)
    residuals = [result.residuals() for result in results]
    assert np.allclose(residuals[0], residuals[1], atol=0.06, equal_nan=True)
    means = []
    for split in (None, False):
        runs = [zakai.smooth(model, record, PARTICLES, particles=2000, split=split, seed=seed) for seed in range(4)]
        means.append(np.mean([run.mean for run in runs], axis=0))
    assert np.sqrt(np.mean((means[0] - means[1]) ** 2 / results[0].variance)) < 0.1


def test_a_path_that_gives_the_linear_states_away_leaves_them_to_draws():
    keys = {**MIXED, "diffusion": [["0.02", "0"], ["0", "0.5"]]}
    model, quiet = zakai.Model(**keys), zakai.Model(**{**MIXED, "diffusion": [["0", "0"], ["0", "0.5"]]})
    record = record_of(model, 3, gaps=False)
    result = zakai.filter(model, record, PARTICLES, particles=500)
    assert result.health["linear_states"][-1] == 0
    drawn = zakai.filter(model, record, PARTICLES, particles=500, split=False)
    assert np.allclose(result.mean[0], drawn.mean[0], atol=0.2) and type(result.density(-1)) is type(drawn.density(-1))
    assert zakai.filter(quiet, record, PARTICLES, particles=500).health["linear_states"][-1] == 0
    with pytest.raises(InputError, match="without noise of its own"):
        zakai.filter(quiet, record, PARTICLES, split=True)
    with pytest.raises(InputError, match="option split"):
        zakai.filter(model, record, PARTICLES, split="yes")


RATE = "exp(0.4*T)*a*b"
REACTOR = {
    "state": ["a", "b", "T"], "drift": [f"1 - a - {RATE}", f"1 - b - {RATE}", f"3*{RATE} - 2*T"], "observation": ["T"],
    "diffusion": np.diag([0.05, 0.05, 0.2]), "observation_noise": [[0.01]], **SAMPLES,
}  # fmt: skip


def agree(result, drawn):
    """Return whether two filters differ by less than five of their standard errors."""
    apart = (result.mean - drawn.mean)[1:] / np.hypot(result.mean_standard_error, drawn.mean_standard_error)[1:]
    errors = np.hypot(result.log_likelihood_standard_error, drawn.log_likelihood_standard_error)
    return np.abs(apart).max() < 5.0 and abs(result.log_likelihood - drawn.log_likelihood) < 4 * errors


def test_filters_whose_equations_take_more_time_than_they_save_are_left_out():
    """The covariance of `a` needs twelve substeps an interval where `a` needs two, and `a` is a third of the error."""
    two = [[0.4, 0.6, 0.5], [0.6, 0.4, 0.5]]
    priors = {"kind": "gaussian", "mean": [0.5] * 3, "cov": [0.04, 0.04, 0.1]}, {
        "kind": "mixture", "weights": [0.5, 0.5], "means": two, "covs": [np.diag([0.04, 0.04, 0.1])] * 2}  # fmt: skip
    times = 0.3 * np.arange(1, 26)
    record = zakai.Record(times, 0.5 + 0.1 * np.sin(times)[:, None], "samples")
    for prior in priors:
        model = zakai.Model(**REACTOR, prior=prior)
        drawn = zakai.filter(model, record, PARTICLES, particles=1500, split=False)
        for seed in range(3):
            result = zakai.filter(model, record, PARTICLES, particles=1500, seed=seed)
            assert (result.health["linear_states"][1:] == 0).all()
        assert agree(result, drawn)
        assert zakai.filter(model, record, PARTICLES, particles=500, split=True).health["linear_states"][-1] == 1


def test_filters_are_kept_or_left_out_after_a_sample_at_the_start():
    times = 0.25 * np.arange(12)
    record = zakai.Record(times, 0.6 + 0.2 * np.cos(times)[:, None], "samples")
    result = zakai.filter(zakai.Model(**MIXED), record, PARTICLES, particles=1000)
    assert (result.health["linear_states"][1:] == 1).all()
    # One whose path gives the linear state away.
    model = zakai.Model(**{**MIXED, "diffusion": [["0.02", "0"], ["0", "0.5"]]})
    result, drawn = (zakai.filter(model, record, PARTICLES, particles=3000, split=split) for split in (None, False))
    assert (result.health["linear_states"][1:] == [1, *[0] * 11]).all() and agree(result, drawn)


def test_a_nonlinear_law_of_the_others_goes_with_a_filter_of_the_linear_states():
    model = zakai.Model(
        state=["u", "v"], drift=["-u", "u - v"], diffusion=np.diag([1.0, 0.3]), observation=["exp(u)", "v"],
        observation_family=["poisson", "gaussian"], observation_noise=[["1", "0"], ["0", "0.1*exp(u)"]], **SAMPLES,
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.5]},
    )  # fmt: skip
    record = record_of(model)
    result, drawn = (zakai.filter(model, record, PARTICLES, particles=3000, split=split) for split in (True, False))
    assert np.allclose(result.mean[1:], drawn.mean[1:], atol=0.15 * np.sqrt(drawn.variance[1:].max()))
    error = np.hypot(result.log_likelihood_standard_error, drawn.log_likelihood_standard_error)
    assert abs(result.log_likelihood - drawn.log_likelihood) < 4 * error


def test_many_observations_of_a_linear_state_act_one_after_the_other():
    factors = [1 + i / 10 for i in range(10)]
    seen, noise = [f"{factor}*v" for factor in factors], np.diag([0.5] * 10)
    prior = {"kind": "gaussian", "mean": [0.0, 1.0], "cov": [0.5, 0.4]}
    model = zakai.Model(
        state=["u", "v"], drift=["-u", "-v"], diffusion=np.diag([1.0, 0.5]), observation=["sin(u)", *seen], **SAMPLES,
        observation_noise=np.diag([0.3, *noise.diagonal()]), prior=prior,
    )  # fmt: skip
    alone = zakai.Model(
        state=["v"], drift=["-v"], diffusion=[[0.5]], observation=seen, observation_noise=noise, **SAMPLES,
        prior={"kind": "gaussian", "mean": [1.0], "cov": [0.4]},
    )  # fmt: skip
    record = record_of(model, 5)
    result = zakai.filter(model, record, PARTICLES, particles=200)
    exact = zakai.filter(alone, zakai.Record(record.times, record.values[:, 1:], "samples"), "kalman-bucy")
    spread = np.sqrt(exact.variance[1:, 0])
    assert np.all(np.abs(result.mean[1:, 1] - exact.mean[1:, 0]) < 0.02 * spread)
    assert np.allclose(result.variance[1:, 1], exact.variance[1:, 0], rtol=0.04)


def test_an_input_that_jumps_after_many_rows_at_rest_makes_the_substeps_anew():
    """The state v is at rest under the old input, so that one substep is exact, until w jumps."""
    model = zakai.Model(
        state=["u", "v"], drift=["-0.01*u", "w/30 - v/30"], diffusion=[["0.01", "0"], ["0", "0.0001"]], inputs=["w"],
        observation=["tanh(u) - v"], observation_kind="samples", observation_noise=[[1e-4]],
        prior={"kind": "gaussian", "mean": [0.0, 1.0], "cov": [0.01, 1e-6]},
    )  # fmt: skip
    times, jumps = np.arange(60.0, 3000.0, 60.0), np.arange(0.0, 3000.0, 430.0)
    inputs = zakai.Inputs(jumps, np.arange(len(jumps)) % 2 == 0)
    record = zakai.Record(times, np.full((len(times), 1), np.nan), "samples", inputs=inputs)
    result = zakai.filter(model, record, "guided-particles")
    known, v, t = [], 1.0, 0.0
    for stop in np.unique([*times, *jumps[1:]]):
        v = inputs.at(t)[0] + (v - inputs.at(t)[0]) * np.exp((t - stop) / 30.0)
        t = stop
        known += [v] if stop in times else []
    assert np.abs(result.mean[1:, 1] - known).max() < 0.2 * np.sqrt(result.variance[-1, 1])
