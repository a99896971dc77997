"""Yau forms and quadratic q of random systems, against differences of phi in 40 digits, which share no code with the proofs."""

import dataclasses
import random

import mpmath
import numpy as np
import pytest
import sympy as sp

import zakai
from zakai.algebra.conditions import all_hold
from zakai.algebra.quadratics import decided_q
from zakai.algebra.systems import yau_system
from zakai.algebra.yau import YauForm, yau_form
from zakai.methods.system.potential import potential_of

T = sp.Symbol("t", real=True)
X = sp.symbols("x1:4", real=True)
STEP = mpmath.mpf(10) ** -12
PHI = {
    "powers": lambda u, v: u**4 / 7 + u * v,
    "log cosh": lambda u, v: sp.log(sp.cosh(u)),
    "sine": lambda u, v: sp.sin(u) + sp.cos(v) / 3,
    "cubic": lambda u, v: u**2 * v / 5 + v**3,
    "logarithm": lambda u, v: sp.log(1 + u**2) + sp.exp(-v),
    "atan": lambda u, v: u * sp.atan(u) - sp.log(1 + u**2) / 2,
    "products": lambda u, v: sp.sin(u) * sp.cos(v) + sp.tanh(u) ** 2,
    "root": lambda u, v: sp.sqrt(1 + u**2) + u * sp.erf(u) + sp.exp(-(u**2)),
}


def system(name, n, seed):
    rng = random.Random(seed)

    def number():
        return sp.Rational(rng.randint(-9, 9), 7) * rng.choice([1, sp.cos(T / 3), 1 + T / 10, sp.exp(-T / 5)])

    x = X[:n]
    u, v = (sum(number() * s for s in x) + x[k] / 3 for k in (0, -1))
    G = sp.Matrix(n, n, lambda i, j: 2 + sp.sin(T + i) / 4 if i == j else sp.Rational(1, 5))
    slopes = [sp.diff(PHI[name](u, v), s) for s in x]
    drift = [sum(number() * s for s in x) + number() + sum(G[i, j] * slopes[j] for j in range(n)) for i in range(n)]
    return zakai.Model(state=[s.name for s in x], drift=drift, process_noise=G.tolist(), observation=[x[0]])


def gradient(phi, x, at, t):
    f = sp.lambdify((x, T), phi, "mpmath")
    shifted = ([c + k * STEP * (i == j) for j, c in enumerate(at)] for i in range(len(at)) for k in (1, -1))
    values = [f(point, t) for point in shifted]
    return [(a - b) / (2 * STEP) for a, b in zip(values[::2], values[1::2])]


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("name", PHI)
def test_the_drift_is_affine_plus_g_times_the_slope_of_phi(name, n):
    model = system(name, n, seed=n)
    form = yau_form(model)
    assert isinstance(form, YauForm) and (form.potential is not None or n == 3)
    rng = random.Random(3)
    with mpmath.workdps(40):
        for _ in range(3):
            at, t = [mpmath.mpf(rng.randint(-900, 900)) / 1009 for _ in range(n)], mpmath.mpf(rng.randint(0, 900)) / 337
            values = {**dict(zip(model.x, at)), model.t: t}
            L, l, G, f = (m.subs(values).evalf(40) for m in (form.matrix, form.offset, model.covariance, model.drift))
            slopes = list(form.gradient.subs(values).evalf(40))
            if form.potential is not None:
                exact = gradient(form.potential.subs(dict(zip(model.x, X))), X[:n], at, t)
                assert max(abs(a - b) for a, b in zip(slopes, exact)) < 1e-15
            found = L * sp.Matrix(at) + l + G * sp.Matrix(slopes)
            assert max(abs(e) for e in found - f) < 1e-15


