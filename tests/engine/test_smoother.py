"""The smoother against a Rauch-Tung-Striebel smoother and dense forward-backward sums in plain NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

import zakai

A, COV = np.array([[-0.5, 1.0], [-1.0, -0.3]]), np.array([[0.3, 0.1], [0.1, 0.5]])
C, NOISE = np.array([[1.0, 0.2], [0.3, -1.0]]), np.array([[0.04, 0.01], [0.01, 0.09]])
MEAN, SPREAD = np.array([1.0, -0.5]), np.array([[0.6, 0.1], [0.1, 0.4]])
PAIR = {"drift": ["-0.5*x + y", "-x - 0.3*y"], "process_noise": COV.tolist(), "observation_noise": NOISE.tolist()}


def pair(kind, **more):
    prior = {"kind": "gaussian", "mean": MEAN.tolist(), "cov": SPREAD.tolist()}
    keys = {**PAIR, "observation_kind": kind, "prior": prior, **more}
    return zakai.Model(state=["x", "y"], observation=["x + 0.2*y", "0.3*x - y"], **keys)


def discrete(length):
    """The transition matrix and the noise of dx = A x dt + dv over an interval, by Van Loan's method."""
    whole = expm(np.block([[-A, COV], [np.zeros((2, 2)), A.T]]) * length)
    moved = whole[2:, 2:].T
    return moved, moved @ whole[:2, 2:]


def updated(mean, cov, H, residual_of, noise):
    gain = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + noise)
    return mean + gain @ residual_of(mean), cov - gain @ H @ cov


def rauch_tung_striebel(steps, updates):
    """Smoothed means and covariances; `steps` are (F, Q) of each interval, `updates` functions of (mean, cov)."""
    mean, cov = MEAN, SPREAD
    filtered, predicted = [(mean, cov)], []
    for (moved, noise), update in zip(steps, updates, strict=True):
        mean, cov = moved @ mean, moved @ cov @ moved.T + noise
        predicted.append((mean, cov))
        mean, cov = update(mean, cov)
        filtered.append((mean, cov))
    smoothed = [filtered[-1]]
    for k in reversed(range(len(steps))):
        (mean, cov), (ahead, wide) = filtered[k], predicted[k]
        gain = cov @ steps[k][0].T @ np.linalg.inv(wide)
        smoothed.append((mean + gain @ (smoothed[-1][0] - ahead), cov + gain @ (smoothed[-1][1] - wide) @ gain.T))
    means, covs = zip(*smoothed[::-1], strict=True)
    return np.array(means), np.array(covs)


def test_samples_with_gaps_agree_with_a_rauch_tung_striebel_smoother():
    rng = np.random.default_rng(0)
    times = np.cumsum(10.0 ** rng.uniform(-3, 0.5, 200))
    values = rng.normal(size=(200, 2))
    values[rng.random((200, 2)) < 0.3] = np.nan
    result = zakai.smooth(pair("samples"), zakai.Record(times, values, "samples"), "kalman-bucy")

    def update_of(value):
        seen = ~np.isnan(value)
        H, noise = C[seen], NOISE[np.ix_(seen, seen)]
        return lambda mean, cov: updated(mean, cov, H, lambda m: value[seen] - H @ m, noise) if seen.any() else (mean, cov)

    steps = [discrete(length) for length in np.diff(np.concatenate([[0.0], times]))]
    means, covs = rauch_tung_striebel(steps, [update_of(value) for value in values])
    np.testing.assert_allclose(result.mean, means, atol=1e-9)
    np.testing.assert_allclose(result.cov, covs, atol=1e-9)
    assert result.warnings == [] and result.health["evidence_error"].max() < 1e-9
    np.testing.assert_allclose(result.mean[-1], result.filtered.mean[-1], atol=1e-14)
    assert result.log_likelihood == result.filtered.log_likelihood
    for k in (0, 1, 73, 74, -1):
        np.testing.assert_allclose(result.density(k).mean(), result.mean[k], atol=1e-13)
        np.testing.assert_allclose(result.density(k).cov(), result.cov[k], atol=1e-13)


