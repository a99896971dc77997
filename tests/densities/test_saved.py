"""Saved densities: a file gives the same density, and a filter that begins with it continues as if it had not stopped."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from zakai.densities import GaussianMixture, GridDensity, PointMasses, ProductDensity
from zakai.errors import InputError
from zakai.models.files import read_model
from zakai.records.checkpoint import write_checkpoint

WELL = {
    "state": ["x"], "drift": ["x - x**3"], "observation": ["x"], "observation_kind": "samples",
    "observation_noise": [[0.5]], "process_noise": [[0.3]], "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]},
}  # fmt: skip
ANGLE = {
    "state": ["theta"], "periodic": ["theta"], "drift": ["sin(theta)"], "observation": ["theta"], "observation_kind": "samples",
    "observation_family": "von-mises", "concentration": 2, "prior": {"kind": "density", "log_density": "cos(theta)"},
}  # fmt: skip
RATE = {
    "state": ["x"], "drift": ["2*(1 - x)"], "diffusion": [["0.5*sqrt(x)"]], "domain": {"x": {"lower": 0.0}},
    "observation": ["x"], "observation_kind": "samples", "observation_noise": [[0.2]],
    "prior": {"kind": "density", "log_density": "3*log(x) - 4*x"},
}  # fmt: skip
NEAR_ZERO = {**RATE, "drift": ["0.3 - x"], "prior": {"kind": "density", "log_density": "-0.7*log(x) - 2*x"}}
LEVEL = {
    "state": ["x"], "drift": ["-0.5"], "diffusion": [[0.6]],
    "domain": {"x": {"lower": 0.0, "upper": 1.0, "boundary": "reflecting"}},
    "observation": ["x"], "observation_kind": "samples", "observation_noise": [[0.2]],
    "prior": {"kind": "density", "log_density": "0"},
}  # fmt: skip
WALL = {**LEVEL, "domain": {"x": {"lower": 0.0, "boundary": "reflecting"}}, "prior": {"kind": "density", "log_density": "-x"}}
NARROW = {
    **WELL, "drift": ["-(x - 1000)"], "observation_noise": [["1e-6"]], "process_noise": [["1e-6"]],
    "prior": {"kind": "gaussian", "mean": [1000], "cov": [[1e-6]]},
}  # fmt: skip


def models():
    yield "kalman-bucy", zakai.load_model("gallery:kalman-bucy-2d"), "auto"
    yield "benes", zakai.load_model("gallery:benes"), "auto"
    yield "limited-direct", zakai.load_model("gallery:spiral-sensor"), "auto"
    yield "double well", zakai.Model(**WELL), "auto"
    yield "angle", zakai.Model(**ANGLE), "auto"
    yield "half line", zakai.Model(**RATE), "auto"
    yield "close to a natural end", zakai.Model(**NEAR_ZERO), "auto"
    yield "reflecting ends", zakai.Model(**LEVEL), "auto"
    yield "one reflecting end", zakai.Model(**WALL), "auto"
    yield "far and narrow", zakai.Model(**NARROW), "yau-yau"


@pytest.mark.parametrize(("name", "model", "method"), list(models()), ids=[name for name, _, _ in models()])
def test_a_filter_continues_from_a_saved_density(tmp_path, name, model, method):
    allowed = 1e-6 if name == "close to a natural end" else 1e-8  # of the tolerance of 1e-5, for another grid
    step = 0.25 if model.observation_kind == "samples" else 0.02
    times = step * np.arange(1, 17)
    _, record = zakai.simulate(model, times, seed=3)
    whole = zakai.filter(model, record, method)
    first = zakai.filter(model, zakai.Record(times[:8], record.values[:8], record.kind), method)
    first.density(-1).save(tmp_path / "end.density")
    later = model.with_prior(zakai.load_density(tmp_path / "end.density"), start=times[7])
    later = read_model(later.text, "a file")  # the text of the model holds the density
    second = zakai.filter(later, zakai.Record(times[8:], record.values[8:], record.kind), method)
    deviations = np.sqrt(whole.variance[8:])
    assert second.method == whole.method and not second.warnings
    assert np.abs((second.mean - whole.mean[8:]) / deviations).max() < allowed
    np.testing.assert_allclose(second.variance[1:], whole.variance[9:], rtol=10 * allowed)
    np.testing.assert_allclose(second.variance[0], whole.variance[8], rtol=1e-4)  # wrapped deviations have a kink
    assert second.log_likelihood == pytest.approx(whole.log_likelihood_increments[9:].sum(), abs=10 * allowed)


def densities():
    logs = -0.5 * np.linspace(-7, 7, 57) ** 2 + np.sin(np.linspace(0, 3, 57))
    grid = GridDensity(logs, np.ones(1), np.array([[0.25]]), ("x",), (False,))
    two = GaussianMixture(np.array([0.3, 0.7]), np.array([[0.0], [2.0]]), np.array([[[1.0]], [[0.5]]]), ("y",), (False,))
    yield grid, grid
    yield two, two
    yield ProductDensity((two, two), ((0,), (1,)), ("a", "b"), (False, False)), None
    yield ProductDensity((grid, two), ((0,), (1,)), ("a", "b"), (False, False)), None
    # A difference of Gaussians is smooth, and no mixture of positive weights.
    yield GaussianMixture(np.array([1.5, -0.5]), np.zeros((2, 1)), np.array([[[4.0]], [[1.0]]]), ("x",), (False,)), None


@pytest.mark.parametrize(("density", "same"), list(densities()))
def test_a_file_gives_the_density_back(tmp_path, density, same):
    density.save(tmp_path / "a.density")
    found = zakai.load_density(tmp_path / "a.density")
    x = density.sample(0, 50)
    np.testing.assert_allclose(found.log_density(x), density.log_density(x), atol=1e-9)
    np.testing.assert_allclose(found.mean(), density.mean(), atol=1e-9)
    assert found.names == density.names and found.periodic == density.periodic
    if same is not None:
        for part in ("weights", "means", "covs") if isinstance(same, GaussianMixture) else ("log_values", "centre", "basis"):
            assert getattr(found, part).tobytes() == getattr(same, part).tobytes()


def test_points_are_saved_with_their_mean_and_covariance(tmp_path):
    points = PointMasses(np.full(40, 1 / 40), np.random.default_rng(0).standard_normal((40, 2)), ("x", "y"), (False, False))
    points.save(tmp_path / "a.density")
    found = zakai.load_density(tmp_path / "a.density")
    np.testing.assert_allclose(found.mean(), points.mean(), atol=1e-12)
    np.testing.assert_allclose(found.cov(), points.cov(), atol=1e-12)


def test_what_a_grid_does_not_resolve_is_refused():
    means, covs = np.array([[0.0], [1.0], [1.0]]), np.array([[[1e-8]], [[1.0]], [[0.9]]])
    peaks = GaussianMixture(np.array([0.9, 0.2, -0.1]), means, covs, ("x",), (False,))
    with pytest.raises(InputError, match="a grid of 2048 points along each axis does not resolve this density"):
        zakai.Model(**WELL).with_prior(peaks)


def test_a_density_of_other_states_is_refused():
    density = GaussianMixture.gaussian(np.zeros(1), np.eye(1), ("y",), (False,))
    with pytest.raises(InputError, match="prior: the density is of y, and the states are x"):
        zakai.Model(**WELL).with_prior(density)


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("centre", [0, 1], r"centre: expected a list of 1 number"),
        ("basis", [[0]], "basis: its columns must be linearly independent"),
        ("log_values", [[0, 1]], r"log_values: expected at most 40,000 numbers on a full grid of 1 axes; its shape is \(1, 2\)"),
        ("log_values", ["a", 1], "log_values: expected numbers on a full grid"),
        ("log_values", [0, float("nan")], "log_values: expected logarithms of a density"),
    ],
)
def test_a_wrong_grid_in_a_model_is_refused_by_its_key(key, value, says):
    prior = {"kind": "grid", "centre": [0], "basis": [[0.5]], "log_values": [-9.0, -1.0, 0.0, -1.0, -9.0]} | {key: value}
    with pytest.raises(InputError, match=f"prior: {says}"):
        zakai.Model(**{**WELL, "prior": prior})


@pytest.mark.parametrize(
    "change",
    [
        {"weights": np.array([-1.0])},
        {"weights": np.array([[1.0]])},
        {"means": np.zeros((2, 1))},
        {"means": np.array([[np.nan]])},
        {"covs": -np.ones((1, 1, 1))},
        {"covs": np.ones((1, 1, 1), np.int64)},
        {"names": ["x y"]},
        {"names": 3},
        {"periodic": [0]},
        {"kind": "points"},
    ],
)
def test_a_file_that_holds_no_density_is_refused(tmp_path, change):
    arrays = {"weights": np.ones(1), "means": np.zeros((1, 1)), "covs": np.ones((1, 1, 1))}
    about = {"kind": "mixture", "names": ["x"], "periodic": [False]}
    for key, value in change.items():
        (arrays if key in arrays else about)[key] = value
    write_checkpoint(tmp_path / "a.density", about, arrays, "density")
    with pytest.raises(InputError, match="a.density: does not hold a density; give a file that density.save wrote"):
        zakai.load_density(tmp_path / "a.density")
