"""One state between reflecting ends: series of cosines, images, and finite volumes, which share no code with the package."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import ncx2, norm

import zakai
from methods.test_line_features import error, normal, samples
from zakai.algebra.theorems import conditions_of
from zakai.engine.driver import filter_from
from zakai.models.prior import GaussianPrior

TIMES = np.cumsum([0.1, 0.25, 0.1, 0.5, 0.04, 0.5, 0.25])


def model_of(drift="-x", upper=None, lower=0.0, **keys):
    ends = {"lower": lower, "boundary": "reflecting"} | ({} if upper is None else {"upper": upper})
    return zakai.Model(**{
        "state": ["x"], "drift": [drift] if isinstance(drift, str) else drift, "observation": ["x"],
        "observation_kind": "samples", "domain": {"x": ends}, **keys,
    })  # fmt: skip


def bayes(p, points, weights, transition, likelihoods):
    """Mean, variance and log-likelihood increment after each sample, for a density on quadrature points."""
    rows = []
    for k, likelihood in enumerate(likelihoods):
        p = transition(k, p) * likelihood(points)
        mass = weights @ p
        p = p / mass
        mean = weights @ (points * p)
        rows.append((mean, weights @ ((points - mean) ** 2 * p), np.log(mass)))
    return np.array(rows)


def lengths(times):
    return np.diff(np.concatenate([[0.0], times]))


def test_reflected_brownian_motion_is_the_series_of_cosines():
    values, noise = [0.3, 0.9, 0.02, 0.7, 0.4, 0.95, 0.0], 0.02
    model = model_of("0", 1.0, diffusion=[["0.6"]], observation_noise=[[str(noise)]],
                     prior={"kind": "density", "log_density": "-2*x"})  # fmt: skip
    result = zakai.filter(model, samples(TIMES, values), "yau-yau")
    nodes, weights = np.polynomial.legendre.leggauss(120)
    x, weights = (nodes + 1) / 2, weights / 2
    cosines = np.cos(np.pi * np.arange(80)[:, None] * x) * np.where(np.arange(80) == 0, 1.0, np.sqrt(2.0))[:, None]

    def transition(k, p):
        decay = np.exp(-0.18 * (np.pi * np.arange(80)) ** 2 * lengths(TIMES)[k])
        return cosines.T @ (decay * (cosines @ (weights * p)))

    p = np.exp(-2 * x) / (weights @ np.exp(-2 * x))
    expected = bayes(p, x, weights, transition, [lambda x, z=z: normal(z, noise)(x) for z in values])
    assert error(result, expected) < 1e-8
    assert not result.warnings
    density = result.density(4)
    grid = (np.arange(4000) + 0.5) / 4000
    assert np.mean(density.pdf(grid)) == pytest.approx(1.0, abs=1e-6)
    assert np.isneginf(density.log_density(np.array([-0.01, 1.01]))).all()
    assert density.mean()[0] == pytest.approx(result.mean[4, 0], abs=1e-12)
    assert density.quantile([0.5])[0, 0] == pytest.approx(np.interp(0.5, np.cumsum(density.pdf(grid)) / 4000, grid), abs=1e-3)


def test_brownian_motion_above_one_reflecting_end_is_its_image():
    """The prior is narrow and far from the end, then the state reaches it."""
    values, noise = [2.3, 1.1, 0.4, 0.2, 0.1, 1.5, 3.0], 0.3
    model = model_of("0", observation_noise=[[str(noise)]], prior={"kind": "gaussian", "mean": [2.0], "cov": [[0.04]]})
    result = zakai.filter(model, samples(TIMES, values), "yau-yau")
    nodes, weights = np.polynomial.legendre.leggauss(400)
    x, weights = 6.0 * (nodes + 1), 6.0 * weights

    def transition(k, p):
        s = np.sqrt(lengths(TIMES)[k])
        return (norm.pdf((x[:, None] - x) / s) + norm.pdf((x[:, None] + x) / s)) / s @ (weights * p)

    expected = bayes(normal(2.0, 0.04)(x), x, weights, transition, [lambda x, z=z: normal(z, noise)(x) for z in values])
    assert error(result, expected) < 1e-6
    assert not result.warnings


def volumes(f, G, lower, upper, size):
    """The points of cells and the generator of second order without flux at the ends."""
    h = (upper - lower) / size
    x, faces = lower + h * (np.arange(size) + 0.5), lower + h * np.arange(1, size)
    flux = np.zeros((size + 1, size))
    inner = np.arange(size - 1)
    flux[1:-1][inner, inner] = f(faces) / 2 + G(x[:-1]) / (2 * h)
    flux[1:-1][inner, inner + 1] = f(faces) / 2 - G(x[1:]) / (2 * h)
    return x, -(flux[1:] - flux[:-1]) / h


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_a_drift_towards_an_end_is_that_of_finite_volumes(kind):
    """Richardson's extrapolation of two grids of cells; f and g' are not zero at the ends."""
    f, G, noise = lambda x: -1.5 + np.sin(3 * x), lambda x: (0.5 + 0.2 * x) ** 2, 0.05
    values = np.array([0.3, 0.9, 0.02, 0.7, 0.4, 1.2, 0.0]) * (1.0 if kind == "samples" else lengths(TIMES))
    model = model_of("-1.5 + sin(3*x)", 1.5, diffusion=[["0.5 + 0.2*x"]], observation_noise=[[str(noise)]],
                     observation_kind=kind, prior={"kind": "density", "log_density": "x"})  # fmt: skip
    record = zakai.Record(TIMES, values[:, None], kind)
    result = zakai.filter(model, record, "yau-yau")
    found = []
    for size in (100, 200):
        x, A = volumes(f, G, 0.0, 1.5, size)

        def transition(k, p, x=x, A=A):
            tau = lengths(TIMES)[k]
            inside = (x * values[k] - 0.5 * tau * x**2) / noise if kind == "increments" else 0.0 * x
            return expm(tau * A + np.diag(inside)) @ p

        likelihoods = [(lambda x, z=z: normal(z, noise)(x)) if kind == "samples" else np.ones_like for z in values]
        weights = np.full(size, 1.5 / size)
        found.append(bayes(np.exp(x) / (weights @ np.exp(x)), x, weights, transition, likelihoods))
    expected = (4 * found[1] - found[0]) / 3
    assert error(result, expected) < 1e-5
    assert not result.warnings


def test_a_sharp_sample_in_a_wide_domain():
    """The posterior is a hundred thousandth of the domain wide; then the state spreads over all of it."""
    model = model_of("0", 1.0, observation_noise=[["1e-10"]], prior={"kind": "density", "log_density": "0"})
    result = zakai.filter(model, samples([0.1, 5.0], [0.4321, np.nan]), "yau-yau")
    assert result.mean[1, 0] == pytest.approx(0.4321, abs=1e-11)
    assert result.variance[1, 0] == pytest.approx(1e-10, rel=1e-6)
    assert result.mean[2, 0] == pytest.approx(0.5, abs=1e-7)
    assert result.variance[2, 0] == pytest.approx(1 / 12, rel=1e-6)


def test_coefficients_in_time_and_inputs():
    """dx = u(t) dt + dv on [0, 1]: the gauge-free reference takes short steps of finite volumes."""
    inputs = zakai.Inputs([0.0, 0.15, 0.4], [[1.0], [-2.0], [0.5]])
    model = model_of("u*(1 + 0.5*sin(5*t))", 1.0, inputs=["u"], observation_noise=[["0.05"]], diffusion=[["0.7"]],
                     prior={"kind": "density", "log_density": "x"})  # fmt: skip
    times, values = np.array([0.1, 0.3]), [0.3, 0.9]
    result = zakai.filter(model, samples(times, values, inputs), "yau-yau")
    found = []
    for size in (50, 100):
        x, still = volumes(lambda x: 0 * x, lambda x: 0.49 + 0 * x, 0.0, 1.0, size)
        _, moving = volumes(lambda x: 1 + 0 * x, lambda x: 0 * x, 0.0, 1.0, size)

        def transition(k, p, still=still, moving=moving):
            start = 0.0 if k == 0 else times[k - 1]
            cuts = np.unique([start, *[t for t in (0.15, 0.4) if start < t < times[k]], times[k]])
            for a, b in zip(cuts[:-1], cuts[1:], strict=True):
                count = int(np.ceil((b - a) / 0.01))
                for t in a + (np.arange(count) + 0.5) * (b - a) / count:
                    u = [1.0, -2.0, 0.5][np.searchsorted([0.15, 0.4], t)]
                    p = expm((still + u * (1 + 0.5 * np.sin(5 * t)) * moving) * (b - a) / count) @ p
            return p

        weights = np.full(size, 1 / size)
        likelihoods = [lambda x, z=z: normal(z, 0.05)(x) for z in values]
        found.append(bayes(np.exp(x) / (weights @ np.exp(x)), x, weights, transition, likelihoods))
    assert error(result, (4 * found[1] - found[0]) / 3) < 1e-4
    assert not result.warnings


def test_online_and_batches_are_records_to_the_bit(tmp_path):
    values = [0.3, 0.9, 0.02, 0.7, 0.4, 0.95, 0.0]
    model = model_of("-1", 1.0, observation_noise=[["0.02"]], prior={"kind": "density", "log_density": "-2*x"})
    record = samples(TIMES, values)
    result = zakai.filter(model, record, "yau-yau")
    batch = zakai.filter(model, [record, record], "yau-yau")
    online = zakai.online(model, method="yau-yau")
    for k, (time, value) in enumerate(zip(TIMES, values, strict=True)):
        if k == 3:
            online.save(tmp_path / "checkpoint")
            online = zakai.online(model, method="yau-yau")
            online.restore(tmp_path / "checkpoint")
        estimate = online.update(time, [value])
        assert np.array_equal(estimate.mean, result.mean[k + 1]) and np.array_equal(estimate.cov, result.cov[k + 1])
    assert all(np.array_equal(one.mean, result.mean) for one in batch)


def test_gradients_are_differences():
    model = model_of("a", 1.0, diffusion=[["0.7*b"]], observation_noise=[["0.05"]], parameters={"a": -0.5, "b": 1},
                     prior={"kind": "density", "log_density": "-2*a*x"})  # fmt: skip
    likelihood = zakai.log_likelihood(model, samples(TIMES[:3], [0.3, 0.8, 0.1]), method="yau-yau")
    _, gradient = likelihood.value_and_gradient([-0.5, 1.0])
    for i, unit in enumerate(np.eye(2) * 1e-3):
        difference = (likelihood([-0.5, 1.0] + unit) - likelihood([-0.5, 1.0] - unit)) / 2e-3
        assert gradient[i] == pytest.approx(difference, abs=1e-5)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_the_state_does_not_matter(scale):
    values = np.array([0.3, 0.9, 0.02])
    one, other = (
        zakai.filter(
            model_of(f"{-s}", s * 1.0, diffusion=[[s]], observation_noise=[[0.02 * s**2]],
                     prior={"kind": "density", "log_density": f"-2*x/{s}"}),
            samples(TIMES[:3], s * values), "yau-yau",
        )
        for s in (1.0, scale)
    )  # fmt: skip
    assert other.mean[1:, 0] / scale == pytest.approx(one.mean[1:, 0], rel=1e-8)


REFUSED = {
    "two states": ({"state": ["x", "z"], "drift": ["-x", "-z"]}, "one state"),
    "jumps": ({"drift": ["sign(x - 1)"]}, "do not jump"),
    "cross noise": ({"observation_kind": "increments", "cross_noise": [["0.1"]]}, "independent"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_hold_is_said_in_one_line(name):
    keys, words = REFUSED[name]
    failed = [condition for condition in conditions_of("yau-yau", model_of(**keys)) if condition.holds is False]
    assert len(failed) == 1 and words in failed[0].statement


def test_the_prior_of_filter_from_is_checked_against_the_domain():
    model, record = model_of(upper=1.0, prior={"kind": "density", "log_density": "0"}), samples(TIMES[:1], [0.3])
    outside = GaussianPrior(np.array([1.0]), np.array([[0.01]]))
    with pytest.raises(zakai.InputError, match="prior: 0.5 of it is outside of the domain of 'x'"):
        filter_from(outside, model, record)


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_smoothed_moments_and_paths_are_those_of_matrices(kind):
    """Forward and backward in finite volumes of second order, extrapolated; f depends on t."""
    values = np.array([0.3, 0.9, 0.02, 0.7]) * (1.0 if kind == "samples" else lengths(TIMES[:4]))
    model = model_of("-1 + sin(3*t)", 1.5, observation_noise=[["0.05"]], observation_kind=kind,
                     prior={"kind": "density", "log_density": "x"})  # fmt: skip
    result = zakai.smooth(model, zakai.Record(TIMES[:4], values[:, None], kind), "yau-yau")
    found = []
    for size in (60, 120):
        x, still = volumes(lambda x: 0 * x, lambda x: 1 + 0 * x, 0.0, 1.5, size)
        _, moving = volumes(lambda x: 1 + 0 * x, lambda x: 0 * x, 0.0, 1.5, size)
        steps, starts = [], np.concatenate([[0.0], TIMES[:3]])
        for start, stop, value in zip(starts, TIMES[:4], values, strict=True):
            tau, step = stop - start, np.eye(size)
            inside = (x * value / tau - 0.5 * x**2) / 0.05 if kind == "increments" else 0.0 * x
            for t in start + (np.arange(24) + 0.5) * tau / 24:
                step = expm(tau / 24 * (still + (np.sin(3 * t) - 1) * moving + np.diag(inside))) @ step
            steps.append(normal(value, 0.05)(x)[:, None] * step if kind == "samples" else step)
        before, after = [np.exp(x)], [np.ones(size)]
        for step in steps:
            before.append(step @ before[-1] / np.sum(step @ before[-1]))
        for step in steps[::-1]:
            after.insert(0, after[0] @ step / np.sum(after[0] @ step))
        rows = [p * b / (p @ b) for p, b in zip(before, after, strict=True)]
        found.append([(p @ x, p @ x**2 - (p @ x) ** 2) for p in rows])
    expected = (4 * np.array(found[1]) - found[0]) / 3
    assert np.column_stack([result.mean[:, 0], result.variance[:, 0]]) == pytest.approx(expected, abs=1e-4)
    assert not result.warnings
    paths = result.sample_paths(4000, seed=1)[:, :, 0]
    assert paths.min() >= 0.0 and paths.max() <= 1.5
    deviations = np.sqrt(expected[:, 1] / 4000)
    assert (np.abs(paths.mean(axis=0) - expected[:, 0]) < 4.0 * deviations).all()
    assert paths.var(axis=0) == pytest.approx(expected[:, 1], rel=0.1)


def test_residuals_are_those_of_the_uniform_law():
    """Brownian motion that begins uniform stays uniform; the noise is Gaussian, or given by its density."""
    prior, domain = {"kind": "density", "log_density": "0"}, {"x": {"lower": 0, "upper": 1, "boundary": "reflecting"}}
    shared = {"state": ["x"], "drift": ["0"], "observation_kind": "samples", "domain": domain, "prior": prior}
    one = zakai.Model(observation=["x"], observation_noise=[["0.02"]], **shared)
    other = zakai.Model(observed=["z"], observation_log_density="-25*(z - x)**2 - log(0.04*pi)/2", **shared)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    expected = weights / 2 @ norm.cdf((0.3 - (nodes + 1) / 2) / np.sqrt(0.02))
    for model, allowed in ((one, 1e-6), (other, 1e-3)):
        assert zakai.filter(model, samples([0.4], [0.3]), "yau-yau").residuals()[0, 0] == pytest.approx(expected, abs=allowed)


def test_an_exponential_prior_at_an_end_that_it_has_flux_through_is_the_folded_process():
    """The state is |y| of dy = -y dt + dv, whose transition is known; the solution has a layer at the end, the prior none."""
    domain = {"x": {"lower": 0.0, "boundary": "reflecting"}}
    prior = {"kind": "density", "log_density": "-x"}
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[["0.1"]], domain=domain,
        prior=prior,
    )  # fmt: skip
    times, values = [0.1, 0.25], [0.1, 0.8]
    result = zakai.filter(model, zakai.Record(times, np.array(values)[:, None], "samples"))
    nodes, weights = np.polynomial.legendre.leggauss(400)
    x, weights = 15.0 * (nodes + 1.0), 15.0 * weights
    p, last, expected = np.exp(-x), 0.0, []
    for time, value in zip(times, values, strict=True):
        decay, last = np.exp(last - time), time
        variance = 0.5 * (1.0 - decay**2)
        kernel = sum(np.exp(-0.5 * (sign * x[:, None] - decay * x) ** 2 / variance) for sign in (1.0, -1.0))
        p = kernel / np.sqrt(2 * np.pi * variance) @ (weights * p) * np.exp(-5.0 * (value - x) ** 2) / np.sqrt(0.2 * np.pi)
        mass = weights @ p
        p = p / mass
        expected.append((weights @ (x * p), np.log(mass)))
    found = np.column_stack([result.mean[1:, 0], result.log_likelihood_increments[1:]])
    assert found == pytest.approx(np.array(expected), abs=1e-6)
    assert not result.warnings


@pytest.mark.parametrize(
    ("level", "boundary"),  # 2 a b / sigma^2 is 1, 0.8 and 1.01
    [("0.5", "reflecting"), ("0.4", "reflecting"), ("0.505", "natural")],
)
def test_a_square_root_process_near_zero_has_chi_square_transitions(level, boundary):
    times, values, noise = np.array([0.3, 0.8, 1.0, 2.0]), [0.9, 0.3, 0.1, 0.4], 0.04
    model = model_of(f"{level} - x", diffusion=[["sqrt(x)"]], observation_noise=[[str(noise)]],
                     prior={"kind": "density", "log_density": "3*log(x) - 4*x"},
                     domain={"x": {"lower": 0.0, "boundary": boundary}})  # fmt: skip
    result = zakai.filter(model, samples(times, values), "yau-yau")
    nodes, weights = np.polynomial.legendre.leggauss(800)
    root, weights = 1.75 * (nodes + 1), 1.75 * weights  # the density of the root has no pole
    x, weights = root**2, 2 * root * weights

    def transition(k, p):
        c = 2 / (1 - np.exp(-lengths(times)[k]))
        decayed = 2 * c * x * np.exp(-lengths(times)[k])
        return 2 * c * ncx2.pdf(2 * c * x[:, None], 4 * float(level), decayed) @ (weights * p)

    p = x**3 * np.exp(-4 * x) / (weights @ (x**3 * np.exp(-4 * x)))
    expected = bayes(p, x, weights, transition, [lambda x, z=z: normal(z, noise)(x) for z in values])
    assert error(result, expected) < 1e-6 and not result.warnings


@pytest.mark.parametrize(
    ("drift", "diffusion", "boundary", "words"),
    [
        ("0.4 - x", "sqrt(x)", "natural", "reaches the end 0 of 'x'; give boundary"),
        ("0.1/x - x", "1", "natural", "reaches the end 0 of 'x'; give boundary"),
        ("0.4 - x", "x**0.25", "natural", "reaches the end 0 of 'x'; give boundary"),
        ("-x", "sqrt(x)", "reflecting", "is absorbed there"),
        ("-1", "x", "natural", "is absorbed there"),
        ("0.5 - x", "sqrt(x)", "natural", ""),
        ("0.6/x - x", "1", "natural", ""),
        ("-x", "x", "natural", ""),
        ("1 - x", "x**0.75", "natural", ""),
        ("-x", "x**0.25", "reflecting", ""),
    ],
)
def test_an_end_that_the_process_reaches_is_named(drift, diffusion, boundary, words):
    keys = {"diffusion": [[diffusion]], "domain": {"x": {"lower": 0.0, "boundary": boundary}},
            "prior": {"kind": "density", "log_density": "9*log(x) - 9*x"}}  # fmt: skip
    try:
        zakai.filter(model_of(drift, **keys), samples([1e-3], [1.0]), "yau-yau")
    except zakai.InputError as raised:
        assert words and words in str(raised)
    else:
        assert not words


def test_a_rate_below_fellers_bound_is_followed_to_its_reflecting_end():
    # The density of the square-root process is infinite at zero; its transition is a noncentral chi-square.
    k, mean, s, noise, step = 0.3, 2.0, 1.3, 0.1, 1 / 12
    model = zakai.Model(
        state=["r"], drift=[f"{k}*({mean} - r)"], diffusion=[[f"{s}*sqrt(r)"]], observation=["r"],
        observation_noise=[[f"{noise}**2"]], observation_kind="samples", domain={"r": {"lower": 0, "boundary": "reflecting"}},
        prior={"kind": "density", "log_density": "-(r - 2)**2/2"},
    )
    values = np.array([1.2, 0.7, 0.4, 0.25, 0.3, 0.19, 0.2, -0.15, -0.05, 0.11, 0.18, 0.22, 0.92, 0.5, 0.2])
    result = zakai.filter(model, zakai.Record(step * np.arange(1, 16), values[:, None], "samples"))
    assert not any("lost" in sentence for sentence in result.warnings)
    freedom, decay = 4 * k * mean / s**2, np.exp(-k * step)
    scale = s**2 * (1 - decay) / (4 * k)
    power = 2 / freedom  # r = z^power: the density of z is finite
    z = (np.arange(1600) + 0.5) * (14.0 ** (1 / power) / 1600)
    r, weights = z**power, power * z ** (power - 1) * (z[1] - z[0])
    kernel = ncx2.pdf(r[:, None] / scale, freedom, r * decay / scale) / scale
    p = np.exp(-((r - 2) ** 2) / 2) * weights
    for row, value in enumerate(values, 1):
        p = weights * (kernel @ (p / p.sum())) * np.exp(-0.5 * ((value - r) / noise) ** 2)
        p = p / p.sum()
        deviation = np.sqrt(p @ (r - p @ r) ** 2)
        assert abs(result.mean[row, 0] - p @ r) < 0.01 * deviation
        assert abs(np.sqrt(result.variance[row, 0]) / deviation - 1) < 0.01
