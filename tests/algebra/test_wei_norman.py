"""The equations of Wei and Norman: against those derived by hand, and against the equation that they solve."""

from __future__ import annotations

import dataclasses
import json
import random

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import zakai
from algebra.random_systems import conjugated, polynomial_system
from references.dmz import dmz
from references.kolmogorov import Box
from references.wei_norman import residuals
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.exponentials import wei_norman_filter
from zakai.algebra.named_conditions import dong_chen_yau_class
from zakai.algebra.wei_norman import NoFactorisation, wei_norman


def system(drift, observation, **keys) -> zakai.Model:
    return zakai.Model(state=[f"x{i + 1}" for i in range(len(drift))], drift=drift, observation=observation, **keys)


def equations(model):
    algebra = estimation_algebra(model)
    assert algebra.no_wei_norman == ""
    return algebra.wei_norman


def same(found, expected) -> bool:
    return len(found) == len(expected) and all(sp.simplify(a - b) == 0 for a, b in zip(found, expected, strict=True))


def linear(n: int, seed: int, **keys) -> zakai.Model:
    """A linear system with offsets, all of whose states are observed through a matrix that is not diagonal."""
    rng = random.Random(seed)
    x = [sp.Symbol(f"x{i + 1}", real=True) for i in range(n)]
    mixed = sp.Matrix(n, n, lambda i, j: rng.randint(-3, 3))
    H = sp.Matrix(n, n, lambda i, j: rng.randint(1, 3) if i == j else (rng.randint(-2, 2) if j > i else 0))
    drift = mixed * sp.Matrix(x) + sp.Matrix([rng.randint(1, 4) for _ in x])
    return system(list(drift), list(H * sp.Matrix(x) + sp.Matrix([rng.randint(-2, 2) for _ in x])), **keys)


MAXIMAL_RANK = {
    **{f"linear, {n}": linear(n, n) for n in (1, 2, 3)},
    "Benes, 1": system(["tanh(x1)"], ["2*x1 + 1"]),
    "Benes, 2": system(["tanh(x1 + x2)", "tanh(x1 + x2)"], ["x1 + x2 - 1", "3*x2"]),
    # A rotation about the axis of the gradient: Omega is not zero.
    "Benes, 3": system(
        [f"tanh(x1 + x2 + x3) + 2*({rotation})" for rotation in ("x2 - x3", "x3 - x1", "x1 - x2")],
        ["x1 + 2*x2", "x2 - x3 + 1", "x3"],
    ),
}


def parts_of_theorem_6(model):
    """H, c_ij = d_i f_j - d_j f_i, and a, b of eta = x'a x + b.x + d."""
    x, analysis = model.x, zakai.analyze(model)
    eta = sp.Poly(analysis.eta, *x)
    a = sp.hessian(eta.as_expr(), x) / 2
    b = sp.Matrix([eta.as_expr().diff(x_i).subs(dict.fromkeys(x, 0)) for x_i in x])
    return sp.Matrix(model.observation).jacobian(x), sp.Matrix(analysis.omega), a, b


@pytest.mark.parametrize("name", MAXIMAL_RANK)
def test_the_robust_form_is_the_corrected_theorem_6_of_yau(name):
    model = MAXIMAL_RANK[name]
    n, found = model.n, equations(model)
    H, c, a, b = parts_of_theorem_6(model)
    s, r = sp.Matrix(found.statistics[:n]), sp.Matrix(found.statistics[n : 2 * n])
    drive = H.T * sp.Matrix(found.path)
    ds = r + c.T * s + drive
    dr = a * s
    dT = drive.dot(drive) / 2 + r.dot(r) / 2 + r.dot(drive) + b.dot(s) / 2
    dT += sum(ds[j] * s[k] * c[k, j] for j in range(n) for k in range(j + 1, n))
    dT -= sum(s[i] ** 2 * (sum(c[i, j] ** 2 for j in range(n)) - a[i, i]) for i in range(n)) / 2
    dT -= sum(s[i] * s[k] * (sum(c[i, j] * c[k, j] for j in range(n)) - a[i, k]) for i in range(n) for k in range(i + 1, n))
    assert same(list(found.robust.values()), [*ds, *dr, dT])
    assert name in ("linear, 1", "Benes, 1", "Benes, 2") or not c.is_zero_matrix


