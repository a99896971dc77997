"""The density over time: mass, quantiles, the circle, and what is drawn when no densities were kept."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from report.fakes import fake_result
from zakai.densities._values import wrap
from zakai.errors import InputError
from zakai.report.heatmap import chosen_times, circle_line, density_over_time, true_states


def test_a_column_keeps_its_mass_even_where_the_density_is_narrower_than_a_cell():
    result, truth = fake_result(observations=400, step=30.0)
    picture = density_over_time(result, 0, truth)
    mass = (picture.density * np.diff(picture.edges)[:, None]).sum(axis=0)
    assert np.diff(picture.edges)[0] > 2 * np.sqrt(result.variance[1:].min())
    np.testing.assert_allclose(mass[1:], 1.0, atol=1e-6)


def test_the_band_of_a_gaussian_is_its_quantiles():
    result, _ = fake_result(observations=20)
    picture = density_over_time(result)
    expected = 1.959963984540054 * np.sqrt(result.variance[:, 0])
    np.testing.assert_allclose(picture.upper - picture.mean, expected, rtol=2e-4)
    np.testing.assert_allclose(picture.mean - picture.lower, expected, rtol=2e-4)


def test_the_band_agrees_with_the_quantiles_of_the_density_itself_when_it_has_two_peaks():
    result, _ = fake_result(observations=5, peaks=True)
    picture = density_over_time(result)
    expected = np.array([result.density(k).quantile([0.025, 0.975])[:, 0] for k in range(6)])
    tolerance = 1e-3 * np.sqrt(result.variance[:, :1])
    assert (np.abs(np.column_stack([picture.lower, picture.upper]) - expected) < tolerance).all()


def test_on_the_circle_the_mass_is_one_and_everything_lies_between_minus_pi_and_pi():
    result, truth = fake_result(state=("theta",), periodic=("theta",), step=0.5)
    picture = density_over_time(result, 0, truth)
    mass = (picture.density * np.diff(picture.edges)[:, None]).sum(axis=0)
    np.testing.assert_allclose(mass, 1.0, atol=1e-6)
    for line in (picture.mean, picture.lower, picture.upper, picture.truth):
        assert (np.abs(line) <= np.pi).all()
    assert (picture.lower > picture.upper).any(), "no band wraps: the test does not test the wrap"


def test_a_line_on_the_circle_is_cut_at_the_edge_and_comes_back_at_the_other():
    times, angle = circle_line(np.array([0.0, 1.0, 2.0]), np.array([3.0, -3.0, -2.5]))
    moment = (np.pi - 3.0) / (2 * np.pi - 6.0)
    np.testing.assert_allclose(times, [0.0, moment, moment, moment, 1.0, 2.0])
    np.testing.assert_allclose(angle, [3.0, np.pi, np.nan, -np.pi, -3.0, -2.5])


def test_no_segment_of_a_drawn_line_goes_across_the_circle():
    result, _ = fake_result(observations=2000, state=("theta",), periodic=("theta",), step=0.7)
    times, angle = circle_line(result.times, result.mean[:, 0])
    assert (np.abs(np.diff(result.mean[:, 0])) > np.pi).any()
    steps = np.abs(np.diff(angle))
    assert steps[np.isfinite(steps)].max() <= np.pi
    assert (np.diff(times) >= 0).all()


def test_an_angle_is_not_joined_across_times_that_are_left_out():
    result, _ = fake_result(observations=2000, state=("theta",), periodic=("theta",), step=0.5)
    assert not density_over_time(result, 0, None, columns=600).joined
    assert density_over_time(result, 0, None, start=1800).joined
    line, _ = fake_result(observations=2000)
    assert density_over_time(line, 0, None, columns=600).joined


def test_wrapping_gives_pi_and_never_minus_pi():
    np.testing.assert_allclose(wrap(np.array([np.pi, -np.pi, 3 * np.pi, 0.0])), [np.pi, np.pi, np.pi, 0.0])


def test_without_densities_the_band_is_gaussian_and_no_density_is_asked_for():
    result, _ = fake_result(densities=False)
    picture = density_over_time(result)
    assert not picture.kept
    assert set(np.unique(picture.density)) == {0.0, 1.0}
    np.testing.assert_allclose(picture.upper, result.mean[:, 0] + 1.959963984540054 * np.sqrt(result.variance[:, 0]))


def test_two_states_are_drawn_by_their_marginals():
    result, _ = fake_result(observations=10, state=("theta", "rate"), periodic=("theta",))
    angle, rate = density_over_time(result, 0), density_over_time(result, 1)
    assert angle.periodic and not rate.periodic
    np.testing.assert_allclose(rate.mean, result.mean[:, 1])
    middle = rate.density[:, 5] @ (rate.grid * np.diff(rate.edges))
    np.testing.assert_allclose(middle, result.mean[5, 1], atol=1e-2)


def test_a_long_record_gives_evenly_spaced_columns_with_its_ends():
    index = chosen_times(9001, columns=600)
    assert len(index) <= 600 and index[0] == 0 and index[-1] == 9000 and np.diff(index).max() <= 16


def test_a_state_that_is_known_exactly_is_drawn_without_asking_for_its_density():
    result, _ = fake_result(observations=5)
    result.variance[0] = 0.0
    result.density = lambda k: pytest.fail("a point mass has no density")
    assert np.isfinite(density_over_time(result, stop=1).density).all()


def test_a_truth_of_the_wrong_shape_is_refused_with_the_shape_expected():
    result, truth = fake_result(observations=30)
    with pytest.raises(InputError, match=r"truth has shape \(7, 1\); expected \(31, 1\)"):
        true_states(truth[:7], result)


def test_a_truth_with_times_of_its_own_is_matched_by_time():
    result, truth = fake_result(observations=30)
    other = SimpleNamespace(times=result.times[3:20], values=truth[3:20])
    matched = true_states(other, result)
    np.testing.assert_array_equal(matched[3:20], truth[3:20])
    assert np.isnan(matched[:3]).all() and np.isnan(matched[20:]).all()


def test_an_empty_range_is_refused():
    result, _ = fake_result(observations=5)
    with pytest.raises(InputError, match="no time of the result lies there"):
        density_over_time(result, start=50)