def test_increments_agree_with_the_limit_of_fine_intervals():
    times, values = np.array([0.3, 0.5, 1.3, 1.4]), np.array([[0.2, -0.1], [0.1, np.nan], [-0.3, 0.6], [np.nan, 0.1]])
    result = zakai.smooth(pair("increments"), zakai.Record(times, values, "increments"), "kalman-bucy")

    def fine(parts):
        # y is linear in an interval: half of the factor of a part acts before the motion, half after it.
        steps, updates, ends = [], [], []
        for length, value in zip(np.diff(np.concatenate([[0.0], times])), values, strict=True):
            seen, part = ~np.isnan(value), length / parts
            H, noise, rate = C[seen] * part / 2, NOISE[np.ix_(seen, seen)] * part / 2, value[seen] / parts / 2

            def half(mean, cov, H=H, noise=noise, rate=rate):
                return updated(mean, cov, H, lambda m: rate - H @ m, noise)

            for _ in range(parts):
                steps += [(np.eye(2), np.zeros((2, 2))), discrete(part)]
                updates += [half, half]
            ends.append(len(steps))
        means, covs = rauch_tung_striebel(steps, updates)
        return means[[0, *ends]], covs[[0, *ends]]

    coarse, finer = fine(50), fine(100)
    for own, first, second in zip((result.mean, result.cov), coarse, finer, strict=True):
        np.testing.assert_allclose(own, (4 * second - first) / 3, atol=1e-6)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_the_extended_smoother_of_a_linear_system_is_the_exact_one(kind):
    rng = np.random.default_rng(3)
    times, values = np.cumsum(rng.uniform(0.001, 0.01, 60)), 0.05 * rng.normal(size=(60, 2))
    values[rng.random((60, 2)) < 0.3] = np.nan
    record = zakai.Record(times, values, kind)
    exact, result = (zakai.smooth(pair(kind), record, method) for method in ("kalman-bucy", "extended-kalman-bucy"))
    bound = 1e-9 if kind == "samples" else 1e-3
    np.testing.assert_allclose(result.mean, exact.mean, atol=bound)
    np.testing.assert_allclose(result.cov, exact.cov, atol=bound)
    np.testing.assert_allclose(result.density(7).mean(), result.mean[7], atol=1e-14)
    assert result.warnings == []


def test_the_extended_smoother_goes_the_short_way_around_a_circle():
    model = zakai.Model(
        state=["x"], periodic=["x"], drift=["0*x"], observation=["sin(x)", "cos(x)"], observation_kind="samples",
        observation_noise=[[0.01, 0], [0, 0.01]], process_noise=[[0.5]],
        prior={"kind": "gaussian", "mean": [3.0], "cov": [[0.1]]},
    )  # fmt: skip
    angles = np.array([3.0, -3.1, -2.9, 3.1])
    record = zakai.Record([0.1, 0.2, 0.3, 0.4], np.column_stack([np.sin(angles), np.cos(angles)]), "samples")
    result, grid = (zakai.smooth(model, record, method) for method in ("extended-kalman-bucy", "yau-yau"))
    apart = result.mean - grid.mean
    np.testing.assert_allclose(apart - 2 * np.pi * np.round(apart / (2 * np.pi)), 0, atol=0.02)
    np.testing.assert_allclose(result.variance, grid.variance, rtol=0.1)


def test_auto_takes_a_method_that_smooths():
    # f = F' with e^F = (1 + 2 x^2) e^(x^2 / 2): hu-yau filters it, and smooths sums of exponentials only.
    prior = {"kind": "gaussian", "mean": [0.2], "cov": [[0.3]]}
    model = zakai.Model(
        state=["x"], drift=["x + 4*x/(1 + 2*x**2)"], observation=["x"], observation_kind="samples", prior=prior
    )
    record = zakai.Record([0.3, 0.5], [[0.4], [0.7]], "samples")
    filtered, smoothed = zakai.filter(model, record), zakai.smooth(model, record)
    assert filtered.method == "hu-yau" and smoothed.method == "limited-direct"
    assert "hu-yau holds too, but" in smoothed.why and "is not a sum of exponentials" in smoothed.why
    np.testing.assert_allclose(smoothed.mean[-1], filtered.mean[-1], atol=1e-6)


