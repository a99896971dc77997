"""Filters of other libraries on models with kinks, tables, observed angles and noise that depends on the state."""

import numpy as np
import pytest

import zakai
from zakai.models.numeric import numpy_function

pytest.importorskip("cuthbert")
pytest.importorskip("dynamax")

EVERY = [("ekf", {}), ("ukf", {}), ("enkf", {"members": 2000}), ("particle", {"particles": 20_000})]


def apart(found, expected):
    """The largest distance of two means in deviations."""
    return float(np.abs((found.mean - expected.mean) / np.sqrt(expected.variance)).max())


@pytest.mark.parametrize(("method", "options"), EVERY)
def test_one_noise_that_depends_on_two_states(method, options):
    model = zakai.Model(
        state=["S", "I"], drift=["-1.5*S*I", "1.5*S*I - I/2"], diffusion=[["-0.3*S*I"], ["0.3*S*I"]], observation=["I"],
        observation_kind="samples", observation_noise=[["(0.02 + 0.05*I)**2"]],
        prior={"kind": "gaussian", "mean": [0.95, 0.05], "cov": [[1e-4, 0], [0, 1e-4]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.linspace(0.5, 6, 12), seed=1)
    expected = zakai.filter(model, record, "yau-yau")
    found = zakai.filter(model, record, method, substeps=8, **options)
    bound = 0.06 if method == "particle" else 0.25
    assert apart(found, expected) < bound
    assert abs(found.log_likelihood - expected.log_likelihood) < bound


@pytest.mark.parametrize(("method", "options"), EVERY)
def test_a_bearing_that_crosses_half_a_turn(method, options):
    def sensor(angle):
        return zakai.Model(
            state=["x", "y"], drift=["0.1", "0.8"], diffusion=[["0.3", "0"], ["0", "0.3"]],
            observation=["sqrt(x**2 + y**2)", angle], observation_kind="samples",
            observation_noise=[["0.01", "0.002"], ["0.002", "0.0025"]],
            prior={"kind": "gaussian", "mean": [-5, -3], "cov": [[0.25, 0], [0, 0.25]]},
        )  # fmt: skip

    front, back = sensor("atan2(y, x)"), sensor("atan2(-y, -x)")
    _, record = zakai.simulate(front, np.linspace(0.25, 6, 24), seed=1)
    values = record.values.copy()
    assert values[:, 1].min() < -3 and values[:, 1].max() > 3
    values[:, 1] = np.angle(np.exp(1j * (values[:, 1] + np.pi)))
    found = zakai.filter(front, record, method, **options)
    expected = zakai.filter(back, zakai.Record(record.times, values, "samples"), method, **options)
    assert np.allclose(found.mean, expected.mean, rtol=0, atol=1e-8)
    assert np.isclose(found.log_likelihood, expected.log_likelihood, rtol=0, atol=1e-8)


def test_particles_take_all_images_of_a_wide_angle():
    model = zakai.Model(
        state=["x"], drift=["-x/4"], diffusion=[["2"]], observation=["x"], observation_kind="samples",
        observation_noise=[["2"]], observed_angles=["x"], prior={"kind": "gaussian", "mean": [0], "cov": [[0.5]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.linspace(0.3, 4.5, 15), seed=5)
    expected = zakai.filter(model, record, "yau-yau")
    found = zakai.filter(model, record, "particle", particles=50_000, substeps=2)
    assert apart(found, expected) < 0.03
    assert abs(found.log_likelihood - expected.log_likelihood) < 0.05


@pytest.mark.parametrize("method", ["ekf", "ukf", "enkf", "particle"])
def test_every_function_of_a_formula_is_taken(method):
    model = zakai.Model(
        state=["x", "y"],
        drift=["-sign(x) - abs(x)/5", "max(x, min(y, 1)) - floor(y)/9 + heaviside(x)/5 - atan2(y, 2) + sinc(x)/3"],
        observation=["depth(x) + y/4"], observation_kind="samples", observation_noise=[["0.2*(1 + abs(y))"]],
        tables={"depth": {"x": [-2.0, -1, 0, 1, 2], "values": [-3.0, -1, 0, 2, 5], "kind": "linear"}},
        prior={"kind": "gaussian", "mean": [0.4, 0.3], "cov": [[0.3, 0], [0, 0.3]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.linspace(0.1, 2, 20), seed=4)
    expected = zakai.filter(model, record, "particle", particles=30_000, seed=7)
    found = zakai.filter(model, record, method)
    assert np.isfinite(found.mean).all()
    assert apart(found, expected) < (0.4 if method == "particle" else 1.2)


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("periodic", [True, False])
def test_tables_in_jax_are_those_of_numpy(kind, periodic):
    import jax

    from zakai.peers._jax_functions import jax_function

    rng = np.random.default_rng(0)
    x, y, values = [0, 1, 2.5, 3, 5, 6.0], [0.0, 1, 2, 3.5, 4], rng.normal(size=6)
    values[-1] = values[0]
    model = zakai.Model(
        state=["x", "y"], drift=["a(x)", "b(x, y)"], observation=["sinc(9*x)"],
        tables={"a": {"x": x, "values": values.tolist(), "kind": kind, "periodic": periodic},
                "b": {"x": x, "y": y, "values": rng.normal(size=(6, 5)).tolist(), "kind": kind}},
    )  # fmt: skip
    formulas = [*model.drift, *model.observation]
    slopes = numpy_function([formula.diff(symbol) for formula in formulas for symbol in model.x], model)
    found, plain = jax_function(formulas, model), numpy_function(formulas, model)
    both = jax.jit(lambda p: (found(p, 0.0, model.theta()), jax.jacfwd(lambda q: found(q, 0.0, model.theta()))(p)))
    for point in rng.uniform(-2, 8, size=(40, 2)):
        value, slope = both(point)
        assert np.allclose(value, plain(point, 0.0, model.theta()), rtol=0, atol=1e-12)
        assert np.allclose(np.ravel(slope), slopes(point, 0.0, model.theta()), rtol=0, atol=1e-11)
