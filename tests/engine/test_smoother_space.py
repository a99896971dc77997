"""The smoother of density grids in two states against dense forward-backward sums and quadrature."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.linalg import expm
from scipy.sparse.linalg import expm_multiply

import zakai

TIMES = np.array([0.05, 0.1, 0.5, 0.6, 1.2])
VALUES = np.array([[0.6, 0.1], [np.nan, np.nan], [-0.3, np.nan], [0.8, -0.4], [0.2, 0.3]])
NOISE = np.array([[0.3, 0.05], [0.05, 0.2]])
MEAN, COV = np.array([0.5, -0.3]), np.array([[0.3, 0.05], [0.05, 0.4]])


def derivatives(axis, closed):
    """The matrices of d/dx and d^2/dx^2 by differences of order eight."""
    size, spacing, shape = len(axis), axis[1] - axis[0], (len(axis), len(axis))
    first, second = sp.csr_matrix(shape), sp.diags([-205 / 72], [0], shape)
    for j, (a, b) in enumerate(zip((4 / 5, -1 / 5, 4 / 105, -1 / 280), (8 / 5, -1 / 5, 8 / 315, -1 / 560), strict=True), 1):
        first = first + sp.diags([a, -a], [j, -j], shape)
        second = second + sp.diags([b, b], [j, -j], shape)
        if closed:
            first = first + sp.diags([-a, a], [size - j, j - size], shape)
            second = second + sp.diags([b, b], [size - j, j - size], shape)
    return first / spacing, second / spacing**2


class Dense:
    """Smoothed densities at the start and at each time, on a fine grid."""

    def __init__(self, axes, closed, drift, covariance, observe, kind):
        self.points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.cell = (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0])
        x, y = self.points.T
        one = [sp.identity(len(axis)) for axis in axes]
        (dx, dxx), (dy, dyy) = (derivatives(axis, c) for axis, c in zip(axes, closed, strict=True))
        dx, dxx, dy, dyy = sp.kron(dx, one[1]), sp.kron(dxx, one[1]), sp.kron(one[0], dy), sp.kron(one[0], dyy)
        (f, g), (a, b, c) = drift(x, y), (value + 0.0 * x for value in covariance(x, y))
        operator = 0.5 * dxx @ sp.diags(a) + dx @ dy @ sp.diags(b) + 0.5 * dyy @ sp.diags(c)
        operator = operator - dx @ sp.diags(f) - dy @ sp.diags(g)
        observed, away = np.stack(observe(x, y), axis=-1), self.points - MEAN
        state = self.normalised(np.exp(-0.5 * ((away @ np.linalg.inv(COV)) * away).sum(axis=1)))
        states, moves = [state], []
        for length, value in zip(np.diff(np.concatenate([[0.0], TIMES])), VALUES, strict=True):
            seen, inside, factor = ~np.isnan(value), 0.0 * x, 1.0 + 0.0 * x
            if seen.any():
                precision, h, z = np.linalg.inv(NOISE[np.ix_(seen, seen)]), observed[:, seen], value[seen]
                if kind == "samples":
                    factor = np.exp(-0.5 * (((z - h) @ precision) * (z - h)).sum(axis=1))
                else:
                    inside = (((z - 0.5 * length * h) @ precision) * h).sum(axis=1)
            moves.append(((length * operator + sp.diags(inside)).tocsr(), factor))
            states.append(self.normalised(factor * expm_multiply(moves[-1][0], states[-1])))
        self.densities, message = [states[-1]], 1.0 + 0.0 * x
        for state, (move, factor) in zip(states[-2::-1], moves[::-1], strict=True):
            message = expm_multiply(move.T.tocsr(), factor * message)
            message /= message.max()
            self.densities.insert(0, self.normalised(state * message))

    def normalised(self, density):
        return density / density.sum() / self.cell


CIRCLE = np.linspace(-np.pi, np.pi, 64, endpoint=False)
SYSTEMS = {
    "cubic": (
        {"drift": ["-x + 0.5*y - x**3", "-0.5*x - y"], "observation": ["x", "y + 0.3*x**2"],
         "process_noise": [[0.5, 0.1], [0.1, 0.4]]},
        (np.linspace(-2.6, 3.2, 75), np.linspace(-4.0, 3.4, 68)), (False, False),
        lambda x, y: (-x + 0.5 * y - x**3, -0.5 * x - y), lambda x, y: (0.5, 0.1, 0.4), lambda x, y: (x, y + 0.3 * x**2),
    ),
    "angle": (
        {"drift": ["0.5*y + 0.3*cos(x)", "-y"], "observation": ["cos(x)", "y"],
         "process_noise": [[0.3, 0], [0, 0.4]], "periodic": ["x"]},
        (CIRCLE, np.linspace(-3.6, 3.2, 72)), (True, False),
        lambda x, y: (0.5 * y + 0.3 * np.cos(x), -y), lambda x, y: (0.3, 0.0, 0.4), lambda x, y: (np.cos(x), y),
    ),
    "state-dependent noise": (
        {"drift": ["-x", "x - y"], "observation": ["x", "y"], "process_noise": [[1, 0], [0, 1]],
         "diffusion": [["0.6 + 0.2*sin(y)", "0"], ["0.2*cos(x)", "0.6"]]},
        (np.linspace(-3.3, 3.5, 62), np.linspace(-3.4, 3.2, 62)), (False, False),
        lambda x, y: (-x, x - y),
        lambda x, y: ((0.6 + 0.2 * np.sin(y)) ** 2, (0.6 + 0.2 * np.sin(y)) * 0.2 * np.cos(x), 0.36 + 0.04 * np.cos(x) ** 2),
        lambda x, y: (x, y),
    ),
}  # fmt: skip


@pytest.mark.parametrize(("system", "kind"), [("cubic", "samples"), ("cubic", "increments"), ("angle", "samples"),
                                              ("angle", "increments"), ("state-dependent noise", "samples")])  # fmt: skip
def test_a_smoothed_density_agrees_with_sums_over_a_fine_grid(system, kind):
    keys, *dense = SYSTEMS[system]
    prior = {"kind": "gaussian", "mean": MEAN.tolist(), "cov": COV.tolist()}
    model = zakai.Model(state=["x", "y"], observation_kind=kind, observation_noise=NOISE.tolist(), prior=prior, **keys)
    result = zakai.smooth(model, zakai.Record(TIMES, VALUES, kind), "yau-yau")
    expected = Dense(*dense, kind)
    for k, density in enumerate(expected.densities):
        if not any(model.periodic):
            mean = density @ expected.points * expected.cell
            deviation = np.sqrt(result.variance[k])
            np.testing.assert_allclose((result.mean[k] - mean) / deviation, 0, atol=1e-3)
            spread = ((expected.points - mean).T * density) @ (expected.points - mean) * expected.cell
            np.testing.assert_allclose((result.cov[k] - spread) / np.outer(deviation, deviation), 0, atol=1e-3)
        if k in (0, 3):
            with np.errstate(divide="ignore"):
                own = np.exp(result.density(k).log_density(expected.points))
            np.testing.assert_allclose(own, density, atol=1e-3 * density.max())
    assert result.warnings == [] and result.log_likelihood == result.filtered.log_likelihood
    np.testing.assert_allclose(result.mean[-1], result.filtered.mean[-1], atol=1e-5)
    assert result.health["evidence_error"].max() < 5e-4


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_both_grids_agree_with_the_smoother_of_a_linear_system(kind):
    prior = {"kind": "gaussian", "mean": MEAN.tolist(), "cov": COV.tolist()}
    model = zakai.Model(
        state=["x", "y"], drift=["y", "-x - 0.5*y"], observation=["x", "y"], observation_kind=kind, prior=prior,
        observation_noise=NOISE.tolist(), process_noise=[[0.1, 0], [0, 0.5]],
    )  # fmt: skip
    record = zakai.Record(TIMES, VALUES, kind)
    exact = zakai.smooth(model, record, "kalman-bucy")
    for method, bound in (("yau-yau", 2e-4), ("limited-direct", 2e-5)):
        result = zakai.smooth(model, record, method)
        np.testing.assert_allclose(result.mean, exact.mean, atol=bound)
        np.testing.assert_allclose(result.cov, exact.cov, atol=bound)
        assert result.warnings == []
        apart = (result.sample_paths(4000, seed=1) - exact.mean) / np.sqrt(exact.variance)
        np.testing.assert_allclose(apart.mean(axis=0), 0.0, atol=4 / np.sqrt(4000))
        np.testing.assert_allclose(apart.var(axis=0), 1.0, atol=4 * np.sqrt(2 / 4000))


def test_a_sharp_observation_narrows_a_wide_prior_before_it():
    # The smoothed density at the start is far narrower than the spacing of the prior's grid.
    prior = {"kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]}
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "-y"], observation=["x", "y"], observation_kind="samples", prior=prior,
        observation_noise=[[1e-4, 0], [0, 1e-4]], process_noise=[[1e-3, 0], [0, 1e-3]],
    )  # fmt: skip
    record = zakai.Record([0.01, 2.0], [[0.7, -0.4], [0.1, 0.05]], "samples")
    exact, result = (zakai.smooth(model, record, method) for method in ("kalman-bucy", "yau-yau"))
    np.testing.assert_allclose((result.mean - exact.mean) / np.sqrt(exact.variance), 0, atol=2e-3)
    np.testing.assert_allclose(result.variance / exact.variance, 1, atol=2e-3)
    np.testing.assert_allclose(result.density(0).mean(), exact.mean[0], atol=1e-4)
    assert result.warnings == []
    apart = (result.sample_paths(4000, seed=1) - exact.mean) / np.sqrt(exact.variance)
    np.testing.assert_allclose(apart.mean(axis=0), 0.0, atol=4 / np.sqrt(4000))
    np.testing.assert_allclose(apart.var(axis=0), 1.0, atol=4 * np.sqrt(2 / 4000))


def test_blocks_on_grids_are_smoothed_one_by_one():
    def model(state, drift, observation):
        prior = {"kind": "gaussian", "mean": [0.1] * len(state), "cov": np.eye(len(state)).tolist()}
        return zakai.Model(state=state, drift=drift, observation=observation, observation_kind="samples", prior=prior)

    pair, line = ["y - x**3", "-x - y"], ["-z**3"]
    values = VALUES[[0, 3, 4]]
    together = model(["x", "y", "z"], [*pair, *line], ["x", "z"])
    result = zakai.smooth(together, zakai.Record([0.3, 0.6, 1.0], values, "samples"))
    first = zakai.smooth(model(["x", "y"], pair, ["x"]), zakai.Record([0.3, 0.6, 1.0], values[:, :1], "samples"))
    last = zakai.smooth(model(["z"], line, ["z"]), zakai.Record([0.3, 0.6, 1.0], values[:, 1:], "samples"))
    np.testing.assert_allclose(result.mean, np.column_stack([first.mean, last.mean]), atol=1e-12)
    np.testing.assert_allclose(result.density(1).mean(), result.mean[1], atol=1e-6)


def test_the_order_of_the_papers_is_refused():
    prior = {"kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]}
    model = zakai.Model(state=["x", "y"], drift=["-x + y", "-y"], observation=["x"], prior=prior)
    with pytest.raises(zakai.InputError, match='"lie" has no backward pass'):
        zakai.smooth(model, zakai.Record([0.1], [[0.1]], "increments"), "limited-direct", splitting="lie")


def test_an_angle_that_turns_is_smoothed_as_in_a_frame_that_turns_with_it():
    times = np.cumsum(np.random.default_rng(2).exponential(0.2, 50) + 0.01)

    def model(drift, angle):
        return zakai.Model(
            state=["a", "b"], drift=[drift, "-0.1*b"], observation=[f"cos({angle})", f"sin({angle})"], observation_kind="samples",
            diffusion=[["0.05", "0"], ["0", "0.05"]], observation_noise=[[0.05, 0], [0, 0.05]], periodic=["a"],
            prior={"kind": "gaussian", "mean": [0, 0], "cov": [[0.3, 0], [0, 0.1]]},
        )  # fmt: skip

    still, turning = model("b", "a + 1.4*t"), model("1.4 + b", "a")
    _, record = zakai.simulate(turning, times, seed=5)
    expected, found = zakai.smooth(still, record), zakai.smooth(turning, record)
    assert not found.warnings and not expected.warnings
    deviation = np.sqrt(expected.variance)
    apart = found.mean - expected.mean - np.stack([1.4 * np.concatenate([[0], times]), np.zeros(len(times) + 1)], 1)
    apart[:, 0] = (apart[:, 0] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(apart / deviation).max() < 2e-3 and np.abs(np.sqrt(found.variance) / deviation - 1).max() < 2e-3


def test_correlated_noise_that_depends_on_the_state_is_smoothed_as_without_a_follower():
    shared = {"observation": ["x"], "observation_noise": [["0.1"]], "observation_kind": "increments"}
    one = zakai.Model(
        state=["x"], drift=["-x"], diffusion=[["0.6 + 0.2*sin(x)"]], cross_noise=[["0.15"]],
        prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.2]]}, **shared,
    )  # fmt: skip
    two = zakai.Model(
        state=["x", "y"], drift=["-x", "x - y"], diffusion=[["0.6 + 0.2*sin(x)", 0], [0, "0.5"]], cross_noise=[["0.15"], [0]],
        prior={"kind": "gaussian", "mean": [0.3, 0], "cov": [0.2, 0.3]}, **shared,
    )  # fmt: skip
    record = zakai.Record([0.1, 0.25, 0.5], [[0.12], [-0.05], [0.2]], "increments")
    expected, result = zakai.smooth(one, record, "yau-yau"), zakai.smooth(two, record, "yau-yau")
    assert not result.warnings and result.health["evidence_error"].max() < 5e-4
    np.testing.assert_allclose(result.mean[:, 0], expected.mean[:, 0], atol=1e-3)
    np.testing.assert_allclose(result.variance[:, 0], expected.variance[:, 0], rtol=2e-3)


def by_quadrature(mean, prior, noise, times, values, observe, variance):
    """Smoothed means and variances (3, 2) of x' = v, v' = noise, for two samples of a function of x.

    Given x at both times all states are jointly normal; what remains is a sum over x at both.
    """
    A, joint, cov = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array(mean), np.diag(prior)
    for length in np.diff(times, prepend=0.0):
        both = expm(length * np.block([[-A, np.diag([0.0, noise])], [np.zeros((2, 2)), A.T]]))  # Van Loan
        move = both[2:, 2:].T
        cross = cov[:, -2:] @ move.T
        cov = np.block([[cov, cross], [cross.T, move @ cov[-2:, -2:] @ move.T + move @ both[:2, 2:]]])
        joint = np.concatenate([joint, move @ joint[-2:]])
    seen = [2, 4]
    P, m = cov[np.ix_(seen, seen)], joint[seen]
    axes = [m[k] + np.sqrt(P[k, k]) * np.linspace(-8.0, 8.0, 1201) for k in range(2)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2) - m
    logs = -0.5 * np.einsum("ij,jk,ik->i", x, np.linalg.inv(P), x) - ((values - observe(x + m)) ** 2).sum(axis=1) / (2 * variance)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    gain = cov[:, seen] @ np.linalg.inv(P)
    states = joint + x @ gain.T
    means = weights @ states
    return means.reshape(3, 2), (np.diag(cov - gain @ cov[seen]) + weights @ (states - means) ** 2).reshape(3, 2)


@pytest.mark.parametrize(
    ("mean", "times", "values", "variance"),
    [
        ([1.6, -0.2], [0.3, 0.6], [1.8, 2.2], 0.01),
        ([1.2, -0.5], [0.2, 0.5], [1.3, 1.15], 0.005),
        ([0.1, 0.0], [0.5, 0.9], [1.5, 1.95], 0.02),
    ],
)
def test_a_distance_that_two_places_explain_is_smoothed(mean, times, values, variance):
    model = zakai.Model(
        state=["x", "v"], drift=["v", "0"], diffusion=[["0"], ["0.3"]], observation=["sqrt(x**2 + 1)"],
        observation_kind="samples", observation_noise=[[str(variance)]],
        prior={"kind": "gaussian", "mean": mean, "cov": [0.2, 0.1]},
    )  # fmt: skip
    record = zakai.Record(times, np.array(values)[:, None], "samples")
    result = zakai.smooth(model, record, "yau-yau")
    expected = by_quadrature(mean, [0.2, 0.1], 0.09, times, values, lambda x: np.sqrt(x**2 + 1), variance)
    assert not result.warnings
    assert np.all(np.abs(result.mean - expected[0]) < 5e-3 * np.sqrt(expected[1]))
    assert np.allclose(result.variance, expected[1], rtol=2e-2)


def test_a_density_that_leaves_its_grid_within_an_interval_is_smoothed():
    model = zakai.Model(
        state=["v", "w"], drift=["v - v**3/3 - w + 0.5", "0.08*(v + 0.7 - 0.8*w)"], diffusion=[["0.1", "0"], ["0", "0.05"]],
        observation=["v"], observation_kind="samples", observation_noise=[["0.04"]],
        prior={"kind": "gaussian", "mean": [-1.0, 0.0], "cov": [0.3, 0.1]},
    )  # fmt: skip
    times = np.cumsum(0.05 + np.random.default_rng(5).exponential(0.5, 40))
    _, record = zakai.simulate(model, times, seed=11)
    result = zakai.smooth(model, record, "yau-yau")
    assert not result.warnings
    assert np.nanmax(result.health["evidence_error"]) < 1e-3
