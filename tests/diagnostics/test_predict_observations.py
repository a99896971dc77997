"""Predicted observations against a Kalman filter in plain NumPy, sums over a grid, and the residuals of the result."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

import zakai
from zakai.errors import InputError

A, G, S = 0.7, 0.5, 0.2
WALK = {
    "state": ["x"], "drift": ["-0.7*x"], "diffusion": [["0.5**0.5"]], "observation": ["2*x"], "observation_noise": [["0.2"]],
    "prior": {"kind": "gaussian", "mean": [1.0], "cov": [[0.3]]},
}  # fmt: skip
TIMES, VALUES = np.array([0.4, 0.6, 1.5, 1.6]), np.array([1.2, np.nan, 0.1, 0.8])


def one_step_ahead(times, values):
    """The means and variances of samples before they are made, then of one at t = 3."""
    mean, variance, now, found = 1.0, 0.3, 0.0, []
    for time, value in [*zip(times, values, strict=True), (3.0, np.nan)]:
        decay = np.exp(-A * (time - now))
        mean, variance, now = decay * mean, decay**2 * variance + G * (1 - decay**2) / (2 * A), time
        found.append((2 * mean, 4 * variance + S))
        if not np.isnan(value):
            gain = 2 * variance / (4 * variance + S)
            mean, variance = mean + gain * (value - 2 * mean), (1 - 2 * gain) * variance
    return np.array(found)


@pytest.mark.parametrize("method", ["kalman-bucy", "yau-yau"])
def test_samples_are_predicted_as_by_a_kalman_filter(method):
    model = zakai.Model(**WALK, observation_kind="samples")
    result = zakai.filter(model, zakai.Record(TIMES, VALUES, "samples"), method)
    expected = one_step_ahead(TIMES, VALUES)
    for predicted, (means, variances) in (
        (result.predict_observations(), expected[:-1].T), (result.predict_observations([3.0]), expected[-1:].T)
    ):  # fmt: skip
        np.testing.assert_allclose(predicted.mean[:, 0], means, atol=2e-3)
        for q in (0.05, 0.5, 0.9):
            wanted = stats.norm.ppf(q, means, np.sqrt(variances))
            np.testing.assert_allclose(predicted.quantile(q)[:, 0], wanted, atol=3e-3)
        draws = predicted.sample(20_000, seed=4)[:, :, 0]
        np.testing.assert_allclose(draws.mean(axis=0), means, atol=6 * np.sqrt(variances.max() / 20_000))
        np.testing.assert_allclose(draws.var(axis=0), variances, rtol=0.06)
        np.testing.assert_array_equal(predicted.sample(5, seed=4), predicted.sample(5, seed=4))


@pytest.mark.parametrize("kind", ["increments", "path", "rates"])
def test_the_share_of_observations_below_a_quantile_is_its_residual(kind):
    model = zakai.Model(**WALK, observation_kind=kind)
    record = zakai.simulate(model, np.arange(0.05, 1.05, 0.05), seed=2)[1]
    result = zakai.filter(model, record, "kalman-bucy")
    predicted, shares = result.predict_observations(), result.residuals()[:, 0]
    for k in (0, 7, 19):
        np.testing.assert_allclose(predicted.quantile(shares[k])[k, 0], record.values[k, 0], atol=1e-5)
    ahead = result.predict_observations([1.1, 1.3])
    assert ahead.sample(4).shape == (4, 2, 1) and (np.diff(ahead.quantile([0.1, 0.9]), axis=0) > 0).all()


@pytest.mark.parametrize("family", ["poisson", "log-normal", "von-mises", "bernoulli"])
def test_other_families_are_predicted_as_by_sums_over_a_grid(family):
    h = {"poisson": "exp(x)", "log-normal": "x", "von-mises": "x", "bernoulli": "1/(1 + exp(-x))"}[family]
    keys = {"concentration": 3} if family == "von-mises" else {}
    keys |= {"observation_noise": [["0.4"]]} if family == "log-normal" else {}
    given = {**WALK, "observation": [h], "observation_kind": "samples", "observation_family": family, **keys}
    given.pop("observation_noise") if family != "log-normal" else None
    first = 1.0 if family != "bernoulli" else 0.0
    result = zakai.filter(zakai.Model(**given), zakai.Record([0.4], [first], "samples"), "yau-yau")
    predicted = result.predict_observations()
    decay = np.exp(-A * 0.4)
    x = np.linspace(-6, 8, 6001)
    weights = stats.norm.pdf(x, decay, np.sqrt(decay**2 * 0.3 + G * (1 - decay**2) / (2 * A)))
    weights /= weights.sum()
    laws = {
        "poisson": lambda z: stats.poisson.cdf(z, np.exp(x)), "log-normal": lambda z: stats.norm.cdf(np.log(z), x, np.sqrt(0.4)),
        "bernoulli": lambda z: np.where(z >= 1, 1.0, 1 - 1 / (1 + np.exp(-x))),
        "von-mises": lambda z: stats.vonmises.cdf(z - x, 3.0) - stats.vonmises.cdf(-np.pi - x, 3.0),
    }  # fmt: skip
    for q in (0.1, 0.5, 0.97):
        z = predicted.quantile(q)[0, 0]
        if family in ("poisson", "bernoulli"):
            assert weights @ laws[family](z) >= q and (z == 0 or weights @ laws[family](z - 1) < q)
        else:
            assert weights @ laws[family](z) == pytest.approx(q, abs=2e-3)
    draws = predicted.sample(20_000)[:, 0, 0]
    if family == "von-mises":
        assert abs(np.angle(np.mean(np.exp(1j * (draws - predicted.mean[0, 0]))))) < 0.03
    else:
        assert draws.mean() == pytest.approx(predicted.mean[0, 0], abs=5 * draws.std() / 140)


def test_blocks_and_wrong_calls():
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "sin(y)"], observation=["y", "x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [1, -2], "cov": [[1, 0], [0, 0.1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.01, 0.5], [[-2.0, 1.0], [np.nan, np.nan]], "samples"))
    mean = result.predict_observations().mean
    assert len(result.blocks) == 2 and abs(mean[0, 0] + 2) < 0.1 and abs(mean[0, 1] - 1) < 0.1
    for call in (lambda: result.predict_observations([0.3]), lambda: result.predict_observations().quantile(1.0),
                 lambda: result.predict_observations().sample(0)):  # fmt: skip
        with pytest.raises(InputError):
            call()


@pytest.mark.parametrize("gap", [0.5, 6.0, 40.0])
def test_quantiles_of_two_peaks_leave_their_share_below(gap):
    weights = np.array([0.3, 0.7])
    prior = {"kind": "mixture", "weights": weights, "means": [[-gap], [gap]], "covs": [[[0.01]], [[0.01]]]}
    model = zakai.Model(
        state=["x"], drift=["0"], diffusion=[["0.001"]], observation=["x"], observation_noise=[["0.01"]],
        observation_kind="samples", prior=prior,
    )  # fmt: skip
    predicted = zakai.filter(model, zakai.Record([0.01], [np.nan], "samples"), "particle", seed=1).predict_observations()
    draws = predicted.sample(200_000, seed=2)[:, 0, 0]
    for q in (1e-6, 0.05, 0.25, 0.35, 0.9, 1 - 1e-6):
        found = predicted.quantile(q)[0, 0]
        assert abs(np.mean(draws <= found) - q) < 5 * np.sqrt(q * (1 - q) / len(draws)) + 1e-5
