"""The estimation algebras of the literature: verdict, dimension, rank, basis and brackets."""

from __future__ import annotations

import dataclasses
import json
import random
import time

import pytest
import sympy as sp

import zakai
from zakai.algebra import estimation_algebra as engine
from zakai.algebra.affine_elements import dimension_and_rank
from zakai.algebra.certificates import CLOSED, OCONE, OMEGA, RANK, SYMBOL
from zakai.algebra.closure import Budget
from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.estimation_algebra import estimation_algebra
from zakai.algebra.ratios import TooLarge
from zakai.algebra.verification import verify


def system(drift, observation, **keys) -> zakai.Model:
    state = ["x"] if len(drift) == 1 else [f"x{i + 1}" for i in range(len(drift))]
    return zakai.Model(state=state, drift=drift, observation=observation, **keys)


def linear(n: int, seed: int = 1) -> zakai.Model:
    rng = random.Random(seed)
    rows = [" + ".join(f"({rng.randint(-9, 9)})*x{j + 1}" for j in range(n)) for _ in range(n)]
    return zakai.Model(state=[f"x{j + 1}" for j in range(n)], drift=rows, observation=["x1"])


def dong_chen_yau_3_6(k: int) -> zakai.Model:
    """Example 3.6 of Dong, Chen and Yau (2021), for any k >= 1."""
    drift = [
        "x1 + x2 + x3 + x4",
        f"x1 - x2 - x3**{k} + x4**{k} + x2**{k + 1}*x3**{k + 3}",
        f"x1 - x3 - x2**{k + 2} - x4**{k} + x3**{k + 5}*x4**{k} - x2**{k + 1}*x3**{k + 3}",
        f"x1 - x4 + x2**{k + 2} + x3**{k} - x3**{k + 5}*x4**{k}",
    ]
    return system(drift, ["c*x1"], parameters={"c": 1})


CORRELATED = [["2", "1", "0"], ["1", "3", "1"], ["0", "1", "1"]]
FULL = "L0, D1, D2, x1, x2, 1"
FINITE = {
    # name: (model, linear rank, basis; maximal rank has 2 n + 2 elements)
    "linear, 1": (system(["-2*x + 1"], ["x"]), 1, "L0, D1, x, 1"),
    "linear, 2": (linear(2), 2, FULL),
    "linear, 3": (linear(3), 3, "L0, D1, D2, D3, x1, x2, x3, 1"),
    "linear, 4": (linear(4), 4, "L0, D1, D2, D3, D4, x1, x2, x3, x4, 1"),
    "linear, decoupled": (system(["x1 + 2*x2", "-x1", "x3 + x4", "3*x3"], ["x1"]), 2, FULL),
    "linear, correlated noise": (
        system(["x1 + 2*x2 - x3", "3*x1 - x2", "x1 - x2 + 4*x3"], ["x1"], process_noise=CORRELATED),
        3,
        "L0, D1, D2, D3, x1, x2, x3, 1",
    ),
    "Brownian motion": (system(["0", "0"], ["x1"]), 1, "L0, D1, x1, 1"),
    "Benes": (system(["tanh(x)"], ["x"]), 1, "L0, D1, x, 1"),
    "rotation": (system(["2*x2", "-2*x1"], ["x1", "x2"]), 2, FULL),
    "Benes, two states": (zakai.load_model("gallery:benes-2d"), 2, FULL),
    "Wong": (zakai.load_model("gallery:wong"), 1, "L0, D2 - D3, x2 - x3, 1"),
    "Dong, Chen and Yau 3.4": (zakai.load_model("gallery:dong-chen-yau-3-4"), 1, "L0, D1, x1, 1"),
    "Dong, Chen and Yau 3.5": (zakai.load_model("gallery:dong-chen-yau-3-5"), 1, "L0, D1, x1, 1"),
    **{f"Dong, Chen and Yau 3.6, {k}": (dong_chen_yau_3_6(k), 1, "L0, D1, x1, 1") for k in range(1, 7)},
    "passive drift": (zakai.load_model("gallery:passive-drift"), 1, "L0, D1, x1, 1"),
    "eta of degree six": (system(["x1", "x2 - x2**3"], ["x1"]), 1, "L0, D1, x1, 1"),
    "an eigenvector": (system(["x1 + x2", "x1 - x2 + 1"], ["x1"]), 1, "L0, D1, x1, 1"),
    "constant observation": (zakai.load_model("gallery:unobserved-double-well"), 0, "L0, 1"),
    "no observation": (zakai.load_model("gallery:silent-double-well"), 0, "L0"),
    "nothing": (system(["0"], ["0"], diffusion=[["0"]]), 0, ""),
    "affine observation": (system(["-x"], ["2*x + 3", "5"]), 1, "L0, D1, x, 1"),
    "singular noise": (zakai.load_model("gallery:falling-body"), 2, "L0, D1, D2, position, speed, 1"),
}
PRINTED_3_4 = [
    "x1 + x2 + x3 + x4",
    "x1 - x2 - 6*x3 + 3*x4 + x2*x3 - x3**3 + x4**3",
    "x1 - x3 - 3*x4 - x2*x3 + x3*x4 - x3**3 - x4**3",
    "x1 + 6*x3 - x4 - x3*x4 + x2**3 + x3**3",
]
INTRODUCTION = ["x1 + x2 + x3 + gamma(x1 + x2 + x3)", "x1 + x3", "x2 - x3"]
THREE_ARGUMENTS = ["x1 + x2 + x3 + gamma(x1, x2, x3)", "x1 + x3", "x1 + x2"]
INFINITE = {
    "2 tanh": (system(["2*tanh(x)"], ["x"]), RANK),
    "tanh observed by tanh": (system(["tanh(x)"], ["tanh(x)"]), OCONE),
    "double well": (system(["x - x**3"], ["x"]), RANK),
    "cubic sensor": (system(["0"], ["x**3"]), OCONE),
    "square sensor": (system(["0"], ["x**2"]), OMEGA),
    "product": (system(["0", "0"], ["x1*x2"]), OMEGA),
    "Yau drift with eta not quadratic": (system(["tanh(x1) + 2*x2", "-2*x1"], ["x1"]), SYMBOL),
    "Wong, as printed in the introduction": (system(INTRODUCTION, ["x2 - x3"], functions=["gamma"]), SYMBOL),
    "Wong, gamma of three arguments": (system(THREE_ARGUMENTS, ["x2 - x3"], functions=["gamma"]), SYMBOL),
    "Dong, Chen and Yau 3.4, phi_3 as printed": (system(PRINTED_3_4, ["x1"]), OCONE),
    "two states and a cube": (system(["x1 + x2", "x1 - x2**3"], ["x1"]), OCONE),
    "pendulum": (system(["x2", "-sin(x1)"], ["x1"]), SYMBOL),
    "Lorenz": (zakai.load_model("gallery:lorenz"), RANK),
}


