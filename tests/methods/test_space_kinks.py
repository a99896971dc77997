"""Two states whose sensors have kinks or jumps, against sums over a fine grid."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import expm

import zakai

AXIS = np.linspace(-3, 3, 41)
TERRAIN = np.sin(AXIS)[:, None] + 0.3 * AXIS**2 + 0.2 * np.cos(2 * AXIS[:, None] * AXIS)


def oscillator(observation, **keys):
    return zakai.Model(
        state=["x", "y"], drift=["y", "-x - 0.3*y"], diffusion=[["0.3", "0"], ["0", "0.4"]], observation=[observation],
        observation_noise=[["0.05"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.3, 0.2], "cov": [0.3, 0.3]}, **keys,
    )  # fmt: skip


def moments(h, value, time):
    """Means and deviations after one observation: the prediction is Gaussian."""
    A, G = np.array([[0.0, 1.0], [-1.0, -0.3]]), np.diag([0.09, 0.16])
    both = expm(time * np.block([[A, G], [np.zeros((2, 2)), -A.T]]))
    root = np.linalg.cholesky(both[:2, :2] @ (0.3 * np.eye(2)) @ both[:2, :2].T + both[:2, 2:] @ both[:2, :2].T)
    u, v = np.meshgrid(*[np.linspace(-7, 7, 3001)] * 2, indexing="ij")
    x, y = (both[:2, :2] @ [0.3, 0.2])[:, None, None] + np.stack([root[0, 0] * u, root[1, 0] * u + root[1, 1] * v])
    weights = np.exp(-0.5 * (u**2 + v**2) - 0.5 * (value - h(x, y)) ** 2 / 0.05)
    weights /= weights.sum()
    mean = np.array([(weights * x).sum(), (weights * y).sum()])
    return mean, np.sqrt(np.array([(weights * x**2).sum(), (weights * y**2).sum()]) - mean**2)


@pytest.mark.parametrize("value", [0.8, 1.4, -0.6])
@pytest.mark.parametrize("sensor", ["terrain", "abs", "steps"])
def test_the_estimate_counts_kinks_between_the_points_of_a_grid(sensor, value):
    if sensor == "terrain":
        table = {"x": AXIS.tolist(), "y": AXIS.tolist(), "values": TERRAIN.tolist(), "kind": "linear"}
        model, linear = oscillator("d(x, y)", tables={"d": table}), RegularGridInterpolator((AXIS, AXIS), TERRAIN)
        h = lambda x, y: linear(np.clip(np.stack([x, y], axis=-1), -3, 3))  # noqa: E731
    elif sensor == "abs":
        model, h = oscillator("abs(x - 0.3*y) + abs(y)"), lambda x, y: np.abs(x - 0.3 * y) + np.abs(y)
    else:
        model, h = oscillator("floor(2*x + y)/2"), lambda x, y: np.floor(2 * x + y) / 2
    result = zakai.filter(model, zakai.Record([0.2], [value], "samples"), "yau-yau")
    mean, deviations = moments(h, value, 0.2)
    apart = (result.mean[1] - mean) / deviations, np.sqrt(result.variance[1]) / deviations - 1
    error = np.abs(apart).max()
    assert error < 3 * result.error_estimate[1] + 1e-4
    assert error < 1e-3 or result.warnings


def test_densities_are_smooth_again_after_the_noise_of_an_interval():
    table = {"x": AXIS.tolist(), "y": AXIS.tolist(), "values": TERRAIN.tolist(), "kind": "linear"}
    model = oscillator("d(x, y)", tables={"d": table})
    values = [0.9, 0.6, 1.0, 0.5, 0.3, 0.8, 0.2, 0.1, 0.4, 0.6]
    result = zakai.filter(model, zakai.Record(0.2 * np.arange(1, 11), values, "samples"), "yau-yau")
    assert np.median([result.density(k).log_values.size for k in range(1, 11)]) < 70_000
    assert result.forecast([2.4]).density(1).log_values.size < 5_000
