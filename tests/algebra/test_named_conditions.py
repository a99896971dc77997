"""(C.1) to (C.5) of Dong, Chen and Yau, and C1, C2, C2' and C3 of the survey, on systems of their class and beside it."""

from __future__ import annotations

import pytest

import zakai
from zakai.algebra.named_conditions import dong_chen_yau_class, survey_conditions


def system(drift, observation, **keys) -> zakai.Model:
    return zakai.Model(state=[f"x{i + 1}" for i in range(len(drift))], drift=drift, observation=observation, **keys)


def failing(conditions) -> list[str]:
    """The labels, such as (C.1), of the conditions that do not hold."""
    return [c.source.rpartition(", ")[2] if ", " in c.source else c.statement for c in conditions if c.holds is not True]


PASSIVE = ["x1 + x2 + x3", "x1 - (x2 + x3)/2 + sin(x2)", "x1 - (x2 + x3)/2 - sin(x2)"]


@pytest.mark.parametrize("name", ["dong-chen-yau-3-4", "dong-chen-yau-3-5", "dong-chen-yau-3-6", "passive-drift"])
def test_the_examples_are_of_the_class(name):
    check = dong_chen_yau_class(zakai.load_model(f"gallery:{name}"))
    assert check.applies is True and check.conclusion.holds is True, str(check)


@pytest.mark.parametrize(
    ("drift", "observation", "labels"),
    [
        (PASSIVE, ["x1 + 1"], []),
        (["x1 + x2 + x3", "x1**2 - (x2 + x3)/2", "x1 - (x2 + x3)/2"], ["x1"], ["(C.1)", "(C.2)", "(C.3)", "(C.4)"]),
        (["x1 + x2 + x3", "2*x1 - (x2 + x3)/2", "x1 - (x2 + x3)/2"], ["x1"], ["(C.2)"]),
        (["1", "sin(x2)"], ["x1"], ["(C.3)"]),
        (["x1 + x2 + x3", "x1 + sin(x2)", "x1"], ["x1"], ["(C.4)"]),
        (PASSIVE, ["x1 + x2"], ["(C.5)"]),
        (PASSIVE, ["1"], ["(C.5)"]),
    ],
)
def test_the_condition_that_fails_is_named(drift, observation, labels):
    check = dong_chen_yau_class(system(drift, observation))
    assert failing(check.assumptions) == labels, str(check)


def test_the_class_asks_for_the_identity_and_for_constant_coefficients():
    noisy = dong_chen_yau_class(system(PASSIVE, ["x1"], diffusion=[["2", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]]))
    assert [c.statement for c in noisy.assumptions if not c.holds] == ["G = I"]
    timed = dong_chen_yau_class(system([PASSIVE[0], *PASSIVE[1:]], ["t*x1"]))
    assert [c.statement for c in timed.assumptions if not c.holds] == ["f, h, G and S are constant in time"]
    assert timed.conclusion.holds is None


def test_the_misprint_of_example_3_4_breaks_c_4():
    model = zakai.load_model("gallery:dong-chen-yau-3-4")
    x = model.x
    drift = [*model.drift[:2], model.drift[2] + x[1] ** 3 - x[2] ** 3, model.drift[3]]
    assert failing(dong_chen_yau_class(system(drift, ["x1"])).assumptions) == ["(C.4)"]


@pytest.mark.parametrize(
    ("model", "labels"),
    [
        (zakai.load_model("gallery:benes-2d"), []),
        (system(["x1 + 3*x2", "-x1"], ["x1", "x2"]), []),
        (system(["0", "0"], ["sin(x1)", "cos(x1)"]), ["C2"]),
        (system(["0"], ["x1**2"]), ["C2", "C2'", "C3"]),
        (system(["x1 - x1**3"], ["x1"]), ["C3"]),
        (system(["x2**2", "0"], ["x1"]), ["C1", "C3"]),
        (zakai.load_model("gallery:falling-body"), ["C1", "C3"]),
    ],
)
def test_the_conditions_of_the_survey_are_told_apart(model, labels):
    assert failing(survey_conditions(model)) == labels
    assert all(c.evidence for c in survey_conditions(model))
