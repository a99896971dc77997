"""What `plot` draws from Python: the right axes, the right numbers, and a clear refusal."""

from __future__ import annotations

import sys

import matplotlib
import numpy as np
import pandas
import pytest

import zakai
from zakai.densities import GaussianMixture, GridDensity, PointMasses, ProductDensity
from zakai.errors import InputError

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402
from matplotlib.dates import date2num  # noqa: E402

LINE = GaussianMixture.gaussian(np.array([1.0]), np.array([[4.0]]), ("x",), (False,))
PLANE = GaussianMixture.gaussian(np.array([1.0, -2.0]), np.array([[4.0, 1.0], [1.0, 1.0]]), ("x", "y"), (False, False))
ANGLE = GaussianMixture.gaussian(np.array([3.0]), np.array([[0.5]]), ("theta",), (True,))


@pytest.fixture(autouse=True)
def _close():
    yield
    pyplot.close("all")


def well():
    return zakai.Model(
        state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples", observation_noise=[[0.3]],
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip


@pytest.fixture(scope="module")
def result():
    truth, record = zakai.simulate(well(), 0.25 * np.arange(1, 13), seed=1)
    return zakai.filter(well(), record), truth


def labels(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def curve(axes, label):
    return next(line for line in axes.lines if line.get_label() == label)


def test_a_result_is_drawn_with_its_observations_and_the_truth(result):
    found, truth = result
    axes = found.plot("x", truth)
    assert labels(axes) == ["density / its peak", "95% band", "mean", "observations", "truth"]
    np.testing.assert_allclose(curve(axes, "mean").get_ydata(), found.mean[:, 0])
    np.testing.assert_allclose(curve(axes, "observations").get_ydata(), found.record.values[:, 0])
    band = curve(axes, "95% band").get_ydata()
    np.testing.assert_allclose(band, found.quantile(0.025)[:, 0], atol=0.05)


def test_given_axes_are_drawn_in_and_anything_else_is_refused(result):
    axes = pyplot.figure().add_subplot()
    assert result[0].plot(ax=axes) is axes and axes.get_ylabel() == "x"
    with pytest.raises(InputError, match="ax is a list; give a Matplotlib Axes"):
        result[0].plot(ax=[])
    with pytest.raises(InputError, match="state 'y' is not in the model; its states are x"):
        result[0].plot("y")


def test_a_record_with_dates_is_drawn_over_dates(result):
    dates = pandas.date_range("2024-03-01", periods=12, freq="6h")
    found = zakai.filter(well(), zakai.Record(dates, result[0].record.values, "samples", unit="d", origin="2024-02-29T18:00"))
    axes = found.plot()
    np.testing.assert_allclose(curve(axes, "observations").get_xdata(), date2num(dates.to_numpy()), rtol=0, atol=1e-9)
    assert axes.get_xlabel() == "date"


def test_a_smoothed_result_shows_what_the_filter_knew():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 21), seed=0)
    smoothed = zakai.smooth(model, record)
    np.testing.assert_allclose(curve(smoothed.plot(), "filtered mean").get_ydata(), smoothed.filtered.mean[:, 0])


def test_a_density_of_one_state_is_its_curve():
    axes = LINE.plot()
    x, y = axes.lines[0].get_data()
    np.testing.assert_allclose(y, np.exp(-0.5 * ((x - 1) / 2) ** 2) / (2 * np.sqrt(2 * np.pi)), rtol=1e-12)
    assert x[0] < 1 - 6 and x[-1] > 1 + 6 and labels(axes) == ["95% interval", "mean"]


def test_an_angle_that_is_spread_is_drawn_on_the_whole_circle():
    axes = ANGLE.plot()
    np.testing.assert_allclose(axes.get_xlim(), [-np.pi, np.pi])
    shaded = axes.collections[1].get_paths()
    assert len(shaded) == 2  # the interval goes through pi
    assert ANGLE.circular_deviation()[0] == pytest.approx(np.sqrt(0.5), rel=1e-12)


def test_the_regions_of_two_states_hold_their_probability():
    axes = PLANE.plot()
    levels = next(one for one in axes.collections if hasattr(one, "levels")).levels
    peak = 1 / (2 * np.pi * np.sqrt(3.0))
    np.testing.assert_allclose(levels, [peak * 0.05, peak * 0.5], rtol=0.03)  # of a Gaussian: 1 - level / peak
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x", "y")


def test_of_many_states_two_are_named():
    third = GaussianMixture.gaussian(np.zeros(1), np.eye(1), ("z",), (False,))
    space = ProductDensity((PLANE, third), ((0, 1), (2,)), ("x", "y", "z"), (False,) * 3)
    with pytest.raises(InputError, match="3 states; name one or two of x, y, z"):
        space.plot()
    assert space.plot(["z", "x"]).get_xlabel() == "z"
    assert space.plot("y").get_xlabel() == "y"


def test_points_are_drawn_smoothed():
    points = PointMasses(np.full(200, 1 / 200), np.random.default_rng(0).standard_normal((200, 1)), ("x",), (False,))
    x, y = points.plot().lines[0].get_data()
    assert np.trapezoid(y, x) == pytest.approx(1.0, abs=5e-3)


def test_pdf_is_the_exponential_of_the_log_density():
    grid = GridDensity(-0.5 * np.linspace(-6, 6, 49) ** 2, np.zeros(1), np.array([[0.25]]), ("x",), (False,))
    for density in (LINE, grid):
        x = np.array([0.3, 1.7])
        mean, variance = density.mean()[0], density.cov()[0, 0]
        expected = np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
        np.testing.assert_allclose(density.pdf(x), expected, rtol=1e-6)


def test_a_fit_is_drawn_as_the_gaussian_of_its_estimates():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    _, record = zakai.simulate(model, 0.05 * np.arange(1, 201), seed=1)
    fitted = zakai.fit(model, record, ["a"])
    axes = fitted.plot()
    x, y = axes.lines[0].get_data()
    assert x[np.argmax(y)] == pytest.approx(fitted.estimates["a"], abs=0.02 * fitted.standard_errors["a"])
    assert y.max() == pytest.approx(1 / (np.sqrt(2 * np.pi) * fitted.standard_errors["a"]), rel=1e-3)
    with pytest.raises(InputError, match="'b' is not among the parameters"):
        fitted.plot("b")


def test_the_structure_of_a_model_is_drawn():
    model = zakai.Model(state=["x", "y"], drift=["-x", "x*y"], observation=["sin(y)"])
    axes = zakai.analyze(model).plot()
    np.testing.assert_array_equal(axes.images[0].get_array(), [[1, 0], [2, 2], [0, 2]])
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["dx/dt", "dy/dt", "h"]


def test_quantiles_and_circular_deviations_over_time(result):
    found = result[0]
    low, high = found.quantile([0.1, 0.9])
    np.testing.assert_array_equal(low[5], found.density(5).quantile([0.1])[0])
    assert found.quantile(0.5).shape == low.shape == (13, 1) and (low < high).all()
    assert np.isnan(found.circular_deviation()).all()


@pytest.mark.parametrize("draw", [LINE.plot, lambda: zakai.analyze(zakai.load_model("gallery:benes")).plot()])
def test_a_missing_library_names_the_extra(monkeypatch, draw):
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    with pytest.raises(InputError, match=r'matplotlib is not installed; .* pip install "zakai\[plots\]"'):
        draw()
