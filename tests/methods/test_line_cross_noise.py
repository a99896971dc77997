"""Correlated noise in one state: E dv dw' = C dt, against solutions that share no code with the package.

With y linear between observations a linear system has a Gaussian law whose mean, variance and mass obey ordinary differential
equations.  Any other system is solved by differences of eighth order with the operators M_i u = h_i u - (a_i u)', a = g C, of
the Zakai equation, multiplied as matrices.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import zakai
from methods.test_line_features import difference_matrices, error, normal
from zakai.algebra.theorems import conditions_of

TIMES = np.cumsum([0.1, 0.02, 0.15, 0.05, 0.3, 0.1])
ONE = np.array([[0.2], [-0.1], [0.3], [0.02], [-0.4], [0.15]])
TWO = np.column_stack([ONE, [0.1, 0.05, np.nan, -0.1, 0.2, np.nan]])
PRIOR = {"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]}


def filtered(values, **keys):
    model = zakai.Model(**{"state": ["x"], "prior": PRIOR, **keys})
    return model, zakai.filter(model, zakai.Record(TIMES, values, "increments"), "yau-yau")


def lengths():
    return np.diff(np.concatenate([[0.0], TIMES]))


@pytest.mark.parametrize("varying", [False, True])
def test_a_linear_system_is_that_of_its_differential_equations(varying):
    wave = "(1 + 0.5*sin(20*t))" if varying else "1"
    _, result = filtered(
        TWO, drift=["-0.7*x + 0.3"], observation=["2*x + 0.1", "-x"], diffusion=[["0.8"]], process_noise=[["1.2"]],
        observation_noise=[["0.3", "0.05"], ["0.05", "0.2"]], cross_noise=[[f"0.3*{wave}", f"-0.1*{wave}"]],
    )  # fmt: skip
    S = np.array([[0.3, 0.05], [0.05, 0.2]])
    mean, variance, rows, start = 0.2, 0.5, [], 0.0
    for stop, value in zip(TIMES, TWO, strict=True):
        seen = ~np.isnan(value)
        H, c, rate = np.array([2.0, -1.0])[seen], np.array([0.1, 0.0])[seen], value[seen] / (stop - start)
        K = np.linalg.inv(S[np.ix_(seen, seen)])

        def slope(t, state, seen=seen, H=H, c=c, rate=rate, K=K):
            m, P, _ = state
            a = 0.8 * np.array([0.3, -0.1])[seen] * (1 + 0.5 * np.sin(20 * t) if varying else 1.0)
            h = H * m + c
            gain = K @ (P * H + a)
            log = h @ K @ rate - 0.5 * h @ K @ h - 0.5 * H @ gain
            return [-0.7 * m + 0.3 + gain @ (rate - h), -1.4 * P + 0.8**2 * 1.2 - (P * H + a) @ gain, log]

        mean, variance, gained = solve_ivp(slope, (start, stop), [mean, variance, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
        rows.append((mean, variance, gained))
        start = stop
    assert error(result, np.array(rows)) < (2e-6 if varying else 1e-7)
    assert not result.warnings


def solved(x, f, G, h, a, S, values):
    """The filter by difference operators: f, G (N,), h and a (m, N)."""
    D1, D2 = difference_matrices(len(x), x[1] - x[0])
    p, rows = normal(0.2, 0.5)(x) / normal(0.2, 0.5)(x).sum(), []
    for length, value in zip(lengths(), values, strict=True):
        seen = ~np.isnan(value)
        K = np.linalg.inv(S[np.ix_(seen, seen)])
        M = [np.diag(own) - D1 * along for own, along in zip(h[seen], a[seen], strict=True)]
        A = length * (0.5 * D2 * G - D1 * f)
        for i in range(len(M)):
            A += sum(-0.5 * length * K[i, j] * M[i] @ M[j] + K[i, j] * value[seen][j] * M[i] for j in range(len(M)))
        p = expm(A) @ p
        mass = p.sum()
        p = p / mass
        mean = x @ p
        rows.append((mean, (x - mean) ** 2 @ p, np.log(mass)))
    return np.array(rows)


SYSTEMS = {
    "double well": (
        {"drift": ["x - x**3"], "observation": ["x"], "observation_noise": [["0.1"]], "cross_noise": [["0.25"]]},
        lambda x: (x - x**3, np.ones_like(x), x[None], 0.25 * np.ones((1, len(x)))),
        np.array([[0.1]]), ONE,
    ),
    "noise that depends on the state": (
        {"drift": ["-x**3"], "observation": ["x + 0.3*sin(x)"], "observation_noise": [["0.2"]], "cross_noise": [["-0.3"]],
         "diffusion": [["0.7 + 0.3*sin(x)"]]},
        lambda x: (-(x**3), (0.7 + 0.3 * np.sin(x)) ** 2, (x + 0.3 * np.sin(x))[None], -0.3 * (0.7 + 0.3 * np.sin(x))[None]),
        np.array([[0.2]]), ONE,
    ),
    "two coordinates, one missing at times": (
        {"drift": ["sin(x) - x"], "observation": ["x**3/4", "tanh(x)"], "observation_noise": [["0.3", "0.1"], ["0.1", "0.2"]],
         "cross_noise": [["0.2", "-0.3"]]},
        lambda x: (np.sin(x) - x, np.ones_like(x), np.array([x**3 / 4, np.tanh(x)]), np.outer([0.2, -0.3], np.ones(len(x)))),
        np.array([[0.3, 0.1], [0.1, 0.2]]), TWO,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_system_is_that_of_difference_operators(name):
    keys, coefficients, S, values = SYSTEMS[name]
    _, result = filtered(values, **keys)
    x = np.linspace(-5, 5, 251)
    expected = solved(x, *coefficients(x), S, values)
    assert error(result, expected) < 1e-6
    assert error(result, expected) < 10 * np.nanmax(result.health["error_estimate"])
    assert not result.warnings
    independent = zakai.filter(
        zakai.Model(**{"state": ["x"], "prior": PRIOR, **keys, "cross_noise": None}), result.record, "yau-yau"
    )
    assert error(independent, expected) > 0.05


def test_a_state_in_a_domain_is_its_logarithm_on_the_line():
    """dx = a x dt + s x dv and z = log x are the same system, where each is filtered in its own variable."""
    keys = {"observation_noise": [["0.1"]], "cross_noise": [["0.2"]]}
    prior = "-(log(x) - 0.2)**2/0.2 - log(x)"
    _, state = filtered(ONE, drift=["0.3*x"], diffusion=[["0.5*x"]], observation=["x"], domain={"x": {"lower": 0.0}},
                        prior={"kind": "density", "log_density": prior}, **keys)  # fmt: skip
    model = zakai.Model(state=["z"], drift=["0.3 - 0.125"], diffusion=[["0.5"]], observation=["exp(z)"],
                        prior={"kind": "gaussian", "mean": [0.2], "cov": [[0.1]]}, **keys)  # fmt: skip
    logarithm = zakai.filter(model, state.record, "yau-yau")
    assert np.abs(state.log_likelihood_increments - logarithm.log_likelihood_increments).max() < 1e-5
    for k in range(1, len(TIMES) + 1):
        density = logarithm.density(k)
        mean = density.weights @ np.exp(density.points[:, 0])
        assert abs(state.mean[k, 0] - mean) < 1e-5 * np.sqrt(state.variance[k, 0])


def test_simulated_increments_are_correlated_with_the_state():
    """Of dx = dv, dy = dw with C = .6 the increments of x and y have the correlation .6, and the filter explains their share."""
    model = zakai.Model(state=["x"], drift=["0"], observation=["0"], cross_noise=[["0.6"]],
                        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1e-4]]})  # fmt: skip
    truth, record = zakai.simulate(model, 0.01 * np.arange(1.0, 4001.0), seed=3)
    along = np.diff(truth.values[:, 0])
    assert np.corrcoef(along, record.values[:, 0])[0, 1] == pytest.approx(0.6, abs=0.04)
    short = zakai.Record(record.times[:40], record.values[:40], "increments")
    result = zakai.filter(model, short, "yau-yau")
    # x given y is N(.6 y, 1e-4 + .64 t).
    assert result.mean[1:, 0] == pytest.approx(0.6 * np.cumsum(short.values[:, 0]), abs=1e-5)
    assert result.variance[1:, 0] == pytest.approx(1e-4 + 0.64 * short.times, rel=1e-5)


def test_gradients_are_differences():
    model = zakai.Model(state=["x"], drift=["x - x**3"], observation=["b*x"], observation_noise=[["0.1"]],
                        cross_noise=[["c"]], parameters={"b": 1.0, "c": 0.2}, prior=PRIOR)  # fmt: skip
    record = zakai.Record([0.04, 0.05], [[0.1], [0.02]], "increments")
    likelihood = zakai.log_likelihood(model, record, method="yau-yau", tolerance=1e-7)
    _, gradient = likelihood.value_and_gradient([1.0, 0.2])
    for i, unit in enumerate(np.eye(2) * 1e-3):
        difference = (likelihood([1.0, 0.2] + unit) - likelihood([1.0, 0.2] - unit)) / 2e-3
        assert gradient[i] == pytest.approx(difference, abs=1e-5 * (1 + abs(difference)))


def test_a_gap_of_a_path_is_said():
    path = zakai.Record(TIMES[:3], [[0.1], [np.nan], [0.2]], "path")
    model = zakai.Model(state=["x"], drift=["-x**3"], observation=["x"], cross_noise=[["0.1"]], prior=PRIOR,
                        observation_kind="path")  # fmt: skip
    assert any("cross_noise is omitted" in sentence for sentence in zakai.filter(model, path, "yau-yau").warnings)


def test_the_smoother_of_a_linear_system_is_the_gaussian_one():
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], observation_noise=[["0.3"]], cross_noise=[["0.25"]],
                        prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.2]]})  # fmt: skip
    record = zakai.Record([0.05, 0.4, 1.0], [[0.1], [-0.2], [0.4]], "increments")
    grid, exact = (zakai.smooth(model, record, method) for method in ("yau-yau", "kalman-bucy"))
    np.testing.assert_allclose(grid.mean, exact.mean, rtol=0, atol=1e-6)
    np.testing.assert_allclose(grid.variance, exact.variance, rtol=0, atol=1e-6)
    assert grid.warnings == []


def test_the_smoothed_mean_at_the_start_is_what_the_evidence_says():
    # The derivative of the evidence for the mean of a prior N(mean, v) is the smoothed mean less the prior's, divided by v.
    def model(mean):
        return zakai.Model(state=["x"], drift=["x - x**3"], observation=["x + x**2/3"], observation_noise=[["0.3"]],
                           cross_noise=[["0.25"]], prior={"kind": "gaussian", "mean": [mean], "cov": [[0.2]]})  # fmt: skip

    record = zakai.Record([0.1, 0.5], [[0.1], [-0.2]], "increments")
    low, high = (zakai.filter(model(0.5 + apart), record, "yau-yau", tolerance=1e-8).log_likelihood for apart in (-0.01, 0.01))
    assert zakai.smooth(model(0.5), record, "yau-yau").mean[0, 0] == pytest.approx(0.5 + 0.2 * (high - low) / 0.02, abs=2e-5)


REFUSED = {
    "five states": (
        {"state": list("abcde"), "drift": ["-a**3", *"bcde"], "observation": ["a"], "cross_noise": [["0.1"], *[["0"]] * 4]},
        "at most four",
    ),
    "jumps": ({"observation": ["sign(x)"]}, "do not jump"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_hold_is_said_in_one_line(name):
    keys, words = REFUSED[name]
    model = zakai.Model(**{"state": ["x"], "drift": ["-x**3"], "observation": ["x"], "cross_noise": [["0.1"]], **keys})
    failed = [condition for condition in conditions_of("yau-yau", model) if condition.holds is False]
    assert len(failed) == 1 and words in failed[0].statement
