
import numpy as np
import pytest

import zakai
from zakai.errors import InputError
from zakai.models import Model, gallery, load_model
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.simulation.simulate import simulate


def linear(kind, **keys):
    settings = {"state": ["x"], "drift": ["-x"], "observation": ["2*x + 1"], "observation_noise": [["0.5"]]}
    prior = {"kind": "gaussian", "mean": [1.0], "cov": [[0.25]]}
    return Model(**{**settings, "observation_kind": kind, "prior": prior, **keys})


# Models without a prior are for analysis: some explode, one has an undetermined function.
@pytest.mark.parametrize("name", [name for name in gallery.names() if gallery.load(name).prior is not None])
def test_every_gallery_model_with_a_prior_can_be_simulated_and_repeated(name):
    model = load_model(f"gallery:{name}")
    inputs = zakai.Inputs([0.0, 0.4], [[1.0, 5.0], [0.0, 4.0]]) if model.inputs else None
    truth, record = simulate(model, np.arange(1, 31) * 0.05, seed=3, inputs=inputs)
    again = simulate(model, np.arange(1, 31) * 0.05, seed=3, inputs=inputs)
    assert truth.values.shape == (31, model.n) and record.values.shape == (30, model.m)
    assert np.array_equal(truth.values, again[0].values) and np.array_equal(record.values, again[1].values)
    other = simulate(model, np.arange(1, 31) * 0.05, seed=4, inputs=inputs)[1]
    assert not np.array_equal(record.values, other.values)
    assert truth.times[0] == model.start and record.kind == model.observation_kind


def test_a_long_path_has_the_moments_of_the_linear_theory():
    # dx = -x dt + dv is stationary with variance 1/2 and correlation exp(-lag); Euler's own bias is d/4.
    truth, _ = simulate(linear("increments"), np.arange(1, 6_001) * 0.5, seed=0, substeps=30)
    x = truth.values[100:, 0]
    assert x.mean() == pytest.approx(0.0, abs=4 * np.sqrt(1.0 / 3_000))
    assert x.var() == pytest.approx(0.5, rel=0.07)
    assert (x[1:] * x[:-1]).mean() / x.var() == pytest.approx(np.exp(-0.5), abs=0.05)


def test_steps_of_a_path_follow_the_drift_over_long_intervals():
    # Without noise to speak of: an oscillator, and an unstable state that grows by e^8.
    keys = dict(observation_noise=[["1e-12"]], observation_kind="samples")
    oscillator = Model(state=["q", "p"], drift=["p", "-q"], diffusion=[["0"], ["1e-9"]], observation=["q"],
                       prior={"kind": "gaussian", "mean": [1, 0], "cov": [0, 0]}, **keys)  # fmt: skip
    unstable = Model(state=["x"], drift=["2*x"], diffusion=[["1e-9"]], observation=["x"],
                     prior={"kind": "gaussian", "mean": [1], "cov": [0]}, **keys)  # fmt: skip
    for length in (1.0, 4.0):
        path = simulate(oscillator, length * np.arange(1, 4), seed=1)[0].values[1:, 0]
        np.testing.assert_allclose(path, np.cos(length * np.arange(1, 4)), atol=1e-3)
        grown = simulate(unstable, [length], seed=1)[0].values[-1, 0]
        assert grown == pytest.approx(np.exp(2 * length), rel=1e-3)


def test_noise_within_a_step_has_the_covariance_of_the_linear_theory():
    model = linear("samples", drift=["-3*x"], prior={"kind": "gaussian", "mean": [0.0], "cov": [0.0]})
    truth, _ = simulate(model, np.arange(1, 40_001) * 0.5, seed=0)
    assert truth.values[100:, 0].var() == pytest.approx(1 / 6, rel=0.02)  # Euler's steps have 8 % more
    integral = linear("increments", drift=["0"], diffusion=[["1"]], observation=["x"], observation_noise=[["1e-12"]])
    truth, record = simulate(integral, [1.0] * np.arange(1, 2001), seed=0)
    trapezoid = record.values[:, 0] - 0.5 * (truth.values[1:, 0] + truth.values[:-1, 0])
    assert abs(trapezoid.mean()) < 0.03  # Euler's sum of left values is a tenth behind