@pytest.mark.parametrize("name", FINITE)
def test_a_finite_algebra_has_its_dimension_rank_and_basis(name):
    model, rank, basis = FINITE[name]
    algebra = estimation_algebra(model)
    assert (algebra.verdict, algebra.linear_rank) == ("finite", rank)
    assert ", ".join(map(str, algebra.basis)) == basis
    assert algebra.dimension == len(algebra.basis) and algebra.certificate.code == CLOSED
    assert verify(algebra.certificate)


@pytest.mark.parametrize("name", INFINITE)
def test_an_infinite_algebra_has_a_certificate_that_stands(name):
    model, code = INFINITE[name]
    algebra = estimation_algebra(model)
    assert (algebra.verdict, algebra.dimension, algebra.basis) == ("infinite", None, ())
    assert algebra.certificate.code == code
    assert verify(algebra.certificate)


@pytest.mark.parametrize("n", [8, 16])
def test_linear_systems_of_many_states_have_2_n_plus_2_elements(n):
    algebra = estimation_algebra(linear(n))
    assert (algebra.verdict, algebra.dimension, algebra.linear_rank) == ("finite", 2 * n + 2, n)


def test_more_states_than_are_explored_are_decided_by_a_theorem():
    algebra = estimation_algebra(linear(25))
    assert (algebra.verdict, algebra.dimension, algebra.linear_rank) == ("finite", 52, 25)
    assert algebra.certificate.code == "FIN-THM4i" and not algebra.basis and algebra.no_wei_norman == "no basis is known"
    assert "not listed" in algebra.note and verify(algebra.certificate)
    assert not verify(dataclasses.replace(algebra.certificate, model=INFINITE["double well"][0]))


AFFINE = [name for name, (model, _, _) in FINITE.items() if name.startswith(("linear", "Ben", "rot", "Bro", "an ", "aff"))]


@pytest.mark.parametrize("name", [*AFFINE, "constant observation"])
def test_the_size_without_a_table_of_brackets_is_that_of_the_table(name):
    model, rank, basis = FINITE[name]
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    assert dimension_and_rank(DmzOperators(model, values)) == (len(basis.split(",")), rank)


def named(algebra) -> dict[str, str]:
    """The brackets that are not zero, as text."""
    names = [str(e) for e in algebra.basis]
    return {f"[{names[i]}, {names[j]}]": str(e) for (i, j), e in algebra.brackets.items() if e != 0}


def test_the_table_of_brackets_of_dong_chen_and_yau_has_4_plus_c_squared():
    algebra = estimation_algebra(FINITE["Dong, Chen and Yau 3.4"][0])
    assert named(algebra) == {"[L0, D1]": "x1*(c**2 + 4)", "[L0, x1]": "D1", "[D1, x1]": "1"}
    assert "general values of c" in algebra.parameters