@pytest.mark.parametrize("n", [2, 3])
def test_both_forms_hold_for_a_covariance_that_is_not_the_identity(n):
    diffusion = [[str(2 + i) if i == j else "1" if j == i + 1 else "0" for j in range(n)] for i in range(n)]
    noise = [["2" if i == j else "1/2" for j in range(n)] for i in range(n)]
    model = linear(n, 10 + n, diffusion=diffusion, observation_noise=noise)
    found, G = equations(model), sp.Matrix(model.covariance)
    H, omega, A, bb = parts_of_theorem_6(model)
    c = -omega
    weighted = sp.Matrix(model.observation_noise).inv()
    s, r = sp.Matrix(found.statistics[:n]), sp.Matrix(found.statistics[n : 2 * n])

    def form(u):
        return (u.T * G * u)[0]

    def last(ds):
        order = sum(ds[k] * s[j] * c[j, k] for j in range(n) for k in range(j))
        return -form(c * s) / 2 + (s.T * A * s)[0] / 2 + bb.dot(s) / 2 - order

    drive = H.T * weighted * sp.Matrix(found.path)
    ds = G * (r + c * s + drive)
    assert same(list(found.robust.values()), [*ds, *(A * s), form(r + drive) / 2 + last(ds)])
    rates = weighted * sp.Matrix(found.rates)
    offset = sp.Matrix(model.observation).subs(dict.fromkeys(model.x, 0))
    ds = G * (r + c * s)
    expected = [*ds, *(A * s + H.T * rates), form(r) / 2 + last(ds) + offset.dot(rates)]
    assert same(list(found.stratonovich.values()), expected)


CLASS_OF_DONG_CHEN_YAU = {
    "3.4": zakai.load_model("gallery:dong-chen-yau-3-4"),
    "3.5": zakai.load_model("gallery:dong-chen-yau-3-5"),
    "passive": zakai.load_model("gallery:passive-drift"),
}


@pytest.mark.parametrize("name", CLASS_OF_DONG_CHEN_YAU)
def test_the_robust_form_is_theorem_4_1_of_dong_chen_and_yau(name):
    drift = CLASS_OF_DONG_CHEN_YAU[name].drift
    model = system(list(drift), ["c*x1 + 2", "d*x1 - 1"], parameters={"c": 3, "d": "1/2"})
    found = equations(model)
    eta = sp.Poly(sp.expand(zakai.analyze(model).eta), model.x[0])
    a1, a2 = eta.coeff_monomial(model.x[0]), eta.coeff_monomial(model.x[0] ** 2)
    c = sp.Matrix(model.observation).diff(model.x[0])
    r2, r1, _ = found.statistics
    drive = c.dot(sp.Matrix(found.path))
    dr0 = r1**2 / 2 + a2 * r2**2 / 2 + a1 * r2 / 2 + drive * r1 + drive**2 / 2
    assert [str(e) for e in found.basis] == ["L0", "D1", "x1", "1"]
    assert same(list(found.robust.values()), [r1 + drive, a2 * r2, dr0])


def test_wongs_equations_whatever_gamma_is():
    found = equations(zakai.load_model("gallery:wong"))
    (s, r, _), (y,), (rate,) = found.statistics, found.path, found.rates
    assert [str(e) for e in found.basis] == ["L0", "D2 - D3", "x2 - x3", "1"]
    assert same(list(found.stratonovich.values()), [r, 3 * s + rate, r**2 + 3 * s**2])
    assert same(list(found.robust.values()), [r + y, 3 * s, r**2 + 3 * s**2 + 2 * r * y + y**2])


SOLVED = {
    **MAXIMAL_RANK,
    **{
        name: zakai.load_model(f"gallery:{name}")
        for name in ("wong", "dong-chen-yau-3-4", "passive-drift", "kalman-bucy-2d", "falling-body", "unobserved-double-well")
    },
    "two noises": linear(2, 5, diffusion=[["2", "1"], ["0", "1"]], observation_noise=[["2", "1"], ["1", "3"]]),
    "one of two observed": system(["x1 + 2*x2", "-x1 + 1"], ["a*x1 + 1"], parameters={"a": 2}),
    "silent": system(["-x1"], ["0"]),
    "no noise": system(["1"], ["sin(x1)"], diffusion=[["0"]]),
}


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("name", SOLVED)
def test_the_product_solves_the_equation(name, robust):
    model = SOLVED[name]
    kept = "kept as symbols" in estimation_algebra(model).parameters
    values = {} if kept else dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    assert max(map(abs, residuals(model, equations(model), robust, values))) < 1e-40


@pytest.mark.parametrize("seed", range(20))
def test_the_product_solves_the_equation_of_a_random_system_in_random_coordinates(seed):
    model = conjugated(polynomial_system(seed), seed)
    if estimation_algebra(model).verdict == "finite":
        for robust in (True, False):
            assert max(map(abs, residuals(model, equations(model), robust))) < 1e-40