TIMES, SAMPLES = np.array([0.4, 0.5, 1.5, 3.0, 3.2]), np.array([0.5, np.nan, -0.6, 1.4, np.nan])
PRIORS = {
    "gaussian": ({"kind": "gaussian", "mean": [0.2], "cov": [[0.8]]}, lambda x: -((x - 0.2) ** 2) / 1.6),
    "density": ({"kind": "density", "log_density": "-(x**2 - 1)**2"}, lambda x: -((x**2 - 1) ** 2)),
}


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize(
    ("method", "options"), [("benes", {}), ("hu-yau", {}), ("hu-yau", {"theorem": "theorem-5"})]
)
def test_a_benes_system_agrees_with_sums_over_a_grid(prior, method, options):
    table, log_prior = PRIORS[prior]
    model = zakai.Model(
        state=["x"], drift=["tanh(x)"], observation=["x"], observation_kind="samples", observation_noise=[[0.5]], prior=table
    )
    result = zakai.smooth(model, zakai.Record(TIMES, SAMPLES[:, None], "samples"), method, **options)

    x = np.linspace(-14, 14, 1401)
    states = [np.exp(log_prior(x))]
    matrices, likelihoods = [], []
    for length, value in zip(np.diff(np.concatenate([[0.0], TIMES])), SAMPLES, strict=True):
        # The transition density of dx = tanh x dt + dv.
        matrices.append(np.cosh(x)[:, None] / np.cosh(x) * np.exp(-0.5 * (x[:, None] - x) ** 2 / length))
        likelihoods.append(np.ones_like(x) if np.isnan(value) else np.exp(-((value - x) ** 2)))
        states.append(likelihoods[-1] * (matrices[-1] @ states[-1]))
    message = np.ones_like(x)
    for k in reversed(range(len(states))):
        density = states[k] * message
        density /= density.sum() * (x[1] - x[0])
        own = np.exp(result.density(k).log_density(x[:, None]))
        np.testing.assert_allclose(own, density, atol=1e-8 * density.max())
        mean = (x * density).sum() * (x[1] - x[0])
        assert result.mean[k, 0] == pytest.approx(mean, abs=1e-8)
        assert result.variance[k, 0] == pytest.approx(((x - mean) ** 2 * density).sum() * (x[1] - x[0]), abs=1e-8)
        if k:
            message = matrices[k - 1].T @ (likelihoods[k - 1] * message)
    assert result.warnings == []


def test_a_drift_with_another_theorem_has_the_same_smoother():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.3]]}
    )
    record = zakai.Record([0.1, 0.4, 1.0], [[0.1], [0.5], [-0.2]], "increments")
    one, other = (zakai.smooth(model, record, "hu-yau", theorem=f"theorem-{i}") for i in (4, 6))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-12)
    np.testing.assert_allclose(one.variance, other.variance, atol=1e-12)


def test_the_one_shot_form_has_the_smoother_of_the_stepwise_form():
    weights, means, covs = [0.4, 0.6], [[1, 0], [-1, 1]], [[[0.5, 0], [0, 0.3]], [[0.1, 0], [0, 0.5]]]
    two = zakai.Model(
        state=["x", "y"], drift=["-x + y", "-y"], observation=["x + 1", "y"],
        prior={"kind": "mixture", "weights": weights, "means": means, "covs": covs},
    )  # fmt: skip
    one = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [1.0], "cov": [[0.3]]}
    )
    for model, theorem in ((two, "theorem-4"), (two, "theorem-5"), (one, "theorem-6")):
        values = 0.1 * np.arange(3.0 * model.n).reshape(3, model.n)
        record = zakai.Record([0.1, 0.4, 0.5], values, "increments")
        shot, steps = (zakai.smooth(model, record, "hu-yau", form=form, theorem=theorem) for form in ("one-shot", "stepwise"))
        np.testing.assert_allclose(shot.mean, steps.mean, atol=1e-11)
        np.testing.assert_allclose(shot.cov, steps.cov, atol=1e-11)
        np.testing.assert_allclose(shot.density(1).mean(), steps.mean[1], atol=1e-11)
        np.testing.assert_allclose(shot.sample_paths(5, seed=1), steps.sample_paths(5, seed=1), atol=1e-9)
        assert shot.warnings == [] and shot.health["evidence_error"].max() < 1e-11


