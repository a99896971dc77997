"""The theorems by their numbers, on systems that meet their assumptions and on systems that do not."""

from __future__ import annotations

import pytest
import sympy as sp

import zakai
from zakai.algebra import yau_theorems as theorems
from zakai.models import gallery

X = sp.symbols("x1 x2", real=True)
T = sp.Symbol("t", real=True)


def system(drift, observation, **keys) -> zakai.Model:
    return zakai.Model(state=[f"x{i + 1}" for i in range(len(drift))], drift=drift, observation=observation, **keys)


ON_MODELS = [
    theorems.theorem_1,
    theorems.theorem_2,
    theorems.theorem_4_i,
    theorems.theorem_4_ii,
    theorems.theorem_5,
    theorems.theorem_7,
    theorems.theorem_8,
    theorems.lemma_3_3,
]
MODELS = {
    "linear": system(["x1 + 2*x2", "-x1"], ["x1", "x2"]),
    "partly observed": system(["x1 + 2*x2", "-x1"], ["x1"]),
    "Benes": gallery.load("benes-2d"),
    "one state": gallery.load("benes"),
    "square": system(["0", "0"], ["x1**2"]),
    "cube": system(["x1", "x2 - x2**3"], ["x1"]),
    "curl": system(["x2**2", "0"], ["x1"]),
    "passive": gallery.load("passive-drift"),
    "correlated": gallery.load("kalman-bucy-2d"),
    "silent": gallery.load("silent-double-well"),
    "two observations without noise": system(["0"], ["x1", "1"], diffusion=[["0"]]),
    "noise in one of two": system(["x2", "-x1"], ["x1"], diffusion=[["0"], ["1"]]),
    "in time": system(["-t*x1"], ["x1"]),
    "not in the ring": system(["sqrt(1 + x1**2)"], ["x1"]),
    "undetermined": gallery.load("wong"),
}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
@pytest.mark.parametrize("theorem", ON_MODELS, ids=lambda theorem: theorem.__name__)
def test_a_theorem_whose_assumptions_hold_has_its_conclusion(theorem, model):
    check = theorem(model)
    if check.applies:
        assert check.conclusion.holds is True, str(check)
    assert all(c.evidence for c in check.assumptions)
    assert "Subs(" not in str(check)


@pytest.mark.parametrize(
    ("theorem", "name", "applies", "concludes"),
    [
        (theorems.theorem_1, "Benes", True, True),
        (theorems.theorem_1, "curl", False, False),
        (theorems.theorem_2, "partly observed", True, True),
        (theorems.theorem_2, "square", False, False),
        (theorems.theorem_4_i, "linear", True, True),
        (theorems.theorem_4_i, "cube", False, None),
        (theorems.theorem_4_ii, "linear", True, True),
        (theorems.theorem_4_ii, "cube", False, False),
        (theorems.theorem_5, "Benes", True, True),
        (theorems.theorem_5, "cube", False, False),
        (theorems.theorem_7, "one state", True, True),
        (theorems.theorem_7, "silent", True, True),
        (theorems.theorem_7, "linear", False, False),
        (theorems.theorem_8, "partly observed", True, True),
        (theorems.theorem_8, "cube", False, False),
        (theorems.lemma_3_3, "passive", True, True),
        (theorems.lemma_3_3, "cube", True, True),
        (theorems.lemma_3_3, "partly observed", False, False),
        (theorems.lemma_3_3, "noise in one of two", False, False),
        (theorems.theorem_7, "two observations without noise", False, False),  # L_0, x, 1
        (theorems.theorem_8, "noise in one of two", False, True),
        (theorems.theorem_4_i, "in time", None, None),
    ],
)
def test_assumptions_and_conclusions_are_told_apart(theorem, name, applies, concludes):
    check = theorem(MODELS[name])
    assert (check.applies, check.conclusion.holds) == (applies, concludes), str(check)
    assert check.name in str(check)


def test_the_quadratic_part_of_theorem_4_is_that_of_the_drift_alone():
    check = theorems.theorem_4_i(MODELS["linear"])
    assert "[[2, 2], [2, 4]]" in check.conclusion.evidence  # f'f = (x1 + 2 x2)^2 + x1^2


def test_no_drift_has_a_function_that_falls_along_a_tube():
    falling = theorems.theorem_3(X[1] ** 2 - X[0] ** 4, X, [T, 0], T)
    assert falling.applies is True and falling.conclusion.holds is True
    rising = theorems.theorem_3(X[1] ** 2 + X[0] ** 4, X, [T, 0], T)
    assert rising.applies is False and rising.conclusion.holds is None
    staying = theorems.theorem_3(-X[0], X, [0 * T, 0], T)
    assert staying.applies is False


def test_a_path_that_is_enough_for_the_corollary_is_not_always_the_middle_of_a_tube():
    # -x1 + x1^3 x2^2 falls along x2 = 0, and rises beside it.
    function, path = -X[0] + X[0] ** 3 * X[1] ** 2, [T, 0]
    assert theorems.corollary_3(function, X, path, T).conclusion.holds is True
    assert theorems.theorem_3(function, X, path, T).applies is None


@pytest.mark.parametrize(("i", "j"), [((1, 0), (0, 1)), ((2, 0), (0, 1)), ((1, 1), (2, 0)), ((3, 0), (0, 2))])
def test_lemma_2_5_gives_brackets_to_leading_order(i, j):
    model = system(["x2*sin(x1)", "x1**2 - x2"], ["x1"])
    check = theorems.lemma_2_5(model, X[0] * X[1] ** 2, i, sp.sin(X[0]) * X[1], j)
    assert check.applies and check.conclusion.holds, str(check)


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        ("noise in one of two", X[0], "G is singular"),
        ("in time", X[0], "depend on time"),
        ("linear", sp.sqrt(X[0]), "not in the operator ring"),
    ],
)
def test_lemma_2_5_says_in_one_line_what_it_cannot_read(name, function, words):
    model = MODELS[name]
    i = (1,) + (0,) * (model.n - 1)
    with pytest.raises(zakai.InputError, match=words) as error:
        theorems.lemma_2_5(model, function, i, X[0], i)
    assert "\n" not in str(error.value)


def test_lemma_2_5_says_nothing_of_two_functions():
    assert theorems.lemma_2_5(MODELS["linear"], X[0], (0, 0), X[1], (0, 0)).applies is False
