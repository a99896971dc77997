"""Residuals: uniform for the true model, and equal to closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import kstest, norm, poisson

import zakai


def _model(noise=1.0, **keys):
    parts = {
        "state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_noise": [["s"]], "observation_kind": "samples",
        "parameters": {"s": noise}, "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    }  # fmt: skip
    return zakai.Model(**{**parts, **keys})


@pytest.mark.parametrize("method", ["kalman-bucy", "limited-direct"])
def test_residuals_of_samples_equal_a_kalman_filter(method):
    model = _model(0.2)
    times = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.5, 30))
    _, record = zakai.simulate(model, times, seed=1)
    found = zakai.filter(model, record, method).residuals()[:, 0]
    mean, variance, last, expected = 0.0, 1.0, 0.0, []
    for time, value in zip(times, record.values[:, 0], strict=True):
        decay = np.exp(-(time - last))
        mean, variance, last = decay * mean, decay**2 * variance + (1 - decay**2) / 2, time
        expected.append(norm.cdf((value - mean) / np.sqrt(variance + 0.2)))
        gain = variance / (variance + 0.2)
        mean, variance = mean + gain * (value - mean), (1 - gain) * variance
    assert np.allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("method", ["kalman-bucy", "yau-yau"])
def test_coordinates_are_conditional_on_those_before_and_missing_ones_are_nan(method):
    model = _model(observation=["x", "2*x"], observation_noise=[["0.3", "0.1"], ["0.1", "0.5"]], parameters={})
    values = np.array([[0.4, -0.3], [np.nan, 1.0]])
    found = zakai.filter(model, zakai.Record([0.0, 1.0], values, "samples"), method).residuals()
    cov = np.outer([1, 2], [1, 2]) + [[0.3, 0.1], [0.1, 0.5]]
    slope = cov[0, 1] / cov[0, 0]
    conditional = (-0.3 - slope * 0.4) / np.sqrt(cov[1, 1] - slope * cov[0, 1])
    assert np.allclose(found[0], norm.cdf([0.4 / np.sqrt(cov[0, 0]), conditional]), atol=2e-5)
    assert np.isnan(found[1, 0]) and 0 < found[1, 1] < 1


@pytest.mark.parametrize("seed", range(3))
def test_the_true_model_is_accepted_and_a_halved_noise_detected(seed):
    model = _model()
    _, record = zakai.simulate(model, np.arange(1, 401) / 20, seed=seed)
    true = zakai.filter(model, record).residuals()
    assert kstest(true[:, 0], "uniform").pvalue > 0.01
    assert np.array_equal(true, zakai.filter(model, record).residuals(seed=7))
    halved = zakai.filter(model.with_parameters(s=0.5), record).residuals()
    assert kstest(halved[:, 0], "uniform").pvalue < 0.05


@pytest.mark.parametrize(
    "method, noise, step, tolerance",
    [
        ("kalman-bucy", 0.5, 0.05, 1e-5), ("yau-yau", 0.5, 0.05, 1e-5), ("kalman-bucy", 0.5, 0.3, 1e-3),
        ("kalman-bucy", 0.05, 0.2, 5e-3), ("yau-yau", 0.05, 0.2, 5e-3),
    ],
)  # fmt: skip
def test_residuals_of_increments_equal_the_exact_law(method, noise, step, tolerance):
    """The exact law is that of the state and its integral, two states whose transition is a matrix exponential."""
    model = _model(noise, observation_kind="increments")
    _, record = zakai.simulate(model, np.arange(1, 9) * step, seed=2)
    found = zakai.filter(model, record, method).residuals()[:, 0]
    A, Q = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.diag([1.0, 0.0])
    blocks = expm(np.block([[-A, Q], [np.zeros((2, 2)), A.T]]) * step)
    transition = blocks[2:, 2:].T
    spread = transition @ blocks[:2, 2:] + np.diag([0.0, noise * step])
    mean, variance, expected = 0.0, 1.0, []
    for value in record.values[:, 0]:
        (state, integral), cov = transition @ [mean, 0.0], transition @ np.diag([variance, 0.0]) @ transition.T + spread
        expected.append(norm.cdf((value - integral) / np.sqrt(cov[1, 1])))
        gain = cov[0, 1] / cov[1, 1]
        mean, variance = state + gain * (value - integral), cov[0, 0] - gain * cov[0, 1]
    assert np.allclose(found, expected, atol=tolerance)


def test_residuals_of_counts_are_drawn_between_the_two_probabilities():
    model = _model(observation=["exp(x)"], observation_noise=None, observation_family="poisson", parameters={})
    times, values = [0.0, 0.5], np.array([[2.0], [np.nan]])
    first = np.linspace(-9, 9, 4001)
    prior, rate = norm.pdf(first) / norm.pdf(first).sum(), np.exp(first)
    low, high = prior @ poisson.cdf(1, rate), prior @ poisson.cdf(2, rate)
    filtered = zakai.filter(model, zakai.Record(times, values, "samples"))
    found = np.array([filtered.residuals(seed=seed)[0, 0] for seed in range(20)])
    draws = np.array([np.random.default_rng(seed).uniform(size=(2, 1))[0, 0] for seed in range(20)])
    assert np.allclose(found, low + draws * (high - low), atol=1e-6)


def test_an_observation_much_sharper_than_the_prediction_has_an_accurate_residual():
    model = _model(1e-8)
    record = zakai.Record([1.0], np.array([[0.3]]), "samples")
    found = zakai.filter(model, record, "yau-yau").residuals()[0, 0]
    variance = np.exp(-2.0) + (1 - np.exp(-2.0)) / 2 + 1e-8
    assert np.isclose(found, norm.cdf(0.3 / np.sqrt(variance)), atol=2e-3)


def test_a_gap_in_a_path_needs_no_special_case():
    model = _model(0.5, observation_kind="path")
    values = np.array([[0.02], [np.nan], [0.11]])
    found = zakai.filter(model, zakai.Record([0.01, 0.02, 0.03], values, "path")).residuals()[:, 0]
    assert np.isnan(found[1])
    scores = np.array([0.02, 0.09]) / np.sqrt([0.5 * 0.01, 0.5 * 0.02])
    assert np.allclose(found[[0, 2]], norm.cdf(scores), atol=0.01)


def test_residuals_of_increments_are_uniform():
    model = _model(0.5, observation_kind="increments")
    _, record = zakai.simulate(model, np.arange(1, 201) / 100, seed=2)
    assert kstest(zakai.filter(model, record).residuals()[:, 0], "uniform").pvalue > 0.01


def test_increments_over_intervals_in_which_the_state_adds_more_than_the_noise_warn():
    model = _model(0.01, observation_kind="increments")
    _, record = zakai.simulate(model, np.arange(1, 9) * 0.2, seed=2)
    with pytest.warns(UserWarning, match="the steps are too long for increments"):
        zakai.filter(model, record).residuals()


POLAR = {
    "state": ["px", "py", "v"], "drift": ["v", "-py/4 + v/5", "-v/5"],
    "diffusion": [["0.2", "0", "0"], ["0", "0.3", "0"], ["0", "0", "0.5"]],
    "observation": ["sqrt(px**2 + py**2)", "px*py/4"], "observation_noise": [["0.05", "0.01"], ["0.01", "0.02"]],
    "observation_kind": "samples",
    "prior": {"kind": "gaussian", "mean": [3, 2, 0.2], "cov": [[1, 0, 0], [0, 0.5, 0], [0, 0, 0.3]]},
}  # fmt: skip


@pytest.mark.parametrize("method", ["general-direct", "tensor-train"])
@pytest.mark.parametrize("values", [(3.1, 1.2), (5.5, 4.0)])
def test_residuals_of_several_states_equal_sums_over_a_grid(method, values):
    """The second coordinate is given the first, which is sharp, and their noise is correlated."""
    filtered = zakai.filter(zakai.Model(**POLAR), zakai.Record([0.0], [values], "samples"), method)
    found = filtered.residuals()[0]
    px, py = np.meshgrid(3 + np.linspace(-7, 7, 1501), 2 + np.sqrt(0.5) * np.linspace(-7, 7, 1501), indexing="ij")
    prior = norm.pdf(px, 3, 1) * norm.pdf(py, 2, np.sqrt(0.5))
    score = (values[0] - np.hypot(px, py)) / np.sqrt(0.05)
    given = norm.cdf((values[1] - px * py / 4 - 0.2 * np.sqrt(0.05) * score) / np.sqrt(0.02 - 0.01**2 / 0.05))
    second = prior * norm.pdf(score)
    expected = np.sum(prior * norm.cdf(score)) / prior.sum(), np.sum(second * given) / second.sum()
    np.testing.assert_allclose(found, expected, atol=1.5e-3)
    assert np.array_equal(found, filtered.residuals(seed=3)[0])
    predicted = filtered.predict_observations()
    np.testing.assert_allclose(predicted.quantile(found[0])[0, 0], values[0], atol=1e-9)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_residuals_of_two_methods_agree_in_two_states(kind):
    model = zakai.Model(
        state=["x", "y"], drift=["-x/5 + y/2", "-y/3"], observation=["x*sin(x)", "x*cos(x)"], observation_kind=kind,
        observation_noise=[["1", "0"], ["0", "1"]], prior={"kind": "gaussian", "mean": [0.5, 0], "cov": [[1, 0], [0, 1]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 6), seed=5)
    first, second = (zakai.filter(model, record, method).residuals() for method in ("general-direct", "yau-yau"))
    np.testing.assert_allclose(first, second, atol=3e-3)


def test_the_record_is_not_filtered_again_where_densities_were_kept(monkeypatch):
    model = zakai.Model(
        state=["x", "y"], drift=["y", "x - x**3 - y"], diffusion=[["0.3", "0"], ["0", "0.5"]], observation=["x", "y + x**2"],
        observation_noise=[["0.1", "0"], ["0", "0.2"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [0.3, 0.3]},
    )  # fmt: skip
    _, record = zakai.simulate(model, np.arange(1, 6) * 0.2, seed=3)
    expected = zakai.filter(model, record, "yau-yau", keep="moments").residuals()

    def filtered(*_, **__):
        raise AssertionError("the record was filtered again")

    monkeypatch.setattr("zakai.diagnostics.residuals.segments", filtered)
    assert np.array_equal(zakai.filter(model, record, "yau-yau").residuals(), expected)
