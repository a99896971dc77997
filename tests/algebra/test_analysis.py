"""The analysis of a model: what it finds, and how it says it."""

from __future__ import annotations

import json
import re

import pytest
import sympy as sp

import zakai

KEYS = ("state", "drift", "observation", "diffusion", "process_noise", "observation_noise", "observation_kind", "parameters") + (
    "functions",
    "periodic",
)


def test_omega_has_the_sign_of_its_convention():
    # f = (x2, 0) and G = 1: omega_12 = d_1 f_2 - d_2 f_1 = -1
    analysis = zakai.analyze(zakai.Model(state=["x1", "x2"], drift=["x2", "0"], observation=["x1"]))
    assert analysis.omega == sp.ImmutableMatrix([[0, -1], [1, 0]])


def test_omega_is_that_of_the_whitened_drift():
    model = zakai.Model(state=["x1", "x2"], drift=["x2", "0"], observation=["x1"], diffusion=[["2", "0"], ["0", "1"]])
    assert zakai.analyze(model).omega[0, 1] == -sp.Rational(1, 4)


def test_eta_of_benes_is_quadratic_whatever_the_functions():
    analysis = zakai.analyze(zakai.load_model("gallery:benes"))
    (x,) = analysis.model.x
    assert analysis.eta == x**2 + 1 == analysis.q  # tanh^2 + sech^2 + x^2
    assert analysis.yau_form.potential == sp.log(sp.cosh(x))
    assert analysis.recommended == "benes"


def test_a_singular_covariance_leaves_omega_and_eta_undefined_and_says_so():
    analysis = zakai.analyze(zakai.load_model("gallery:falling-body"))
    assert analysis.omega is None and analysis.eta is None
    assert "singular" in str(analysis)
    assert analysis.recommended == "kalman-bucy"


@pytest.mark.parametrize(
    ("observation", "rank"),
    [(["x1"], 1), (["x1 + x2", "2*x1 + 2*x2 + 1"], 1), (["x1", "t*x2"], 2), (["3"], 0), (["t*x1**2"], None)],
)
def test_the_linear_rank_counts_the_directions_of_affine_functions(observation, rank):
    analysis = zakai.analyze(zakai.Model(state=["x1", "x2"], drift=["0", "0"], observation=observation))
    assert analysis.algebra.linear_rank == rank


@pytest.mark.parametrize("name", zakai.gallery.names())
def test_every_form_of_the_analysis_says_the_same(name):
    analysis = zakai.analyze(zakai.load_model(f"gallery:{name}"))
    read = json.loads(analysis.to_json())
    page = str(analysis)
    assert read["recommended"] == analysis.recommended
    for method, conditions in analysis.methods.items():
        assert [c["holds"] for c in read["methods"][method]["conditions"]] == [c.holds for c in conditions]
        assert all(set(c) == {"statement", "holds", "evidence", "source"} for c in read["methods"][method]["conditions"])
        assert method in page
    words = "".join(page.split())
    for conditions in analysis.methods.values():
        for condition in conditions:
            assert "".join(f"{condition.evidence}[{condition.source}]".split()) in words
    latex = analysis.to_latex()
    assert latex.count("{") == latex.count("}") and latex.startswith("\\begin{align*}") and latex.endswith("\\end{tabular}")
    for form in (latex, page, analysis.to_json()):
        assert not re.search(r"Subs|Derivative|_xi|_z1|Symbol|Matrix\(", form)
    proof = analysis.algebra.certificate
    assert proof is None or proof.source.split(";")[0].replace("_", r"\_") in latex and proof.code in latex
    assert all(len(line) <= 110 for line in page.splitlines())
    given = analysis.model
    assert read["drift"] == [str(entry) for entry in given.drift] and read["observation"] == [str(h) for h in given.observation]
    assert zakai.Model(**{key: read[key] for key in (*KEYS, *given.keys_of_features) if key in read}).drift == given.drift


def test_a_model_without_prior_or_with_undetermined_functions_is_analysed():
    model = zakai.Model(
        state=["x1", "x2"], drift=["gamma(x1 + x2) - x2", "gamma(x1 + x2)"], observation=["x1"], functions=["gamma"]
    )
    analysis = zakai.analyze(model)
    assert analysis.omega == sp.ImmutableMatrix([[0, 1], [-1, 0]])
    assert analysis.recommended is None
    assert "undetermined: gamma" in str(analysis)
    json.loads(analysis.to_json())


def test_a_recommendation_for_a_model_without_prior_says_what_is_missing():
    analysis = zakai.analyze(zakai.Model(state=["x"], drift=["-x"], observation=["x"]))
    assert analysis.recommended == "kalman-bucy"
    assert "needs a prior" in str(analysis)


def test_a_sum_before_dt_stands_in_parentheses():
    latex = zakai.analyze(zakai.Model(state=["x"], drift=["1 - x"], observation=["x + 2"])).to_latex()
    assert r"dx &= \left(1 - x\right)\,dt + dv" in latex and r"dy &= \left(x + 2\right)\,dt + dw" in latex


def test_json_says_why_there_is_no_yau_form_and_no_product():
    analysis = zakai.analyze(zakai.load_model("gallery:lorenz"))
    read = json.loads(analysis.to_json())
    assert read["no_yau_form"] == analysis.no_yau_form == "omega_12 = -x3 depends on x3"
    assert read["algebra"]["no_wei_norman"] == "no basis is known"
    undetermined = json.loads(zakai.analyze(zakai.load_model("gallery:wong")).to_json())
    assert undetermined["omega"][0][1] == "-gamma'(x1 + x2 + x3)" and undetermined["functions"] == ["gamma"]


def test_latex_has_the_certificate_in_words_that_latex_takes_for_words():
    latex = zakai.analyze(zakai.load_model("gallery:lorenz")).to_latex()
    assert r"Witness: E contains x1, x2, x3, and omega\_1,2 = " in latex and r"\text{linear rank} &\ge 3" in latex
    assert r"\mathop{\gamma'}{\left(x_{1} + x_{2} + x_{3} \right)}" in zakai.analyze(zakai.load_model("gallery:wong")).to_latex()
    model = zakai.Model(state=["x1", "x2"], drift=["0", "g(x1, x2)"], observation=["x1"], functions=["g"])
    assert r"\mathop{\partial_{1} g}" in zakai.analyze(model).to_latex()


def test_an_analysis_shows_what_auto_takes_and_how_many_methods_hold():
    text = repr(zakai.analyze(zakai.load_model("gallery:benes")))
    assert text == "Analysis('Benes', state x: auto takes benes; the conditions hold for 10 of 13 methods)"
