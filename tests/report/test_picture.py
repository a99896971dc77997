"""Frames of pictures: columns that hold the mass, quantiles, the window that is seen, and joint densities."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import zakai
from report.fakes import fake_result
from report.frames import read
from zakai.densities import GaussianMixture
from zakai.densities.conditional import ConditionalParticleDensity
from zakai.densities.grid import GridDensity
from zakai.densities.interval import IntervalDensity
from zakai.densities.mapped import IntervalMap, MappedDensity
from zakai.densities.particles import ParticleDensity
from zakai.errors import InputError
from zakai.report.picture import picture_bytes
from zakai.report.plane import plane_bytes


def masses(arrays):
    """The integral of each column over its window."""
    rows = arrays["cells"].shape[1]
    return (arrays["cells"] / 65535 * arrays["peak"][:, None]).sum(axis=1) * (arrays["high"] - arrays["low"]) / rows


def below(arrays, column, value):
    """The probability below a value, by the cells of a column."""
    edges = np.linspace(arrays["low"][column], arrays["high"][column], arrays["cells"].shape[1] + 1)
    total = np.concatenate([[0.0], np.cumsum(arrays["cells"][column], dtype=float)])
    return np.interp(value, edges, total / total[-1])


class One:
    """A result of one time whose density is given."""

    def __init__(self, density):
        names = density.names
        self.model = SimpleNamespace(state=names, periodic=tuple(n for n, p in zip(names, density.periodic, strict=True) if p))
        self.times, self.state, self.record, self.has_densities = np.zeros(1), names, None, True
        self.mean, self.variance, self.density = density.mean()[None], np.diag(density.cov())[None], lambda k: density


def drawn(density, **options):
    return read(picture_bytes(One(density), **options))


@pytest.fixture(scope="module", params=["gallery:cubic-sensor", "gallery:kalman-bucy-2d"])
def result(request):
    model = zakai.load_model(request.param)
    _, record = zakai.simulate(model, 0.02 * np.arange(1, 31), seed=0)
    return zakai.filter(model, record)


def test_every_column_integrates_to_one_and_has_the_values_of_its_density(result):
    _, arrays = read(picture_bytes(result))
    np.testing.assert_allclose(masses(arrays), 1.0, rtol=2e-4)
    rows = arrays["cells"].shape[1]
    for k in (0, 7, 30):
        middles = arrays["low"][k] + (arrays["high"][k] - arrays["low"][k]) * (np.arange(rows) + 0.5) / rows
        expected = result.density(k).marginal(0).pdf(middles[:, None]).ravel()
        np.testing.assert_allclose(arrays["cells"][k] / 65535 * arrays["peak"][k], expected, atol=2e-3 * expected.max())


def test_the_band_is_the_quantiles_of_the_density():
    fake, _ = fake_result(observations=40, peaks=True)
    _, arrays = read(picture_bytes(fake))
    expected = np.array([fake.density(k).quantile([0.025, 0.975])[:, 0] for k in range(41)]).T
    assert (np.abs(arrays["quantiles"] - expected) < 2e-3 * np.sqrt(fake.variance[:, 0])).all()


def test_narrow_peaks_far_apart_keep_their_mass_and_their_places():
    apart = GaussianMixture(np.array([0.3, 0.7]), np.array([[-4.0], [6.0]]), np.array([[[1e-6]], [[4e-6]]]), ("x",), (False,))
    _, arrays = drawn(apart)
    np.testing.assert_allclose(masses(arrays), 1.0, rtol=1e-4)
    assert below(arrays, 0, 0.0) == pytest.approx(0.3, abs=1e-4)
    assert arrays["quantiles"][:, 0] == pytest.approx([-4.0, 6.0], abs=0.1)


def test_a_narrow_density_far_from_zero_is_resolved():
    _, arrays = drawn(GaussianMixture.gaussian([1e6], [[1e-8]], ("x",), (False,)))
    expected = norm(1e6, 1e-4)
    assert arrays["quantiles"][:, 0] - 1e6 == pytest.approx([-1.96e-4, 1.96e-4], rel=1e-3)
    assert arrays["peak"][0] == pytest.approx(expected.pdf(1e6), rel=1e-3)


@pytest.mark.parametrize("size", [63, 64])
@pytest.mark.parametrize("width", [0.12, 2.0])
def test_a_density_on_the_circle_is_whole_where_it_passes_pi(size, width):
    grid = 2 * np.pi * (np.arange(size) - size // 2) / size
    logs = np.cos(grid - 3.0) / width**2
    density = GridDensity(logs, np.zeros(1), np.array([[2 * np.pi / size]]), ("x",), (True,))
    header, arrays = drawn(density)
    assert header["periodic"] and header["range"] == pytest.approx([-np.pi, np.pi])
    np.testing.assert_allclose(masses(arrays), 1.0, rtol=1e-4)
    assert arrays["peak"][0] == pytest.approx(density.pdf(np.array([[3.0]]))[0], rel=2e-3)
    low, high = arrays["quantiles"][:, 0]
    inside = np.linspace(0, np.mod(high - low, 2 * np.pi), 4001)
    assert np.trapezoid(density.pdf((low + inside)[:, None]), inside) == pytest.approx(0.95, abs=2e-3)


@pytest.mark.parametrize("ends", [IntervalMap(0.0, np.inf), IntervalMap(-np.inf, 0.0), IntervalMap(0.0, 1.0)])
def test_a_density_between_ends_has_its_quantiles(ends):
    points = np.arange(-60, 61)
    line = GridDensity(-0.5 * (0.2 * points / 0.5) ** 2, np.array([0.3]), np.array([[0.2]]), ("x",), (False,))
    _, arrays = drawn(MappedDensity(line, ends))
    assert arrays["quantiles"][:, 0] == pytest.approx(ends.x(norm.ppf([0.025, 0.975], 0.3, 0.5)), rel=5e-3)
    np.testing.assert_allclose(masses(arrays), 1.0, rtol=2e-4)


def test_a_density_that_ends_with_a_jump_has_its_probabilities():
    order = 9
    inner = np.polynomial.legendre.Legendre.basis(order - 1).deriv().roots()
    nodes = np.concatenate([[-1.0], inner, [1.0]])  # of Gauss and Lobatto
    rule = 2 / (order * (order - 1) * np.polynomial.legendre.Legendre.basis(order - 1)(nodes) ** 2)
    _, arrays = drawn(IntervalDensity(1.5 + nodes, nodes, rule, ("x",)))  # p(x) = (1.5 + x) / 3
    assert below(arrays, 0, 0.0) == pytest.approx(1 / 3, abs=2e-3)
    assert (arrays["low"][0], arrays["high"][0]) == (-1.0, 1.0)


def test_particles_are_drawn_by_their_kernels():
    random = np.random.default_rng(0)
    particles = ParticleDensity(np.full(4000, 1 / 4000), random.normal(2.0, 0.5, (4000, 1)), ("x",), (False,))
    _, arrays = drawn(particles)
    points = np.linspace(1, 3, 9)
    expected = [np.sum(particles.weights * (particles.points[:, 0] < value)) for value in points]
    np.testing.assert_allclose([below(arrays, 0, value) for value in points], expected, atol=0.02)
    rows = arrays["cells"].shape[1]
    middles = arrays["low"][0] + (arrays["high"][0] - arrays["low"][0]) * (np.arange(rows) + 0.5) / rows
    np.testing.assert_allclose(arrays["cells"][0] / 65535 * arrays["peak"][0], particles.pdf(middles[:, None]), atol=2e-3)


def test_particles_with_gaussians_are_wider_than_their_means():
    random = np.random.default_rng(1)
    points = random.normal(0.0, 0.1, (2000, 1))
    density = ConditionalParticleDensity(np.full(2000, 1 / 2000), points, ("x",), (False,), (0,), np.full((2000, 1, 1), 4.0))
    _, arrays = drawn(density)
    assert arrays["quantiles"][:, 0] == pytest.approx(
        norm.ppf([0.025, 0.975], points.mean(), np.hypot(2.0, points.std())), rel=2e-3
    )


def test_points_that_coincide_and_a_state_known_exactly_are_columns_too():
    header, arrays = drawn(ParticleDensity(np.full(5, 0.2), np.full((5, 1), 3.0), ("x",), (False,)))
    assert arrays["quantiles"][:, 0] == pytest.approx([3.0, 3.0], abs=1e-6) and header["range"][0] < 3 < header["range"][1]


def test_a_window_has_every_time_in_it_and_one_on_either_side():
    fake, truth = fake_result(observations=5000)
    asked = [100.05, 130.0]
    header, arrays = read(picture_bytes(fake, window=tuple(asked), truth=truth))
    inside = np.flatnonzero((fake.times >= asked[0]) & (fake.times <= asked[1]))
    expected = np.arange(inside[0] - 1, inside[-1] + 2)
    np.testing.assert_array_equal(arrays["times"], fake.times[expected])
    np.testing.assert_array_equal(arrays["mean"], fake.mean[expected, 0])
    np.testing.assert_array_equal(arrays["truth"], truth[expected, 0])
    assert header["complete"] and header["extent"] == [0.0, fake.times[-1]]
    assert header["window"] == [arrays["times"][0], arrays["times"][-1]]


def test_of_a_hundred_thousand_observations_only_what_can_be_seen_is_sent():
    fake, truth = fake_result(observations=100_000, densities=False)
    truth[54_321] = 1e3  # an extreme that no even choice of times would hold
    frame = picture_bytes(fake, columns=800, truth=truth)
    header, arrays = read(frame)
    assert len(frame) < 500_000 and not header["complete"] and len(arrays["times"]) == 800
    lines = {line["role"]: line for line in header["lines"]}
    assert arrays[lines["truth"]["values"]].max() == 1e3
    assert arrays[lines["mean"]["values"]].max() == fake.mean.max()
    assert len(arrays[lines["mean"]["values"]]) <= 1600


def test_frames_of_one_result_have_one_key_and_those_of_another_or_another_state_a_different_one():
    fake, _ = fake_result(observations=50, state=("theta", "rate"))
    other, _ = fake_result(observations=50, state=("theta", "rate"), seed=1)
    keys = [read(picture_bytes(*of))[0]["key"] for of in ((fake, 0), (fake, 0, (1, 2)), (fake, 1), (other, 0))]
    assert keys[0] == keys[1] and len(set(keys)) == 3


def test_coverage_counts_a_band_that_wraps_around_the_circle():
    angle, angles = fake_result(observations=400, state=("theta",), periodic=("theta",), step=0.5)
    line, values = fake_result(observations=400, step=0.5)
    found = [read(picture_bytes(one, truth=truth))[0]["coverage"] for one, truth in ((angle, angles), (line, values))]
    assert found[0] == pytest.approx(found[1], abs=0.005) and 0.8 < found[0] < 1
    _, arrays = read(picture_bytes(angle))
    assert (arrays["quantiles"][0] > arrays["quantiles"][1]).any(), "no band wraps: the test does not test the wrap"


def test_an_angle_is_not_joined_across_times_that_are_left_out():
    fake, _ = fake_result(observations=2000, state=("theta",), periodic=("theta",), step=0.5)
    header, _ = read(picture_bytes(fake, columns=600))
    assert "band" not in {line["role"] for line in header["lines"]}
    header, arrays = read(picture_bytes(fake, window=(150.0, 180.0)))
    (mean,) = (line for line in header["lines"] if line["role"] == "mean")
    steps = np.abs(np.diff(arrays[mean["values"]]))
    assert not mean["dots"] and steps[np.isfinite(steps)].max() <= np.pi


def test_without_densities_the_band_is_that_of_a_gaussian():
    fake, _ = fake_result(densities=False)
    _, arrays = read(picture_bytes(fake))
    assert "cells" not in arrays
    np.testing.assert_allclose(arrays["quantiles"][1], norm.ppf(0.975, fake.mean[:, 0], np.sqrt(fake.variance[:, 0])))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"coordinate": "speed"}, "there is no state 'speed'; the states are x"),
        ({"coordinate": 1}, "there is no state 1"),
        ({"window": (2.0, 1.0)}, "does not rise"),
        ({"columns": 1}, "columns is 1"),
        ({"truth": np.zeros((3, 3))}, "truth has shape"),
    ],
)
def test_a_wrong_request_says_what_is_wrong(options, message):
    fake, _ = fake_result(observations=10)
    with pytest.raises(InputError, match=message):
        picture_bytes(fake, **options)


def joint_mass(arrays, t):
    return (arrays["values"][t] / 65535 * arrays["peak"][t]).sum() * abs(np.linalg.det(arrays["basis"][t]))


@pytest.mark.parametrize("particles", [False, True])
def test_a_thin_joint_density_integrates_to_one_and_its_regions_hold_their_probabilities(particles):
    mean, cov = np.array([1.0, -2.0]), np.array([[1.0, 0.999], [0.999, 1.0]])
    names, angles = ("x", "y"), (False, False)
    density = GaussianMixture.gaussian(mean, cov, names, angles)
    if particles:
        points = np.random.default_rng(0).multivariate_normal(mean, cov, 20_000)
        density = ParticleDensity(np.full(20_000, 1 / 20_000), points, names, angles)
    _, arrays = read(plane_bytes(One(density), ("x", "y"), [0]))
    assert joint_mass(arrays, 0) == pytest.approx(1.0, abs=2e-3)
    assert arrays["peak"][0] == pytest.approx(1 / (2 * np.pi * np.sqrt(np.linalg.det(cov))), rel=0.12 if particles else 2e-3)
    # Of a Gaussian the level of the region with probability p is 1 - p of the peak.
    assert arrays["levels"][0] == pytest.approx([0.5, 0.05], abs=0.06 if particles else 0.01)


def test_a_joint_density_on_a_slanted_grid_is_that_density_where_an_angle_passes_pi():
    i, j = np.meshgrid(np.arange(64) - 32, np.arange(48) - 24, indexing="ij")
    angle = 2 * np.pi * i / 64
    logs = 8 * np.cos(angle - 3.0) - 0.5 * (0.4 * j) ** 2
    basis = np.array([[2 * np.pi / 64, 0.0], [0.0, 0.3]])
    density = GridDensity(logs, np.array([0.0, 5.0]), basis, ("x", "y"), (True, False))
    _, arrays = read(plane_bytes(One(density), ("x", "y"), [0]))
    assert joint_mass(arrays, 0) == pytest.approx(1.0, abs=2e-3)
    for at in ([40, 40], [20, 50], [61, 33]):
        place = arrays["origin"][0] + arrays["basis"][0] @ at
        shown = arrays["values"][0][at[1], at[0]] / 65535 * arrays["peak"][0]
        assert shown == pytest.approx(float(density.pdf(place)), abs=1e-4 * arrays["peak"][0])


def test_a_joint_density_needs_two_states():
    fake, _ = fake_result(observations=5, state=("theta", "rate"), periodic=("theta",))
    header, arrays = read(plane_bytes(fake, (0, 1), [0, -1]))
    assert header["periodic"] == [True, False] and arrays["index"].tolist() == [0, 5]
    assert joint_mass(arrays, 1) == pytest.approx(1.0, abs=0.01)
    with pytest.raises(InputError, match="give two different ones"):
        plane_bytes(fake, ("rate", "rate"))


def test_one_outlier_does_not_set_the_range_of_two_states():
    model = zakai.Model(
        state=["x", "v"], drift=["v", "-x - v"], diffusion=[[0.0], [0.5]], observation=["x"], observation_kind="samples",
        observation_noise=[["0.1"]], prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.5]},
    )  # fmt: skip
    values = np.where(np.arange(40) == 20, -999.0, 0.1)
    result = zakai.filter(model, zakai.Record(0.5 * np.arange(1, 41), values, "samples"))
    header, _ = read(plane_bytes(result, ("x", "v"), list(range(41))))
    assert result.mean[21, 0] < -100.0
    assert -10.0 < header["range"]["x"][0] < -1.0 < 1.0 < header["range"]["x"][1] < 10.0
