"""The sections of the report on joint densities and observations, and a report with dates."""

from __future__ import annotations

import re

import numpy as np
import pandas
import pytest

import zakai
from report.frames import on_page, series, without_scripts
from zakai.report import observed
from zakai.report.html import page


@pytest.fixture(scope="module")
def oscillator():
    model = zakai.load_model("gallery:kalman-bucy-2d")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 21), seed=0)
    dates = pandas.date_range("2024-03-01T06:00", periods=20, freq="6h")
    return zakai.filter(model, zakai.Record(dates, record.values, record.kind, unit="d", origin="2024-03-01"))


def test_the_joint_density_has_its_peak_at_the_mean_at_every_moment(oscillator):
    text = observed.joint(oscillator, None)
    header, arrays = on_page(text)["joint-0-1"]
    cov = oscillator.cov[-1]
    assert f"correlation is {cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]):.3f}" in text and "2024-03-06 00:00:00" in text
    assert len(arrays["times"]) > 3 and header["names"] == list(oscillator.state)
    for t, k in enumerate(arrays["index"].astype(int)):
        row, column = np.unravel_index(np.argmax(arrays["values"][t]), arrays["values"][t].shape)
        peak = arrays["origin"][t] + arrays["basis"][t] @ [column, row]
        assert (np.abs(peak - oscillator.mean[k]) < 0.1 * np.sqrt(oscillator.variance[k])).all()


def test_increments_are_drawn_over_their_time_against_h(oscillator):
    header, arrays = on_page(observed.observations(oscillator))["observations-figure"]
    dots, line = series((header, arrays))
    np.testing.assert_allclose(dots["y"], oscillator.record.values[:, 0] / 0.25, rtol=1e-6)
    np.testing.assert_allclose(line["y"], oscillator.mean[1:, 0], rtol=1e-6)  # h = x
    clock = header["panels"][0]["x"]["clock"]
    dates = np.rint(clock["origin"] + dots["x"] * clock["unit"]).astype(np.int64).astype("datetime64[ms]")
    np.testing.assert_array_equal(dates, oscillator.record.dates)


def test_gaps_and_laws_without_a_mean_are_left_out():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation_log_density="-(z - x)**2 - log(pi)/2", observed=["z"],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.5, 1.0, 2.0], [0.1, np.nan, 0.3], "samples"))
    text = observed.observations(result)
    assert "posterior mean" not in text
    (dots,) = series(on_page(text)["observations-figure"])
    np.testing.assert_array_equal(dots["x"], [0.5, 2.0])


def test_a_report_with_dates_has_dates_everywhere(oscillator):
    text = page(oscillator)
    assert "2024-03-01 00:00:00 to 2024-03-06 00:00:00" in text
    assert len(re.findall("<section", text)) == 9
    frames = on_page(text)
    over_time = [header for name, (header, _) in frames.items() if not name.startswith("joint")]
    clocks = [header["clock"] for header in over_time if header["kind"] == "density"]
    clocks += [p["x"]["clock"] for header in over_time for p in header.get("panels", ()) if p["x"]["title"] == "time"]
    assert len(clocks) >= 6 and all(clock["unit"] == 86400e3 for clock in clocks)


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
    text = without_scripts(page(result))
    assert f"± {deviation:.3g} rad" in text and "theta at the end, circular" in text
