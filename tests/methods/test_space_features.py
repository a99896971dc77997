"""Grids in two states for models beyond f(x, t), g(t), h(x, t) and Gaussian noise, against Bayes' rule on a dense grid."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.special import gammaln
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student

import zakai
from zakai.errors import ConditionError

F, G = np.array([[-0.5, 0.5], [0.0, -1.0]]), np.array([[0.3, 0.1], [0.1, 0.4]])
MEAN, COV = np.array([0.3, 0.1]), np.array([[0.5, 0.1], [0.1, 0.5]])
LINEAR = {
    "state": ["x", "y"], "drift": ["-0.5*x + 0.5*y", "-y"], "process_noise": G.tolist(), "observation_kind": "samples",
    "prior": {"kind": "gaussian", "mean": MEAN.tolist(), "cov": COV.tolist()},
}  # fmt: skip
TIMES = np.array([0.2, 0.9, 1.0, 1.6])


def grid_of(size, reach=5.0):
    """Return points (size^2, 2), none of them on an axis, and the area of each."""
    deviation = np.sqrt(np.maximum(np.diagonal(COV), np.diagonal(solve_continuous_lyapunov(F, -G))))
    axes = [np.linspace(-reach, reach, size) * d + 0.5 * reach * d / size for d in deviation]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), np.prod([axis[1] - axis[0] for axis in axes])


@lru_cache(maxsize=4)
def transition(tau, size):
    """Return the transition densities of the linear system between the points of a grid, times the area of a point."""
    x, area = grid_of(size)
    blocks = expm(np.block([[-F, G], [np.zeros((2, 2)), F.T]]) * tau)
    A = blocks[2:, 2:].T
    root = np.linalg.cholesky(A @ blocks[:2, 2:])
    to, frm = np.linalg.solve(root, x.T), np.linalg.solve(root, A @ x.T)
    apart = (to**2).sum(0)[:, None] + (frm**2).sum(0) - 2 * to.T @ frm
    return np.exp(-0.5 * apart) * area / (2 * np.pi * np.linalg.det(root))


def dense(values, log_density, size):
    """Bayes' rule on a fixed grid for the linear system: means, variances, and increments of the log-likelihood."""
    x, area = grid_of(size)
    u, time, out = multivariate_normal(MEAN, COV).pdf(x) * area, 0.0, []
    for stop, z in zip(TIMES, values, strict=True):
        u, time = transition(round(stop - time, 9), size) @ u, stop
        u = u * np.exp(log_density(z, x))
        mass, u = u.sum(), u / u.sum()
        mean = u @ x
        out.append((mean, u @ (x - mean) ** 2, np.log(mass)))
    return out


def check(keys, values, log_density, bound=1e-3, warns=False, compares=True, size=45):
    """Compare `yau-yau` with the dense grid, which is of order two where a factor has a kink; return its result."""
    record = zakai.Record(TIMES, np.asarray(values, float)[:, None], "samples")
    result = zakai.filter(zakai.Model(**{**LINEAR, **keys}), record, "yau-yau")
    assert bool(result.warnings) == warns
    expected = dense(values, log_density, size)
    error = max(
        max(
            np.abs((result.mean[k + 1] - mean) / np.sqrt(variance)).max(),
            np.abs(result.variance[k + 1] / variance - 1).max(),
            abs(result.log_likelihood_increments[k + 1] - logs),
        )
        for k, (mean, variance, logs) in enumerate(expected)
    )
    assert error < bound
    if compares and not warns:
        assert error < 10 * np.nanmax(result.health["error_estimate"])
    return result


def logistic(z, x):
    p = 1 / (1 + np.exp(-2 * x[:, 0] - x[:, 1]))
    return np.log(p if z == 1 else 1 - p)


def von_mises(z, x):
    return 5 * np.cos(z - x[:, 0]) - np.log(2 * np.pi * np.i0(5.0))