@pytest.mark.parametrize("robust", [True, False])
def test_the_product_of_matrices_solves_its_equation_where_the_order_of_factors_matters(robust):
    def unit(i, j):
        return sp.Matrix(4, 4, lambda a, b: int((a, b) == (i, j)))

    # [E_3, [E_2, E_1]] is not zero, so that the exponentials do not commute on E_1.
    places = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3), (0, 3)]
    L0 = sp.diag(1, 3, 4, 9) + 2 * unit(0, 1) - unit(1, 3)
    elements = [L0, *(unit(*place) for place in places)]

    def coordinates(matrix):
        return tuple(sp.Integer(0) if place is None else matrix[place] for place in [None, *places])

    def bracket(a, b):
        return a * b - b * a

    constants = {(i, j): coordinates(bracket(elements[i], elements[j])) for i in range(7) for j in range(i + 1, 7)}
    h = unit(0, 1) + 2 * unit(1, 2) - unit(2, 3)
    found = wei_norman(sp.symbols("L0 E1:7", commutative=False), constants, [coordinates(h)])
    (y,), (rate,) = found.path, found.rates
    product = sp.eye(4)
    for r, element in zip(found.statistics, elements[1:], strict=True):
        product = (r * element).exp() * product
    form, generator = (found.robust, (-y * h).exp() * L0 * (y * h).exp()) if robust else (found.stratonovich, L0 + rate * h)
    left = sum((rate_k * product.diff(r) for r, rate_k in form.items()), sp.zeros(4)) + product * L0
    assert (left - generator * product).expand().is_zero_matrix


@pytest.mark.parametrize("robust", [True, False])
def test_a_product_with_one_wrong_coefficient_does_not_solve_it(robust):
    model = SOLVED["linear, 2"]
    right = equations(model)
    form = "robust" if robust else "stratonovich"
    for k, r in enumerate(right.statistics):
        changed = dict(getattr(right, form)) | {r: getattr(right, form)[r] + right.statistics[0] / 7}
        assert max(map(abs, residuals(model, dataclasses.replace(right, **{form: changed}), robust))) > 1e-6, k


