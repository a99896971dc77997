"""Benes' and Hu and Yau's filters against spectral solutions of the DMZ equation, each other and the grid."""

from __future__ import annotations

import numpy as np
import pytest

import zakai
from references.convention import within_convention
from references.dmz import dmz
from references.kolmogorov import Box
from zakai.errors import InputError

G = np.array([[1.0, 0.3], [0.3, 0.6]])
Q, P = np.array([0.8, -0.5]), np.array([0.5, 0.8])  # Q.P = 0


def scalar_benes():
    """f = 0.6 mu tanh(mu x + 3/10), G = 0.6, h = x + 1/5, a prior with two modes."""
    keys = {
        "drift": ["12/25*tanh(4/5*x + 3/10)"],
        "process_noise": [["3/5"]],
        "observation": ["x + 1/5"],
        "observation_noise": [["1/2"]],
        "prior": {"kind": "density", "log_density": "-(x**2 - 1)**2"},
    }
    return keys, {
        "drift": lambda x, t: 0.48 * np.tanh(0.8 * x + 0.3),
        "divergence": lambda x, t: 0.48 * 0.8 / np.cosh(0.8 * x[..., 0] + 0.3) ** 2,
        "covariance": lambda t: np.array([[0.6]]),
        "h": lambda x, t: x + 0.2,
        "S": np.array([[0.5]]),
        "sigma": lambda x: np.exp(-((x[..., 0] ** 2 - 1) ** 2)),
    }


def scalar_erf():
    """F = x^2/2 + log(3/2 + erf x): its quadratic part becomes drift, and the remainder is no sum of exponentials."""

    def slope(x):
        from scipy.special import erf

        return 2 / np.sqrt(np.pi) * np.exp(-(x**2)) / (1.5 + erf(x))

    keys = {
        "drift": ["x + (2/sqrt(pi))*exp(-x**2)/(3/2 + erf(x))"],
        "observation": ["x"],
        "prior": {"kind": "mixture", "weights": [0.6, 0.4], "means": [[-1.0], [1.2]], "covs": [[[0.16]], [[0.25]]]},
    }
    return keys, {
        "drift": lambda x, t: x + slope(x),
        "divergence": lambda x, t: (1 - 2 * x * slope(x) - slope(x) ** 2)[..., 0],
        "covariance": lambda t: np.eye(1),
        "h": lambda x, t: x,
        "S": np.eye(1),
        "sigma": lambda x: sum(
            w * np.exp(-((x[..., 0] - m) ** 2) / (2 * v)) / np.sqrt(v) for w, m, v in ((0.6, -1, 0.16), (0.4, 1.2, 0.25))
        ),
    }


def planar():
    """G that is no multiple of the identity, a drift with Omega != 0, D'q = 0, and two modes that are not Gaussian."""
    angle = "4/5*x1 - 1/2*x2 + 1/5"
    along = "1/2*x1 + 4/5*x2"
    keys = {
        "state": ["x1", "x2"],
        "drift": [f"13/20*tanh({angle}) + 1/2*({along})", f"-3/50*tanh({angle}) + 4/5*({along})"],
        "process_noise": [["1", "3/10"], ["3/10", "3/5"]],
        "observation": ["x1 + x2/2"],
        "prior": {"kind": "density", "log_density": "-(x1**2 - 1)**2 - x2**2 + x1*x2/2"},
    }

    def tanh(x):
        return np.tanh(x @ Q + 0.2)

    return keys, {
        "drift": lambda x, t: tanh(x)[..., None] * (G @ Q) + (x @ P)[..., None] * P,
        "divergence": lambda x, t: (Q @ G @ Q) * (1 - tanh(x) ** 2) + P @ P,
        "covariance": lambda t: G,
        "h": lambda x, t: (x @ np.array([1.0, 0.5]))[..., None],
        "S": np.eye(1),
        "sigma": lambda x: np.exp(-((x[..., 0] ** 2 - 1) ** 2) - x[..., 1] ** 2 + x[..., 0] * x[..., 1] / 2),
    }


CASES = {
    "benes": (scalar_benes, Box(9.0, 384), ("benes", "hu-yau")),
    "erf": (scalar_erf, Box(10.0, 512), ("hu-yau",)),
    "planar": (planar, Box(8.0, 128, (0.0, 0.0)), ("benes", "hu-yau")),
}
TIMES = np.array([0.1, 0.17, 0.3])
INCREMENTS = np.array([[0.25], [-0.2], [0.3]])