def test_the_brackets_of_wong():
    expected = {"[L0, D2 - D3]": "3*x2 - 3*x3", "[L0, x2 - x3]": "D2 - D3", "[D2 - D3, x2 - x3]": "2"}
    assert named(estimation_algebra(FINITE["Wong"][0])) == expected


def test_brackets_have_the_sign_of_omega_and_the_g_of_the_noise():
    # g = G^-1 f = (x2, -x1), omega_12 = -2, eta = 2 x1^2 + 2 x2^2 + h^2: [D_1, D_2] = -omega_12, [L_0, x] = G D.
    model = system(["2*x2", "-2*x1"], ["x1"], process_noise=[["2", "0"], ["0", "2"]])
    table = named(estimation_algebra(model))
    assert table["[D1, D2]"] == "2" and table["[L0, x1]"] == "2*D1"
    assert table["[L0, D1]"] == "3*x1 - 4*D2" and table["[L0, D2]"] == "2*x2 + 4*D1"


def test_structure_constants_obey_jacobi():
    algebra = estimation_algebra(linear(3))
    d = algebra.dimension
    ad = [sp.zeros(d, d) for _ in range(d)]
    for (i, j), row in algebra.structure_constants.items():
        for k, c in enumerate(row):
            ad[i][k, j], ad[j][k, i] = c, -c
    for (i, j), row in algebra.structure_constants.items():
        bracket = sum((c * ad[k] for k, c in enumerate(row)), sp.zeros(d, d))
        assert ad[i] * ad[j] - ad[j] * ad[i] == bracket


@pytest.mark.parametrize(
    ("drift", "observation", "keys", "words"),
    [
        (["t*x"], ["x"], {}, "depend on time"),
        (["-x"], ["x"], {"observation_kind": "samples"}, "samples"),
        (["abs(x)"], ["x"], {}, "Abs is not in the operator ring"),
        (["sqrt(2)*x"], ["x"], {}, "sqrt"),
        (["gamma(sin(x))"], ["x"], {"functions": ["gamma"]}, "function of a function"),
    ],
)
def test_what_cannot_be_explored_is_undecided_and_says_why(drift, observation, keys, words):
    algebra = estimation_algebra(system(drift, observation, **keys))
    assert algebra.verdict == "undecided" and words in algebra.note and algebra.certificate is None
    assert algebra.linear_rank == 1


def test_a_spent_budget_is_undecided_and_says_how_far_it_went():
    algebra = estimation_algebra(system(["0", "2*x1*x3", "-1"], ["x1"]))
    assert algebra.verdict == "undecided"
    assert "order above 8" in algebra.note and "explored" in algebra.note


def test_a_system_with_singular_noise_is_never_infinite_by_a_theorem_that_needs_its_inverse(monkeypatch):
    model = system(["x2", "-sin(x1)"], ["x1"], diffusion=[["0"], ["1"]])
    monkeypatch.setattr(Budget, "of", classmethod(lambda cls, states: cls(elements=8)))
    algebra = estimation_algebra.__wrapped__(model)
    assert algebra.verdict == "undecided" and "G is singular" in algebra.note


def test_theorems_on_smooth_functions_are_not_used_for_a_drift_that_is_singular_somewhere():
    algebra = estimation_algebra(system(["2/x"], ["x"]))
    assert algebra.certificate.code == OCONE and verify(algebra.certificate)
    beside = estimation_algebra(system(["1/x1", "0"], ["x2**2"])).certificate
    assert beside is None or beside.code != OMEGA
    smooth = estimation_algebra(system(["2*x/(1 + x**2)"], ["x"]))
    assert smooth.certificate.code == RANK and verify(smooth.certificate)
    assert not verify(dataclasses.replace(smooth.certificate, model=system(["2/x"], ["x"])))


def test_a_parameter_may_change_the_verdict_and_the_report_says_so():
    algebra = estimation_algebra(system(["x - a*x**3"], ["x"], parameters={"a": 0}))
    assert (algebra.verdict, algebra.dimension) == ("finite", 4)
    assert "for general values, kept as symbols, it is infinite" in algebra.parameters


def test_many_parameters_are_tried_at_random_rationals_and_the_report_says_so(monkeypatch):
    monkeypatch.setattr(engine, "MOST_SYMBOLS", 1)
    algebra = estimation_algebra.__wrapped__(system(["a*x"], ["b*x"], parameters={"a": 1, "b": 2}))
    assert algebra.verdict == "finite" and "the same at 2 random rationals: a = " in algebra.parameters
    assert named(algebra)["[L0, D1]"] == "5*x"


