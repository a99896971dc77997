"""The direct method against independent solutions of the Kolmogorov equation and of the filtering problem."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.kolmogorov import Box, filter_system
from references.systems import planar, scalar
from zakai.errors import ConditionError, InputError


def relative_error(result, reference, box, k):
    """The largest error of the normalised density at every third point of each axis, relative to its maximum."""
    every_third = (slice(None, None, 3),) * box.n
    expected = reference[every_third] / (reference.sum() * box.cell)
    computed = np.exp(result.density(k).log_density(box.x[every_third]))
    return np.abs(computed - expected).max() / expected.max()


@pytest.fixture(scope="module")
def one_state():
    system = scalar()
    box = Box(9.0, 512)
    return system, box, filter_system(box, system)


@pytest.mark.parametrize("kernel", ["flow", "power-series"])
def test_the_density_of_one_state_agrees_with_the_kolmogorov_equation(one_state, kernel):
    system, box, reference = one_state
    model = system.model("increments")
    record = zakai.Record(system.times, system.increments, "increments")
    result = zakai.filter(model, record, splitting="lie", kernel=kernel)
    assert result.method == "limited-direct" and not result.warnings
    for k in range(1, len(system.times) + 1):
        assert relative_error(result, reference[k - 1][1], box, k) <= 1e-10


@pytest.fixture(scope="module")
def two_states():
    system = planar()
    box = Box(7.0, 96, (0.0, 0.0))
    return system, box, filter_system(box, system)


@pytest.mark.parametrize("kernel", ["flow", "power-series"])
def test_the_density_of_two_states_agrees_with_the_kolmogorov_equation(two_states, kernel):
    system, box, reference = two_states
    model = system.model("increments")
    record = zakai.Record(system.times, system.increments, "increments")
    result = zakai.filter(model, record, splitting="lie", kernel=kernel)
    assert not result.warnings
    for k in range(1, len(system.times) + 1):
        assert relative_error(result, reference[k - 1][1], box, k) <= 1e-9


@pytest.mark.parametrize(
    ("system", "kind", "splitting"),
    [
        (scalar(), "increments", "lie"), (scalar(), "increments", "strang"), (scalar(), "samples", "strang"),
        (planar(), "increments", "lie"), (planar(), "samples", "strang"),
    ],
)  # fmt: skip
def test_both_kernels_give_one_result_over_irregular_times_and_gaps(system, kind, splitting):
    model = system.model(kind)
    times = np.array([0.0003, 0.1, 0.2, 0.9, 1.0]) if splitting == "lie" or kind == "samples" else np.array([0.003, 0.1, 0.15])
    values = 0.3 * np.random.default_rng(0).normal(size=(len(times), len(system.observation)))
    values[2] = np.nan
    record = zakai.Record(times, values, kind)
    flow, series = (
        zakai.filter(model, record, "limited-direct", splitting=splitting, kernel=kernel) for kernel in ("flow", "power-series")
    )
    assert not series.warnings
    for one, other in ((flow.mean, series.mean), (flow.cov, series.cov), (flow.log_likelihood, series.log_likelihood)):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)


def linear(n, **keys):
    """A linear system, whose filter is that of Kalman and Bucy."""
    drift = ["-x/2 + sin(t)/3", "x - y*cos(t)"][:n]
    noise = [["1 + t/4", "1/5"], ["1/5", "1"]] if n == 2 else [["1 + t/4"]]
    prior = {"kind": "gaussian", "mean": [0.3] * n, "cov": (0.5 * np.eye(n)).tolist()}
    state = ["x", "y"][:n]
    return zakai.Model(**{"state": state, "drift": drift, "observation": state, "process_noise": noise, "prior": prior} | keys)


@pytest.mark.parametrize(("n", "allowed"), [(1, 1e-9), (2, 1e-6)])
def test_increments_of_an_affine_function_are_split_with_the_series(n, allowed):
    model = linear(n)
    _, record = zakai.simulate(model, np.array([0.05, 0.2, 0.3]), seed=1)
    series = zakai.filter(model, record, "limited-direct", kernel="power-series")
    exact = zakai.filter(model, record, "kalman-bucy")
    assert not series.warnings
    np.testing.assert_allclose(series.mean, exact.mean, atol=allowed)
    np.testing.assert_allclose(series.log_likelihood, exact.log_likelihood, atol=allowed)


def spread_out(n, **keys):
    """Samples so rare that the kernel is wide."""
    return linear(n, observation_kind="samples", **keys), zakai.Record([0.4, 1.0, 4.0], 0.5 * np.ones((3, n)), "samples")


@pytest.mark.parametrize("n", [1, 2])
def test_the_series_gives_the_same_bits_online(n):
    model, record = spread_out(n)
    result = zakai.filter(model, record, "limited-direct", kernel="power-series")
    online = zakai.online(model, "limited-direct", kernel="power-series")
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True), 1):
        assert np.array_equal(online.update(time, value).mean, result.mean[k])


@pytest.mark.parametrize("n", [1, 2])
def test_the_gradient_with_the_series_is_that_of_central_differences(n):
    noise = [["c*(1 + t/4)", "1/5"], ["1/5", "1"]] if n == 2 else [["c*(1 + t/4)"]]
    drift = ["-a*x + sin(a*t)/3", "x - y*cos(t)"][:n]
    model, record = spread_out(n, drift=drift, process_noise=noise, parameters={"a": 0.5, "c": 1.0})
    record = zakai.Record(record.times[:1], record.values[:1], "samples") if n == 2 else record
    function = zakai.log_likelihood(model, record, "limited-direct", kernel="power-series")
    theta = np.array([0.5, 1.0])
    value, gradient = function.value_and_gradient(theta)
    assert np.isclose(value, function(theta))
    steps = 1e-4 * np.eye(2)
    central = [(function(theta + step) - function(theta - step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(gradient, central, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_series_does_not_depend_on_the_unit_of_the_state(unit):
    model, record = spread_out(1)
    drift, cov = f"-x/2 + {unit}*sin(t)/3", [[0.5 * unit**2]]
    prior = {"kind": "gaussian", "mean": [0.3 * unit], "cov": cov}
    keys = {"drift": [drift], "observation": [f"x/{unit}"], "process_noise": [[f"{unit}**2*(1 + t/4)"]], "prior": prior}
    other, _ = spread_out(1, **keys)
    one, scaled = (zakai.filter(m, record, "limited-direct", kernel="power-series") for m in (model, other))
    np.testing.assert_allclose(scaled.mean / unit, one.mean, rtol=1e-9)


def test_a_coefficient_that_is_not_analytic_is_refused_with_the_way_out():
    model, record = spread_out(1, drift=["-x*abs(t - 2/5)"])
    with pytest.raises(ConditionError, match='no power series about t = 0.4.*kernel="flow"'):
        zakai.filter(model, record, "limited-direct", kernel="power-series")


def test_an_unknown_kernel_is_refused():
    model, record = spread_out(1)
    with pytest.raises(InputError, match='option kernel: "exact" is neither "flow" nor "power-series"'):
        zakai.filter(model, record, "limited-direct", kernel="exact")


def test_another_method_on_the_same_model_changes_nothing():
    def model(name):
        prior = {"kind": "density", "log_density": "-(x-0.4)**2/2"}
        parts = {"drift": ["tanh(x)"], "observation": ["x"], "observation_kind": "increments", "prior": prior}
        return zakai.Model(name=name, state=["x"], **parts)

    record = zakai.simulate(model("a"), 0.3 * np.arange(1, 11), seed=1)[1]
    expected = zakai.filter(model("a"), record, "limited-direct").mean
    other = model("b")
    zakai.filter(other, record, "yau-yau")
    assert np.allclose(zakai.filter(other, record, "limited-direct").mean, expected, rtol=0, atol=1e-9)
