"""`guided-particles` where few particles hold a mode of small weight: what it reports against the spread over seeds."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

PARTICLES = "guided-particles"


def _square() -> tuple[zakai.Model, zakai.Record]:
    """Return a position of which the square is seen: the prior gives the mode on the other side a thirtieth of the weight."""
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-0.5*v"], diffusion=[["0"], ["0.3"]], observation=["x**2"], observation_kind="samples",
        observation_noise=[["0.05"]], prior={"kind": "gaussian", "mean": [0.9, 0.0], "cov": [0.25, 0.1]},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.2 * np.arange(1, 13), seed=4, initial=[0.9, 0.2])
    return model, record


def _beacon() -> tuple[zakai.Model, zakai.Record]:
    """Return a motion in the plane of which the distance and one coordinate are seen: that across has two signs."""
    zero = "0"
    model = zakai.Model(
        state=["x", "y", "u", "w"], drift=["u", "w", "-0.2*u", "-0.2*w"],
        diffusion=[[zero, zero], [zero, zero], ["0.2", zero], [zero, "0.2"]], observation=["sqrt(x**2 + y**2)", "x"],
        observation_kind="samples", observation_noise=[["0.0025", zero], [zero, "0.0025"]],
        prior={"kind": "gaussian", "mean": [2.0, 0.6, 0.0, 0.0], "cov": [0.25, 0.1, 0.05, 0.05]},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.25 * np.arange(1, 13), seed=6, initial=[2.1, 0.8, 0.1, 0.1])
    return model, record


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", [_square, _beacon])
def test_the_reported_error_of_a_deviation_is_its_spread_over_seeds(case):
    model, record = case()
    runs = [zakai.filter(model, record, PARTICLES, seed=seed, keep="moments") for seed in range(16)]
    deviations = np.sqrt([run.variance[1:] for run in runs])
    spread = (deviations.std(axis=0, ddof=1) / deviations.mean(axis=0)).max(axis=1)
    reported = np.array([run.health["deviation_error"][1:] for run in runs])
    assert 0.7 < np.sqrt(np.mean(spread**2) / np.mean(reported**2)) < 1.4
    errors = np.std([run.mean[1:] for run in runs], axis=0, ddof=1)
    assert 0.7 < np.sqrt(np.mean(errors**2) / np.mean([run.mean_standard_error[1:] ** 2 for run in runs])) < 1.4


@pytest.mark.filterwarnings("ignore")
def test_a_mode_that_few_particles_hold_is_warned_of():
    model, record = _square()
    result = zakai.filter(model, record, PARTICLES, particles=2000, seed=4)  # with most seeds no particle meets the mode
    assert np.nanmax(result.health["deviation_error"]) > 0.2
    assert any("deviation_error" in words for words in result.warnings)
    assert np.nansum(result.health["lower_bound"]) > 0
