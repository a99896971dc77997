"""The part of the state that is observed and moves by itself."""

from __future__ import annotations

import json
import random

import pytest
import sympy as sp

import zakai
from algebra.random_systems import conjugated, polynomial_system
from zakai.algebra.observed_block import observed_block


def system(drift, observation, **keys) -> zakai.Model:
    return zakai.Model(state=[f"x{i + 1}" for i in range(len(drift))], drift=drift, observation=observation, **keys)


def stands(model, block) -> bool:
    """Whether W f = b(W x) and h = h(W x), at random points, in 40 digits."""
    rng = random.Random(3)
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    W = sp.Matrix(list(block.coordinates)).jacobian(model.x) if block.coordinates else sp.zeros(0, model.n)
    worst = sp.Integer(0)
    for _ in range(3):
        point = {x: sp.Rational(rng.randint(-300, 300), 211) for x in model.x}
        z = dict(zip(block.symbols, W * sp.Matrix([point[x] for x in model.x]), strict=True))
        sides = [(W * model.drift, block.drift), (model.observation, block.observation)]
        for left, right in sides:
            for a, b in zip(left, right, strict=True):
                worst = max(worst, abs((a.xreplace(values | point) - b.xreplace(z)).doit().evalf(40)))
    return worst < 1e-30


BLOCKS = {
    "class of Dong, Chen and Yau": (zakai.load_model("gallery:dong-chen-yau-3-4"), "(x1, x2 + x3 + x4)", True),
    "passive drift": (zakai.load_model("gallery:passive-drift"), "(x1, x2 + x3)", True),
    "nothing is observed": (zakai.load_model("gallery:unobserved-double-well"), "()", True),
    "one state of two": (system(["-x1**3", "x1*x2"], ["sin(x1)"]), "(x1,)", False),
    "all of them": (system(["-x1**3 + x2", "x1*x2"], ["sin(x1)"]), "(x1, x2)", False),
    "a sum": (system(["x1 + tanh(x1 + x2)", "x2 + x1*x3", "x3"], ["(x1 + x2)**2", "x3"]), "(x1, x2, x3)", False),
    "a sum that is a block": (system(["x1 + x3*x2", "x2 - x2*x3", "cos(x3)"], ["exp(x1 + x2)"]), "(x1 + x2,)", False),
    "a quotient": (system(["-x1/(1 + x1**2)", "exp(x2)"], ["1/(1 + x1**2)"]), "(x1,)", False),
    "a parameter": (system(["a*x2 - x1", "-x2"], ["x1"], parameters={"a": 0}), "(x1,)", True),
    "many directions at once": (system(["0", "0", "0", "0"], ["x1*x2 + sin(x3)"]), "(x1, x2, x3)", False),
    "pi": (system(["pi*x1 + x2", "-x2", "x1"], ["pi*x1"]), "(x1, x2)", True),
}


@pytest.mark.parametrize("name", BLOCKS)
def test_the_block_is_the_smallest_and_stands(name):
    model, coordinates, linear = BLOCKS[name]
    block = observed_block(model)
    assert (str(block.coordinates), block.linear) == (coordinates, linear)
    assert stands(model, block)


def test_a_block_of_an_undetermined_function():
    block = observed_block(zakai.load_model("gallery:wong"))
    x1, x2, x3 = zakai.load_model("gallery:wong").x
    assert block.coordinates == (x2 - x3,) and block.drift == (-block.symbols[0],) and block.covariance == sp.Matrix([[2]])


def test_the_class_of_dong_chen_and_yau_is_a_linear_saddle():
    for example in ("3-4", "3-5", "3-6"):
        block = observed_block(zakai.load_model(f"gallery:dong-chen-yau-{example}"))
        A = sp.Matrix(block.drift).jacobian(block.symbols)
        assert block.linear and A.trace() == 0 and A.det() == -4  # eigenvalues +- |a| = +- 2


@pytest.mark.parametrize("seed", range(30))
def test_the_size_of_a_block_does_not_depend_on_coordinates(seed):
    model = polynomial_system(seed)
    other = conjugated(model, seed)
    block, moved = observed_block(model), observed_block(other)
    assert (len(block.symbols), block.linear) == (len(moved.symbols), moved.linear)
    assert stands(model, block) and stands(other, moved)


def test_coefficients_that_depend_on_time_are_not_explored():
    analysis = zakai.analyze(zakai.load_model("gallery:spiral-sensor"))
    assert "depend on time" in observed_block(analysis.model)
    assert analysis.observed_block is None and json.loads(analysis.to_json())["observed_block"] is None


def test_the_symbols_of_a_block_are_not_those_of_the_model():
    block = observed_block(zakai.Model(state=["z1", "u"], drift=["-z1", "u"], observation=["z1"]))
    assert [z.name for z in block.symbols] == ["z_1"]


def test_the_page_and_the_json_show_the_block():
    analysis = zakai.analyze(zakai.load_model("gallery:passive-drift"))
    page, read = str(analysis), json.loads(analysis.to_json())["observed_block"]
    assert "  z2 = x2 + x3\n  dz1 = (z1 + z2) dt + dn1" in page and "E dn dn' = [[1, 0], [0, 2]] dt,  h = [2*z1]" in page
    assert read["coordinates"] == ["x1", "x2 + x3"] and read["linear"] is True and read["covariance"] == [["1", "0"], ["0", "2"]]
    assert r"d\left[\begin{matrix}z_{1}\\z_{2}\end{matrix}\right] &= \left[\begin{matrix}z_{1} + z_{2}\\" in analysis.to_latex()
    assert r"z_{1} &= x_{2} - x_{3}, & dz_{1} &= - z_{1}\,dt + dn" in zakai.analyze(zakai.load_model("gallery:wong")).to_latex()
    assert "Observed block" not in str(zakai.analyze(zakai.load_model("gallery:benes")))
    assert "nothing of the state is observed" in str(zakai.analyze(zakai.load_model("gallery:silent-double-well")))


def test_the_filter_of_the_block_is_that_of_the_whole():
    drift, noise = ["x1 + x2", "x1 - 2*x2", "3*x3 + 2*x1 - x2"], [["1", "0.3", "0.2"], ["0.3", "2", "0.5"], ["0.2", "0.5", "1"]]
    cov = [[1.0, 0.2, 0.1], [0.2, 0.5, 0.3], [0.1, 0.3, 2.0]]
    prior = {"kind": "gaussian", "mean": [0.5, -1.0, 2.0], "cov": cov}
    whole = system(drift, ["2*x1 + 1"], process_noise=noise, prior=prior)
    block = zakai.analyze(whole).observed_block
    assert str(block.coordinates) == "(x1, x2)" and block.linear
    part = zakai.Model(
        state=[z.name for z in block.symbols],
        drift=list(block.drift),
        observation=list(block.observation),
        process_noise=block.covariance.tolist(),
        prior={"kind": "gaussian", "mean": [0.5, -1.0], "cov": [row[:2] for row in cov[:2]]},
    )
    record = zakai.Record([0.1, 0.3, 0.4], [[0.3], [-0.2], [0.5]], "increments")
    a, b = (zakai.filter(model, record, method="kalman-bucy") for model in (whole, part))
    assert abs(a.mean[:, :2] - b.mean).max() < 1e-10 and abs(a.cov[:, :2, :2] - b.cov).max() < 1e-10
    assert abs(a.log_likelihood - b.log_likelihood) < 1e-10
