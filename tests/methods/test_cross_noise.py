"""Correlated noise of linear systems, against the moment equations and the exact joint law of fine increments."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import zakai
from references.convention import within_convention
from references.moments import moments
from zakai.errors import ConditionError, InputError

PRIOR = np.array([0.3, -0.5]), np.array([[0.8, 0.1], [0.1, 0.5]])
L, C, OFFSET, LEVEL = np.array([[-0.8, 0.3], [0.5, -1.0]]), np.array([[1.0, 0.2], [0.3, -2.0]]), np.array([0.2, -0.1]), np.ones(2)
g, Q, S = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1, 0.2], [0.2, 0.5]]), np.array([[0.5, 0.1], [0.1, 1 / 3]])
N = np.array([[0.3, 0.1], [-0.1, -0.2]])
KEYS = {
    "state": ["x", "y"],
    "drift": ["-0.8*x + 0.3*y + 0.2", "0.5*x - y - 0.1"],
    "process_noise": [["1", "1/5"], ["1/5", "1/2"]],
    "diffusion": [["1", "1/2"], ["0", "1"]],
    "observation": ["x + 0.2*y + 1", "0.3*x - 2*y + 1"],
    "observation_noise": [["1/2", "1/10"], ["1/10", "1/3"]],
    "cross_noise": [["c", "1/10"], ["-1/10", "-1/5"]],
    "parameters": {"c": 0.3},
    "prior": {"kind": "gaussian", "mean": PRIOR[0].tolist(), "cov": PRIOR[1].tolist()},
}


def correlated(kind="increments", **more):
    """Return the system above."""
    return zakai.Model(**{**KEYS, **more}, observation_kind=kind)


def record_of(kind, count=10):
    """Return observations at irregular times, with gaps but for a path."""
    draw = np.random.default_rng(4)
    values = 0.5 * draw.normal(size=(count, 2))
    if kind != "path":
        values[2], values[4, 1] = np.nan, np.nan
    return zakai.Record(np.cumsum(10.0 ** draw.uniform(-2, -0.2, count)), values, kind)


def agrees(result, expected):
    """Check means, covariances and evidence to 1e-9."""
    mean, cov, evidence = expected
    np.testing.assert_allclose(result.mean[1:], mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.cov[1:], cov, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.cumsum(result.log_likelihood_increments)[1:], evidence, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["increments", "rates", "path"])
@pytest.mark.parametrize("varying", [False, True])
def test_it_agrees_with_the_moment_equations(kind, varying):
    def coefficients(t, u):
        own = N + varying * 0.1 * np.cos(3 * t) * np.eye(2)
        return L, OFFSET, g @ Q @ g.T, C, LEVEL, S, g @ own

    more = {"cross_noise": [["c + cos(3*t)/10", "1/10"], ["-1/10", "cos(3*t)/10 - 1/5"]]} if varying else {}
    record = record_of(kind)
    result = zakai.filter(correlated(kind, **more), record)
    assert result.method == "kalman-bucy" and not within_convention(result.warnings)
    driven = zakai.Record(record.times, record.values, kind, zakai.Inputs([0.0], [0.0]))
    agrees(result, moments(driven, kind, "zero", PRIOR, coefficients))


def test_fine_increments_have_the_evidence_of_their_exact_joint_law():
    """The exact filter of (x, dy), by the covariance of the augmented process, relative to noise alone."""
    model = correlated()
    errors = []
    for count in (50, 100, 200):
        step = 1.0 / count
        _, record = zakai.simulate(model, np.arange(1, 201) / 200, seed=2, substeps=5)
        values = record.values.reshape(count, -1, 2).sum(axis=1)
        A, noise = np.zeros((5, 5)), np.zeros((5, 5))
        A[:2, :2], A[:2, 4], A[2:4, :2], A[2:4, 4] = L, OFFSET, C, LEVEL
        noise[:2, :2], noise[:2, 2:4], noise[2:4, :2], noise[2:4, 2:4] = g @ Q @ g.T, g @ N, (g @ N).T, S
        whole = expm(np.block([[-A, noise], [np.zeros((5, 5)), A.T]]) * step)
        flow = whole[5:, 5:].T
        gathered = flow @ whole[:5, 5:]
        mean, cov, evidence = *PRIOR, 0.0
        for dy in values:
            both = flow[:4, :2] @ mean + flow[:4, 4]
            spread = flow[:4, :2] @ cov @ flow[:4, :2].T + gathered[:4, :4]
            gain = np.linalg.solve(spread[2:, 2:], spread[2:, :2]).T
            rest = dy - both[2:]
            evidence -= 0.5 * (rest @ np.linalg.solve(spread[2:, 2:], rest) - dy @ np.linalg.solve(S * step, dy))
            evidence -= 0.5 * (np.linalg.slogdet(spread[2:, 2:])[1] - np.linalg.slogdet(S * step)[1])
            mean, cov = both[:2] + gain @ rest, spread[:2, :2] - gain @ spread[2:, :2]
        result = zakai.filter(model, zakai.Record(step * np.arange(1, count + 1), values, "increments"))
        apart = np.abs(result.mean[-1] - mean).max(), np.abs(result.cov[-1] - cov).max()
        errors.append([abs(result.log_likelihood - evidence), *apart])
    assert np.all(errors[-1] < np.array([0.02, 0.02, 0.005]))
    assert errors[2][0] < 0.7 * errors[1][0] < 0.5 * errors[0][0]


def test_batch_online_and_chunks_give_what_a_record_gives(monkeypatch):
    model, record = correlated(), record_of("increments")
    result = zakai.filter(model, record)
    monkeypatch.setattr("zakai.engine.loop.CHUNK", 3)
    again = zakai.filter(correlated(), [record, record])[1]
    assert again.mean.tobytes() == result.mean.tobytes() and again.log_likelihood == result.log_likelihood
    online = zakai.online(model)
    means = [online.update(float(time), value).mean for time, value in zip(record.times, record.values)]
    assert np.array(means).tobytes() == result.mean[1:].tobytes()


@pytest.mark.parametrize("cross", [KEYS["cross_noise"], [["c + cos(3*t)/10", "1/10"], ["-1/10", "c*t/10 - 1/5"]]])
def test_gradients_agree_with_differences(cross):
    likelihood = zakai.log_likelihood(correlated(cross_noise=cross), record_of("increments"))
    _, gradient = likelihood.value_and_gradient([0.3])
    difference = (likelihood(np.array([0.30001])) - likelihood(np.array([0.29999]))) / 2e-5
    assert gradient[0] == pytest.approx(difference, rel=1e-8)


def test_smoothed_moments_are_the_limit_of_the_exact_law_of_fine_increments():
    """Against one large Gaussian of the states and the increments, extrapolated from two lengths of the steps."""
    record = zakai.Record([0.4, 0.9, 1.0], [[0.3, -0.2], [-0.1, 0.4], [0.2, 0.1]], "increments")
    smoothed = zakai.smooth(correlated(), record)
    assert not smoothed.warnings

    K = g @ N @ np.linalg.inv(S)
    A, G = L - K @ C, g @ Q @ g.T - K @ S @ K.T

    def dense(parts):
        # y is linear in an interval: dx = (A x + l - K c + K dy/dt) dt + noise of G, and half of the factor of a part acts before
        # it, half after it.
        average, cov = PRIOR
        places, kept, H, rest, noise = [np.arange(2)], [0], [], [], []
        for length, dy in zip(np.diff(record.times, prepend=0.0), record.values, strict=True):
            step = length / parts
            moved = expm(A * step)
            gathered = moved @ expm(np.block([[-A, G], [np.zeros((2, 2)), A.T]]) * step)[:2, 2:]
            push = np.linalg.solve(A, (moved - np.eye(2)) @ (OFFSET - K @ LEVEL + K @ dy / length))
            for _ in range(parts):
                H.append(places[-1])
                size = len(average)
                flow = np.zeros((2, size))
                flow[:, places[-1]] = moved
                average, across = np.concatenate([average, flow @ average + push]), flow @ cov
                cov = np.block([[cov, across.T], [across, flow @ cov @ flow.T + gathered]])
                places.append(np.arange(size, size + 2))
                H.append(places[-1])
                rest += [dy / length - LEVEL] * 2
                noise += [S * 2 / step] * 2
            kept.append(len(places) - 1)
        size = len(average)
        full = np.zeros((2 * len(H), size))
        for i, where in enumerate(H):
            full[2 * i : 2 * i + 2, where] = C
        R = np.zeros((2 * len(H), 2 * len(H)))
        for i, block in enumerate(noise):
            R[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
        gain = np.linalg.solve(full @ cov @ full.T + R, full @ cov).T
        after = average + gain @ (np.concatenate(rest) - full @ average)
        left = cov - gain @ full @ cov
        return np.array([np.concatenate([after[p], left[np.ix_(p, p)].ravel()]) for p in (places[k] for k in kept)])

    coarse, fine = dense(20), dense(40)
    wanted = (4 * fine - coarse) / 3
    np.testing.assert_allclose(np.column_stack([smoothed.mean, smoothed.cov.reshape(4, 4)]), wanted, rtol=0, atol=1e-6)


def test_simulated_records_are_calibrated():
    keys = {"state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_noise": [["0.25"]]}
    keys["prior"] = {"kind": "gaussian", "mean": [0], "cov": [0.5]}
    model, independent = zakai.Model(**keys, cross_noise=[["0.45"]]), zakai.Model(**keys)
    scores = []
    for seed in range(4):
        truth, record = zakai.simulate(model, 0.02 * np.arange(1, 801), seed=seed)
        results = [zakai.filter(one, record) for one in (model, independent)]
        scores.append([np.mean((truth.values - r.mean)[50:, 0] ** 2 / r.variance[50:, 0]) for r in results])
    own, other = np.mean(scores, axis=0)
    assert 0.75 < own < 1.3 and other < 0.4


def test_noise_that_is_one_and_the_same_leaves_nothing_unknown():
    """dy = x dt + dv with dx = dv and a known start: x = x0 + y - int x dt is known for ever."""
    model = zakai.Model(
        state=["x"], drift=["0"], observation=["x"], cross_noise=[["1"]], prior={"kind": "gaussian", "mean": [0.5], "cov": [[0]]}
    )
    result = zakai.filter(model, zakai.Record([0.2, 0.5], [[0.3], [-0.1]], "increments"))
    x, expected = 0.5, []
    for length, dy in ((0.2, 0.3), (0.3, -0.1)):
        x = dy / length + (x - dy / length) * np.exp(-length)
        expected.append(x)
    np.testing.assert_allclose(result.mean[1:, 0], expected, rtol=0, atol=1e-12)
    assert np.abs(result.variance).max() < 1e-14 and not result.warnings


def test_an_increment_after_a_gap_is_reported():
    record = zakai.Record([0.1, 0.2, 0.3], [[0.1, 0.2], [np.nan, 0.1], [0.3, 0.2]], "path")
    assert any("cross_noise is omitted" in warning for warning in zakai.filter(correlated("path"), record).warnings)
    assert not any("cross_noise" in warning for warning in zakai.filter(correlated("path"), record_of("path")).warnings)


@pytest.mark.parametrize("method", ["benes", "hu-yau", "limited-direct", "general-direct"])
def test_other_methods_refuse_it(method):
    record = record_of("increments")
    with pytest.raises((ConditionError, InputError), match="cross_noise is not zero"):
        zakai.filter(correlated(), record, method)


def test_the_extended_filter_converges_to_it():
    record = record_of("increments")
    exact = zakai.filter(correlated(), record, "kalman-bucy")
    errors = []
    for substeps in (8, 16):
        result = zakai.filter(correlated(), record, "extended-kalman-bucy", substeps=substeps)
        away = np.abs((result.mean - exact.mean) / np.sqrt(exact.variance)).max()
        errors.append(max(away, abs(result.log_likelihood - exact.log_likelihood)))
    assert errors[1] < 0.3 * errors[0] < 0.01
    with pytest.raises(InputError, match="euler.*cross_noise"):
        zakai.filter(correlated(), record, "extended-kalman-bucy", riccati="euler")