@pytest.mark.parametrize("case", CASES)
def test_the_density_solves_the_dmz_equation(case):
    make, box, methods = CASES[case]
    keys, reference = make()
    sigma = reference.pop("sigma")(box.x)
    start = sigma.sum() * box.cell
    expected = dmz(box, sigma, TIMES, INCREMENTS, **reference)
    model = zakai.Model(**{"state": ["x"], **keys})
    record = zakai.Record(TIMES, INCREMENTS, "increments")
    # A sum of thousands of Gaussians at every point of a plane would take minutes.
    some = (slice(None, None, 1 if box.n == 1 else 12),) * box.n
    for method in methods:
        result = zakai.filter(model, record, method)
        assert not result.warnings
        for k, values in enumerate(expected, start=1):
            mass = values.sum() * box.cell
            wanted = values / mass
            found = np.exp(result.density(k).log_density(box.x[some]))
            assert np.abs(found - wanted[some]).max() <= 1e-8 * wanted.max()
            assert result.log_likelihood_increments[: k + 1].sum() == pytest.approx(np.log(mass / start), abs=1e-8)
    assert zakai.filter(model, record).method == methods[0]


def modes_far_apart(variance):
    """e^F = e^(x^2/2) (2 + erf x), two modes at -10 and 10 where erf is flat, observations with next to no information."""
    return zakai.Model(
        state=["x"],
        drift=["x + exp(-x**2)*2/sqrt(pi)/(2 + erf(x))"],
        observation=["x"],
        observation_noise=[["1000"]],
        observation_kind="samples",
        prior={"kind": "mixture", "weights": [0.3, 0.7], "means": [[-10.0], [10.0]], "covs": [[[variance]]] * 2},
    )


def test_modes_that_are_narrow_and_far_apart_keep_their_shares():
    """Each mode is a Kalman filter of dx = x dt + dw; both explain an observation of zero equally well."""
    result = zakai.filter(modes_far_apart(0.0025), zakai.Record([0.0005, 0.001], [[0.0], [0.0]], "samples"), "hu-yau")
    assert not result.warnings
    at, variance, share = 10.0, 0.0025, np.array([0.3, 0.7])
    for k in range(3):
        if k:
            at, variance = at * np.exp(0.0005), variance * np.exp(0.001) + np.expm1(0.001) / 2
            at, variance = at * 1000 / (1000 + variance), variance * 1000 / (1000 + variance)
        density = result.density(k)
        for mean, cov in ((result.mean[k], result.cov[k]), (density.mean(), density.cov())):
            assert mean[0] == pytest.approx(0.4 * at, abs=1e-9)
            assert cov[0, 0] == pytest.approx(variance + 0.84 * at**2, abs=1e-8)
        deviation = np.sqrt(variance)
        x = np.linspace(-4, 4, 17)
        for side, weight in zip((-1, 1), share, strict=True):
            wanted = np.log(weight) - x**2 / 2 - np.log(deviation * np.sqrt(2 * np.pi))
            assert density.log_density(side * at + deviation * x) == pytest.approx(wanted, abs=1e-8)
        # 0.15 is the middle of the first mode, 0.3 + 0.35 that of the second.
        assert density.quantile([0.15, 0.65])[:, 0] == pytest.approx([-at, at], abs=1e-4)
        assert np.mean(density.sample(3, 4000)[:, 0] > 0) == pytest.approx(0.7, abs=0.03)


def test_a_grid_that_cannot_resolve_a_density_warns_and_the_density_does_not_need_it():
    result = zakai.filter(modes_far_apart(1e-6), zakai.Record([1e-9], [[0.0]], "samples"), "hu-yau")
    density = result.density(0)
    assert density.mean()[0] == pytest.approx(4.0, abs=1e-9)
    assert density.log_density(np.array([10.0])) == pytest.approx(np.log(0.7e3 / np.sqrt(2 * np.pi)), abs=1e-8)
    with pytest.warns(UserWarning, match="do not resolve"):
        density.quantile([0.5])


def model_of(make, **more):
    return zakai.Model(**{"state": ["x"], **make()[0], **more})