def test_parameters_and_pi_stay_symbols_in_the_brackets():
    algebra = estimation_algebra(zakai.load_model("gallery:kalman-bucy-1d"))
    assert named(algebra)["[L0, D1]"] == "x*(a**2 + c**2*sigma**2)/sigma**2"
    turning = estimation_algebra(system(["pi*x"], ["x"]))
    assert named(turning)["[L0, D1]"] == "x*(1 + pi**2)" and verify(turning.certificate)


def test_a_false_certificate_is_refused():
    finite = estimation_algebra(FINITE["Benes"][0]).certificate
    wrong = {**finite.constants, (0, 1): tuple(2 * c for c in finite.constants[0, 1])}
    assert not verify(dataclasses.replace(finite, constants=wrong))
    assert not verify(dataclasses.replace(finite, model=system(["2*tanh(x)"], ["x"])))
    assert not verify(dataclasses.replace(finite, elements=finite.elements[:3], constants={}))
    for name, (_, code) in INFINITE.items():
        claim = estimation_algebra(INFINITE[name][0]).certificate
        if claim.model.n == 1:
            assert not verify(dataclasses.replace(claim, model=FINITE["Benes"][0])), name
        elif claim.model.n == 2:
            assert not verify(dataclasses.replace(claim, model=linear(2))), (name, code)


def test_a_long_witness_of_rational_functions_is_checked_at_once():
    claim = estimation_algebra(system(["x1 + 2*x2 + 2*x2**2", "1/(2 + 2*x2**2)"], ["x1"])).certificate
    assert claim.code == SYMBOL and max(len(word) for word in claim.elements[0]) == 7
    begin = time.process_time()
    assert verify(claim)
    assert time.process_time() - begin < 20
    other = system(["x1 + 2*x2", "x2"], ["x1"])
    assert not verify(dataclasses.replace(claim, model=other))


def test_a_false_growth_is_refused():
    claim = estimation_algebra(system(["3*x1**2 - 1", "2*x1**2*x2 - 2*x1*x2**2 - 3*x1 - 2"], ["2*x1"])).certificate
    assert claim.code == "INF-SYM2" and verify(claim)
    assert not verify(dataclasses.replace(claim, weights=(1,) * 4))
    assert not verify(dataclasses.replace(claim, model=linear(2)))


def test_the_forms_of_the_analysis_show_the_algebra():
    analysis = zakai.analyze(zakai.load_model("gallery:dong-chen-yau-3-4"))
    page, read, latex = str(analysis), json.loads(analysis.to_json())["algebra"], analysis.to_latex()
    assert "basis: L0, D1, x1, 1" in page and "[L0, D1] = x1*(c**2 + 4)" in page and "FIN-closed" in page
    assert read["basis"] == ["L0", "D1", "x1", "1"] and read["brackets"]["0,1"] == "x1*(c**2 + 4)"
    assert read["structure_constants"]["0,1"] == ["0", "0", "c**2 + 4", "0"] and read["certificate"]["code"] == CLOSED
    assert r"\left[L_{0}, D_{1}\right] &= x_{1} \left(c^{2} + 4\right)" in latex
    infinite = zakai.analyze(zakai.load_model("gallery:cubic-sensor"))
    assert "INF-OCONE" in str(infinite) and r"\dim E &= \infty" in infinite.to_latex()
    assert json.loads(infinite.to_json())["algebra"]["certificate"]["witness"] == "h1 is the function x**3"


def test_the_analysis_explores_the_algebra_only_when_it_is_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr("zakai.algebra.analysis.estimation_algebra", lambda model: asked.append(model))
    analysis = zakai.analyze(FINITE["Benes"][0])
    assert asked == []
    assert analysis.algebra is None and asked == [analysis.model]


def test_derivatives_of_undetermined_functions_are_written_with_primes_and_numbers():
    page = str(zakai.analyze(zakai.load_model("gallery:wong")))
    assert "omega_1,2 = -gamma'(x1 + x2 + x3)" in page
    assert "none was found: omega_12 = -gamma'(x1 + x2 + x3) depends on x1" in page
    page = str(zakai.analyze(system(["0", "gamma(x1, x1 + x2)"], ["x1"], functions=["gamma"])))
    assert "omega_1,2 = gamma_1(x1, x1 + x2) + gamma_2(x1, x1 + x2)" in page


def test_pi_beside_many_parameters_ends_in_words(monkeypatch):
    monkeypatch.setattr(engine, "MOST_SYMBOLS", 0)
    whole = engine._explore

    def explore(model, values):
        if values and sp.Integer(1) not in values.values():
            raise TooLarge("polynomials in the constants grow too large")
        return whole(model, values)

    monkeypatch.setattr(engine, "_explore", explore)
    algebra = estimation_algebra.__wrapped__(system(["a*pi*x"], ["x"], parameters={"a": 1}))
    assert algebra.verdict == "finite" and "other values were not explored: polynomials" in algebra.parameters
