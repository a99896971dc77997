"""The prior under a gauge: the mass of v_0 = e^-phi sigma_0 and its derivatives, against quadrature in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

import zakai
from zakai.methods.gaussian.family_prior import prior_families
from zakai.methods.gaussian.gauge import Gauge
from zakai.numerics.complex_step import STEP
from zakai.numerics.families import log_terms

LINE = ["a*tanh(a*x + b)"], lambda x, a, b: np.logaddexp(a * x[..., 0] + b, -a * x[..., 0] - b) - np.log(2)
KINKED = ["a*(2/sqrt(pi))*exp(-a**2*x**2)/(1 + b + erf(a*x))"], lambda x, a, b: np.log(1 + b + erf(a * x[..., 0]))
TURNED = (
    ["a*tanh(a*x + b*y)", "b*tanh(a*x + b*y)"],
    lambda x, a, b: np.logaddexp(x @ [a, b], -x @ [a, b]) - np.log(2),
)


def gaussian(mean, cov):
    return {"kind": "gaussian", "mean": mean, "cov": cov}


MIXTURE = {"kind": "mixture", "weights": [0.6, 0.4], "means": [[-1.0], [1.2]], "covs": [[[0.16]], [[0.25]]]}
DENSITY = {"kind": "density", "log_density": "-(x**2 - 1)**2"}


def normal(x, mean, cov):
    away = x - np.asarray(mean)
    cov = np.asarray(cov)
    return np.exp(-0.5 * np.einsum("...i,ij,...j", away, np.linalg.inv(cov), away)) / np.sqrt(np.linalg.det(2 * np.pi * cov))


def mixture(x):
    return 0.6 * normal(x, [-1.0], [[0.16]]) + 0.4 * normal(x, [1.2], [[0.25]])


def line(half, count):
    points = np.linspace(-half, half, count)
    return points[:, None], points[1] - points[0]


def plane():
    points, cell = line(9.0, 361)
    return np.stack(np.meshgrid(points[:, 0], points[:, 0], indexing="ij"), axis=-1).reshape(-1, 2), cell**2


OBLIQUE = [[0.5, 0.2], [0.2, 0.4]]
THIN = np.outer([0.6, -0.3], [0.6, -0.3])


def thin():
    """A covariance of rank one: points along it, and the mass of each."""
    s, cell = line(9.0, 2001)
    return np.array([0.3, -0.2]) + s * np.array([0.6, -0.3]), np.exp(-0.5 * s[:, 0] ** 2) / np.sqrt(2 * np.pi) * cell


CASES = {
    "benes, narrow": (LINE, gaussian([0.4], [[0.01]]), line(3.0, 20001), lambda x: normal(x, [0.4], [[0.01]])),
    "benes, wide": (LINE, gaussian([0.4], [[400.0]]), line(180.0, 200001), lambda x: normal(x, [0.4], [[400.0]])),
    "benes, mixture": (LINE, MIXTURE, line(6.0, 4001), mixture),
    "benes, density": (LINE, DENSITY, line(6.0, 4001), lambda x: np.exp(-((x[..., 0] ** 2 - 1) ** 2))),
    "erf": (KINKED, MIXTURE, line(6.0, 4001), mixture),
    "turned": (TURNED, gaussian([0.3, -0.2], OBLIQUE), plane(), lambda x: normal(x, [0.3, -0.2], OBLIQUE)),
    "turned, thin": (TURNED, gaussian([0.3, -0.2], THIN.tolist()), thin(), lambda x: 1.0),
    "turned, a point": (TURNED, gaussian([0.3, -0.2], [0.0, 0.0]), (np.array([[0.3, -0.2]]), 1.0), lambda x: 1.0),
}


@pytest.mark.parametrize("origin", [0.0, 0.7])
@pytest.mark.parametrize("case", CASES)
def test_the_mass_under_the_gauge_and_its_gradient_are_those_of_quadrature(case, origin):
    (drift, phi), prior, (x, cell), sigma = CASES[case]
    state = ["x", "y"][: len(drift)]
    model = zakai.Model(state=state, drift=drift, observation=["x"], parameters={"a": 0.8, "b": 0.3}, prior=prior)
    theta = model.theta()

    def mass(values):
        gauge = Gauge(model, values, np.full(model.n, origin))
        families = prior_families(gauge, model, model.prior).families
        return np.sum(families.signs * np.exp(log_terms(families)))

    def expected(a, b):
        return np.sum(sigma(x) * np.exp(-phi(x, a, b)) * cell)

    a, b = theta
    assert mass(theta) == pytest.approx(expected(a, b), rel=1e-11)
    gradient = [mass(theta + 1j * STEP * direction).imag / STEP for direction in np.eye(2)]
    step = 1e-4
    wanted = np.array([expected(a + step, b) - expected(a - step, b), expected(a, b + step) - expected(a, b - step)]) / (2 * step)
    assert gradient == pytest.approx(wanted, rel=1e-6, abs=1e-9)


KINDS = {
    "mixture": MIXTURE,
    "density": DENSITY,
    "wide": gaussian([0.4], [[400.0]]),
}
DRIFTS = {
    "benes": ("benes", ["a*tanh(a*x + b)"], {"a": 0.8, "b": 0.3}),
    "erf": ("hu-yau", ["x + (2/sqrt(pi))*exp(-x**2)/(a + erf(x))"], {"a": 1.5}),
}


@pytest.mark.parametrize(
    ("kind", "drift"), [(kind, "benes") for kind in KINDS] + [(kind, "erf") for kind in KINDS if kind != "wide"]
)
def test_the_log_likelihood_has_the_gradient_of_differences_for_every_kind_of_prior(kind, drift):
    method, field, parameters = DRIFTS[drift]
    model = zakai.Model(
        state=["x"], drift=field, observation=["c*x"], parameters={**parameters, "c": 1.2}, prior=KINDS[kind]
    )
    record = zakai.Record([0.1, 0.15, 0.4], [[0.2], [np.nan], [0.3]], "increments")
    likelihood, theta = zakai.log_likelihood(model, record, method), model.theta()
    value, gradient = likelihood.value_and_gradient(theta)
    assert value == pytest.approx(zakai.filter(model, record, method).log_likelihood, abs=1e-10)

    def at(**changed):
        return zakai.filter(model.with_parameters(**changed), record, method).log_likelihood

    for index, name in enumerate(model.parameters):
        above, below = (at(**{name: theta[index] + shift}) for shift in (1e-4, -1e-4))
        assert gradient[index] == pytest.approx((above - below) / 2e-4, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("variance", [1e4, 1e8])
def test_a_posterior_beyond_the_nodes_of_a_split_prior_is_warned_of(variance):
    # The observations say x = 20 to 30 deviations of the prior.
    x = 25 * np.sqrt(variance)
    prior = {"kind": "gaussian", "mean": [0.3], "cov": [[variance]]}
    system = zakai.Model(state=["x"], drift=["tanh(x)"], observation=["x"], observation_noise=[[1e-8]], prior=prior)
    result = zakai.filter(system, zakai.Record([1e-6], [[1e-6 * x]], "increments"), "benes")
    assert any("edge_weight" in said for said in result.warnings)
