"""`limited-direct` in two states where the gauge is steep in the tails: drift with tanh of a moving direction."""

import numpy as np
import pytest

import zakai


def model_of(rate: str, observed: list[str], noise: list[list[str]]) -> zakai.Model:
    """A drift L x + G p tanh(p.x) with p = (c(t), 1) and L'p = -dp/dt, so that q is quadratic."""
    c, derivative, a = (f"(1 + {rate}*t)", rate, "(-1/5)")
    (g11, g12), (g21, g22) = noise
    tanh = f"tanh({c}*x1 + x2)"
    return zakai.Model(
        state=["x1", "x2"],
        drift=[
            f"{a}*x1 + (({g11})*{c} + ({g12}))*{tanh}",
            f"(-{derivative} - {a}*{c})*x1 + (({g21})*{c} + ({g22}))*{tanh}",
        ],
        process_noise=noise,
        observation=observed,
        observation_kind="increments",
        observation_noise=[["1/4" if i == j else "0" for j in range(len(observed))] for i in range(len(observed))],
        prior={"kind": "gaussian", "mean": [0.3, -0.2], "cov": [[0.5, 0.1], [0.1, 0.4]]},
    )


def by_particles(rate: float, rows: np.ndarray, noise: np.ndarray, record: zakai.Record, count: int) -> np.ndarray:
    """Return the posterior means (K, 2) by a bootstrap filter with Euler steps."""
    random = np.random.default_rng(5)
    x = random.multivariate_normal([0.3, -0.2], [[0.5, 0.1], [0.1, 0.4]], count)
    root, t, logs, means = np.linalg.cholesky(noise), 0.0, np.zeros(count), []
    for time, increment in zip(record.times, record.values, strict=True):
        steps = 8
        dt, share = (time - t) / steps, increment / (time - t)
        for _ in range(steps):
            h = x @ rows.T
            logs += dt * (h @ share - 0.5 * (h**2).sum(axis=1)) / 0.25
            p = np.array([1.0 + rate * t, 1.0])
            lower = np.array([[-0.2, 0.0], [-rate + 0.2 * p[0], 0.0]])
            drift = x @ lower.T + np.tanh(x @ p)[:, None] * (noise @ p)
            x = x + dt * drift + np.sqrt(dt) * random.normal(size=x.shape) @ root.T
            t += dt
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        means.append(weights @ x)
        x = x[np.searchsorted(np.cumsum(weights), (random.random() + np.arange(count)) / count).clip(max=count - 1)]
        logs = np.zeros(count)
    return np.array(means)


@pytest.mark.parametrize(
    ("observed", "rows"), [(["x1"], [[1.0, 0.0]]), (["x1", "x2 + x1/2"], [[1.0, 0.0], [0.5, 1.0]])], ids=["one", "both"]
)
def test_the_moments_are_those_of_particles(observed, rows):
    model = model_of("1/10", observed, [["2", "1/2"], ["1/2", "1"]])
    times = np.cumsum(np.random.default_rng(2).uniform(0.05, 0.15, 14))
    _, record = zakai.simulate(model, times, seed=1)
    result = zakai.filter(model, record, "limited-direct")
    assert not [warning for warning in result.warnings if "linear between" not in warning]
    reference = by_particles(0.1, np.array(rows), np.array([[2.0, 0.5], [0.5, 1.0]]), record, 20_000)
    deviations = np.sqrt(result.variance[1:])
    assert np.all(np.abs(result.mean[1:] - reference) < 0.1 * deviations)


def test_short_intervals_need_no_larger_grid():
    model = model_of("1/10", ["x1"], [["2", "1/2"], ["1/2", "1"]])
    _, record = zakai.simulate(model, 0.02 * np.arange(1, 41), seed=1)
    result = zakai.filter(model, record, "limited-direct")
    sizes = [result.density(k).log_values.size for k in range(1, 41)]
    assert max(sizes) < 30_000
    assert np.nanmax(result.health["error_estimate"]) < 1e-6
