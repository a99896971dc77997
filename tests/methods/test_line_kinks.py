"""Kinks in f and h of one state, against conservative differences on fine grids with a face at each kink."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import fftconvolve
from tests.references.graded import posterior

import zakai

HALF = lambda x: 1.0 * (x > 0.4)  # noqa: E731
TIMES = np.cumsum([0.053, 0.11, 0.324, 0.241, 0.056, 0.185])


def model_of(drift, observation, noise):
    return zakai.Model(
        state=["x"], drift=[drift], observation=[observation], observation_noise=[[noise]], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[0.25]]},
    )  # fmt: skip


def exact(f, h, noise, values):
    """Return means, deviations and the log-likelihood, extrapolated from two spacings."""
    logs = [lambda x, z=z: -0.5 * (z - h(x)) ** 2 / noise - 0.5 * np.log(2 * np.pi * noise) for z in values]
    grids = [np.linspace(-4.0, 4.0, count + 1) for count in (800, 1600)]
    parts = [posterior(f, lambda x: -0.5 * (x - 0.1) ** 2 / 0.25, TIMES, logs, faces, 1e-3, 24) for faces in grids]
    coarse, fine = (np.concatenate([np.ravel(part) for part in found]) for found in parts)
    found, k = fine + (fine - coarse) / 3.0, len(TIMES)
    return found[:k], np.sqrt(found[k : 2 * k]), found[-1]


@pytest.mark.parametrize(
    ("drift", "f", "observation", "h", "noise"),
    [
        ("-x", lambda x: -x, "abs(x)", np.abs, 0.1),
        ("-x", lambda x: -x, "max(x, 1/10)", lambda x: np.maximum(x, 0.1), 0.05),
        ("sin(x)", np.sin, "abs(x - 3/10)", lambda x: np.abs(x - 0.3), 0.05),
        ("-abs(x)*x", lambda x: -np.abs(x) * x, "x", lambda x: x, 0.2),
        ("-3*sign(x)", lambda x: -3.0 * np.sign(np.round(x, 9)), "x", lambda x: x, 0.2),
        ("1/2 - x - abs(x)", lambda x: 0.5 - x - np.abs(x), "abs(x)", np.abs, 0.1),
        ("3/10 - x - max(x, 0)/2", lambda x: 0.3 - x - 0.5 * np.maximum(x, 0.0), "heaviside(x - 2/5)", HALF, 0.04),
        ("-x", lambda x: -x, "heaviside(x - 2/5)", HALF, 0.04),
        ("-x", lambda x: -x, "floor(2*x)", lambda x: np.floor(2.0 * x), 0.04),
        ("-sign(x)", lambda x: -np.sign(np.round(x, 9)), "floor(2*x)", lambda x: np.floor(2.0 * x), 0.04),
    ],
)
def test_kinks_are_as_accurate_as_smooth_functions(drift, f, observation, h, noise):
    model = model_of(drift, observation, str(noise))
    _, record = zakai.simulate(model, TIMES, seed=2)
    result = zakai.filter(model, record, "yau-yau")
    mean, deviation, log_likelihood = exact(f, h, noise, record.values[:, 0])
    errors = np.abs(result.mean[1:, 0] - mean) / deviation, np.abs(np.sqrt(result.variance[1:, 0]) / deviation - 1.0)
    assert np.max(errors) < 2e-5
    assert result.log_likelihood == pytest.approx(log_likelihood, abs=4e-5)
    assert np.max(errors) < 10.0 * np.nanmax(result.health["error_estimate"]) + 1e-5
    if any(jump in drift + observation for jump in ("sign", "heaviside", "floor")):
        assert np.nanmax(result.health["error_estimate"]) < 1e-5 and not result.warnings
        assert np.nanmax(zakai.smooth(model, record, "yau-yau").health["evidence_error"]) < 1e-6


FLAT = {
    "max(x, 0.9)": (0.012, [1.139, 0.988, 0.731, 0.919], lambda x: np.maximum(x, 0.9)),
    "min(x, 2*x)": (0.002, [-1.078, 0.321, -2.494, -3.329], lambda x: np.minimum(x, 2 * x)),
}


@pytest.mark.parametrize("method", ["limited-direct", "yau-yau"])
@pytest.mark.parametrize("formula", FLAT)
def test_sharp_samples_whose_grid_is_refined_to_its_largest_size(formula, method):
    """A refined grid that is cut at its largest size loses the part of the density that the sample does not see."""
    variance, values, h = FLAT[formula]
    times = np.array([0.35, 0.4, 0.55, 0.8])
    model = zakai.Model(
        state=["x"], drift=["-x/2"], observation=[formula], observation_kind="samples", observation_noise=[[variance]],
        prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.8]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(times, np.array(values)[:, None], "samples"), method)
    x = np.linspace(-6.0, 5.0, 2201)
    p, last, expected = np.exp(-0.5 * (x - 0.3) ** 2 / 0.8), 0.0, []
    for time, value in zip(times, values, strict=True):
        decay, last = np.exp(-0.5 * (time - last)), time
        kernel = np.exp(-0.5 * (x[:, None] - decay * x) ** 2 / (1.0 - decay**2))
        p = kernel @ (p / p.sum()) / kernel.sum(axis=0).max() * np.exp(-0.5 * (value - h(x)) ** 2 / variance)
        mass = p.sum()
        mean = x @ p / mass
        expected.append((mean, np.sqrt((x - mean) ** 2 @ p / mass), np.log(mass / np.sqrt(2 * np.pi * variance))))
    mean, deviation, gained = np.array(expected).T
    assert np.abs(result.mean[1:, 0] - mean).max() < 1e-4 * deviation.min()
    assert np.abs(np.sqrt(result.variance[1:, 0]) / deviation - 1).max() < 1e-4
    assert result.log_likelihood_increments[1:] == pytest.approx(gained, abs=1e-3)


@pytest.mark.parametrize(
    ("drift", "f", "bound"),
    [
        ("-3*sign(x)", lambda x: -3.0 * np.sign(x), 2e-4),
        ("-abs(x)*x - 2*max(x, 1/2)", lambda x: -np.abs(x) * x - 2.0 * np.maximum(x, 0.5), 5e-6),
    ],
)
def test_increments_of_a_drift_with_jumps_or_kinks(drift, f, bound):
    times, noise = np.cumsum([0.05, 0.3, 1.0, 0.02, 0.5, 0.1]), 0.1
    model = zakai.Model(
        state=["x"], drift=[drift], observation=["x"], observation_noise=[[noise]],
        prior={"kind": "gaussian", "mean": [0.1], "cov": [[0.25]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, times, seed=2)
    result = zakai.filter(model, record, "yau-yau")
    rates = record.values[:, 0] / np.diff(times, prepend=0.0)
    potentials = [lambda x, r=r: (x * r - 0.5 * x**2) / noise for r in rates]
    parts = []
    for count in (800, 1600):
        faces = np.round(np.linspace(-4.0, 4.0, count + 1), 9)  # a face lies at each jump
        zero = [np.zeros_like] * len(times)
        found = posterior(f, lambda x: -0.5 * (x - 0.1) ** 2 / 0.25, times, zero, faces, 1e-3, 200, potentials)
        parts.append(np.concatenate([np.ravel(part) for part in found]))
    exact = parts[1] + (parts[1] - parts[0]) / 3.0
    deviation = np.sqrt(exact[6:12])
    errors = np.abs(result.mean[1:, 0] - exact[:6]) / deviation, np.abs(np.sqrt(result.variance[1:, 0]) / deviation - 1.0)
    assert np.max(errors) < bound
    assert result.log_likelihood == pytest.approx(exact[-1], abs=bound)
    assert np.max(errors) < 10.0 * np.nanmax(result.health["error_estimate"])


def test_a_tank_that_empties_through_a_hole_is_filtered_like_one_with_a_smooth_law():
    def tank(root):
        parts = {"observation": ["h"], "observation_kind": "samples", "observation_noise": [["0.01"]], "diffusion": [["0.1"]]}
        prior = {"kind": "gaussian", "mean": [1.0], "cov": [[0.05]]}
        return zakai.Model(state=["h"], drift=[f"0.5 - 0.4*sqrt({root})"], prior=prior, **parts)

    rng = np.random.default_rng(5)
    times = np.cumsum(10 ** rng.uniform(-2.5, -0.2, 120))
    record = zakai.simulate(tank("h"), times, seed=5)[1]
    values = np.where(rng.random(120) < 0.2, np.nan, record.values[:, 0])[:, None]
    record = zakai.Record(times, values, "samples")
    kinked, smooth = (zakai.filter(tank(root), record) for root in ("max(h, 0)", "0.5*(h + sqrt(h**2 + 0.0001))"))
    # The level stays 10 deviations above zero.
    assert np.abs((kinked.mean - smooth.mean) / np.sqrt(smooth.variance)).max() < 1e-3
    assert np.nanmax(kinked.health["error_estimate"]) < 1e-4


@pytest.mark.parametrize("diffusion", ["1 + sin(3*t)/2", "1 + sin(3*t)/1000"])
def test_a_kink_in_h_leaves_the_mass_of_a_prediction_with_a_diffusion_of_t(diffusion):
    model = zakai.Model(
        state=["x"], drift=["-x"], diffusion=[[diffusion]], observation=["abs(x + 1)"], observation_kind="samples",
        observation_noise=[["0.01"]], prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.3]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.05, 0.85], [0.15, np.nan], "samples"), "yau-yau")
    assert abs(result.log_likelihood_increments[2]) < 1e-6 and not result.warnings


@pytest.mark.parametrize("method", ["limited-direct", "yau-yau"])
def test_a_jump_of_a_likelihood_that_no_grid_resolves_does_not_widen_the_grid(method):
    times = np.cumsum(np.tile([0.09, 0.05, 0.16, 0.3, 0.6], 5))
    values = np.tile([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0], 4)[: len(times)]
    model = zakai.Model(
        state=["x"], drift=["-x/2"], observation=["1/10 + 4/5*heaviside(x - 3/10)"], observation_kind="samples",
        observation_family="bernoulli", prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(times, values, "samples"), method)
    x = np.arange(-7.995, 8.0, 0.01)  # 3/10 lies between two points
    p, last = np.exp(-0.5 * x**2), 0.0
    for k, (time, value) in enumerate(zip(times, values, strict=True), 1):
        decay, last = np.exp(-0.5 * (time - last)), time
        kernel = np.exp(-0.5 * (x[:, None] - decay * x) ** 2 / (1.0 - decay**2))
        p = kernel @ (p / p.sum()) * np.abs(1.0 - value - np.where(x > 0.3, 0.9, 0.1))
        p = p / p.sum()
        deviation = np.sqrt(p @ (x - p @ x) ** 2)
        assert abs(result.mean[k, 0] - p @ x) < 0.03 * deviation
        assert abs(np.sqrt(result.variance[k, 0]) / deviation - 1.0) < 0.03


@pytest.mark.parametrize("drift", ["push(x)", "max(-x, -x/2 - 1/2)"])
def test_a_drift_with_kinks_that_contracts_a_broad_prior(drift):
    nodes, heights = np.linspace(-4.0, 4.0, 9), np.array([6.0, 3.0, -1.0, -1.0, 0.0, 1.0, 1.0, -3.0, -6.0])
    lengths = [0.7, 0.1, 0.1, 0.3, 0.7, 0.1, 0.1, 0.3]
    values = [1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
    model = zakai.Model(
        state=["x"], drift=[drift], diffusion=[["3/5"]], observation=["1/(1 + exp(-x))"], observation_kind="samples",
        observation_family="bernoulli", tables={"push": (nodes, heights)},
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(np.cumsum(lengths), values, "samples"))
    x, h, G = np.linspace(-6.5, 6.5, 651), 0.02, 0.36
    between = 0.5 * (x[1:] + x[:-1])
    f = np.interp(between, nodes, heights) if "push" in drift else np.maximum(-between, -between / 2 - 0.5)
    # Scharfetter and Gummel's fluxes between cells, which are exact where f is constant.
    to, back = (0.5 * G / h**2 * u / np.expm1(u) for u in (-2.0 * f * h / G - 1e-12, 2.0 * f * h / G + 1e-12))
    rates = np.diag(to, -1) + np.diag(back, 1)
    rates -= np.diag(rates.sum(axis=0))
    known = {length: expm(length * rates) for length in set(lengths)}
    p, chance = np.exp(-0.5 * x**2), 1.0 / (1.0 + np.exp(-x))
    for k, (length, value) in enumerate(zip(lengths, values, strict=True), 1):
        p = known[length] @ (p / p.sum()) * (chance if value else 1.0 - chance)
        p = p / p.sum()
        deviation = np.sqrt(p @ (x - p @ x) ** 2)
        assert abs(result.mean[k, 0] - p @ x) < 2e-3 * deviation
        assert abs(np.sqrt(result.variance[k, 0]) / deviation - 1.0) < 2e-3


def test_a_jump_of_the_drift_where_the_sensor_jumps_is_one():
    def filtered(place):
        model = zakai.Model(
            state=["x"], drift=[f"-0.8*sign(x - {place})"], diffusion=[[0.7]], observation=["floor(2*x)/2"],
            observation_kind="samples", observation_noise=[[0.04]], prior={"kind": "gaussian", "mean": [0.3], "cov": [[1.5]]},
        )  # fmt: skip
        return zakai.filter(model, zakai.Record([0.3, 0.6, 1.0, 1.5], [[0.5], [0.02], [0.48], [np.nan]], "samples"))

    one, other = filtered(0), filtered(1e-5)
    assert np.isfinite(one.mean).all() and np.abs(one.mean - other.mean).max() < 1e-4


@pytest.mark.parametrize(("step", "noise"), [("1/20", 1e-2), ("1/200", 1e-5)])
def test_a_finely_quantised_sensor_is_accurate_and_its_error_is_in_the_estimate(step, noise):
    """Where a prior spans hundreds of jumps of a sensor, these act as averages over the spacing of the grid."""
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=[f"{step}*floor(x/({step}))"], observation_noise=[[noise]],
        observation_kind="samples", prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, TIMES, seed=1)
    result = zakai.filter(model, record, "yau-yau")
    q = float(Fraction(step))
    h = min(q / 16.0, 1.0 / 1600.0)
    faces = h * np.arange(round(-6.0 / h), round(6.0 / h) + 1)
    x = faces[:-1] + 0.5 * h
    p, last = np.exp(-0.5 * x**2), 0.0
    for k, (time, value) in enumerate(zip(TIMES, record.values[:, 0], strict=True), 1):
        decay, last = np.exp(last - time), time
        sums = np.append(0.0, np.cumsum(p) / np.sum(p))
        kernel = np.exp(-(faces**2) / (1.0 - decay**2))
        p = fftconvolve(np.diff(np.interp(faces / decay, faces, sums)), kernel, mode="same")
        p = np.maximum(p, 0.0) * np.exp(-0.5 * (value - q * np.floor(x / q)) ** 2 / noise)
        p = p / np.sum(p)
        deviation = np.sqrt((x - x @ p) ** 2 @ p)
        error = abs(result.mean[k, 0] - x @ p) / deviation
        assert error < min(2e-4, result.health["error_estimate"][k])
        assert abs(np.sqrt(result.variance[k, 0]) / deviation - 1.0) < 1e-3


@pytest.mark.parametrize("kind", ["samples", "increments"])
def test_smoothing_leaves_the_evidence_of_the_filter_where_formulas_have_kinks(kind):
    sensor = "abs(x)" if kind == "increments" else "heaviside(x - 2/5)"
    model = zakai.Model(
        state=["x"], drift=["-x*abs(x)"], observation=[sensor], observation_noise=[["1" if kind == "increments" else "0.04"]],
        observation_kind=kind, prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip
    _, record = zakai.simulate(model, 0.5 * np.arange(1, 11), seed=3)
    result = zakai.smooth(model, record)
    assert not result.warnings and np.nanmax(result.health["evidence_error"]) < 1e-5
