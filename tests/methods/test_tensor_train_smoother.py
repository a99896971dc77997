"""Smoothing by draws from tensor trains, against the exact smoother, a grid of all points, and weighted paths."""

from __future__ import annotations

import numpy as np

import zakai
from methods.tracks import track


def linear_track():
    """Return the track with a record that has a gap, and its exact smoothing result."""
    model = track()
    times = np.cumsum(np.random.default_rng(5).uniform(0.1, 0.6, 9))
    times[5:] += 2.0
    _, record = zakai.simulate(model, times, seed=2)
    values = record.values.copy()
    values[2, 0] = np.nan
    record = zakai.Record(times, values, "samples")
    return model, record, zakai.smooth(model, record, "kalman-bucy")


def apart(result, exact):
    """Return the errors of the means and of the deviations, in deviations (K + 1, n)."""
    deviations = np.sqrt(exact.variance)
    errors = result.mean - exact.mean
    periodic = [name in exact.model.periodic for name in exact.model.state]
    errors = np.where(periodic, (errors + np.pi) % (2 * np.pi) - np.pi, errors)
    return errors / deviations, np.sqrt(result.variance) / deviations - 1


def test_a_linear_track_is_smoothed_as_by_the_exact_smoother_without_chance_in_its_means():
    model, record, exact = linear_track()
    result = zakai.smooth(model, record, "tensor-train")
    means, deviations = apart(result, exact)
    assert not result.warnings
    assert np.abs(means).max() < 5e-3 and np.abs(deviations).max() < 0.1
    assert (result.mean_standard_error < 1e-3 * np.sqrt(exact.variance)).all()
    assert result.log_likelihood == result.filtered.log_likelihood


def test_paths_have_the_moments_of_the_exact_smoother_also_between_times():
    model, record, exact = linear_track()
    paths = zakai.smooth(model, record, "tensor-train").sample_paths(4000, seed=3)
    others = exact.sample_paths(4000, seed=4)
    errors = (paths.mean(axis=0) - exact.mean) / np.sqrt(exact.variance)
    assert np.abs(errors).max() < 5.0 / np.sqrt(4000)
    assert np.abs(paths.std(axis=0) / np.sqrt(exact.variance) - 1).max() < 0.06
    for k in (0, 5):
        one, other = (np.corrcoef(np.concatenate([p[:, k], p[:, k + 1]], axis=1).T) for p in (paths, others))
        assert np.abs(one - other).max() < 0.08


def test_equal_seeds_give_equal_paths_and_smoothing_twice_gives_equal_bits():
    model = track(observation=["sqrt(px**2 + py**2)", "atan2(py, px)"])
    _, record = zakai.simulate(model, np.array([0.2, 0.5, 0.6]), seed=2)
    one, other = (zakai.smooth(model, record, "tensor-train", tolerance=2e-2) for _ in range(2))
    assert np.array_equal(one.mean, other.mean) and np.array_equal(one.mean_standard_error, other.mean_standard_error)
    assert np.array_equal(one.sample_paths(50, seed=1), other.sample_paths(50, seed=1))
    assert not np.array_equal(one.sample_paths(50, seed=1), one.sample_paths(50, seed=2))


def weighted_paths(drift, noise, record, h, variance, prior, count, step):
    """Return the smoothed means and deviations at the start and all observations, by paths that are weighed by all of them."""
    rng = np.random.default_rng(0)
    x = prior[0] + rng.standard_normal((count, len(prior[0]))) * np.sqrt(prior[1])
    kept, logs, t = [x], np.zeros(count), 0.0
    for stop, z in zip(record.times, record.values, strict=True):
        steps = int(np.ceil((stop - t) / step))
        d = (stop - t) / steps
        for _ in range(steps):
            x = x + 0.5 * d * drift(x + 0.25 * d * drift(x))
            x = x + np.sqrt(d) * noise * rng.standard_normal(x.shape)
            x = x + 0.5 * d * drift(x + 0.25 * d * drift(x))
        logs -= 0.5 * ((z - h(x)) ** 2 / variance).sum(axis=1)
        kept.append(x)
        t = stop
    w = np.exp(logs - logs.max())
    w /= w.sum()
    means = np.array([w @ x for x in kept])
    return means, np.sqrt(np.array([w @ (x - m) ** 2 for x, m in zip(kept, means, strict=True)])), 1 / (w @ w)