@pytest.mark.parametrize("theorem", ["theorem-4", "theorem-5", "theorem-6"])
def test_one_shot_is_stepwise_early(theorem):
    model = model_of(scalar_benes, prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]})
    times = np.cumsum([0.1, 0.07, 0.13, 0.2, 0.1])
    record = zakai.Record(times, 0.3 * np.cos(np.arange(5.0))[:, None], "increments")
    stepwise = zakai.filter(model, record, "hu-yau")
    for form in ("stepwise", "one-shot"):
        other = zakai.filter(model, record, "hu-yau", form=form, theorem=theorem)
        assert other.mean == pytest.approx(stepwise.mean, abs=1e-11)
        assert other.cov == pytest.approx(stepwise.cov, abs=1e-11)
        assert other.log_likelihood_increments == pytest.approx(stepwise.log_likelihood_increments, abs=1e-11)


def test_one_shot_refuses_when_its_digits_are_lost_and_stepwise_does_not():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    times = 0.5 * np.arange(1, 81)
    record = zakai.Record(times, 0.1 * np.ones((80, 1)), "increments")
    assert not zakai.filter(model, record, "hu-yau").warnings
    with pytest.raises(InputError, match="one-shot.*error estimate.*stepwise"):
        zakai.filter(model, record, "hu-yau", form="one-shot")


@pytest.mark.parametrize(("size", "said"), [(0.0, False), (1000.0, True)])
def test_one_shot_reports_the_rounding_of_a_large_observation(size, said):
    """The evidence of h = x + c is that of h = x but for what c itself explains, so that the error grows with c."""
    model = zakai.Model(
        state=["x"],
        drift=["tanh(x)"],
        observation=[f"x + {size}"],
        observation_noise=[["1/2"]],
        prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]},
    )
    dy = 0.1 * size + 0.22 * np.random.default_rng(0).standard_normal((50, 1))
    record = zakai.Record(0.1 * np.arange(1, 51), dy, "increments")
    stepwise, other = (zakai.filter(model, record, "hu-yau", form=form) for form in ("stepwise", "one-shot"))
    error = np.abs(np.cumsum(other.log_likelihood_increments - stepwise.log_likelihood_increments))[1:]
    assert not stepwise.warnings
    assert [("lost_digits" in warning) for warning in other.warnings] == [True] * said
    assert (error.max() > 1e-6) == said and error.max() <= np.nanmax(other.health["lost_digits"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"form": "twice"}, "option form"),
        ({"theorem": "theorem-7"}, "option theorem.*none of theorem-4"),
        ({"theorem": "survey-1"}, "G = I"),
        ({"tolerance": -1.0}, "option tolerance"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, words):
    record = zakai.Record(TIMES, INCREMENTS, "increments")
    with pytest.raises(InputError, match=words):
        zakai.filter(model_of(scalar_benes), record, "hu-yau", **options)


