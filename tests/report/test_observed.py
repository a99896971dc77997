"""The sections of the report on joint densities and observations, and a report with dates."""

from __future__ import annotations

import re

import numpy as np
import pandas
import pytest

import zakai
from zakai.report import observed
from zakai.report.html import page
from zakai.report.plots import library


@pytest.fixture(scope="module")
def oscillator():
    model = zakai.load_model("gallery:kalman-bucy-2d")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 21), seed=0)
    dates = pandas.date_range("2024-03-01T06:00", periods=20, freq="6h")
    return zakai.filter(model, zakai.Record(dates, record.values, record.kind, unit="d", origin="2024-03-01"))


def drawn(monkeypatch):
    """Collect the figures that are put on a page."""
    figures = {}
    monkeypatch.setattr("zakai.report.plots.html", lambda figure, name: figures.update({name: figure}) or f"[{name}]")
    return figures


def test_the_joint_density_is_that_of_the_last_time(oscillator, monkeypatch):
    figures = drawn(monkeypatch)
    text = observed.joint(oscillator)
    figure = figures["joint-0-1"]
    percent = np.array(figure.data[0].z, float)
    row, column = np.unravel_index(np.argmax(percent), percent.shape)
    spread = np.sqrt(oscillator.variance[-1])
    assert abs(figure.data[0].x[column] - oscillator.mean[-1, 0]) < 0.1 * spread[0]
    assert abs(figure.data[0].y[row] - oscillator.mean[-1, 1]) < 0.1 * spread[1]
    cov = oscillator.cov[-1]
    assert f"Correlation {cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]):.3f}" in text and "2024-03-06 00:00:00" in text


def test_increments_are_drawn_over_their_time_against_h(oscillator, monkeypatch):
    figures = drawn(monkeypatch)
    observed.observations(oscillator)
    dots, line = figures["observations-figure"].data
    np.testing.assert_allclose(np.array(dots.y, float), oscillator.record.values[:, 0] / 0.25, rtol=1e-6)
    np.testing.assert_allclose(np.array(line.y, float), oscillator.mean[1:, 0], rtol=1e-6)  # h = x
    np.testing.assert_array_equal(np.array(dots.x, "datetime64[ns]"), oscillator.record.dates)


def test_gaps_and_laws_without_a_mean_are_left_out(monkeypatch):
    model = zakai.Model(
        state=["x"], drift=["-x"], observation_log_density="-(z - x)**2 - log(pi)/2", observed=["z"],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.5, 1.0, 2.0], [0.1, np.nan, 0.3], "samples"))
    figures = drawn(monkeypatch)
    assert "posterior mean" not in observed.observations(result)
    (dots,) = figures["observations-figure"].data
    np.testing.assert_array_equal(dots.x, [0.5, 2.0])


def test_a_report_with_dates_has_dates_everywhere(oscillator):
    text = page(oscillator).replace(library(), "")
    assert "2024-03-01 00:00:00 to 2024-03-06 00:00:00" in text
    assert text.count('"text":"date"') >= 4 and '"text":"time"' not in text
    assert len(re.findall("<section", text)) == 9


def test_an_angle_has_its_circular_mean_and_deviation_in_the_head():
    model = zakai.Model(
        state=["theta"], periodic=["theta"], drift=["0"], observation=["theta"], observation_kind="samples",
        observation_family="von-mises", concentration=4, prior={"kind": "density", "log_density": "cos(theta)"},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.5, 1.0], [3.0, -3.1], "samples"))
    deviation = result.density(-1).circular_deviation()[0]
    # The definition, by a sum over the circle.
    grid = np.linspace(-np.pi, np.pi, 2001)[:-1]
    resultant = np.sum(np.exp(1j * grid) * result.density(-1).pdf(grid)) * (grid[1] - grid[0])
    assert deviation == pytest.approx(np.sqrt(-2 * np.log(abs(resultant))), rel=1e-9)
    text = page(result).replace(library(), "")
    assert f"± {deviation:.3g} rad" in text and "theta at the end, circular" in text
