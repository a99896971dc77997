"""The Kalman-Bucy filter against equations that are integrated without it, where numbers are extreme, and for other priors."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.convention import within_convention
from references.kalman_bucy import assert_agrees, kalman_bucy
from zakai.methods.gaussian.kalman_bucy import METHOD
from zakai.records.schedule import schedule_of


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


@pytest.mark.parametrize("n", [1, 2, 3, 10])
def test_it_agrees_with_the_equations_of_kalman_and_bucy(n):
    rng = np.random.default_rng(n)
    root = rng.standard_normal((n, n))
    mean, cov = rng.standard_normal(n), root @ root.T + 0.1 * np.eye(n)
    parts = linear_model(n, 2, rng, max(1, n - 1), {"kind": "gaussian", "mean": mean, "cov": cov})
    times = np.cumsum(rng.uniform(0.02, 0.2, 8))
    dy = 0.3 * rng.standard_normal((8, 2))
    dy[2, 0] = dy[4] = np.nan
    result = zakai.filter(parts[0], zakai.Record(times, dy, "increments"))
    assert result.method == "kalman-bucy" and not within_convention(result.warnings)
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


@pytest.mark.parametrize("kind", ["increments", "path", "samples"])
def test_a_prior_density_and_every_kind_of_record_agree_with_the_grid(kind):
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
    exact, grid = (zakai.filter(model, record, method) for method in ("auto", "limited-direct"))
    assert exact.method == "kalman-bucy"
    # A path's increment across a gap acts as one factor in both methods, and both warn of it.
    assert ["after a gap" in text for text in exact.warnings] == ([True] if kind == "path" else [])
    assert exact.mean == pytest.approx(grid.mean, abs=1e-9)
    assert exact.cov == pytest.approx(grid.cov, abs=1e-9)
    assert exact.log_likelihood == pytest.approx(grid.log_likelihood, abs=1e-9)
    x = np.linspace(-2, 2, 41)
    assert np.exp(exact.density(0).log_density(x)) == pytest.approx(np.exp(grid.density(0).log_density(x)), abs=1e-9)
    assert np.exp(exact.density(-1).log_density(x)) == pytest.approx(np.exp(grid.density(-1).log_density(x)), abs=1e-9)


def test_a_prior_that_no_nodes_resolve_is_said():
    model = zakai.Model(
        state=["x"],
        drift=["-x"],
        observation=["x"],
        prior={"kind": "density", "log_density": "-abs(x)"},
    )
    result = zakai.filter(model, zakai.Record([0.1], [[0.0]], "increments"))
    assert result.method != "kalman-bucy" or any("representation_error" in warning for warning in result.warnings)


VARYING = {
    "state": ["x", "y"],
    "drift": ["-x*(1 + cos(3*t)/2) + y", "-y + sin(40*t)"],
    "observation": ["x + t", "x - y"],
    "observation_noise": [["1 + 9/10*sin(50*t)", "sin(t)/10"], ["sin(t)/10", "2"]],
    "process_noise": [["1", "0"], ["0", "0"]],
    "prior": {"kind": "gaussian", "mean": [1.0, 2.0], "cov": [1.0, 0.0]},
}


def record_with_gaps(kind, seed=0):
    """Irregular times over four decades, and a third of the coordinates unobserved."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(np.exp(rng.uniform(np.log(1e-4), 0.0, 24)))
    values = rng.standard_normal((24, 2))
    values[rng.random((24, 2)) < 0.3] = np.nan
    return zakai.Record(times, values, kind)


@pytest.mark.parametrize("drift", [VARYING["drift"], ["-x + y", "-y"]])
@pytest.mark.parametrize("kind", ["increments", "path", "rates", "samples"])
def test_what_is_prepared_for_an_interval_does_not_depend_on_the_others(kind, drift):
    noise = VARYING["observation_noise"] if drift is VARYING["drift"] else [["1", "0"], ["0", "2"]]
    observation = VARYING["observation"] if drift is VARYING["drift"] else ["x", "x - y"]
    keys = {**VARYING, "drift": drift, "observation_noise": noise, "observation": observation}
    model = zakai.Model(**keys, observation_kind=kind)
    schedule, values = schedule_of(model, record_with_gaps(kind))
    whole = METHOD.prepare(model, schedule, model.theta())
    state = METHOD.init(whole, model.prior)
    for k in range(len(schedule)):
        alone = METHOD.prepare(model, schedule.part(slice(k, k + 1)), model.theta())
        first, second = METHOD.step(whole, k, state, values[k]), METHOD.step(alone, 0, state, values[k])
        assert all(np.array_equal(a, b) for a, b in zip(first[0], second[0], strict=True))
        assert first[1].log_likelihood_increment == second[1].log_likelihood_increment
        state = first[0]


