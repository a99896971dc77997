"""The references are held to closed forms, and their texts to their numpy functions."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from scipy.linalg import expm, solve_continuous_lyapunov

from references.kolmogorov import Box, propagate
from references.systems import planar, scalar

SYSTEMS = [scalar(), planar()]


def numbers(text, system, x, t):
    expressions = sympy.Matrix(sympy.sympify(text))
    values = dict(zip(sympy.symbols(system.state), x, strict=True)) | {sympy.Symbol("t"): t}
    return np.array(expressions.subs(values).evalf(20), dtype=float)


def gaussian(x, mean, cov):
    d = x - mean
    exponent = -0.5 * np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d)
    return np.exp(exponent) / np.sqrt(np.linalg.det(2.0 * np.pi * cov))


@pytest.mark.parametrize(
    ("theta", "points", "half_width", "allowed"),
    [
        (np.array([[0.7]]), 256, 12.0, 1e-11),
        (np.array([[0.7, -0.9], [0.5, 0.3]]), 96, 9.0, 1e-10),
    ],
)
def test_the_reference_reproduces_the_density_of_an_ornstein_uhlenbeck_process(
    theta, points, half_width, allowed
):
    n, time = len(theta), 0.3
    G = np.array([[1.0, 0.4], [0.4, 0.8]])[:n, :n]
    box = Box(half_width, points, np.zeros(n))
    mean, cov = np.array([0.8, -0.5])[:n], 0.3 * np.eye(n)
    flow = expm(-theta * time)
    stationary = solve_continuous_lyapunov(theta, G)
    exact = gaussian(box.x, flow @ mean, flow @ (cov - stationary) @ flow.T + stationary)
    found = propagate(
        box,
        gaussian(box.x, mean, cov),
        0.0,
        time,
        lambda x, t: -x @ theta.T,
        lambda x, t: np.full(x.shape[:-1], -np.trace(theta)),
        lambda t: G,
        lambda x, t: np.zeros(x.shape[:-1]),
    )
    assert np.max(np.abs(found - exact)) <= allowed * np.max(exact)


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_the_texts_of_a_system_say_what_its_functions_say(system):
    x, t = np.array([0.37, -0.81])[: system.n], 0.23

    def text(value):
        return numbers(value, system, x, t)

    diffusion, process = text(system.diffusion), text(system.process_noise)
    pairs = {
        "drift": (text(system.drift).ravel(), system.f(x, t)),
        "covariance": (diffusion @ process @ diffusion.T, system.G(t)),
        "observation": (text(system.observation).ravel(), system.h(x, t)),
        "observation noise": (text(system.observation_noise), system.S(t)),
        "G": (text(system.yau["G"]), system.G(t)),
        "L": (text(system.yau["L"]), system.L(t)),
        "l": (text(system.yau["l"]).ravel(), system.l(t)),
        "phi": (text([system.yau["phi"]]).ravel(), system.phi(x, t)),
    }
    for name, (found, expected) in pairs.items():
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14, err_msg=name)


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_the_quadratic_of_a_system_is_q_and_its_divergence_is_that_of_the_drift(system):
    names = sympy.symbols(system.state)
    t = sympy.Symbol("t")
    yau = {
        key: sympy.Matrix([sympy.sympify(value)])
        if key in ("phi", "r")
        else sympy.Matrix(sympy.sympify(value))
        for key, value in system.yau.items()
    }
    G, L, l, Q, p = (yau[key] for key in ("G", "L", "l", "Q", "p"))
    phi, r, x = yau["phi"][0], yau["r"][0], sympy.Matrix(names)
    gradient = sympy.Matrix([phi.diff(name) for name in names])
    S, h = (
        sympy.Matrix(sympy.sympify(system.observation_noise)),
        sympy.Matrix(sympy.sympify(system.observation)),
    )
    at = dict(zip(names, (0.37, -0.81), strict=False)) | {t: 0.23}

    def value(expression):
        return np.array(sympy.Matrix([expression]).subs(at).evalf(20), dtype=float)

    hessian = sympy.hessian(phi, names)
    noise = h.subs(at).evalf(30).T * S.subs(at).evalf(30).inv() * h.subs(at).evalf(30)
    q = (
        value(
            2 * phi.diff(t)
            + (G * hessian).trace()
            + (gradient.T * G * gradient)[0]
            + 2 * ((L * x + l).T * gradient)[0]
            + 2 * L.trace()
        )
        + float(noise[0])
    ).item()
    assert q == pytest.approx(value((x.T * Q * x)[0] + (p.T * x)[0] + r).item(), abs=1e-13)
    drift = sympy.sympify(system.drift)
    divergence = value(sum(f.diff(name) for f, name in zip(drift, names, strict=True))).item()
    point = np.array([0.37, -0.81])[: system.n]
    assert divergence == pytest.approx(float(system.div_f(point, 0.23)), abs=1e-13)
    assert value(phi.diff(t)).item() != pytest.approx(0.0, abs=1e-3)
