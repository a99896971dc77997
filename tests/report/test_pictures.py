"""Static pictures: what is on them, where they go, and how they are refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from report.fakes import fake_result
from zakai.errors import InputError
from zakai.report import diagnostics_figure, posterior_figure, save_figure
from zakai.report._style import DENSITY_COLOURS


def test_the_posterior_is_drawn_with_mean_band_and_truth():
    result, truth = fake_result(observations=50)
    axes = posterior_figure(result, "x", truth).axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["density / its peak", "95% band", "mean", "truth"]
    assert axes.get_xlabel() == "time" and axes.get_ylabel() == "x"


def test_an_angle_is_drawn_on_the_circle():
    result, truth = fake_result(observations=500, state=("theta",), periodic=("theta",), step=0.6)
    axes = posterior_figure(result, 0, truth, start=200, stop=400).axes[0]
    np.testing.assert_allclose(axes.get_ylim(), [-np.pi, np.pi])
    steps = np.concatenate([np.abs(np.diff(line.get_ydata())) for line in axes.lines])
    assert steps[np.isfinite(steps)].max() <= np.pi
    np.testing.assert_allclose(axes.get_xlim(), result.times[[200, 399]])


def test_the_diagnostics_have_a_panel_for_each_figure_of_health():
    result, _ = fake_result(observations=50)
    assert len(diagnostics_figure(result).axes) == 2 + len(result.health)


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_a_figure_is_written(tmp_path, ending):
    result, _ = fake_result(observations=20)
    save_figure(posterior_figure(result), tmp_path / f"x.{ending}")
    assert (tmp_path / f"x.{ending}").stat().st_size > 1000


def test_another_ending_is_refused(tmp_path):
    result, _ = fake_result(observations=20)
    with pytest.raises(InputError, match="must end in one of them"):
        save_figure(posterior_figure(result), tmp_path / "x.docx")


def test_an_unknown_state_is_refused_with_the_states_there_are():
    result, _ = fake_result(observations=20)
    with pytest.raises(InputError, match="'speed' is not in the model; its states are x"):
        posterior_figure(result, "speed")


def test_the_colours_of_the_density_fall_evenly_in_grey():
    grey = [0.299 * int(c[1:3], 16) + 0.587 * int(c[3:5], 16) + 0.114 * int(c[5:7], 16) for c in DENSITY_COLOURS]
    steps = -np.diff(grey)
    assert (steps > 8).all() and steps.max() < 4 * steps.min()


def test_pyplot_is_not_needed(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    result, _ = fake_result(observations=5)
    assert posterior_figure(result).axes


def test_a_missing_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    result, _ = fake_result(observations=5)
    with pytest.raises(InputError, match=r'pip install "zakai\[plots\]"'):
        posterior_figure(result)