def test_correlated_noise_enters_the_state_with_g_q_g():
    model = Model(state=["x", "v"], drift=["0", "0"], observation=["x"], diffusion=[["1", "0"], ["1", "2"]],
                  process_noise=[["1", "0.5"], ["0.5", "1 + t"]])  # fmt: skip
    steps = np.diff(simulate(model, np.arange(1, 20_001) * 1e-4, seed=0, initial=[0, 0], substeps=1)[0].values, axis=0)
    expected = [[1, 2], [2, 1 + 2 + 4 * 2]]  # t is 1 on average over [0, 2]
    np.testing.assert_allclose(steps.T @ steps / 2.0, expected, rtol=0.06)


def test_the_four_kinds_of_record_are_four_readings_of_one_path():
    times = np.cumsum([0.1, 0.3, 0.05, 0.2])
    truth, increments = simulate(linear("increments"), times, seed=5)
    _, path = simulate(linear("path"), times, seed=5)
    _, rates = simulate(linear("rates"), times, seed=5)
    lengths = np.diff(truth.times)[:, None]
    np.testing.assert_allclose(path.values, np.cumsum(increments.values, axis=0))
    np.testing.assert_allclose(rates.values, increments.values / lengths)
    truth, samples = simulate(linear("samples"), np.arange(5_000) * 0.01, seed=5)
    noise = samples.values - (2 * truth.values[1:] + 1)
    assert noise.mean() == pytest.approx(0, abs=0.04) and noise.var() == pytest.approx(0.5, rel=0.08)
    assert truth.values[0] == truth.values[1] and truth.times[0] == truth.times[1] == 0.0


def test_increments_are_the_integral_of_h_with_noise_of_the_right_size():
    truth, record = simulate(linear("increments", drift=["0"], diffusion=[["0"]]), np.arange(1, 5_001) * 0.2, seed=1)
    residual = record.values[:, 0] - 0.2 * (2 * truth.values[0, 0] + 1)
    assert residual.mean() == pytest.approx(0, abs=0.02) and residual.var() == pytest.approx(0.5 * 0.2, rel=0.08)


def test_angles_are_wrapped():
    truth, _ = simulate(load_model("gallery:wind-vane-rate"), np.arange(1, 2_001) * 1.0, seed=0)
    assert (np.abs(truth.values[:, 0]) <= np.pi).all() and np.abs(np.diff(truth.values[:, 0])).max() > 5


def test_a_clock_that_is_regular_up_to_rounding_is_regular():
    model = load_model("gallery:spiral-sensor")
    first, _ = simulate(model, np.arange(1, 1_001) / 100, seed=0)
    second, _ = simulate(model, np.arange(1, 1_001) * 0.01, seed=0)
    assert first.values == pytest.approx(second.values, rel=1e-9)


def test_a_result_does_not_depend_on_how_the_time_is_cut_into_pieces(monkeypatch):
    model, times = linear("increments"), np.arange(1, 101) * 0.1
    import zakai.simulation.simulate as module

    truth, record = simulate(model, times, seed=2)
    monkeypatch.setattr(module, "CHUNK", 70)
    truth_in_pieces, record_in_pieces = simulate(model, times, seed=2)
    np.testing.assert_allclose(truth_in_pieces.values, truth.values, rtol=1e-14)
    np.testing.assert_allclose(record_in_pieces.values, record.values, rtol=1e-12)