@pytest.mark.parametrize(
    ("drift", "divergence", "primitive"),
    [
        ("-x", lambda x: -np.ones_like(x), lambda x: -(x**2) / 2),
        ("tanh(x)", lambda x: np.cosh(x) ** -2, lambda x: np.log(np.cosh(x))),
    ],
)
def test_the_product_applied_to_a_density_is_the_solution_of_the_equation(drift, divergence, primitive):
    model = zakai.Model(state=["x"], drift=[drift], observation=["2*x + 1/2"])
    f, h = {"-x": np.negative, "tanh(x)": np.tanh}[drift], lambda x: 2 * x + 0.5
    times, increments = np.array([0.1, 0.25, 0.4]), np.array([[0.3], [-0.1], [0.25]])
    box = Box(9.0, 256)
    x = box.axes[0]
    prior = np.exp(-((x - 0.4) ** 2)) + 0.5 * np.exp(-2 * (x + 0.8) ** 2)  # not a Gaussian

    def solution(dy):
        fields = (lambda x, t: f(x), lambda x, t: divergence(x[..., 0]), lambda t: np.eye(1), lambda x, t: h(x))
        return dmz(box, prior, times, dy, *fields, np.eye(1))

    expected, without = solution(increments), solution(0 * increments)
    found = equations(model)
    assert [str(e) for e in found.basis] == ["L0", "D1", "x", "1"]
    rates = sp.lambdify([found.statistics, found.rates], list(found.stratonovich.values()))
    r, start = np.zeros(3), 0.0
    for k, stop in enumerate(times):
        rate = increments[k] / (stop - start)
        r = solve_ivp(lambda t, r, rate=rate: rates(r, rate), (start, stop), r, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        # exp(r1 D) phi = exp(F(x) - F(x + r1)) phi(x + r1) with F' = f
        shifted = np.fft.irfft(np.fft.rfft(without[k]) * np.exp(box.gradient_symbols[0] * r[0]), box.points)
        sigma = np.exp(r[2] + r[1] * x + primitive(x) - primitive(x + r[0])) * shifted
        inside = np.abs(x) < 5
        assert np.max(np.abs(sigma - expected[k])[inside]) < 1e-9 * np.max(expected[k])
        assert np.max(np.abs(without[k] - expected[k])) > 0.05 * np.max(expected[k])
        start = stop


def test_the_forms_of_the_analysis_show_the_equations():
    analysis = zakai.analyze(zakai.load_model("gallery:dong-chen-yau-3-4"))
    found = analysis.algebra.wei_norman
    page, read, latex = str(analysis), json.loads(analysis.to_json())["algebra"]["wei_norman"], analysis.to_latex()
    assert found.product == "exp(r3) exp(r2*x1) exp(r1*D1) exp(t*L0) sigma_0"
    for line in found.lines():
        assert line in page
    assert "  dr1/dt = c*y + r2" in str(found) and "  dr2 = (r1*(c**2 + 4)) dt + c dy" in str(found)
    assert read["product"] == found.product and (read["statistics"], read["path"]) == (["r1", "r2", "r3"], ["y"])
    assert read["robust"]["r1"] == "c*y + r2" and read["stratonovich"]["r2"] == str(found.stratonovich[found.statistics[1]])
    assert r"\sigma &= e^{r_{3}}\,e^{r_{2} x_{1}}\,e^{r_{1} D_{1}}\,e^{t L_{0}}\,\sigma_0, & r(0) &= 0" in latex
    assert r"\dot{r_{1}} &= c y + r_{2}" in latex and r"c \dot{y}" in latex


def test_the_equations_are_found_once_and_only_when_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr("zakai.algebra.estimation_algebra.wei_norman", lambda *given: asked.append(given) or wei_norman(*given))
    algebra = dataclasses.replace(estimation_algebra(SOLVED["Benes, 1"]))
    assert asked == []
    assert algebra.wei_norman is algebra.wei_norman and len(asked) == 1


def test_an_algebra_that_is_not_finite_has_no_equations():
    analysis = zakai.analyze(zakai.load_model("gallery:cubic-sensor"))
    assert analysis.algebra.wei_norman is None and analysis.algebra.no_wei_norman == "no basis is known"
    assert json.loads(analysis.to_json())["algebra"]["wei_norman"] is None
    assert "Wei-Norman" not in str(analysis)


def test_the_symbols_of_the_equations_are_not_those_of_the_model():
    model = zakai.Model(state=["r1", "y"], drift=["k*y", "-r1"], observation=["y2*y"], parameters={"k": 2, "y2": 3, "ydot": 1})
    found = equations(model)
    assert [r.name for r in found.statistics] == [f"rr{k}" for k in range(1, 6)] and found.path[0].name == "yy"
    assert max(map(abs, residuals(model, found, True))) < 1e-40


def test_a_page_has_one_meaning_for_each_name():
    model = zakai.Model(state=["D1", "L0", "y"], drift=["L0 - D1", "-L0", "sin(y)"], observation=["2*D1"])
    analysis = zakai.analyze(model)
    assert ", ".join(map(str, analysis.algebra.basis)) == "LL0, DD1, DD2, D1, L0, 1"
    page, latex = str(analysis), analysis.to_latex()
    for line in ("dy = sin(y) dt + dv3", "dyy = (2*D1) dt + dw", "with LL0 = (D'G D - eta)/2", "[LL0, D1] = DD1"):
        assert f"\n  {line}" in page
    assert "exp(t*LL0) sigma_0" in page and r"e^{t LL_{0}}" in latex and r"dyy &= 2 D_{1}\,dt" in latex
    assert {str(y) for y in analysis.algebra.wei_norman.path} == {"yy"}  # though y is in no element of E


def test_the_filter_knows_the_operators_of_a_state_that_is_named_like_one():
    model = zakai.Model(state=["D1"], drift=["-D1"], observation=["D1"])
    conditions = wei_norman_filter(model)
    assert [c.holds for c in conditions] == [True] * len(conditions)
    assert dong_chen_yau_class(zakai.Model(state=["D1", "y"], drift=["D1 + y", "D1 - y"], observation=["D1"])).conclusion.holds


def test_a_basis_that_gives_no_product_says_why():
    def numbers(rows):
        return {pair: tuple(map(sp.Integer, row)) for pair, row in rows.items()}

    basis = sp.symbols("L0 A B C", commutative=False)
    observation = [tuple(map(sp.Integer, (0, 0, 1, 0)))]
    heisenberg = {
        (0, 1): (0, 0, 0, 0),
        (0, 2): (0, 1, 0, 0),
        (0, 3): (0,) * 4,
        (1, 2): (0, 0, 0, 1),
        (1, 3): (0,) * 4,
        (2, 3): (0,) * 4,
    }
    assert wei_norman(basis, numbers(heisenberg), observation).robust
    with pytest.raises(NoFactorisation, match="along L_0"):
        wei_norman(basis, numbers(heisenberg), [tuple(map(sp.Integer, (1, 0, 0, 0)))])
    with pytest.raises(NoFactorisation, match="not nilpotent"):
        wei_norman(basis, numbers(heisenberg | {(1, 3): (0, 1, 0, 0)}), observation)
    with pytest.raises(NoFactorisation, match="earlier ones"):
        wei_norman(basis, numbers(heisenberg | {(1, 2): (0, 0, 0, 0), (2, 3): (0, 1, 0, 0)}), observation)
    constant = zakai.analyze(zakai.Model(state=["x"], drift=["0"], observation=["1"], diffusion=[["0"]]))
    assert "none: an observation has a part along L_0" in str(constant)
