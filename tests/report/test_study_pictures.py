"""The pictures of a study show its numbers, and its page needs nothing else."""

from __future__ import annotations

import json

import numpy as np
import pytest

from report.frames import on_page, series, without_scripts
from zakai.report.comparisons import error_curves, log_range, nees_curves, works
from zakai.report.study_page import page, write_study
from zakai.report.study_pictures import error_figure, nees_figure, work_figure
from zakai.studies.study import run_study

STUDY = """
name = "Two <filters> & a $walk$"
models = ["gallery:kalman-bucy-1d"]
reference = "exact"
batch = 2
[seeds]
count = 12
[times]
until = 0.5
step = 0.05
[methods.exact]
method = "kalman-bucy"
[methods."Euler's <step>"]
method = "extended-kalman-bucy"
options = { riccati = "euler" }
"""


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "study.toml").write_text(STUDY)
    return run_study(folder / "study.toml", folder / "out")


def test_the_curves_are_those_of_the_runs(outcome):
    data = outcome.points[0]
    exact, euler = error_curves(data)
    errors = np.sqrt(data["squared_error_at"].sel(filter="exact").values)
    assert exact.middle == pytest.approx([np.sqrt(np.median(column**2)) for column in errors.T])
    assert (exact.label, euler.label) == ("exact", "Euler's <step>") and (exact.high >= exact.middle).all()
    curves, (low, high) = nees_curves(data)
    assert curves[0].middle == pytest.approx(data["nees_at"].sel(filter="exact").values.mean(axis=0))
    assert (12 * low, 12 * high) == pytest.approx((4.40379, 23.33666), abs=1e-4)  # the table's, of 12 degrees


def test_a_failed_run_is_in_no_curve(outcome):
    data = outcome.points[0].copy(deep=True)
    data["squared_error_at"][0, 0] = 1e9
    data["failed"][0, 0] = 3
    assert error_curves(data)[0].high.max() < 1e3


def test_every_method_is_in_the_picture_of_cost(outcome):
    found = works(outcome.summary["points"][0], outcome.timing["points"][0])
    assert [one.label for one in found] == ["exact", "Euler's <step>"]
    assert np.isnan(found[0].distance) and found[1].distance > 0
    assert found[0].error == pytest.approx(np.sqrt(outcome.points[0]["squared_error"].sel(filter="exact").mean()))
    figure = work_figure(outcome)
    assert len(figure.axes) == 2 and "µs" in figure.axes[0].get_xlabel()


def test_an_axis_of_nearly_equal_numbers_is_no_magnifying_glass():
    low, high = log_range([2.0, 2.001])
    assert high / low == pytest.approx(5.0) and low < 2.0 < high
    assert log_range([1.0, 1000.0]) == pytest.approx((1 / 1.4, 1400.0))


def test_static_pictures_have_units_and_a_line_for_every_method(outcome):
    for draw, unit in ((error_figure, "unit of the state"), (nees_figure, "no unit")):
        axes = draw(outcome).axes[0]
        assert unit in axes.get_ylabel() and "time" in axes.get_xlabel()
        labelled = [line for line in axes.get_lines() if not line.get_label().startswith("_")]
        assert len(labelled) == 2
        assert len({line.get_linestyle() for line in labelled}) == 2  # told apart without colours


def test_the_page_is_whole_escaped_and_fetches_nothing(outcome):
    text = page(outcome)
    rest = without_scripts(text)
    assert "Two &lt;filters&gt; &amp; a $walk$" in rest and "<filters>" not in rest
    assert "Euler&#x27;s &lt;step&gt;" in rest
    names = {one["text"] for one in series(on_page(text)["error-over-time-0"]) if "below" not in one["text"]}
    assert names == {entry.label for entry in outcome.study.methods}
    assert "src=" not in rest and "href=" not in rest and "default-src 'none'" in rest
    written = write_study(outcome)
    assert [path.name for path in written] == ["error-over-time.png", "nees.png", "work-precision.png", "study.html"]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in written[:3])
    assert written[3].read_text() == text
    figures = json.loads((outcome.folder / "summary.json").read_text())
    assert f"{figures['points'][0]['methods']['exact']['squared_error']['worst']:.4g}" in rest
