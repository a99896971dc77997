"""Increments over long intervals: their exact law differs from that of y linear between observations, and results say so."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.linalg import expm

import zakai

RATE = 0.5  # dx = -x/2 dt + dv, x ~ N(0, 1) at the start


def simulated(slope, noise, length, count, parts=100):
    """Increments (count,) of dy = slope x dt + dw."""
    rng, x, d = np.random.default_rng(3), 0.4, length / parts
    path = np.empty((count, parts))
    for place in np.ndindex(path.shape):
        path[place] = x
        x += -RATE * x * d + np.sqrt(d) * rng.normal()
    return slope * d * path.sum(axis=1) + np.sqrt(noise * length) * rng.normal(size=count)


def exact(slope, noise, length, values):
    """Filtered means and standard deviations: Bayes' rule for the joint normal law of the state and the increment."""
    drift, zero = np.array([[-RATE, 0.0], [slope, 0.0]]), np.zeros((2, 2))
    both = expm(length * np.block([[-drift, np.diag([1.0, noise])], [zero, drift.T]]))  # Van Loan
    move = both[2:, 2:].T
    added = move @ both[:2, 2:]
    mean, variance, found = 0.0, 1.0, []
    for z in values:
        law, cov = move @ [mean, 0.0], move @ np.diag([variance, 0.0]) @ move.T + added
        gain = cov[0, 1] / cov[1, 1]
        mean, variance = law[0] + gain * (z - law[1]), cov[0, 0] - gain * cov[0, 1]
        found.append((mean, np.sqrt(variance)))
    return np.array(found).T


