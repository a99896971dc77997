"""A sample may lie at the model's start, where no interval comes before it."""

import numpy as np
import pytest

import zakai

KEYS = {
    "state": ["x"], "drift": ["0"], "observation": ["x"], "observation_kind": "samples", "observation_noise": [["0.25"]],
}  # fmt: skip
GAUSSIAN = zakai.Model(**KEYS, prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]})
UNNORMALISED = zakai.Model(**KEYS, prior={"kind": "density", "log_density": "3 - x**2/2"})
TIMES = np.array([0.0, 0.5, 1.0])


@pytest.mark.parametrize("first", [0.7, np.nan])
@pytest.mark.parametrize("model", [GAUSSIAN, UNNORMALISED])
def test_the_evidence_is_the_readings_own_whatever_the_scale_of_the_prior(model, first):
    record = zakai.Record(TIMES, np.array([[first], [0.2], [-0.1]]), "samples")
    result = zakai.filter(model, record)
    # z_0 ~ N(0, 1 + 1/4)
    expected = 0.0 if np.isnan(first) else -0.5 * (first**2 / 1.25 + np.log(2 * np.pi * 1.25))
    assert result.log_likelihood_increments[1] == pytest.approx(expected, abs=1e-12)


def test_the_first_density_is_found_again_when_only_moments_are_kept():
    record = zakai.Record(TIMES, np.array([[0.7], [0.2], [-0.1]]), "samples")
    kept = zakai.filter(UNNORMALISED, record)
    moments = zakai.filter(UNNORMALISED, record, keep="moments")
    np.testing.assert_allclose(moments.mean, kept.mean, atol=1e-10)
    np.testing.assert_allclose(moments.cov, kept.cov, atol=1e-10)


def test_a_prior_with_a_kink_is_said_to_be_known_less_well():
    keys = {"state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_kind": "samples"}
    record = zakai.Record([0.0, 0.5], [[0.7], [0.2]], "samples")
    kinked, smooth = (
        zakai.filter(zakai.Model(**keys, prior={"kind": "density", "log_density": text}), record, "limited-direct")
        for text in ("-abs(x)", "-x**4 + x**2")
    )
    assert np.nanmax(kinked.error_estimate) > 1e-5 > 1e-8 > np.nanmax(smooth.error_estimate)