FAMILIES = {
    "poisson": (
        {"observation": ["exp(x)"], "observation_family": "poisson"}, [1, 0, 3, 2],
        lambda z, x: z * x[:, 0] - np.exp(x[:, 0]) - gammaln(z + 1),
    ),
    "bernoulli": ({"observation": ["1/(1 + exp(-2*x - y))"], "observation_family": "bernoulli"}, [1, 0, 0, 1], logistic),
    "student-t": (
        {
            "observation": ["x + y"], "observation_family": "student-t", "degrees_of_freedom": "4",
            "observation_noise": [["0.1"]],
        },
        [0.5, 0.2, 6.0, -0.4], lambda z, x: student.logpdf(z, 4, x.sum(axis=1), np.sqrt(0.1)),
    ),
    "von-mises": (
        {"observation": ["x"], "observation_family": "von-mises", "concentration": "5"}, [0.5, -0.2, 0.9, 2.5], von_mises,
    ),
    "noise that depends on the state": (
        {"observation": ["x"], "observation_noise": [["0.1 + 0.1*y**2"]]}, [0.5, -0.4, 0.9, 0.2],
        lambda z, x: norm.logpdf(z, x[:, 0], np.sqrt(0.1 + 0.1 * x[:, 1] ** 2)),
    ),
    "log density": (
        {"observation_log_density": "-z - x - exp(-z - x)", "observed": ["z"]}, [0.5, -0.4, 0.9, 0.2],
        lambda z, x: -z - x[:, 0] - np.exp(-z - x[:, 0]),
    ),
    "sinc": (
        {"observation": ["sinc(2*x) + y"], "observation_noise": [["0.1"]]}, [0.5, -0.4, 0.9, 0.2],
        lambda z, x: norm.logpdf(z, np.sinc(2 * x[:, 0] / np.pi) + x[:, 1], np.sqrt(0.1)),
    ),
    "cubic table": (
        {
            "observation": ["depth(x)"], "observation_noise": [["0.1"]],
            "tables": {"depth": {"kind": "cubic", "x": [-6, -2, 2, 6], "values": [-216, -8, 8, 216]}},
        },
        [0.5, -0.4, 0.9, 0.2], lambda z, x: norm.logpdf(z, x[:, 0] ** 3, np.sqrt(0.1)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAMILIES)
def test_every_law_of_an_observation_follows_bayes_rule(name):
    check(*FAMILIES[name])


def test_a_kink_in_an_observation():
    keys = {"observation": ["max(x, y)"], "observation_noise": [["0.1"]]}
    check(keys, [0.5, 0.4, 0.9, 0.2], lambda z, x: norm.logpdf(z, x.max(axis=1), np.sqrt(0.1)), 3e-3, compares=False, size=61)


def test_a_jump_in_an_observation_warns():
    keys = {"observation": ["heaviside(x)"], "observation_noise": [["0.1"]]}
    check(keys, [0.5, 1.4, 0.9, 0.2], lambda z, x: norm.logpdf(z, x[:, 0] > 0, np.sqrt(0.1)), bound=0.05, warns=True, size=61)


def test_mass_outside_of_a_table_and_mass_without_a_law_warn():
    narrow = {"depth": {"kind": "linear", "x": [-0.5, 0.5], "values": [-0.5, 0.5]}}
    keys = {"observation": ["depth(x)"], "observation_noise": [["0.1"]], "tables": narrow}
    law = lambda z, x: norm.logpdf(z, np.clip(x[:, 0], -0.5, 0.5), 0.1**0.5)  # noqa: E731
    clipped = check(keys, [0.5, -0.4, 0.9, 0.2], law, 3e-3, True, size=61)
    assert 0.05 < np.nanmax(clipped.health["outside_tables"]) < 1
    record = zakai.Record([0.2], [[1.0]], "samples")
    model = zakai.Model(**LINEAR, observation=["x + 2"], observation_family="poisson")
    result = zakai.filter(model, record, "yau-yau")
    assert any("without_law" in warning for warning in result.warnings)
    assert np.nanmax(result.health["without_law"]) == pytest.approx(norm.cdf(-2.16 / 0.71), rel=0.5)


def test_the_mass_outside_of_a_table_in_the_drift_is_counted_on_the_grid_of_the_result():
    restoring = {"pull": {"kind": "linear", "x": [-3, -1, 0, 1, 3], "values": [3, 1, 0, -1, -3]}}
    keys = {"state": ["x", "v"], "drift": ["v", "pull(x) - v"], "diffusion": [["0"], ["1"]], "tables": restoring}
    model = zakai.Model(
        **keys, observation=["x"], observation_noise=[["0.1"]], prior={"kind": "gaussian", "mean": [0, 0], "cov": [0.5, 0.5]}
    )
    truth, record = zakai.simulate(model, 0.1 * np.arange(1, 9), seed=3)
    health = zakai.filter(model, record, "yau-yau").health["outside_tables"][1:]
    assert (0 <= health).all() and (health < 1e-2).all()


def test_a_drift_that_jumps_is_refused():
    model = zakai.Model(**{**LINEAR, "drift": ["-sign(x)", "-y"]}, observation=["x"])
    record = zakai.Record([0.2], [[1.0]], "samples")
    with pytest.raises(ConditionError, match=r"do not jump[^\0]*write tanh\(x/w\) for sign\(x\)"):
        zakai.filter(model, record, "yau-yau")


def test_a_drift_of_one_state_that_jumps_is_refused_where_no_noise_spreads_the_point_that_it_makes():
    keys = {**LINEAR, "state": ["x"], "drift": ["-sign(x)"], "observation": ["x"], "observation_noise": [["0.1"]]}
    keys["observation_kind"] = "increments"
    keys |= {"diffusion": [["0"]], "process_noise": [["1"]], "prior": {"kind": "gaussian", "mean": [1.0], "cov": [[0.2]]}}
    assert zakai.online(zakai.Model(**keys)).method == "guided-particles"
    with pytest.raises(ConditionError, match="do not jump .*there is no noise"):
        zakai.online(zakai.Model(**keys), "yau-yau")
    assert zakai.online(zakai.Model(**{**keys, "diffusion": [["1/10"]]})).method == "yau-yau"


def test_the_advice_for_a_drift_that_jumps_converges():
    """In one state the jump itself is filtered, to an error of the grid."""
    keys = {**LINEAR, "state": ["x"], "process_noise": [["0.3"]], "prior": {"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]}}
    keys |= {"observation": ["x"], "observation_noise": [["0.1"]]}
    record = zakai.Record(TIMES, [[0.5], [-0.4], [0.9], [0.2]], "samples")
    exact = zakai.filter(zakai.Model(**{**keys, "drift": ["-sign(x)"]}), record, "yau-yau")
    added = {"state": ["x", "y"], "process_noise": [["0.3", "0"], ["0", "0.4"]]}
    added["prior"] = {"kind": "gaussian", "mean": [0.3, 0.1], "cov": [0.5, 0.5]}
    errors = []
    for width in (0.1, 0.05):
        model = zakai.Model(**{**keys, **added, "drift": [f"-tanh(x/{width})", "-y + x"]})
        away = zakai.filter(model, record, "yau-yau").mean[:, 0] - exact.mean[:, 0]
        errors.append(np.abs(away / np.sqrt(exact.variance[:, 0])).max())
    assert errors[1] < 0.35 * errors[0] < 0.03


def kalman(record, inputs):
    """Kalman's equations with a constant input in every hundredth, which divides the times of the inputs."""
    mean, cov, time, out = MEAN.copy(), COV.copy(), 0.0, []
    A = expm(F * 0.01)
    Q = sum(expm(F * s) @ G @ expm(F.T * s) for s in (np.arange(10) + 0.5) * 0.001) * 0.001
    for stop, z in zip(record.times, record.values[:, 0], strict=True):
        for i in range(round((stop - time) / 0.01)):
            u = inputs(time + 0.01 * (i + 0.5))
            mean = A @ mean + np.linalg.solve(F, (A - np.eye(2)) @ np.array([u, 0.0]))
            cov = A @ cov @ A.T + Q
        time, s = stop, cov[0, 0] + 0.1
        residual, gain = z - mean[0], cov[:, 0] / s
        mean, cov = mean + gain * residual, cov - np.outer(gain, cov[0])
        out.append((mean, np.diagonal(cov), norm.logpdf(residual, 0, np.sqrt(s))))
    return out


def test_inputs_that_change_inside_of_intervals():
    model = zakai.Model(
        **{**LINEAR, "drift": ["-0.5*x + 0.5*y + u", "-y"], "inputs": ["u"]}, observation=["x"], observation_noise=[["0.1"]]
    )
    record = zakai.Record(TIMES, [[0.5], [1.4], [0.9], [0.2]], "samples", inputs=zakai.Inputs([0.0, 0.5, 1.3], [1.0, -3.0, 6.0]))
    result = zakai.filter(model, record, "yau-yau")
    expected = kalman(record, lambda t: 1.0 if t < 0.5 else -3.0 if t < 1.3 else 6.0)
    for k, (mean, variance, logs) in enumerate(expected):
        assert np.abs((result.mean[k + 1] - mean) / np.sqrt(variance)).max() < 1e-3
        assert np.abs(result.variance[k + 1] / variance - 1).max() < 1e-3
        assert abs(result.log_likelihood_increments[k + 1] - logs) < 1e-3


def test_an_input_is_the_same_as_its_formula_in_time():
    keys = {"state": ["x", "y"], "process_noise": G.tolist(), "prior": LINEAR["prior"], "observation_kind": "increments"}
    record = zakai.Record(TIMES, [[0.1], [0.4], [0.1], [-0.3]], "increments")
    formula = zakai.Model(**keys, drift=["sin(y) - x*(1 + t)", "-y"], observation=["x*(1 + t)"])
    model = zakai.Model(**keys, drift=["sin(y) - x*u", "-y"], observation=["x*u"], inputs=["u"], input_hold="linear")
    given = zakai.Record(record.times, record.values, "increments", inputs=zakai.Inputs([0.0, 0.4, 2.0], [1.0, 1.4, 3.0]))
    one, two = (zakai.filter(m, r, "yau-yau", tolerance=1e-4) for m, r in ((formula, record), (model, given)))
    assert np.abs((one.mean - two.mean) / np.sqrt(one.variance)).max() < 2e-4
    assert abs(one.log_likelihood - two.log_likelihood) < 2e-4


def test_the_state_dependent_law_has_derivatives():
    keys = {**LINEAR, "drift": ["-0.5*x + 0.5*y + a*u", "-y"], "inputs": ["u"], "parameters": {"a": 0.7}}
    keys |= {"observation": ["exp(a*x)"], "observation_family": "poisson"}
    record = zakai.Record(TIMES, [[1], [0], [3], [2]], "samples", inputs=zakai.Inputs([0.0, 0.5], [1.0, -1.0]))
    model = zakai.Model(**keys)
    value, slope = zakai.log_likelihood(model, record, "yau-yau", tolerance=1e-5).value_and_gradient([0.7])
    below, above = (zakai.log_likelihood(model, record, "yau-yau", tolerance=1e-5)([0.7 + d]) for d in (-1e-3, 1e-3))
    assert below < value < above or above < value < below
    assert slope[0] == pytest.approx((above - below) / 2e-3, rel=1e-3)


def test_noise_that_depends_on_the_state_has_the_exact_moments():
    # d E x = -E x / 2 dt and d E x^2 = (-E x^2 + 0.09 (1 + E x^2)) dt
    model = zakai.Model(
        **{**LINEAR, "drift": ["-x/2", "-y"], "process_noise": [["1", "0"], ["0", "1"]]}, observation=["y"],
        diffusion=[["0.3*sqrt(1 + x**2)", "0"], ["0", "0.4"]],
    )  # fmt: skip
    times = np.array([0.2, 0.5, 1.0])
    result = zakai.filter(model, zakai.Record(times, np.full((3, 1), np.nan), "samples"), "yau-yau")
    mean = MEAN[0] * np.exp(-times / 2)
    square = (MEAN[0] ** 2 + COV[0, 0] - 0.09 / 0.91) * np.exp(-0.91 * times) + 0.09 / 0.91
    variance = square - mean**2
    means, variances = (result.mean[1:, 0] - mean) / np.sqrt(variance), result.variance[1:, 0] / variance - 1
    error = max(np.abs(means).max(), np.abs(variances).max())
    assert error < 1e-4 and error < 10 * np.nanmax(result.health["error_estimate"])
    assert not result.warnings


def test_little_mass_where_noise_has_no_value_makes_a_small_error():
    # d E x = -E x / 2 dt and d E x^2 = (-E x^2 + 0.09 E x) dt; P(x < 0) = 3e-6 at the start.
    model = zakai.Model(
        state=["x", "y"], drift=["-x/2", "x - y"], diffusion=[["0.3*sqrt(x)", "0"], ["0", "0.4"]], observation=["y"],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0.9, 0.1], "cov": [0.04, 0.5]},
    )  # fmt: skip
    times = np.array([0.2, 0.5, 1.0])
    result = zakai.filter(model, zakai.Record(times, np.full((3, 1), np.nan), "samples"), "yau-yau", tolerance=1e-4)
    mean = 0.9 * np.exp(-times / 2)
    square = (0.9**2 + 0.04) * np.exp(-times) + 0.09 * 0.9 * 2 * (np.exp(-times / 2) - np.exp(-times))
    variance = square - mean**2
    means, variances = (result.mean[1:, 0] - mean) / np.sqrt(variance), result.variance[1:, 0] / variance - 1
    error, estimate = max(np.abs(means).max(), np.abs(variances).max()), np.nanmax(result.health["error_estimate"])
    assert error < 3e-4 and error < 10 * estimate and estimate < 5e-3


def test_noise_that_depends_on_another_coordinate_agrees_with_particles():
    model = zakai.Model(
        **{**LINEAR, "drift": ["-x + y", "-y"], "process_noise": [["1", "0"], ["0", "1"]]}, observation=["x"],
        diffusion=[["0.5 + 0.3*sin(2*y)", "0.2"], ["0.3*x", "0.5"]], observation_noise=[["0.2"]],
    )  # fmt: skip
    record = zakai.Record([0.3, 0.6, 0.9], [[0.5], [1.2], [0.1]], "samples")
    result = zakai.filter(model, record, "yau-yau")
    rng, count, step = np.random.default_rng(0), 100_000, 0.01
    x = rng.multivariate_normal(MEAN, COV, count)
    for k, z in enumerate(record.values[:, 0]):
        for _ in range(30):
            v, w = np.sqrt(step) * rng.standard_normal((2, count))
            a, b = x.T
            noise = [(0.5 + 0.3 * np.sin(2 * b)) * v + 0.2 * w, 0.3 * a * v + 0.5 * w]
            x = x + np.stack([step * (b - a) + noise[0], -step * b + noise[1]], axis=1)
        weights = norm.pdf(z, x[:, 0], np.sqrt(0.2))
        assert abs(np.log(weights.mean()) - result.log_likelihood_increments[k + 1]) < 0.02
        weights = weights / weights.sum()
        mean = weights @ x
        assert np.abs(mean - result.mean[k + 1]).max() < 0.02
        apart = x - mean
        assert np.abs((apart * weights[:, None]).T @ apart - result.cov[k + 1]).max() < 0.02
        x = x[np.searchsorted(np.cumsum(weights), (np.arange(count) + rng.uniform()) / count).clip(0, count - 1)]


def test_a_fill_value_that_is_no_observation_warns():
    model = zakai.Model(
        state=["x", "y"], drift=["-x + y", "-y"], observation=["atan(x)"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.2, 0.9], [[1.0], [1e20], [2.0]], "samples")
    assert any("tail_depth" in warning for warning in zakai.filter(model, record).warnings)


def test_an_end_of_a_domain_that_two_states_cross_is_said():
    keys = {
        "state": ["c", "p"], "drift": ["-0.03", "-p"], "observation": ["c + p"], "observation_kind": "samples",
        "observation_noise": [["0.01"]], "domain": {"c": {"lower": 0.0, "upper": 1.0}},
        "prior": {"kind": "gaussian", "mean": [0.3, 0.0], "cov": [0.003, 0.01]},
    }  # fmt: skip
    record = zakai.Record(np.arange(1.0, 11.0), np.full((10, 1), 0.03), "samples")
    crossing = zakai.filter(zakai.Model(**keys, diffusion=[["0.02", "0"], ["0", "0.1"]]), record)
    assert any("cross the end 0 of 'c'" in warning for warning in crossing.warnings)
    assert not any("end 1" in warning for warning in crossing.warnings)
    keys["drift"] = ["c*(1 - c)", "-p"]
    short = zakai.Record([0.02, 0.04], [[0.3], [0.3]], "samples")
    inside = zakai.filter(zakai.Model(**keys, diffusion=[["0.1*c*(1 - c)", "0"], ["0", "0.1"]]), short)
    assert not any("cross" in warning for warning in inside.warnings)