@pytest.mark.parametrize(
    ("model", "times", "options", "words"),
    [
        (linear("increments"), [0.0, 1.0], {}, "entry 0 (0) is not after the start 0"),
        (linear("samples"), [-1.0, 1.0], {}, "entry 0 (-1) is not after the start"),
        (linear("samples"), [1.0, 1.0], {}, "entry 1 (1) is not after 1"),
        (linear("samples"), [], {}, "at least one time"),
        (linear("samples"), [1.0, np.nan], {}, "finite"),
        (linear("samples"), ["a"], {}, "a list of numbers"),
        (linear("samples", prior=None), [1.0], {}, "prior: missing"),
        (linear("samples"), [1.0], {"initial": [1, 2]}, "initial: expected 1 finite numbers"),
        (linear("samples"), [1.0], {"initial": "x"}, "initial: expected 1 numbers"),
        (linear("samples"), [1.0], {"substeps": 0}, "substeps: expected a whole number"),
        (linear("samples"), [1.0], {"seed": -1}, "seed: expected a whole number of at least 0"),
        (linear("samples", drift=["x**3"]), [9.0], {"initial": 5.0}, "drift"),
        (linear("samples", drift=["log(x)"]), [9.0], {"initial": -0.3}, "drift[0] = log(x): log of a negative"),
        (linear("samples", drift=["1/x"], diffusion=[["0"]]), [9.0], {"initial": 0.0}, "drift[0] = 1/x: division by zero"),
        (linear("samples", observation=["sqrt(x - 9)"]), [9.0], {}, "observation[0] = sqrt(x - 9): square root"),
        (linear("samples", observation_noise=[["1 - t"]]), [2.0], {}, "observation_noise: is not positive definite"),
        (linear("samples", functions=["gamma"], drift=["gamma(x)"]), [2.0], {}, "undetermined"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line(model, times, options, words):
    with pytest.raises(InputError) as error:
        simulate(model, times, **options)
    assert words in str(error.value) and str(error.value).isprintable()


@pytest.mark.parametrize(
    ("log_density", "mean", "variance"),
    [("-10*x**2", 0.0, 0.05), ("-(x - 40)**2/8", 40.0, 4.0), ("-1e8*(x - 3)**2/2", 3.0, 1e-8)],
)
def test_a_density_prior_is_drawn_from_wherever_its_mass_is(log_density, mean, variance):
    model = linear("samples", prior={"kind": "density", "log_density": log_density})
    draws = np.array([simulate(model, [0.0], seed=seed)[0].values[0, 0] for seed in range(400)])
    assert draws.mean() == pytest.approx(mean, abs=5 * np.sqrt(variance / 400))
    assert draws.var() == pytest.approx(variance, rel=0.35)


@pytest.mark.parametrize(
    ("log_density", "words"),
    [("x", "does not decay in 'x'"), ("log(x)*2 - x**2", "log of a negative number"), ("0", "does not decay")],
)
def test_a_density_prior_that_is_no_density_is_refused(log_density, words):
    with pytest.raises(InputError, match=words):
        simulate(linear("samples", prior={"kind": "density", "log_density": log_density}), [1.0])


def test_priors_have_the_moments_and_densities_of_their_draws():
    rng = np.random.default_rng(0)
    gaussian = GaussianPrior(np.array([1.0, -1.0]), np.array([[1.0, 1.0], [1.0, 1.0]]))  # singular
    draws = gaussian.sample(rng, 20_000)
    np.testing.assert_allclose(draws[:, 0] - draws[:, 1], 2.0, atol=1e-7)
    with pytest.raises(InputError, match="singular"):
        gaussian.log_density(np.zeros(2))
    mixture = MixturePrior(np.array([0.25, 0.75]), np.array([[-2.0], [2.0]]), np.array([[[0.5]], [[1.0]]]))
    draws = mixture.sample(rng, 40_000)
    np.testing.assert_allclose(draws.mean(axis=0), mixture.mean, atol=0.05)
    np.testing.assert_allclose(draws.var(axis=0), mixture.cov[0], rtol=0.04)
    grid = np.linspace(-9, 9, 4001)[:, None]
    assert np.exp(mixture.log_density(grid)).sum() * (grid[1, 0] - grid[0, 0]) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize(
    ("drift", "start", "deviations"),
    [
        (["v", "-100*x - 0.2*v"], [0.1, 0.0], [0.158, 1.58]),  # Euler's ten steps of an interval made it grow to 1e17
        (["v", "50*(1 - x**2)*v - x"], [2.0, 0.0], None),  # overflowed
    ],
)
def test_steps_are_short_enough_for_a_drift_that_is_stiff_or_oscillates(drift, start, deviations):
    model = zakai.Model(
        state=["x", "v"], drift=drift, diffusion=[[0], [1]], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": start, "cov": [0.01, 0.01]},
    )  # fmt: skip
    times = np.arange(1, 201) * 0.5
    truth, record = zakai.simulate(model, times, seed=3)
    again, _ = zakai.simulate(model, times, seed=3)
    assert (again.values == truth.values).all() and np.abs(truth.values[:, 0]).max() < 3.0
    if deviations is not None:  # the stationary ones: 1 / (2 * 0.2) for v, and a hundredth of it for x
        assert truth.values.std(axis=0) == pytest.approx(deviations, rel=0.25)