@pytest.mark.parametrize(
    ("slope", "noise", "length", "warns"),
    [(2.0, 0.01, 0.1, True), (1.5, 0.05, 0.36, True), (1.0, 0.1, 0.1, False), (1.0, 1.0, 0.4, False)],
)
@pytest.mark.parametrize("method", ["kalman-bucy", "yau-yau"])
def test_the_distance_from_the_exact_law_of_increments_is_said(method, slope, noise, length, warns):
    values = simulated(slope, noise, length, 60)
    times = length * np.arange(1, 61)
    model = zakai.Model(
        state=["x"], drift=[f"-{RATE}*x"], observation=[f"{slope}*x"], observation_noise=[[str(noise)]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(times, values[:, None]), method)
    mean, deviation = exact(slope, noise, length, values)
    apart = np.abs(result.mean[1:, 0] - mean) / deviation
    said = [float(found[1]) for warning in result.warnings if (found := re.search(r"up to about (\S+) standard", warning))]
    assert (apart.max() > 0.1) == bool(said) == warns
    online = zakai.online(model, method)
    assert bool(online.update(times[0], values[:1]).warnings) == warns
    if warns:
        assert 0.25 * said[0] < apart.max() < 1.1 * said[0]


def moved(speed, growth, length, count, diffusion=0.02, noise=1e-3):
    """Increments (count,) of dx = (speed + growth x) dt + .02 dv, dy = x dt + dw, x = 0 at the start, and their exact law."""
    drift, spread = np.array([[growth, 0.0, speed], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.diag([diffusion**2, noise, 0.0])
    both = expm(length * np.block([[-drift, spread], [np.zeros((3, 3)), drift.T]]))  # Van Loan
    move = both[3:, 3:].T
    added = move @ both[:3, 3:]
    rng, x, mean, cov, nats, values, found = np.random.default_rng(7), 0.0, 0.0, 0.01, 0.0, [], []
    for _ in range(count):
        x, z = (move @ [x, 0.0, 1.0] + np.linalg.cholesky(added + 1e-18 * np.eye(3)) @ rng.normal(size=3))[:2]
        law, joint = move @ [mean, 0.0, 1.0], move @ np.diag([cov, 0.0, 0.0]) @ move.T + added
        white, gain = noise * length, joint[0, 1] / joint[1, 1]
        nats += (z**2 / white + np.log(white) - (z - law[1]) ** 2 / joint[1, 1] - np.log(joint[1, 1])) / 2.0
        mean, cov = law[0] + gain * (z - law[1]), joint[0, 0] - gain * joint[0, 1]
        values.append(z)
        found.append((mean, np.sqrt(cov)))
    return np.array(values), np.array(found).T, nats


@pytest.mark.parametrize(
    ("speed", "growth", "length", "warns"),
    [(1.0, 0.0, 0.2, True), (0.5, 0.5, 0.3, True), (1.0, 0.0, 0.05, False), (-4.0, 0.0, 0.1, True)],
)
def test_motion_within_an_interval_of_increments_is_said(speed, growth, length, warns):
    values, (mean, deviation), nats = moved(speed, growth, length, 12)
    model = zakai.Model(
        state=["x"], drift=[f"{speed} + {growth}*x"], diffusion=[["0.02"]], observation=["x"], observation_noise=[["1e-3"]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [0.0], "cov": [[0.01]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(length * np.arange(1, 13), values[:, None]), "kalman-bucy")
    lost, apart = (nats - result.log_likelihood) / 12, np.max(np.abs(result.mean[1:, 0] - mean) / deviation)
    said = [re.search(r"up to about (\S+) .* interval by about (\d[\d.]*)", warning) for warning in result.warnings]
    assert bool(said) == warns
    assert warns or max(lost, apart) < 0.1
    if warns:
        assert apart < 1.1 * float(said[0][1]) or said[0][1] == "1"
        assert 0.1 < lost < 1.3 * float(said[0][2]) or said[0][2] == "1"


def exact_evidence(slope, noise, length, values):
    """The log-likelihood of the increments by their exact law, relative to noise alone, after each of them."""
    drift, zero = np.array([[-RATE, 0.0], [slope, 0.0]]), np.zeros((2, 2))
    both = expm(length * np.block([[-drift, np.diag([1.0, noise])], [zero, drift.T]]))  # Van Loan
    move = both[2:, 2:].T
    added = move @ both[:2, 2:]
    mean, variance, nats = 0.0, 1.0, []
    for z in values:
        law, cov = move @ [mean, 0.0], move @ np.diag([variance, 0.0]) @ move.T + added
        white, gain = noise * length, cov[0, 1] / cov[1, 1]
        nats.append((z**2 / white + np.log(white) - (z - law[1]) ** 2 / cov[1, 1] - np.log(cov[1, 1])) / 2.0)
        mean, variance = law[0] + gain * (z - law[1]), cov[0, 0] - gain * cov[0, 1]
    return np.cumsum(nats)


def linear(slope, noise, **keys):
    return zakai.Model(
        state=["x"], drift=[f"-{RATE}*x"], observation=[f"{slope}*x"], observation_noise=[[f"{noise}"]],
        observation_kind="increments", prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}, **keys,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("slope", "noise", "length", "count", "warns"),
    [(1.0, 1.0, 0.3, 400, True), (1.0, 0.1, 0.05, 1000, True), (1.0, 1.0, 0.1, 200, False), (2.0, 0.01, 0.1, 60, True)],
)
def test_the_nats_that_short_intervals_lose_one_by_one_add_up(slope, noise, length, count, warns):
    values = simulated(slope, noise, length, count, parts=20)
    record = zakai.Record(length * np.arange(1, count + 1), values[:, None])
    result = zakai.filter(linear(slope, noise), record, "kalman-bucy")
    lost = exact_evidence(slope, noise, length, values) - np.cumsum(result.log_likelihood_increments[1:])
    said = result.increment_law_error
    assert said[0] == 0 and (np.diff(said) >= 0).all()
    assert np.allclose(said[1:], lost, rtol=0.25, atol=0.1)
    assert any("increment_law_error" in warning for warning in result.warnings) == warns == (lost[-1] > 2.0)


def test_a_fit_reports_the_nats_too():
    values = simulated(1.0, 1.0, 0.5, 300, parts=20)
    record = zakai.Record(0.5 * np.arange(1, 301), values[:, None])
    model = linear("a", 1.0, parameters={"a": 1.0})
    fitted = zakai.fit(model, record, method="kalman-bucy")
    assert any("increment_law_error, more than 2" in warning for warning in fitted.warnings)


def test_the_nats_of_a_cubic_sensor_are_those_of_particles():
    """Increments of x^3 every .03 to .3: the exact law by particles, in steps of a hundredth."""
    rng = np.random.default_rng(5)
    gaps = rng.uniform(0.03, 0.3, 60)

    def moved(x, length, count):
        total, d = np.zeros_like(x), length / count
        for _ in range(count):
            before = x**3
            x = x - x * d + np.sqrt(d) * rng.normal(size=x.shape)
            total += d * (before + x**3) / 2
        return x, total

    x, values = rng.normal(size=1), []
    for length in gaps:
        x, total = moved(x, length, 100)
        values.append(total[0] + np.sqrt(length) * rng.normal())
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x**3"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(np.cumsum(gaps), np.array(values)[:, None]))
    particles, nats = rng.normal(size=20_000), 0.0
    for length, z in zip(gaps, values, strict=True):
        particles, total = moved(particles, length, 10)
        logs = (z * total - total**2 / 2) / length
        weights = np.exp(logs - logs.max())
        nats += logs.max() + np.log(weights.mean())
        places = np.searchsorted(np.cumsum(weights), weights.sum() * (rng.random() + np.arange(20_000)) / 20_000)
        particles = particles[np.minimum(places, 19_999)]
    lost, said = nats - result.log_likelihood, result.increment_law_error[-1]
    assert lost > 0.3 and 0.6 * lost < said < 2.0 * lost


def test_blocks_add_their_nats_and_samples_have_none():
    values = simulated(1.0, 1.0, 0.3, 100, parts=20)
    times = 0.3 * np.arange(1, 101)
    one = zakai.filter(linear(1.0, 1.0), zakai.Record(times, values[:, None]), "kalman-bucy").increment_law_error
    two = zakai.Model(
        state=["x", "y"], drift=[f"-{RATE}*x", f"-{RATE}*y"], observation=["x", "y"], observation_kind="increments",
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    both = zakai.filter(two, zakai.Record(times, np.stack([values, values], axis=1)), "kalman-bucy")
    assert np.allclose(both.increment_law_error, 2 * one, rtol=1e-6)
    samples = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    assert zakai.filter(samples, zakai.Record([1.0], [0.3])).increment_law_error is None