def test_blocks_are_smoothed_one_by_one():
    def model(state, drift, prior):
        return zakai.Model(state=state, drift=drift, observation=state, observation_kind="samples", prior=prior)

    record = np.array([[0.3, -0.2], [0.8, 0.1], [0.2, -0.9]])
    together = model(["x", "y"], ["-x", "-y"], {"kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]})
    alone = model(["x"], ["-x"], {"kind": "gaussian", "mean": [0], "cov": [[1]]})
    whole = zakai.smooth(together, zakai.Record([0.5, 1.0, 2.0], record, "samples"))
    for i in range(2):
        part = zakai.smooth(alone, zakai.Record([0.5, 1.0, 2.0], record[:, [i]], "samples"))
        np.testing.assert_allclose(whole.mean[:, i], part.mean[:, 0], atol=1e-14)
        np.testing.assert_allclose(whole.density(1).mean()[i], part.mean[1, 0], atol=1e-14)


def test_a_state_far_from_the_prior_and_units_of_any_size_keep_their_digits():
    def smoothed(unit, offset):
        prior = {"kind": "gaussian", "mean": [offset * unit], "cov": [[unit**2]]}
        noise = {"process_noise": [[unit**2]], "observation_noise": [[0.01 * unit**2]]}
        model = zakai.Model(
            state=["x"], drift=["0*x"], observation=["x"], observation_kind="samples", prior=prior, **noise
        )
        values = np.array([[0.1], [0.3], [-0.2]]) * unit + offset * unit
        return zakai.smooth(model, zakai.Record([0.1, 1.0, 1.5], values, "samples"), "kalman-bucy")

    plain = smoothed(1.0, 0.0)
    for unit, offset in ((1e-6, 0.0), (1e6, 0.0), (1.0, 1e6)):
        other = smoothed(unit, offset)
        np.testing.assert_allclose(other.mean / unit - offset, plain.mean, atol=1e-9)
        np.testing.assert_allclose(other.variance / unit**2, plain.variance, rtol=1e-9)
        assert other.warnings == []


def test_a_method_or_a_form_without_a_backward_pass_is_refused():
    record = zakai.Record([0.1], [[0.1]], "increments")
    line = zakai.load_model("gallery:benes")
    with pytest.raises(zakai.InputError, match='"algorithm-1" has no backward pass; take "split-merge"'):
        zakai.smooth(line, record, "gaussian-sum", reduction="algorithm-1")
    with pytest.raises(zakai.InputError, match='riccati="euler" has no backward pass'):
        zakai.smooth(line, record, "extended-kalman-bucy", riccati="euler")


def test_a_result_is_stored_and_read(tmp_path):
    model = zakai.load_model("gallery:benes")
    result = zakai.smooth(model, zakai.Record([0.1, 0.2], [[0.1], [0.0]], "increments"))
    result.save(tmp_path / "smoothed.nc")
    np.testing.assert_array_equal(zakai.load_result(tmp_path / "smoothed.nc").mean, result.mean)
    assert result.to_dataset().attrs["kind"] == "smoothed" and repr(result).startswith("SmoothingResult(benes")


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_the_compiled_backward_pass_is_that_of_single_steps(kind, monkeypatch):
    from zakai.methods.gaussian import kalman_bucy

    rng = np.random.default_rng(5)
    times, values = np.cumsum(10.0 ** rng.uniform(-3, 0.5, 300)), rng.normal(size=(300, 2))
    values[rng.random((300, 2)) < 0.3] = np.nan
    record = zakai.Record(times, values, kind)
    compiled = zakai.smooth(pair(kind), record, "kalman-bucy")
    single = dataclasses.replace(kalman_bucy.METHOD.backward, segment=None)
    monkeypatch.setattr(kalman_bucy, "METHOD", dataclasses.replace(kalman_bucy.METHOD, backward=single))
    stepwise = zakai.smooth(pair(kind), record, "kalman-bucy")
    np.testing.assert_allclose(compiled.mean, stepwise.mean, rtol=0, atol=1e-11)
    np.testing.assert_allclose(compiled.cov, stepwise.cov, rtol=0, atol=1e-12)
    assert compiled.health["evidence_error"].max() < 1e-9


@pytest.mark.parametrize("memory", [2**30, 0])
def test_all_densities_take_each_interval_back_once_and_have_the_smoothed_moments(memory, monkeypatch):
    from zakai.engine import smoother

    monkeypatch.setattr(smoother, "KEPT_BYTES", memory)
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples", observation_noise=[["0.2"]],
        prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.5]]},
    )  # fmt: skip
    record = zakai.simulate(model, np.arange(0.1, 20.05, 0.1), seed=0)[1]
    result = zakai.smooth(model, record)
    taken, whole = [], smoother.SmoothingRun._backward
    monkeypatch.setattr(smoother.SmoothingRun, "_backward", lambda *given: (taken.append(len(given[-1])), whole(*given))[1])
    for _ in range(1 if memory == 0 else 2):
        means = [result.density(k).mean() for k in range(len(result.times))]
    assert sum(taken) <= len(record)
    np.testing.assert_allclose(means, result.mean, atol=1e-6)
    taken.clear()
    assert abs(result.density(-1).mean() - result.mean[-1]) < 1e-6 and taken == []
