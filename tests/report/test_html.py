"""The HTML report: complete, self-contained, escaped, small and fast."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import sympy

import zakai
from report.fakes import fake_result
from report.frames import on_page, series, without_scripts
from zakai.algebra.conditions import Condition
from zakai.errors import InputError
from zakai.report import write_report
from zakai.report.equations import equations
from zakai.report.html import page
from zakai.report.sections import special_moments
from zakai.report.series import thinned


@pytest.fixture(scope="module")
def small():
    result, truth = fake_result(observations=60, warnings=["The window cut off 2% of the mass."])
    return without_scripts(page(result, truth))


@pytest.mark.parametrize(
    "text",
    [
        "The posterior over time", "The density at moments of note", "Log-likelihood",
        "Health of the computation",
        "Which method, and why", "The model", "limited-direct", "exact in its class", "60 observations",
        "The window cut off 2% of the mass.", "The drift has the Yau form", "✓ holds",
        "does not hold", "undecided",
        "Theorem 3 holds", "edge mass", "<math", "Parameters", "numpy", "rms error of the mean",
    ],
)  # fmt: skip
def test_the_page_contains(small, text):
    assert text in small


def test_nothing_on_the_page_comes_from_a_network(small):
    assert not re.findall(r"(?i)https?:|<link|@import|url\(|<iframe|<img|<script[^>]*src", small)
    assert "default-src 'none'" in small


def test_hostile_texts_are_escaped_everywhere():
    hostile = '</script><script>alert("x")</script><img src=x onerror=alert(1)>'
    result, truth = fake_result(observations=20, warnings=[hostile], name=hostile)
    result.why = result.model.text = result.method = hostile
    result.attributes = {"exactness": hostile, "version_zakai": hostile}
    result.health = {hostile: np.arange(21.0)}
    result.conditions = {hostile: (Condition(hostile, False, hostile, hostile),)}
    result.model.state = (hostile,)
    result.model.parameters = {hostile: 1}
    result.model.drift = sympy.ImmutableMatrix([sympy.Symbol(hostile) ** 2])
    text = without_scripts(page(result, truth))
    assert "<img" not in text and 'alert("x")</script>' not in text
    assert text.count("&lt;img") > 12


def test_warnings_come_before_the_first_picture(small):
    assert small.index('role="alert"') < small.index("<div data-zakai")


def test_a_run_without_densities_says_so_and_draws_the_band():
    result, _ = fake_result(observations=30, densities=False)
    text = without_scripts(page(result))
    assert "The densities of this run were not kept" in text and 'id="posterior-0"' in text


def test_a_state_with_a_thin_band_is_drawn_once():
    result, _ = fake_result(observations=100, step=5.0)
    assert without_scripts(page(result)).count('id="posterior-0"') == 1


def test_a_report_says_whether_it_is_of_a_filter_or_a_smoother_and_draws_the_inputs():
    model = zakai.load_model("gallery:heated-room")
    inputs = zakai.Inputs([0.0, 1.0], [[1.0, 5.0], [0.0, 4.0]])
    record = zakai.simulate(model, np.arange(0.5, 6, 0.5), seed=0, inputs=inputs)[1]
    results = [call(model, record) for call in (zakai.filter, zakai.smooth)]
    assert [special_moments(result)[0] for result in results] == [(0, "prior"), (0, "start")]
    filtered, smoothed = (without_scripts(page(result)) for result in results)
    assert "Filtering report" in filtered and "given all observations up to that time" in filtered
    assert "Smoothing report" in smoothed and "all observations, earlier and later" in smoothed
    assert "Filtering report" not in smoothed and "smoothed 11 observations" in smoothed
    assert 'id="inputs"' in filtered and "At the end, t = 5.5, the estimate is " in filtered


def test_a_run_without_observations_or_health_or_conditions_is_a_page_too():
    result, _ = fake_result(observations=0)
    result.health, result.conditions = {}, {}
    assert "There was no observation" in without_scripts(page(result))


def test_nine_thousand_observations_take_little_space(tmp_path):
    result, truth = fake_result(observations=9000, state=("theta",), periodic=("theta",), kind="samples")
    write_report(result, tmp_path / "report.html", truth)
    assert (tmp_path / "report.html").stat().st_size < 2e6
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "600 of 9,001 densities are drawn" in text and "The last 200 times" in text


def test_a_refused_truth_leaves_no_file(tmp_path):
    result, _ = fake_result(observations=10)
    with pytest.raises(InputError, match="truth has shape"):
        write_report(result, tmp_path / "report.html", np.zeros((3, 3)))
    assert list(tmp_path.iterdir()) == []


def test_the_moments_of_note_hold_the_surprise_the_spread_and_both_ends():
    result, _ = fake_result(observations=100)
    moments = dict(special_moments(result))
    assert len(moments) == 6 and 0 in moments and 100 in moments
    assert "largest surprise" in moments[1 + int(np.argmin(result.log_likelihood_increments[1:]))]
    assert "most uncertain" in moments[1 + int(np.argmax(result.variance[1:, 0]))]


def test_a_time_without_an_observation_is_not_the_most_uncertain_moment():
    result, _ = fake_result()
    values = np.ones((len(result.times) - 1, 1))
    widest = int(np.argmax(result.variance[1:, 0]))
    values[widest] = np.nan
    result.record = SimpleNamespace(values=values)
    moments = dict(special_moments(result))
    assert "most uncertain" not in moments.get(1 + widest, "")
    assert any("most uncertain" in name for name in moments.values())


def test_thinning_keeps_both_extremes():
    values = np.random.default_rng(0).standard_normal(100_000)
    kept = thinned(values, 1000)
    assert len(kept) <= 1000 and values.argmin() in kept and values.argmax() in kept


def test_a_figure_of_health_that_only_the_method_knows_is_explained_in_its_words():
    result, _ = fake_result(observations=20)
    result.health["wobble"], result.bounds = (
        np.linspace(0.1, 1.0, 21),
        {"wobble": (0.5, "how far it wobbles")},
    )
    text = without_scripts(page(result))
    assert "How far it wobbles." in text
    header, _ = frame = on_page(text)["health-figures"]
    number = [panel["title"] for panel in header["panels"]].index("wobble")
    (bound,) = (one["at"] for one in series(frame, number) if one["kind"] == "row")
    assert bound == 0.5


def test_the_equations_name_the_kind_of_observation_and_keep_long_decimals():
    result, _ = fake_result(observations=5, kind="samples")
    result.model.drift = sympy.ImmutableMatrix([sympy.Rational("0.12345") * result.model.x[0]])
    text = equations(result.model)
    assert "samples z" in text and "<mn>0.12345</mn>" in text


WAITING = {"state": ["x"], "drift": ["-x"], "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]}}
LAWS = {
    "z(tk)=x+r": {"observation": ["x"]},
    "logz(tk)=x+r": {"observation": ["x"], "observation_family": "log-normal"},
    "r∼t(0,S,degrees of freedom=4),S=1": {"observation": ["x"], "observation_family": "student-t", "degrees_of_freedom": 4},
    "z(tk)∼poisson(x2)": {"observation": ["x**2"], "observation_family": "poisson"},
    "z(tk)∼von-mises(x,concentration=3)": {"observation": ["x"], "observation_family": "von-mises", "concentration": 3},
    "logp(z | x)=−|x−z|": {"observation_log_density": "-abs(z - x)", "observed": ["z"]},
    "x∈[0,3], reflecting ends": {
        "observation": ["x"], "domain": {"x": {"lower": 0, "upper": 3, "boundary": "reflecting"}},
        "prior": {"kind": "density", "log_density": "-x**2"},
    },
    "x∈(0,∞), natural ends": {
        "observation": ["x"], "domain": {"x": {"lower": 0}}, "prior": {"kind": "density", "log_density": "-x**2"},
    },
    "z(tk)=max(x,0)+atan2(x,t)+r": {"observation": ["max(x, 0) + atan2(x, t)"]},
    "z(tk)=r+ε": {"state": ["r"], "drift": ["-r"], "observation": ["r"]},
    "dv1=−0.4v1dt+0.3dβ": {"state": ["v1"], "drift": ["-0.4*v1"], "diffusion": [["0.3"]], "observation": ["v1/2"]},
}  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_the_equations_show_the_law_of_the_observations_and_the_domain(law: str):
    text = equations(zakai.Model(**{**WAITING, "observation_kind": "samples", **LAWS[law]}))
    said = re.sub(r"<[^>]+>", "", text)
    assert law in said
    assert ("Observation noise" in said) == (not re.match(r"z.*∼|logp", law))
