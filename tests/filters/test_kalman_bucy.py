"""The Kalman-Bucy filter against equations that are integrated without it, where numbers are extreme, and for other priors."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from filters.test_exact_laws import assert_agrees, kalman_bucy


def linear_model(n, m, rng, rank, prior):
    """A random time-varying linear system whose noise has this rank: (model, L, l, G, C, S)."""
    A, B = np.round(rng.standard_normal((2, n, n)) / 3, 4)
    b, g, C = (np.round(rng.standard_normal(s), 4) for s in (n, (n, rank), (m, n)))
    S = np.eye(m) + 0.2
    state = [f"x{i}" for i in range(n)]

    def form(row, other=None):
        second = "" if other is None else " + cos(t)*(" + " + ".join(f"({c})*{x}" for c, x in zip(other, state)) + ")"
        return " + ".join(f"({c})*{x}" for c, x in zip(row, state)) + second

    model = zakai.Model(
        state=state,
        drift=[form(A[i], B[i]) + f" + ({b[i]})*sin(t)" for i in range(n)],
        diffusion=[[str(v) for v in row] for row in g],
        observation=[form(row) for row in C],
        observation_noise=[[str(v) for v in row] for row in S],
        prior=prior,
    )
    return model, lambda t: A + np.cos(t) * B, lambda t: b * np.sin(t), lambda t: g @ g.T, C, S


@pytest.mark.parametrize("n", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 10))])
def test_it_agrees_with_the_equations_of_kalman_and_bucy(n):
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n))
    mean, cov = rng.standard_normal(n), root @ root.T + 0.1 * np.eye(n)
    parts = linear_model(n, 2, rng, max(1, n - 1), {"kind": "gaussian", "mean": mean, "cov": cov})
    times = np.cumsum(rng.uniform(0.02, 0.2, 8))
    dy = 0.3 * rng.standard_normal((8, 2))
    dy[2, 0] = dy[4] = np.nan
    result = zakai.filter(parts[0], zakai.Record(times, dy, "increments"))
    assert result.method == "kalman-bucy" and not result.warnings
    assert_agrees(result, kalman_bucy(times, dy, mean, cov, *parts[1:]), 1e-10)


def test_the_falling_body_whose_noise_is_singular_is_filtered():
    model = zakai.load_model("gallery:falling-body")
    times = 0.1 * np.arange(1, 11)
    dy = 0.1 * np.cos(times)[:, None] + 0.49 * times[:, None] ** 2
    result = zakai.filter(model, zakai.Record(times, dy, "increments"))
    expected = kalman_bucy(
        times,
        dy,
        np.zeros(2),
        np.eye(2),
        lambda t: np.array([[0.0, 1.0], [0.0, 0.0]]),
        lambda t: np.array([0.0, 9.81]),
        lambda t: np.diag([0.0, 1.0]),
        np.array([[1.0, 0.0]]),
        np.eye(1),
    )
    assert result.method == "kalman-bucy" and not result.warnings
    assert_agrees(result, expected, 1e-10)


def oscillator(variance, **keys):
    return zakai.Model(
        state=["x", "v"],
        drift=["v", "-x - v/5"],
        diffusion=[["0"], ["1"]],
        observation=["x"],
        prior={"kind": "gaussian", "mean": [0.3, -0.2], "cov": [variance, variance]},
        **keys,
    )


@pytest.mark.parametrize("variance", [0.0, 1e-8, 1e8])
@pytest.mark.parametrize("step", [1e-6, 10.0])
def test_extreme_variances_and_steps_keep_a_covariance_and_the_right_limits(variance, step):
    times = step * np.arange(1, 21)
    dy = step * np.cos(0.7 * np.arange(20))[:, None]
    result = zakai.filter(oscillator(variance), zakai.Record(times, dy, "increments"))
    assert np.isfinite(result.mean).all() and np.isfinite(result.log_likelihood)
    for k in range(1, 21):
        assert np.linalg.eigvalsh(result.cov[k])[0] >= 0
    if step == 10.0:
        # The algebraic Riccati equation does not know the prior.
        P, A = result.cov[-1], np.array([[0.0, 1.0], [-1.0, -0.2]])
        residual = A @ P + P @ A.T + np.diag([0.0, 1.0]) - np.outer(P[:, 0], P[:, 0])
        assert np.abs(residual).max() <= 1e-9
    elif variance == 1e8:
        # x was all but unknown: what is known of it is its mean increment, with the variance of that.
        assert result.cov[-1, 0, 0] == pytest.approx(1 / times[-1], rel=2e-3)
    else:
        assert result.mean[-1] == pytest.approx([0.3, -0.2], abs=1e-4)


def test_a_mixture_is_filtered_component_by_component():
    weights, means, variances = [0.3, 0.7], [[-1.0, 0.0], [1.0, 0.5]], [0.5, 0.2]
    times, dy = np.array([0.1, 0.4, 0.5]), np.array([[0.1], [-0.2], [np.nan]])
    record = zakai.Record(times, dy, "increments")

    def prior(rows):
        keep = np.array(weights)[rows]
        covs = [[variances[i], variances[i]] for i in rows]
        return {"kind": "mixture", "weights": keep / keep.sum(), "means": [means[i] for i in rows], "covs": covs}

    model = oscillator(1.0)
    keys = {"state": ["x", "v"], "drift": ["v", "-x - v/5"], "diffusion": [["0"], ["1"]], "observation": ["x"]}
    both, *alone = (zakai.filter(zakai.Model(**keys, prior=prior(rows)), record) for rows in ([0, 1], [0], [1]))
    evidence = np.array([one.log_likelihood for one in alone]) + np.log(weights)
    share = np.exp(evidence - np.logaddexp.reduce(evidence))
    assert both.log_likelihood == pytest.approx(np.logaddexp.reduce(evidence), abs=1e-12)
    assert both.mean[-1] == pytest.approx(share @ [one.mean[-1] for one in alone], abs=1e-12)
    assert model.n == 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["increments", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("path", "samples"))])
def test_a_prior_density_and_every_kind_of_record_agree_with_the_lattice(kind):
    model = zakai.Model(
        state=["x"],
        drift=["sin(t) - x/2"],
        observation=["2*x + t"],
        observation_kind=kind,
        observation_noise=[["1/2"]],
        prior={"kind": "density", "log_density": "-(x**2 - 1)**2"},
    )
    times = np.array([0.05, 0.2, 0.3, 0.7, 0.75])
    values = np.array([[0.2], [np.nan], [0.3], [0.8], [0.7]])
    if kind == "samples":
        times = times - 0.05
    record = zakai.Record(times, values, kind)
    exact, lattice = (zakai.filter(model, record, method) for method in ("auto", "limited-direct"))
    assert exact.method == "kalman-bucy"
    # A path's increment across a gap acts as one fact in both methods, and both say so; nothing else is to be said.
    assert ["read after a gap" in text for text in exact.warnings] == ([True] if kind == "path" else [])
    assert exact.mean == pytest.approx(lattice.mean, abs=1e-9)
    assert exact.cov == pytest.approx(lattice.cov, abs=1e-9)
    assert exact.log_likelihood == pytest.approx(lattice.log_likelihood, abs=1e-9)
    x = np.linspace(-2, 2, 41)
    assert np.exp(exact.density(0).log_density(x)) == pytest.approx(np.exp(lattice.density(0).log_density(x)), abs=1e-9)
    assert np.exp(exact.density(-1).log_density(x)) == pytest.approx(np.exp(lattice.density(-1).log_density(x)), abs=1e-9)


@pytest.mark.slow
def test_a_prior_that_no_nodes_resolve_is_said():
    model = zakai.Model(
        state=["x"],
        drift=["-x"],
        observation=["x"],
        prior={"kind": "density", "log_density": "-abs(x)"},
    )
    result = zakai.filter(model, zakai.Record([0.1], [[0.0]], "increments"))
    assert result.method != "kalman-bucy" or any("representation_error" in warning for warning in result.warnings)
