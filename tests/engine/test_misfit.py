"""Observations that no state of the model explains are reported, whatever the method, and ordinary outliers are not."""

from __future__ import annotations

import re

import numpy as np
import pytest

import zakai

PRIOR = {"kind": "gaussian", "mean": [0.3], "cov": [[0.4]]}
GAUSSIAN = {"observation": ["x"], "observation_noise": [["0.1"]]}
VALUES = [0.1, 0.3, 0.2]


def warned(method, value, kind="samples", values=VALUES, law=GAUSSIAN, **keys):
    """Return what a record warns of the observation at t = 0.2; an online filter must do the same."""
    model = zakai.Model(state=["x"], drift=["0"], observation_kind=kind, prior=PRIOR, **law, **keys)
    times, values = [0.1, 0.2, 0.3], [values[0], value, values[2]]
    result = zakai.filter(model, zakai.Record(times, [[z] for z in values], kind), method)
    found = [warning for warning in result.warnings if "cannot be explained" in warning]
    online = zakai.online(model, method)
    said = ["cannot be explained" in str(online.update(time, [z]).warnings) for time, z in zip(times, values, strict=True)]
    assert said[:2] == [False, bool(found)]
    return found


@pytest.mark.parametrize("method", ["yau-yau", "limited-direct", "general-direct"])
def test_a_sample_beyond_every_value_of_h_warns_on_a_circle(method):
    sine = {**GAUSSIAN, "observation": ["sin(x)"], "periodic": ["x"]}
    (warning,) = warned(method, 45.0, law=sine)
    assert "at t = 0.2 (1.4e+02 standard deviations)" in warning  # 44 / sqrt(0.1)
    assert not warned(method, 2.5, law=sine)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_fill_value_of_a_linear_system_warns_and_ten_deviations_do_not(kind):
    assert warned("kalman-bucy", 9.97e36, kind)
    assert not warned("kalman-bucy", 7.0 if kind == "samples" else 1.0, kind)


# Values that each law makes, one that is an outlier, and one with a probability below e^-200.
LAWS = {
    "counts": ({"observation": ["exp(x)"], "observation_family": "poisson"}, [1, 2, 1], 40, 1e6),
    "student-t": ({**GAUSSIAN, "observation_family": "student-t", "degrees_of_freedom": 5}, VALUES, 1e4, 9.97e36),
    "noise of the state": ({"observation": ["x"], "observation_noise": [["0.1 + 0.1*sin(x)**2"]]}, VALUES, 4.0, 60.0),
    "log density": (
        {"observed": ["z"], "observation_log_density": "-abs(z - x - 7)/0.01 - log(0.02)"}, [7.1, 7.3, 7.2], 8.0, 20.0
    ),
    "two peaks": (
        {"observed": ["z"], "observation_log_density": "log(cosh(30*z*x)) - 5*z**2 - 45*x**2"}, VALUES, 4.0, 60.0
    ),
}  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_every_law_of_a_sample_is_judged_by_its_probability(law):
    keys, values, outlier, impossible = LAWS[law]
    assert not warned("yau-yau", outlier, values=values, law=keys)
    assert warned("yau-yau", impossible, values=values, law=keys)


def test_a_fill_value_that_a_grid_rejects_is_in_the_evidence():
    model = zakai.Model(
        state=["x", "y"], drift=["y - x", "-y - y**3"], observation=["x"], observation_kind="samples",
        observation_noise=[["1/10 + x**2"]], prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [1.0, 1.0]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.2, 0.4, 0.6], [0.2, 1e8, 0.1], "samples"), "yau-yau")
    # No state within 60 deviations explains the value: |z - h| > 9e7, S < 4000.
    assert result.log_likelihood < -(9e7**2) / 2 / 4000
    assert any("cannot be explained" in warning for warning in result.warnings)


def test_a_fill_value_beyond_the_reach_of_a_grid_of_one_state_leaves_the_prediction():
    model = zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples", observation_noise=[["1/10 + x**2"]],
        prior={"kind": "gaussian", "mean": [0.0], "cov": [1.0]},
    )  # fmt: skip
    records = [zakai.Record([0.2, 0.4, 0.6], [0.2, value, 0.1], "samples") for value in (1e8, float("nan"))]
    filled, missing = zakai.filter(model, records, "yau-yau")
    assert filled.mean == pytest.approx(missing.mean, abs=1e-6)
    assert any("cannot be explained" in warning for warning in filled.warnings)


# The first three have no finite mass over z; the last two have, one with the tails of Cauchy's law and one with a support.
@pytest.mark.parametrize("law", ["z*x", "z + x**4", "-log(1 + abs(z - x))/2", "-log(1 + (z - x)**2) - log(pi)",
                                 "log(heaviside(1 - z**2)) - log(2)"])  # fmt: skip
def test_a_log_density_without_finite_mass_over_the_observation_is_named(law):
    model = zakai.Model(
        state=["x"], drift=["-x/2"], observation_log_density=law, observed=["z"], observation_kind="samples", prior=PRIOR
    )
    result = zakai.filter(model, zakai.Record([0.5, 1.0], [[0.3], [0.4]], "samples"))
    infinite = "log(1 + (z" not in law and "heaviside" not in law
    assert any("no finite mass over 'z'" in warning for warning in result.warnings) == infinite
    assert not any("cannot be explained" in warning for warning in result.warnings)
    online = zakai.online(model)
    assert any("no finite mass over 'z'" in warning for warning in online.update(0.5, [0.3]).warnings) == infinite


def test_what_an_unexplained_observation_causes_is_a_part_of_its_sentence():
    """A fill value takes a grid of two states beyond its tolerance from there on; what was before it keeps its own warning."""
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x + sin(x)"], diffusion=[["0.1", 0], [0, "0.5"]], observation=["x"],
        observation_kind="samples", observation_noise=[["0.1"]],
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.5]},
    )  # fmt: skip
    times = 0.2 * np.arange(1, 11)
    values = np.where(np.arange(10) == 5, -999.0, 0.1)
    (warning,) = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau").warnings
    assert "cannot be explained by the model, " in warning and "a fill value must be nan, in a file NA" in warning
    clause = r"from t = 1.2 on (the density was lost|estimates may be wrong).*tolerance_ratio exceeds 1 at \d times"
    assert re.search(clause, warning)


def test_a_smoother_says_it_too():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[["0.01"]],
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.2, 0.3], [0.1, -999.0, 0.1], "samples")
    smoothed = zakai.smooth(model, record)
    assert any("cannot be explained by the model" in one for one in smoothed.warnings)
    assert sum("cannot be explained" in one for one in smoothed.warnings) == 1
