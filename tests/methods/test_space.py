"""Density grids in two to four states against Kalman's equations, an independent solver, exact laws, and other units."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

import zakai
from references.kolmogorov import Box, filter_system, propagate
from references.systems import planar
from zakai.errors import InputError
from zakai.methods.space import direct as space_direct
from zakai.methods.space import filter as space_filter
from zakai.methods.space import kolmogorov as space_kolmogorov
from zakai.numerics.prior_grid import mixture_grid, prior_grid
from zakai.records.schedule import schedule_of

L, H = np.array([[-0.3, 1.0], [-1.0, -0.2]]), np.array([[1.0, 0.0]])


def steps(model, record, theta=None, method="yau-yau", **options):
    """The reports and states of all steps."""
    schedule, values = schedule_of(model, record)
    prepare = space_direct.prepare if method == "limited-direct" else space_kolmogorov.prepare
    prepared = prepare(model, schedule, model.theta() if theta is None else theta, **options)
    state, infos, states = space_filter.init(prepared, model.prior), [], []
    for k in range(len(schedule)):
        state, info = space_filter.step(prepared, k, state, values[k])
        infos.append(info)
        states.append(state)
    return prepared, states, infos


def kalman(record, G, S, mean, cov, L=L, H=H):
    """Means, covariances and log-likelihoods of a sampled linear system."""
    n, time, out = len(mean), 0.0, []
    for stop, z in zip(record.times, record.values, strict=True):
        blocks = expm(np.block([[-L, G], [np.zeros((n, n)), L.T]]) * (stop - time))
        A = blocks[n:, n:].T
        mean, cov, time = A @ mean, A @ cov @ A.T + A @ blocks[:n, n:], stop
        seen = ~np.isnan(z)
        logs = 0.0
        if seen.any():
            V, r = (H @ cov @ H.T + S)[np.ix_(seen, seen)], (z - H @ mean)[seen]
            gain = cov @ H[seen].T @ np.linalg.inv(V)
            logs = -0.5 * r @ np.linalg.solve(V, r) - 0.5 * np.linalg.slogdet(2 * np.pi * V)[1]
            mean, cov = mean + gain @ r, cov - gain @ H[seen] @ cov
        out.append((mean, cov, logs))
    return out


def error_of(infos, expected):
    """The largest error: means in deviations, covariances relative to them, log-likelihoods."""
    worst = 0.0
    for info, (mean, cov, logs) in zip(infos, expected, strict=True):
        deviation = np.sqrt(np.diagonal(cov))
        worst = max(
            worst,
            np.abs((info.mean - mean) / deviation).max(),
            np.abs((info.cov - cov) / np.outer(deviation, deviation)).max(),
            abs(info.log_likelihood_increment - logs),
        )
    return worst


def linear(process_noise, **keys):
    return zakai.Model(
        state=["a", "b"], drift=["-0.3*a + b", "-a - 0.2*b"], process_noise=process_noise, observation=["a"],
        observation_noise=[["0.3"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.5, 0.5], "cov": [1, 1]}, **keys,
    )  # fmt: skip


IRREGULAR = zakai.Record([0.01, 0.2, 0.2001, 0.9, 2.4, 2.5], [[0.4], [1.1], [0.7], [np.nan], [-0.6], [-0.2]], "samples")


@pytest.mark.parametrize("noise", [[["1", "0.3"], ["0.3", "0.5"]], [["0", "0"], ["0", "1"]]])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_irregular_samples_of_a_linear_system_follow_kalman(noise, tolerance):
    G = np.array(noise, float)
    _, _, infos = steps(linear(noise), IRREGULAR, tolerance=tolerance)
    error = error_of(infos, kalman(IRREGULAR, G, np.array([[0.3]]), np.array([0.5, 0.5]), np.eye(2)))
    estimate = max(info.health["error_estimate"] for info in infos)
    assert error < 2 * tolerance and error < 10 * estimate and estimate < tolerance


def test_limited_direct_is_exact_for_irregular_samples():
    G = np.array([[1.0, 0.3], [0.3, 0.5]])
    _, _, infos = steps(linear([["1", "0.3"], ["0.3", "0.5"]]), IRREGULAR, method="limited-direct")
    assert error_of(infos, kalman(IRREGULAR, G, np.array([[0.3]]), np.array([0.5, 0.5]), np.eye(2))) < 1e-9


def test_limited_direct_agrees_with_the_kolmogorov_equation():
    system, box = planar(), Box(7.0, 96, (0.0, 0.0))
    reference = filter_system(box, system)
    model = system.model("increments")
    record = zakai.Record(system.times, system.increments, "increments")
    prepared, states, _ = steps(model, record, method="limited-direct", splitting="lie")
    for state, (_, expected) in zip(states, reference, strict=True):
        expected = expected / (expected.sum() * box.cell)
        computed = np.exp(space_filter.density(prepared, state).log_density(box.x))
        assert np.abs(computed - expected).max() <= 1e-9 * expected.max()


def test_increments_of_a_nonlinear_system_agree_with_an_independent_solver():
    model = zakai.Model(
        state=["x", "y"], drift=["cos(x) + 0.5*sin(y)", "cos(y)"], observation=["x + 0.2*x**2", "x*y"],
        observation_noise=[["1", "0.2"], ["0.2", "0.5"]], prior={"kind": "gaussian", "mean": [0, 0.3], "cov": [0.2, 0.3]},
    )  # fmt: skip
    times, values = np.array([0.05, 0.3, 0.35]), np.array([[0.1, -0.2], [0.4, np.nan], [0.2, 0.3]])
    _, _, infos = steps(model, zakai.Record(times, values, "increments"))
    box, S = Box(5.5, 64, (0.0, 0.0)), np.array([[1, 0.2], [0.2, 0.5]])
    x, y = box.x[..., 0], box.x[..., 1]
    h = np.stack([x + 0.2 * x**2, x * y], axis=-1)
    u, start, expected = model.prior and np.exp(model.prior.log_density(box.x)), 0.0, []
    u = u / (u.sum() * box.cell)
    for stop, dy in zip(times, values, strict=True):
        seen = ~np.isnan(dy)
        P = np.linalg.inv(S[np.ix_(seen, seen)])
        inside = ((h[..., seen] - 2 * dy[seen] / (stop - start)) @ P * h[..., seen]).sum(axis=-1)
        u = propagate(
            box, u, start, stop, lambda z, t: np.stack([np.cos(z[..., 0]) + 0.5 * np.sin(z[..., 1]), np.cos(z[..., 1])], axis=-1),
            lambda z, t: -np.sin(z[..., 0]) - np.sin(z[..., 1]), lambda t: np.eye(2), lambda z, t, q=inside: q, 1e-8,
        )  # fmt: skip
        mass = u.sum() * box.cell
        u, start = u / mass, stop
        mean = np.array([(u * x).sum(), (u * y).sum()]) * box.cell
        apart = box.x - mean
        expected.append((mean, np.einsum("ab,abi,abj->ij", u, apart, apart) * box.cell, np.log(mass)))
    assert error_of(infos, expected) < 1e-3


def test_noise_that_oscillates_within_an_interval_is_integrated():
    keys = {
        "state": ["a", "b"], "drift": ["-a + 0.3*b", "-b"], "observation": ["a"], "observation_kind": "increments",
        "observation_noise": [["1 + 0.9*sin(50*t)"]], "prior": {"kind": "gaussian", "mean": [0.5, 0], "cov": [1, 0.5]},
    }  # fmt: skip
    model = zakai.Model(**keys)
    record = zakai.Record([0.3, 0.45, 0.8], [[0.4], [-0.3], [0.5]], "increments")
    exact = zakai.filter(model, record, "kalman-bucy")
    _, _, infos = steps(model, record)
    expected = [(exact.mean[k + 1], exact.cov[k + 1], exact.log_likelihood_increments[k + 1]) for k in range(3)]
    assert error_of(infos, expected) < 2e-3


@pytest.mark.parametrize("method", ["yau-yau", "limited-direct"])
def test_a_sharp_observation_of_a_wide_prediction(method):
    model = zakai.Model(
        state=["a", "b"], drift=["0", "0"], observation=["a", "a + b"], observation_kind="samples",
        observation_noise=[["1e-6", "0"], ["0", "1e-4"]], prior={"kind": "gaussian", "mean": [0, 0], "cov": [1e2, 4]},
    )  # fmt: skip
    record = zakai.Record([0.1, 0.2], [[7.123, 9.0], [7.0, 8.8]], "samples")
    expected = kalman(
        record,
        np.eye(2),
        np.diag([1e-6, 1e-4]),
        np.zeros(2),
        np.diag([100.0, 4.0]),
        np.zeros((2, 2)),
        np.array([[1, 0], [1, 1.0]]),
    )
    _, _, infos = steps(model, record, method=method)
    assert error_of(infos, expected) < (1e-2 if method == "yau-yau" else 1e-6)


def test_an_outlier_warns():
    model = linear([["1", "0"], ["0", "1"]])
    _, _, infos = steps(model, zakai.Record([0.1], [[60.0]], "samples"))
    assert max(infos[0].health["tolerance_ratio"], infos[0].health["tail_depth"]) > 1


def test_an_angle_that_diffuses_around_the_circle():
    model = zakai.Model(
        state=["a", "x"], periodic=["a"], drift=["1 + 0.5*sin(a)", "-x"], process_noise=[["2", "0"], ["0", "1"]],
        observation=["cos(a)", "x"], observation_noise=[["0.3", "0"], ["0", "0.5"]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [2.5, 0.3], "cov": [0.2, 0.5]},
    )  # fmt: skip
    record = zakai.Record([0.4, 1.9, 2.0], [[-0.5, 0.2], [0.1, np.nan], [-0.8, -0.4]], "samples")
    _, _, infos = steps(model, record)
    # The angle alone: Fourier modes of its equation; the other coordinate is independent.
    N = 64
    a = 2 * np.pi * np.arange(N) / N
    k = np.fft.fftfreq(N, 1 / N)
    D = np.real(np.fft.ifft(1j * k[:, None] * np.fft.fft(np.eye(N), axis=0), axis=0))
    generator = np.real(np.fft.ifft(-(k[:, None] ** 2) * np.fft.fft(np.eye(N), axis=0), axis=0)) - D @ np.diag(
        1 + 0.5 * np.sin(a)
    )
    p = sum(np.exp(-((a - 2.5 + 2 * np.pi * w) ** 2) / 0.4) for w in (-1, 0, 1))
    p, time = p / p.sum(), 0.0
    for info, stop, z in zip(infos, record.times, record.values, strict=True):
        p = expm((stop - time) * generator) @ p * np.exp(-((z[0] - np.cos(a)) ** 2) / 0.6)
        p, time = p / p.sum(), stop
        assert abs(np.angle(np.exp(1j * (info.mean[0] - np.angle(p @ np.exp(1j * a)))))) < 2e-3


def test_units_and_offsets_change_nothing_but_rounding():
    def scaled(c, s):
        return zakai.Model(
            state=["x", "v"], drift=["v", f"0.5*(1 - ((x - {c!r})/{s!r})**2)*v - (x - {c!r})"],
            process_noise=[["0", "0"], ["0", repr(0.5 * s * s)]], observation=["x"], observation_noise=[[repr(0.2 * s * s)]],
            observation_kind="samples", prior={"kind": "gaussian", "mean": [c, 0], "cov": [s * s, s * s]},
        )  # fmt: skip

    z = np.array([[0.3], [-0.5]])
    _, _, first = steps(scaled(0.0, 1.0), zakai.Record([0.3, 0.5], z, "samples"))
    for c, s in ((0.0, 2.0**20), (1024.0, 1 / 1024)):
        _, _, other = steps(scaled(c, s), zakai.Record([0.3, 0.5], c + s * z, "samples"))
        for one, two in zip(first, other, strict=True):
            assert np.abs((two.mean - [c, 0]) / s - one.mean).max() < 1e-7
            assert abs(two.log_likelihood_increment + np.log(s) - one.log_likelihood_increment) < 1e-6


def test_an_interval_depends_on_itself_alone():
    model = linear([["1", "0"], ["0", "1"]])
    schedule, values = schedule_of(model, IRREGULAR)
    whole = space_kolmogorov.prepare(model, schedule, model.theta())
    one = other = space_filter.init(whole, model.prior)
    for k in range(len(schedule)):
        single = space_kolmogorov.prepare(model, schedule.part(slice(k, k + 1)), model.theta())
        one, first = space_filter.step(whole, k, one, values[k])
        other, second = space_filter.step(single, 0, other, values[k])
        assert first.log_likelihood_increment == second.log_likelihood_increment
        assert np.array_equal(one.values, other.values) and np.array_equal(first.mean, second.mean)


@pytest.mark.parametrize("method", ["yau-yau", "limited-direct"])
def test_the_complex_step_agrees_with_differences(method):
    model = zakai.Model(
        state=["x", "y"], drift=["-a*x + b*y", "-y - b*x"], observation=["x"], observation_noise=[["a"]],
        observation_kind="samples", parameters={"a": 0.5, "b": 1.0},
        prior={"kind": "gaussian", "mean": [1, 0], "cov": [0.5, 0.5]},
    )  # fmt: skip
    record = zakai.Record([0.2, 0.5], [[0.7], [0.9]], "samples")
    options = {"method": method} if method == "limited-direct" else {"tolerance": 1e-5}

    def total(theta):
        return sum(info.log_likelihood_increment for info in steps(model, record, theta=theta, **options)[2])

    for i in range(2):
        step = np.eye(2)[i]
        slope = total(model.theta() + 1e-150j * step).imag / 1e-150
        difference = (total(model.theta() + 1e-4 * step) - total(model.theta() - 1e-4 * step)) / 2e-4
        assert abs(slope - difference) < (1e-6 if method == "limited-direct" else 3e-4) * abs(difference)


def test_three_states_follow_kalman():
    A = np.array([[-0.5, 1.0, 0.0], [-1.0, -0.3, 0.4], [0.0, -0.4, -0.6]])
    model = zakai.Model(
        state=["a", "b", "c"], drift=["-0.5*a + b", "-a - 0.3*b + 0.4*c", "-0.4*b - 0.6*c"], observation=["a"],
        observation_kind="samples", observation_noise=[["0.4"]],
        prior={"kind": "gaussian", "mean": [0.5, 0, 0], "cov": [1, 1, 1]},
    )  # fmt: skip
    record = zakai.Record([0.2, 0.5], [[0.7], [0.1]], "samples")
    expected = kalman(record, np.eye(3), np.array([[0.4]]), np.array([0.5, 0, 0]), np.eye(3), A, np.array([[1.0, 0, 0]]))
    for method, bound in (("yau-yau", 2e-3), ("limited-direct", 1e-9)):
        assert error_of(steps(model, record, method=method)[2], expected) < bound


@pytest.mark.parametrize(("place", "width"), [(0.0, 1.0), (1e6, 1.0), (-3e-7, 1e-9), (5e8, 1e7), (40.0, 0.02)])
def test_a_prior_is_found_wherever_it_is(place, width):
    grid = prior_grid(lambda x: -0.5 * ((x[:, 0] - place) / width) ** 2, 1)
    weights = np.exp(grid.log_values - grid.log_values.max())
    mean = weights @ grid.offsets[:, 0] / weights.sum() + grid.centre[0]
    assert abs(mean - place) < 1e-6 * width + 1e-9 * abs(place)
    assert abs(grid.log_mass - np.log(width * np.sqrt(2 * np.pi))) < 1e-8


def test_a_prior_with_two_peaks_in_two_states():
    covs = np.array([[[0.04, 0.01], [0.01, 0.09]], [[0.5, 0.0], [0.0, 0.1]]])
    laws = [multivariate_normal([-3, 1], covs[0]), multivariate_normal([4, 0], covs[1])]
    grid = prior_grid(lambda x: np.logaddexp(laws[0].logpdf(x) + np.log(0.2), laws[1].logpdf(x) + np.log(0.8)), 2)
    assert abs(grid.log_mass) < 1e-9 and grid.error < 1e-11
    again = mixture_grid(np.array([0.2, 0.8]), np.array([[-3.0, 1], [4, 0]]), covs)
    assert abs(again.log_mass) < 1e-9


@pytest.mark.parametrize(
    ("log_density", "words"),
    [
        (lambda x: 0 * x[:, 0], "does not decay"),
        (lambda x: x[:, 0] ** 2, "does not decay"),
        (lambda x: np.full(len(x), -np.inf), "not finite anywhere"),
        (lambda x: np.log(x[:, 0]) - x[:, 0], "not a number"),
    ],
)
def test_a_prior_that_is_no_density_is_refused(log_density, words):
    with pytest.raises(InputError, match=words):
        prior_grid(log_density, 1)


def test_a_free_angle_with_a_rate_that_is_not_observed_has_its_wrapped_gaussian():
    """The mass spreads over many turns, so that the density is folded again and again."""
    keys = {
        "state": ["w", "a"], "drift": ["-0.5*w", "w + 0.3"], "process_noise": [["1", "0"], ["0", "0.5"]],
        "observation": ["cos(a)", "sin(a)"], "observation_noise": [["1e3", "0"], ["0", "1e3"]], "observation_kind": "samples",
        "prior": {"kind": "gaussian", "mean": [0.2, 3.0], "cov": [0.5, 0.4]},
    }  # fmt: skip
    model = zakai.Model(periodic=["a"], **keys)
    times = np.array([0.5, 2.0, 6.0, 6.3, 11.0])
    record = zakai.Record(times, np.full((5, 2), np.nan), "samples")
    prepared, states, infos = steps(model, record, method="limited-direct")
    exact = zakai.filter(zakai.Model(**{**keys, "observation": ["a", "w"]}), record, "kalman-bucy")
    angles = np.linspace(-np.pi, np.pi, 41)[:-1]
    for k, (state, info) in enumerate(zip(states, infos, strict=True), start=1):
        law = multivariate_normal(exact.mean[k], exact.cov[k])
        points = np.stack([np.full(40, exact.mean[k, 0] + 0.3), angles], axis=1)
        expected = sum(law.pdf(points + [0.0, 2 * np.pi * turn]) for turn in range(-30, 31))
        got = np.exp(space_filter.density(prepared, state).log_density(points))
        assert np.abs(got - expected).max() < 1e-8 * expected.max()
        assert abs(info.mean[0] - exact.mean[k, 0]) < 1e-9 and abs(info.cov[0, 0] / exact.cov[k, 0, 0] - 1) < 1e-9
        resultant = np.exp(1j * exact.mean[k, 1])
        assert exact.cov[k, 1, 1] > 30 or abs(np.angle(np.exp(1j * info.mean[1]) / resultant)) < 1e-6


def test_an_angle_whose_prior_is_a_density_agrees_with_the_same_angle_on_a_circle():
    model = zakai.Model(
        state=["a", "w"], periodic=["a"], drift=["w", "-w"], process_noise=[["0.3", "0"], ["0", "0.5"]], observation=["cos(a)"],
        observation_noise=[["0.3"]], observation_kind="samples",
        prior={"kind": "density", "log_density": "0.5*cos(a) - w**2"},
    )  # fmt: skip
    record = zakai.Record([0.0, 0.5, 1.0], [[0.4], [-0.2], [0.3]], "samples")
    _, _, first = steps(model, record, method="limited-direct")
    _, _, second = steps(model, record, tolerance=1e-5)
    for one, two in zip(first, second, strict=True):
        assert np.abs(one.mean[1] - two.mean[1]) < 1e-4
        assert abs(one.log_likelihood_increment - two.log_likelihood_increment) < 1e-4