@pytest.mark.parametrize("kind", ["increments", "samples"])
def test_the_log_likelihood_has_the_gradient_of_differences(kind):
    keys = {**VARYING, "drift": ["-a*x*(1 + cos(3*t)/2) + y", "-y + sin(b*t)"], "observation": ["a*x + t", "x - b*y"]}
    keys["observation_noise"] = [["c + 9/10*sin(50*t)", "sin(t)/10"], ["sin(t)/10", "2*c"]]
    model = zakai.Model(**keys, observation_kind=kind, parameters={"a": 0.9, "b": 1.3, "c": 1.1})
    likelihood, theta = zakai.log_likelihood(model, record_with_gaps(kind), "kalman-bucy"), model.theta()
    value, gradient = likelihood.value_and_gradient(theta)
    assert value == pytest.approx(zakai.filter(model, record_with_gaps(kind), "kalman-bucy").log_likelihood, rel=1e-12)
    for i in range(3):
        above, below = (float(likelihood(theta + shift * np.eye(3)[i])) for shift in (1e-5, -1e-5))
        assert gradient[i] == pytest.approx((above - below) / 2e-5, rel=1e-6, abs=1e-6)


def scaled(unit, clock, offset, kind):
    """A system in which x is measured in units of 1/unit from -offset, and t in units of 1/clock."""
    x = f"(x/{unit!r} - {offset!r})"
    model = zakai.Model(
        state=["x"],
        drift=[f"{unit / clock!r}*(1/3 - {x})"],
        process_noise=[[repr(unit**2 / clock)]],
        observation=[f"{(1.0 if kind == 'samples' else 1 / clock)!r}*2*{x}"],
        observation_noise=[[repr(0.5 if kind == "samples" else 0.5 / clock)]],
        observation_kind=kind,
        prior={"kind": "gaussian", "mean": [unit * (0.3 + offset)], "cov": [[0.7 * unit**2]]},
    )
    times = clock * np.array([0.1, 0.35, 0.4, 2.0])
    result = zakai.filter(model, zakai.Record(times, [[0.3], [np.nan], [-0.4], [1.1]], kind), "kalman-bucy")
    return result.mean[:, 0] / unit - offset, np.sqrt(result.variance[:, 0]) / unit, result.log_likelihood


@pytest.mark.parametrize("kind", ["increments", "samples"])
@pytest.mark.parametrize(
    ("unit", "clock", "offset"), [(2.0**20, 1.0, 0.0), (2.0**-20, 1.0, 0.0), (1.0, 1024.0, 0.0), (1.0, 1.0, 1e6)]
)
def test_units_change_the_answer_by_rounding_only(unit, clock, offset, kind):
    expected, found = scaled(1.0, 1.0, 0.0, kind), scaled(unit, clock, offset, kind)
    tolerance = 1e-8 if offset else 1e-11
    for a, b in zip(found, expected, strict=True):
        assert a == pytest.approx(b, abs=tolerance)


@pytest.mark.parametrize("noise", ["1/10000", "1/10**8", "1/10**12"])
@pytest.mark.parametrize("variance", [0.0, 1e4])
def test_sharp_samples_on_a_wide_or_known_prior(noise, variance):
    model = oscillator(variance, observation_kind="samples", observation_noise=[[noise]])
    result = zakai.filter(model, zakai.Record([0.0, 0.1, 0.25], [[0.7], [0.6], [np.nan]], "samples"), "kalman-bucy")
    assert np.isfinite(result.mean).all()
    # A known state is .4 from the first sample.
    assert len(result.warnings) == (variance == 0.0) and all("cannot be explained" in line for line in result.warnings)
    r = {"1/10000": 1e-4, "1/10**8": 1e-8, "1/10**12": 1e-12}[noise]
    assert result.variance[1, 0] == pytest.approx(variance * r / (variance + r), rel=1e-9)
    assert result.log_likelihood_increments[1] == pytest.approx(
        -0.5 * 0.16 / (variance + r) - 0.5 * np.log(2 * np.pi * (variance + r)), rel=1e-9
    )


def test_an_interval_of_any_length_leaves_the_stationary_law():
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], prior={"kind": "gaussian", "mean": [3.0], "cov": [[2.0]]}
    )
    for length in (40.0, 1e4, 1e9):
        result = zakai.filter(model, zakai.Record([length], [[np.nan]], "increments"), "kalman-bucy")
        assert result.mean[1, 0] == pytest.approx(0.0, abs=1e-12) and result.variance[1, 0] == pytest.approx(0.5, rel=1e-12)
        observed = zakai.filter(model, zakai.Record([length], [[0.5 * length]], "increments"), "kalman-bucy")
        # P' = 0 = -2 P + 1 - P^2, and dm/dt = 0 = -m + P (1/2 - m).
        P = np.sqrt(2) - 1
        assert observed.variance[1, 0] == pytest.approx(P, rel=1e-12)
        assert observed.mean[1, 0] == pytest.approx(P / 2 / (1 + P), rel=1e-12)
