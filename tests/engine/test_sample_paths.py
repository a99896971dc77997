"""Paths drawn from the joint law of the state at all times, against sums over a fine grid and a smoother in plain NumPy."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.linalg import expm

import zakai

COUNT = 4000
A, COV = np.array([[0.0, 1.0], [-1.0, -0.3]]), np.diag([0.0, 0.5])
MEAN, SPREAD = np.array([1.0, -0.5]), np.array([[0.6, 0.1], [0.1, 0.4]])
H, NOISE = np.array([[1.0, 0.2]]), 0.04
OSCILLATOR = zakai.Model(
    state=["x", "v"], drift=["v", "-x - 0.3*v"], diffusion=[["0"], ["1"]], process_noise=[["0.5"]], observation=["x + 0.2*v"],
    observation_kind="samples", observation_noise=[["0.04"]],
    prior={"kind": "gaussian", "mean": MEAN.tolist(), "cov": SPREAD.tolist()},
)  # fmt: skip


def oscillator():
    rng = np.random.default_rng(0)
    times, values = np.cumsum(10.0 ** rng.uniform(-2, 0.3, 60)), rng.normal(size=(60, 1))
    values[rng.random(60) < 0.3] = np.nan
    return times, values


def rauch_tung_striebel(times, values):
    """The smoothed means, covariances, and the covariances of x_k and x_(k+1)."""
    mean, cov, steps, filtered, predicted = MEAN, SPREAD, [], [(MEAN, SPREAD)], []
    for length, value in zip(np.diff(np.concatenate([[0.0], times])), values[:, 0], strict=True):
        whole = expm(np.block([[-A, COV], [np.zeros((2, 2)), A.T]]) * length)  # Van Loan's method
        moved = whole[2:, 2:].T
        steps.append(moved)
        mean, cov = moved @ mean, moved @ cov @ moved.T + moved @ whole[:2, 2:]
        predicted.append((mean, cov))
        if not np.isnan(value):
            gain = cov @ H.T / (H @ cov @ H.T + NOISE)
            mean, cov = mean + gain @ (value - H @ mean), cov - gain @ H @ cov
        filtered.append((mean, cov))
    means, covs, lagged = [mean], [cov], []
    for (mean, cov), (ahead, wide), moved in list(zip(filtered[:-1], predicted, steps, strict=True))[::-1]:
        gain = cov @ moved.T @ np.linalg.inv(wide)
        lagged.append(gain @ covs[-1])
        means.append(mean + gain @ (means[-1] - ahead))
        covs.append(cov + gain @ (covs[-1] - wide) @ gain.T)
    return np.array(means[::-1]), np.array(covs[::-1]), np.array(lagged[::-1])


def assert_near(values, expected):
    """Averages of values (COUNT, ...) are what is expected up to five standard errors, and many of them to about one."""
    errors = (values.mean(axis=0) - expected) / np.maximum(values.std(axis=0) / np.sqrt(len(values)), 1e-12)
    assert np.abs(errors).max() < 5.0
    assert errors.size < 50 or np.mean(errors**2) < 2.5


def test_paths_have_the_means_covariances_and_lagged_covariances_of_a_smoother():
    times, values = oscillator()
    paths = zakai.smooth(OSCILLATOR, zakai.Record(times, values, "samples"), "kalman-bucy").sample_paths(COUNT, seed=2)
    assert paths.shape == (COUNT, 61, 2)
    means, covs, lagged = rauch_tung_striebel(times, values)
    apart = paths - means
    assert_near(paths, means)
    assert_near(apart[..., :, None] * apart[..., None, :], covs)
    assert_near(apart[:, :-1, :, None] * apart[:, 1:, None, :], lagged)


def test_paths_on_grids_of_two_states_have_the_law_of_a_smoother():
    times = np.array([0.0, 0.02, 0.05, 0.3, 0.4, 0.9, 1.6])
    values = np.array([[1.2], [0.7], [np.nan], [0.6], [0.1], [0.3], [-0.6]])
    paths = zakai.smooth(OSCILLATOR, zakai.Record(times, values, "samples"), "yau-yau").sample_paths(COUNT, seed=3)
    means, covs, lagged = rauch_tung_striebel(times, values)
    apart = paths - means
    assert_near(paths, means)
    assert_near(apart[..., :, None] * apart[..., None, :], covs)
    assert_near(apart[:, :-1, :, None] * apart[:, 1:, None, :], lagged)


NOISE_OF_STATE = [["0.6*sqrt(1 + x**2)", "0"], ["0.2", "0.5 + 0.3*sin(2*y)"]]
SPACE = {
    "wells": (["4*x - 4*x**3 + (y - x)/2", "4*y - 4*y**3 + (x - y)/2"], [["0.8", 0], [0, "0.8"]], "x + y", "samples", []),
    "noise that depends on the state": (["-x + y/2", "-y"], NOISE_OF_STATE, "x", "increments", []),
    "pendulum": (["y", "-4*sin(x) - y/5"], [["0"], ["2"]], "sin(x)", "samples", ["x"]),
}


@pytest.mark.parametrize("case", SPACE)
def test_paths_on_grids_of_two_states_have_the_smoothed_moments(case):
    drift, diffusion, observation, kind, angles = SPACE[case]
    model = zakai.Model(
        state=["x", "y"], drift=drift, diffusion=diffusion, observation=[observation], observation_kind=kind,
        observation_noise=[["0.2"]], periodic=angles,
        prior={"kind": "gaussian", "mean": [2.5 if angles else 0.5, 0.2], "cov": [[0.2, 0], [0, 0.3]]},
    )  # fmt: skip
    values = np.array([[0.4], [np.nan], [-0.3]]) * (0.2 if kind == "increments" else 1.0)
    result = zakai.smooth(model, zakai.Record([0.1, 0.25, 0.3], values, kind), "yau-yau")
    paths = result.sample_paths(COUNT, seed=1)
    np.testing.assert_array_equal(paths, result.sample_paths(COUNT, seed=1))
    apart = paths - result.mean
    if angles:
        assert np.abs(paths[..., 0]).max() <= np.pi
        assert (np.diff(paths[..., 0]) < -np.pi).any()
        apart[..., 0] = np.angle(np.exp(1j * apart[..., 0]))
    assert_near(apart[..., 1], 0.0)
    assert_near(np.sin(apart[..., 0]) if angles else apart[..., 0], 0.0)
    assert_near(apart**2, result.variance)


LINE, CIRCLE = np.linspace(-3.4, 3.4, 241), np.linspace(-np.pi, np.pi, 96, endpoint=False)
TIMES, VALUES = np.array([0.05, 0.1, 0.9, 1.0, 2.5]), np.array([0.6, np.nan, -0.3, 0.8, 0.2])
CASES = {
    "double well": (LINE, "4*x - 4*x**3", 4 * LINE - 4 * LINE**3, "x", LINE, False),
    "circle": (CIRCLE, "0.3 + sin(x)", 0.3 + np.sin(CIRCLE), "cos(x)", np.cos(CIRCLE), True),
}


def generator(x, drift, covariance, closed):
    """The forward operator of a Markov chain on a grid, with the rates of a diffusion between neighbours."""
    size, spacing = len(x), x[1] - x[0]
    if closed:
        k = np.fft.fftfreq(size, 1 / size)[:, None]
        waves = np.fft.fft(np.eye(size), axis=0)
        first, second = (np.fft.ifft(factor * waves, axis=0).real for factor in (1j * k, -(k**2)))
        return 0.5 * covariance * second - first * drift
    first = (np.eye(size, k=1) - np.eye(size, k=-1)) * 2 / 3 - (np.eye(size, k=2) - np.eye(size, k=-2)) / 12
    second = (np.eye(size, k=1) + np.eye(size, k=-1)) * 4 / 3 - (np.eye(size, k=2) + np.eye(size, k=-2)) / 12 - 2.5 * np.eye(size)
    return 0.5 * covariance * second / spacing**2 - first * drift / spacing


def joint_laws(x, operator, h, noise, kind, prior):
    """The joint densities (N, N) of x_k (columns) and x_(k+1) (rows), on a grid."""
    states, matrices = [prior / prior.sum()], []
    for length, value in zip(np.diff(np.concatenate([[0.0], TIMES])), VALUES, strict=True):
        inside, factor = np.zeros_like(x), np.ones_like(x)
        if not np.isnan(value) and kind == "samples":
            factor = np.exp(-0.5 * (value - h) ** 2 / noise)
        elif not np.isnan(value):
            inside = (h * value / length - 0.5 * h**2) / noise
        matrices.append(factor[:, None] * expm(length * (operator + np.diag(inside))))
        states.append(matrices[-1] @ states[-1])
        states[-1] /= states[-1].sum()
    message, found = np.ones_like(x), []
    for state, matrix in list(zip(states, matrices, strict=False))[::-1]:
        joint = message[:, None] * matrix * state
        found.append(joint / joint.sum())
        message = matrix.T @ message
        message /= message.max()
    return found[::-1]


@pytest.mark.parametrize("kind", ["samples", "increments"])
@pytest.mark.parametrize("case", CASES)
def test_neighbouring_states_of_paths_have_their_joint_law(case, kind):
    x, drift, f, observation, h, closed = CASES[case]
    model = zakai.Model(
        state=["x"], drift=[drift], observation=[observation], observation_kind=kind, observation_noise=[[0.3]],
        process_noise=[[0.8]], periodic=["x"] if closed else [], prior={"kind": "gaussian", "mean": [0.4], "cov": [[0.04]]},
    )  # fmt: skip
    paths = zakai.smooth(model, zakai.Record(TIMES, VALUES[:, None], kind), "yau-yau").sample_paths(COUNT, seed=1)[:, :, 0]
    expected = joint_laws(x, generator(x, f, 0.8, closed), h, 0.3, kind, np.exp(-((x - 0.4) ** 2) / 0.08))
    functions = [np.sin, np.cos, lambda x: np.sin(2 * x)] if closed else [lambda x: x, lambda x: x**2, lambda x: np.tanh(3 * x)]
    for k, joint in enumerate(expected):
        for one in functions:
            assert_near(one(paths[:, k + 1]), joint.sum(axis=1) @ one(x))
            for other in functions:
                assert_near(one(paths[:, k]) * other(paths[:, k + 1]), other(x) @ joint @ one(x))


def test_a_gauge_and_nodes_of_a_prior_have_the_law_of_a_grid():
    model = zakai.Model(
        state=["x"], drift=["2*tanh(2*x)"], observation=["x"], prior={"kind": "density", "log_density": "-2*(x**2 - 1)**2"}
    )
    record = zakai.Record(TIMES, VALUES[:, None], "increments")
    exact, grid = (zakai.smooth(model, record, method) for method in ("benes", "yau-yau"))
    paths = exact.sample_paths(COUNT)
    assert_near(paths, grid.mean)
    assert_near((paths - grid.mean) ** 2, grid.variance)
    assert paths.std(axis=0).min() > 0.1


def test_blocks_are_drawn_independently():
    model = zakai.Model(
        state=["a", "x"], drift=["-a", "x - x**3"], observation=["x", "a"], observation_kind="samples",
        observation_noise=[["0.5", "0"], ["0", "0.5"]], prior={"kind": "gaussian", "mean": [0, 1], "cov": [[1, 0], [0, 0.2]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record([0.4, 0.5], [[0.6, -0.4], [0.7, np.nan]], "samples"))
    assert len(result.blocks) == 2
    paths = result.sample_paths(COUNT)
    assert_near(paths, result.mean)
    assert_near((paths - result.mean) ** 2, result.variance)
    assert np.abs(np.corrcoef(paths[:, 1].T)[0, 1]) < 0.06


def test_paths_keep_to_a_domain_and_a_sample_at_the_start_is_no_interval():
    model = zakai.Model(
        state=["x"], drift=["1 - x"], diffusion=[["0.4*sqrt(x)"]], observation=["x"], observation_kind="samples",
        observation_noise=[["0.05"]], domain={"x": {"lower": 0.0}}, prior={"kind": "gaussian", "mean": [1], "cov": [[0.02]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record([0.0, 0.4, 0.5], [[1.1], [0.6], [0.7]], "samples"))
    paths = result.sample_paths(COUNT)
    np.testing.assert_array_equal(paths[:, 0], paths[:, 1])
    assert (paths > 0).all()
    assert_near(paths, result.mean)
    assert_near((paths - result.mean) ** 2, result.variance)


def test_a_known_start_is_drawn_as_it_is():
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x"], diffusion=[["0"], ["1"]], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1, 2], "cov": [[0, 0], [0, 0]]},
    )  # fmt: skip
    result = zakai.smooth(model, zakai.Record([0.1, 0.2], [[1.0], [0.8]], "samples"))
    paths = result.sample_paths(COUNT)
    np.testing.assert_allclose(paths[:, 0], np.broadcast_to([1.0, 2.0], (COUNT, 2)), atol=1e-6)
    assert_near(paths[:, 1:], result.mean[1:])


def test_a_seed_gives_the_same_paths():
    times, values = oscillator()
    result = zakai.smooth(OSCILLATOR, zakai.Record(times, values, "samples"))
    first = result.sample_paths(10, seed=5)
    np.testing.assert_array_equal(first, result.sample_paths(10, seed=5))
    assert not np.array_equal(first, result.sample_paths(10, seed=6))


def test_what_cannot_be_drawn_is_refused_in_one_line():
    result = zakai.smooth(OSCILLATOR, zakai.Record([1.0], [[1.0]], "samples"))
    for count in (0, True, 2.5, "three"):
        with pytest.raises(zakai.InputError, match="count is .* whole number"):
            result.sample_paths(count)
    with pytest.raises(zakai.InputError, match="GiB; draw at most"):
        result.sample_paths(10**9)


def test_laws_that_are_not_near_to_normal_warn(monkeypatch, caplog):
    monkeypatch.setattr("zakai.engine.paths.MOST_PARTS", 1)
    model = zakai.Model(
        state=["x", "y"], drift=["4*x - 4*x**3 + y", "-y"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [[0.5, 0], [0, 0.5]]},
    )  # fmt: skip
    record = zakai.Record([0.1], [[0.3]], "samples")
    result = zakai.smooth(model, record, "yau-yau")
    result.sample_paths(100)
    assert not caplog.records
    monkeypatch.setattr("zakai.engine.paths.NORMAL", 1e-6)
    result.sample_paths(100)
    assert "not near to normal in 1 of 1 intervals" in caplog.text


def test_beyond_a_bound_the_memory_of_a_smoothed_record_does_not_grow_with_the_densities(monkeypatch):
    monkeypatch.setattr("zakai.engine.smoother.KEPT_BYTES", 0)
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0], "cov": [[0.5]]},
    )  # fmt: skip
    values = np.random.default_rng(0).normal(size=(1500, 1))
    record = zakai.Record(np.arange(1, 1501) * 0.05, values, "samples")
    zakai.smooth(model, record, "yau-yau")  # fills what is kept for a model
    tracemalloc.start()
    result = zakai.smooth(model, record, "yau-yau")
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.isfinite(result.mean).all()
    assert kept < 600 * len(record)  # a density takes more than 256 bytes, the moments and figures of health 370
