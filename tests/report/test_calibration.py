"""The tests of the calibration section against what their names say, on residuals with a known defect."""

import re

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm

import zakai
from zakai.report.calibration import calibration_of


def _correlated(rng):
    z = np.zeros(150)
    for k in range(1, 150):
        z[k] = 0.5 * z[k - 1] + np.sqrt(0.75) * rng.normal()
    return z


DEFECTS = {
    "none": (lambda rng: rng.normal(size=150), ""),
    "noise too small": (lambda rng: 1.35 * rng.normal(size=150), "noise is too small"),
    "noise too large": (lambda rng: 0.75 * rng.normal(size=150), "noise is too large"),
    "bias": (lambda rng: 0.5 + rng.normal(size=150), "bias"),
    "dynamics": (_correlated, "dynamics are wrong"),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_each_defect_is_named_in_nearly_all_of_100_records(name):
    make, words = DEFECTS[name]
    tables = [calibration_of(np.arange(150.0), norm.cdf(make(np.random.default_rng(seed)))).table() for seed in range(100)]
    if not words:
        agree = [table.count("consistent with the model") for table in tables]
        assert sum(count == 3 for count in agree) >= 80
        assert sum(count + table.count("weak evidence") == 3 for count, table in zip(agree, tables, strict=True)) >= 92
    else:
        assert sum(words in table for table in tables) >= 92


@pytest.mark.parametrize("after", [0, 2])
def test_one_outlier_is_no_verdict_on_the_model(after):
    """It may draw the next residuals with it."""
    z = np.random.default_rng(0).normal(size=90)
    z[40] = 30.0
    z[41 : 41 + after] = -5.5
    verdicts = calibration_of(np.arange(90.0), norm.cdf(z)).verdicts()
    said = [said for _, _, said, _ in verdicts]
    expected = "one outlier" if not after else "3 outliers"
    assert f"{expected} beyond 4 deviations; the others are consistent with the model" in said
    assert not any("noise" in one or "dynamics" in one for one in said)


def test_p_values_are_those_of_the_definitions():
    rng = np.random.default_rng(5)
    u = rng.uniform(size=60)
    u[[3, 17, 18]] = np.nan
    seen = u[~np.isnan(u)]
    found = calibration_of(np.arange(60.0), u)
    z = norm.ppf(seen)
    assert found.uniformity == pytest.approx(kstest(seen, "uniform").pvalue, abs=0.02)  # by an approximation
    assert found.variance == pytest.approx(2 * min(chi2(57).cdf(np.sum(z**2)), chi2(57).sf(np.sum(z**2))))
    assert len(found.times) == 57 and 0 < found.independence < 1


@pytest.mark.parametrize("noise, words", [(0.2, "consistent with the model"), (0.1, "model's noise is too small")])
def test_a_report_shows_the_tests_of_a_double_well_with_weak_observations(tmp_path, noise, words):
    def model(s):
        return zakai.Model(
            state=["x"], drift=["x - x**3"], observation=["x"], observation_noise=[[s]], observation_kind="samples",
            prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
        )  # fmt: skip

    _, record = zakai.simulate(model(0.2), np.arange(1, 201) / 10, seed=1)
    zakai.filter(model(noise), record).report(tmp_path / "page.html")
    section = re.search(r'<section id="calibration">.*?</section>', (tmp_path / "page.html").read_text(), re.DOTALL)[0]
    assert words in section and section.count("<tr>") == 4
    assert ("model's noise is too small" in section) == (noise == 0.1)