def test_a_nonlinear_system_of_three_states_is_smoothed_as_by_weighted_paths():
    model = zakai.Model(
        state=["h", "v", "b"], drift=["v", "-sin(h) - 0.3*v + b", "-0.5*b*h**2"], diffusion=[[0, 0], [0.5, 0], [0, 0.4]],
        observation=["h + 0.2*h**2"], observation_kind="samples", observation_noise=[[0.1]],
        prior={"kind": "gaussian", "mean": [0.5, 0.5, 0.2], "cov": [0.4, 0.3, 0.2]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.array([0.4, 0.7, 1.3]), seed=3)
    result = zakai.smooth(model, record, "tensor-train")

    def drift(x):
        h, v, b = x.T
        return np.column_stack([v, -np.sin(h) - 0.3 * v + b, -0.5 * b * h**2])

    means, deviations, size = weighted_paths(
        drift, np.array([0.0, 0.5, 0.4]), record, lambda x: x[:, :1] + 0.2 * x[:, :1] ** 2, 0.1,
        (np.array([0.5, 0.5, 0.2]), np.array([0.4, 0.3, 0.2])), 200_000, 0.1,
    )  # fmt: skip
    assert size > 20_000
    allowed = 4 * np.sqrt(1 / size + result.error_estimate[:, None] ** 2)
    assert (np.abs(result.mean - means) / deviations < allowed).all()
    assert np.abs(np.sqrt(result.variance) / deviations - 1).max() < 0.1
    for k in (0, 1, 3):
        assert np.allclose(result.density(k).mean(), result.mean[k]) and np.allclose(result.density(k).cov(), result.cov[k])


def near_grid(model, times, bound):
    """Check the smoothed means and deviations against those of a grid of all points."""
    _, record = zakai.simulate(model, np.array(times), seed=1)
    means, deviations = apart(zakai.smooth(model, record, "tensor-train"), zakai.smooth(model, record, "yau-yau"))
    assert np.abs(means).max() < bound and np.abs(deviations).max() < 0.1


def test_noise_that_depends_on_the_state_is_smoothed_as_on_a_grid():
    model = zakai.Model(
        state=["a", "b"], drift=["a*(1 - b)", "b*(a - 1)"], diffusion=[["0.2*a", 0], [0, "0.2*b"]], observation=["a"],
        observation_kind="samples", observation_noise=[[0.04]],
        prior={"kind": "gaussian", "mean": [1.2, 0.8], "cov": [[0.02, 0.0], [0.0, 0.02]]},
    )  # fmt: skip
    near_grid(model, [0.2, 0.5], 0.02)


def test_increments_are_smoothed_as_on_a_grid():
    model = zakai.Model(
        state=["x", "y"], drift=["cos(x) + 0.5*sin(y)", "cos(y)"], diffusion=[[1, 0], [0, 1]], observation=["x**3", "y**3"],
        observation_kind="increments", observation_noise=[[1, 0], [0, 1]],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [[0.5, 0], [0, 0.5]]},
    )  # fmt: skip
    near_grid(model, [0.05, 0.1, 0.15], 0.02)


def test_a_heading_on_the_whole_circle_is_smoothed_as_on_a_grid_within_chance():
    model = zakai.Model(
        state=["p", "a"], drift=["cos(a)", "0.3"], diffusion=[[0.2, 0], [0, 0.8]], observation=["p"], observation_kind="samples",
        observation_noise=[[0.05]], prior={"kind": "gaussian", "mean": [0, 0.5], "cov": [[0.3, 0], [0, 1.5]]}, periodic=["a"],
    )  # fmt: skip
    near_grid(model, [0.3, 0.6], 0.12)


def test_two_modes_keep_their_shares_and_paths_stay_in_their_mode():
    model = zakai.Model(
        state=["x", "y", "z"], drift=["-0.2*x", "-0.2*y + 0.1*x", "-0.2*z + 0.1*x"], diffusion=(0.4 * np.eye(3)).tolist(),
        observation=["x**2/2", "y", "z"], observation_kind="samples", observation_noise=(0.1 * np.eye(3)).tolist(),
        prior={"kind": "gaussian", "mean": [0.0] * 3, "cov": [1.0] * 3},
    )  # fmt: skip
    values = np.array([[2.0, 0.1, -0.1], [2.2, 0.0, 0.1], [2.1, 0.1, 0.0]])
    record = zakai.Record([0.3, 0.6, 0.9], values, "samples")
    x = zakai.smooth(model, record, "tensor-train").sample_paths(2000, seed=1)[:, 1:, 0]
    assert (np.abs(x) > 0.5).mean() > 0.99 and (np.sign(x) == np.sign(x[:, :1])).all(axis=1).mean() > 0.99
    # The observations of y and z favour one sign: its share is that of the filter at the last time.
    density = zakai.filter(model, record, "tensor-train").density(-1).marginal("x")
    share = np.exp(density.log_density(np.linspace(0, 5, 2001)[:, None])).sum() * 2.5e-3
    assert abs((x[:, 0] > 0).mean() - share) < 0.05


def test_a_lost_density_smooths_to_nothing_and_says_when_it_was_lost():
    model = track(observation=["sqrt(px**2 + py**2)", "atan2(py, px)"], observation_noise=[[1e-4, 0], [0, 1e-6]])
    record = zakai.Record([0.5, 1.0, 1.5], [[8.0, 0.4], [400.0, 2.2], [7.0, 0.4]], "samples")
    result = zakai.smooth(model, record, "tensor-train", tolerance=2e-2)
    assert np.isnan(result.mean).all()
    assert len(result.warnings) == 1 and "the density was lost at t = 1" in result.warnings[0]