@pytest.mark.parametrize(
    ("drift", "phi"),
    [
        ("1/x", sp.log),
        ("2/x - x", lambda x: 2 * sp.log(x)),
        ("tan(x)", lambda x: -sp.log(sp.cos(x))),
        ("1/(1 + exp(-x))", lambda x: x + sp.log(1 + sp.exp(-x))),
    ],
)
def test_a_singular_drift_has_a_potential_in_closed_form(drift, phi):
    model = zakai.Model(state=["x"], drift=[drift], observation=["x"])
    x, form = model.x[0], yau_form(model)
    rest = sp.diff(form.potential - phi(x), x, 2)
    assert all(abs(rest.subs(x, at).evalf(30)) < 1e-20 for at in (0.3, 0.7, 1.2))


@pytest.mark.parametrize("name", PHI)
def test_one_changed_number_leaves_no_yau_form(name):
    model = system(name, 2, seed=8)
    drift = [model.drift[0] + sp.sin(model.x[1]) / 1000, model.drift[1]]
    changed = zakai.Model(
        state=model.state, drift=drift, process_noise=model.process_noise.tolist(), observation=[model.x[0]]
    )
    form = yau_form(changed)
    assert not isinstance(form, YauForm) and form.holds is False and " at " in form.witness


def test_q_of_a_moving_log_cosh_is_the_quadratic_that_differences_give():
    # phi = log cosh(q(t) x + d(t)) with q' + a q = 0 and d' + b q = 0 leaves a quadratic q.
    x = X[0]
    a, q, d = sp.cos(T) / 3, sp.exp(-sp.sin(T) / 3), sp.Rational(1, 2)
    G = 2 + sp.sin(T) / 4
    model = zakai.Model(
        state=["x1"], drift=[a * x + G * q * sp.tanh(q * x + d)], process_noise=[[G]], observation=[x * (1 + T)]
    )
    found = yau_system(model)
    assert found is not None and found.unobserved is not None and found.full is not None
    assert all("no proof" not in decided_q(model, energy).evidence for energy in (False, True))
    phi = sp.log(sp.cosh(q * x + d))
    exact = 2 * sp.diff(phi, T) + G * (sp.diff(phi, x, 2) + sp.diff(phi, x) ** 2) + 2 * a * x * sp.diff(phi, x) + 2 * a
    for energy, quadratic in ((0, found.unobserved), (x**2 * (1 + T) ** 2, found.full)):
        value = quadratic.matrix[0] * x**2 + quadratic.linear[0] * x + quadratic.constant
        for at, t in ((0.3, 0.7), (-1.2, 2.1), (2.0, 0.1)):
            difference = (exact + energy + 2 * value.subs(model.x[0], x)).subs({x: at, T: t})
            assert abs(difference.evalf(30)) < 1e-12


def test_phi_by_quadrature_is_that_in_closed_form():
    model = system("log cosh", 2, seed=5)
    form = yau_form(model)
    open_form = dataclasses.replace(form, potential=None)
    points = np.random.default_rng(0).normal(size=(200, 2)) * 3
    closed, line = (potential_of(one, model) for one in (form, open_form))
    origin = closed(np.zeros((1, 2)), 0.7, model.theta())
    np.testing.assert_allclose(
        line(points, 0.7, model.theta()), closed(points, 0.7, model.theta()) - origin, rtol=0, atol=1e-10
    )
    # The value at a point does not depend on what else is asked for.
    assert np.array_equal(line(points, 0.7, model.theta())[3:4], line(points[3:4], 0.7, model.theta()))


def test_a_full_moving_covariance_in_six_states_is_decided():
    x = sp.symbols("x1:7", real=True)
    G = sp.Matrix(6, 6, lambda i, j: 2 + sp.sin(T + i) if i == j else sp.cos(T / (min(i, j) + 2)) / (5 + i + j))
    p = [sp.cos(T / (i + 2)) + sp.Rational(i, 3) for i in range(6)]
    slope = sp.tanh(sum(a * s for a, s in zip(p, x)))
    drift = [-x[i] + sum(G[i, j] * p[j] for j in range(6)) * slope for i in range(6)]
    model = zakai.Model(state=[s.name for s in x], drift=drift, process_noise=G.tolist(), observation=[x[0]])
    analysis = zakai.analyze(model)
    assert str(analysis.yau_form.potential).startswith("log(cosh(")
    assert all_hold(analysis.methods["benes"]) is False