def test_theorem_6_needs_a_symmetric_matrix():
    prior = {"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]}
    model = zakai.Model(state=["x", "y"], drift=["y", "-x/2"], observation=["x"], prior=prior)
    with pytest.raises(InputError, match="symmetric"):
        zakai.filter(model, zakai.Record([0.1], [[0.0]], "increments"), "hu-yau", theorem="theorem-6")


def test_theorem_6_refuses_a_prior_that_its_e_to_the_S_makes_flat():
    # G grad S = x / 2, so that the precision 1/2 of the prior becomes zero.
    prior = {"kind": "gaussian", "mean": [0.3], "cov": [[2.0]]}
    model = zakai.Model(state=["x"], drift=["-x/2"], observation=["x"], prior=prior)
    with pytest.raises(InputError, match="outgrows the prior"):
        zakai.filter(model, zakai.Record([0.1], [[0.0]], "increments"), "hu-yau", theorem="theorem-6")


def test_theorem_6_needs_a_G_that_has_an_inverse():
    prior = {"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]}
    model = zakai.Model(
        state=["x", "y"], drift=["-x", "-2*y"], diffusion=[["1"], ["0"]], observation=["x + y"], prior=prior
    )
    record = zakai.Record([0.1], [[0.1]], "increments")
    assert np.isfinite(zakai.filter(model, record, "hu-yau").mean).all()
    with pytest.raises(InputError, match="theorem-6.*inverse"):
        zakai.filter(model, record, "hu-yau", theorem="theorem-6")


@pytest.mark.parametrize("kind", ["path", "samples"])
def test_gaps_irregular_times_and_other_records_agree_with_the_grid(kind):
    model = model_of(scalar_benes, observation_kind=kind)
    times = np.array([0.03, 0.2, 0.26, 0.7])
    record = zakai.Record(times, [[0.2], [np.nan], [0.3], [0.5]], kind)
    exact, grid = zakai.filter(model, record), zakai.filter(model, record, "limited-direct")
    # A path that is observed after a gap is an approximation; every method warns of it.
    assert exact.method == "benes" and ["after a gap" in said for said in exact.warnings] == [True] * (kind == "path")
    assert exact.mean == pytest.approx(grid.mean, abs=1e-9)
    assert exact.cov == pytest.approx(grid.cov, abs=1e-9)
    assert exact.log_likelihood == pytest.approx(grid.log_likelihood, abs=1e-9)


@pytest.mark.parametrize("variance", [1e-8, 1e8])
@pytest.mark.parametrize("step", [1e-6, 10.0])
def test_extreme_variances_and_steps_have_the_right_limits(variance, step):
    model = zakai.Model(
        state=["x"], drift=["tanh(x)"], observation=["x"], prior={"kind": "gaussian", "mean": [0.3], "cov": [[variance]]}
    )
    times = step * np.arange(1, 11)
    result = zakai.filter(model, zakai.Record(times, step * np.ones((10, 1)), "increments"))
    assert result.method == "benes" and not within_convention(result.warnings)
    assert np.isfinite(result.mean).all() and np.isfinite(result.log_likelihood) and np.all(result.variance > 0)
    assert result.mean[0, 0] == pytest.approx(0.3, rel=1e-6) and result.variance[0, 0] == pytest.approx(variance, rel=1e-6)
    if step == 1e-6 and variance == 1e-8:
        assert result.mean[-1, 0] == pytest.approx(0.3 + np.tanh(0.3) * times[-1], abs=1e-7)
    elif step == 1e-6:
        # The mean increment, 1, is all that is known, with the variance 1/t.
        assert result.variance[-1, 0] == pytest.approx(1e5, rel=3e-3) and result.mean[-1, 0] == pytest.approx(1.0, abs=10.0)
    else:
        other = zakai.filter(model, zakai.Record(times, step * np.ones((10, 1)), "increments"), "hu-yau")
        assert result.mean[-1] == pytest.approx(other.mean[-1], abs=1e-9)
        # v is N(1, 1) by then, and u = cosh(x) v.
        assert result.mean[-1, 0] == pytest.approx(1.0 + np.tanh(1.0), abs=1e-9)


@pytest.mark.parametrize("variance", [0.0, 1e-8])
def test_a_start_that_is_known_under_a_gauge_without_exponentials_has_the_right_limits(variance):
    model = model_of(scalar_erf, prior={"kind": "gaussian", "mean": [0.3], "cov": [[variance]]})
    record = zakai.Record(1e-6 * np.arange(1, 4), [[1e-6]] * 3, "increments")
    result = zakai.filter(model, record)
    assert result.method == "hu-yau" and not result.warnings
    assert result.mean[0, 0] == pytest.approx(0.3, abs=1e-12) and result.variance[0, 0] == pytest.approx(variance, abs=1e-15)
    drift = scalar_erf()[1]["drift"](np.array([0.3]), 0.0)[0]
    assert result.mean[-1, 0] == pytest.approx(0.3 + 3e-6 * drift, abs=1e-10)
    assert result.variance[-1, 0] == pytest.approx(variance + 3e-6, rel=1e-5)


def test_a_start_that_is_not_known_under_a_gauge_without_exponentials_is_reported_to_be_beyond_the_nodes():
    model = model_of(scalar_erf, prior={"kind": "gaussian", "mean": [0.3], "cov": [[1e8]]})
    result = zakai.filter(model, zakai.Record([10.0, 20.0], [[10.0]] * 2, "increments"), "hu-yau")
    assert np.isfinite(result.mean).all() and np.all(result.variance > 0)
    assert any("representation_error" in warning for warning in result.warnings)


def test_the_exponents_of_a_steep_gauge_do_not_overflow():
    model = zakai.Model(
        state=["x"], drift=["60*tanh(60*x)"], observation=["x"], prior={"kind": "gaussian", "mean": [0.0], "cov": [[4.0]]}
    )
    result = zakai.filter(model, zakai.Record([0.5, 1.0], [[12.0], [25.0]], "increments"))
    assert result.method == "benes" and np.isfinite(result.mean).all() and np.isfinite(result.log_likelihood)
    x = np.array([[30.0], [-30.0]])
    assert np.isfinite(result.density(1).log_density(x)).all()


def test_ten_thousand_steps_lose_nothing_against_a_reference_that_restarts():
    """The reference carries each Gaussian of v in information form, renormalised at every step, in plain NumPy."""
    step, count = 0.01, 10_000
    rng = np.random.default_rng(11)
    x, dy = 1.0, np.empty(count)
    for k in range(count):
        dy[k] = x * step + np.sqrt(step) * rng.standard_normal()
        x += np.tanh(x) * step + np.sqrt(step) * rng.standard_normal()
    model = zakai.Model(
        state=["x"],
        drift=["tanh(x)"],
        observation=["x"],
        prior={"kind": "mixture", "weights": [0.5, 0.5], "means": [[-1.0], [1.2]], "covs": [[[0.16]], [[0.25]]]},
    )
    result = zakai.filter(model, zakai.Record(step * np.arange(1, count + 1), dy[:, None], "increments"), keep="moments")
    assert result.method == "benes" and not result.warnings

    # v0 = sigma0 / cosh on points; after one step each is a Gaussian (mean m_i, common variance P, log-weight w_i).
    z = np.linspace(-7, 7, 401)
    sigma = sum(0.5 * np.exp(-((z - m) ** 2) / (2 * c)) / np.sqrt(2 * np.pi * c) for m, c in ((-1, 0.16), (1.2, 0.25)))
    with np.errstate(divide="ignore"):
        w = np.log(sigma / np.cosh(z) * (z[1] - z[0]))
    keep = w > -600
    m, w, P = z[keep], w[keep], 0.0
    ch, sh = np.cosh(step), np.sinh(step)
    evidence, means = 0.0, np.empty(count)
    for k in range(count):
        # v_t = v''/2 - (1 + x^2)/2 v + x (dy/dt) v, exactly: with y = x - rate the Mehler kernel.
        rate = dy[k] / step
        c = m - rate
        V = ch + P * sh
        w = w - 0.5 * np.log(V) - 0.5 * c**2 * sh / V - 0.5 * step + 0.5 * rate**2 * step
        m, P = rate + c / V, (P * ch + sh) / V
        u = w + np.logaddexp(m, -m) - np.log(2) + P / 2
        top = u.max()
        share = np.exp(u - top)
        total = share.sum()
        means[k] = (share * (m + P * np.tanh(m))).sum() / total
        evidence += top + np.log(total)
        w = w - top - np.log(total)
    assert np.abs(result.mean[1:, 0] - means).max() <= 1e-9
    assert abs(result.log_likelihood - evidence) <= 1e-6


@pytest.mark.parametrize("theorem", ["theorem-4", "theorem-6"])
@pytest.mark.parametrize("form", ["stepwise", "one-shot"])
def test_the_log_likelihood_has_the_gradient_of_differences(form, theorem):
    model = zakai.Model(
        state=["x"],
        drift=["-a*x + b"],
        observation=["c*x"],
        parameters={"a": 0.8, "b": 0.3, "c": 1.2},
        prior={"kind": "gaussian", "mean": [0.2], "cov": [[0.5]]},
    )
    record = zakai.Record([0.1, 0.15, 0.4, 0.9], [[0.2], [0.1], [0.3], [-0.2]], "increments")
    likelihood, theta = zakai.log_likelihood(model, record, "hu-yau", form=form, theorem=theorem), model.theta()
    gradient = likelihood.value_and_gradient(theta)[1]
    for i in range(3):
        above, below = (float(likelihood(theta + shift * np.eye(3)[i])) for shift in (1e-5, -1e-5))
        assert gradient[i] == pytest.approx((above - below) / 2e-5, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("theorem", ["theorem-5", "theorem-6"])
def test_a_drift_without_potential_has_the_same_filter_by_every_theorem(theorem):
    prior = {"kind": "gaussian", "mean": [1.0], "cov": [[0.3]]}
    model = zakai.Model(state=["x"], drift=["-x"], observation=["x"], prior=prior)
    record = zakai.Record([0.1, 0.3], [[0.2], [0.1]], "increments")
    own, other = zakai.filter(model, record, "hu-yau", theorem=theorem), zakai.filter(model, record, "kalman-bucy")
    np.testing.assert_allclose(own.mean, other.mean, atol=1e-12)
    np.testing.assert_allclose(own.variance, other.variance, atol=1e-12)
    assert own.log_likelihood == pytest.approx(other.log_likelihood, abs=1e-12)
