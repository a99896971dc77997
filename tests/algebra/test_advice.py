"""Refusals advise: the nearest method and its assumption that fails, then what can be done, which is checked to be true."""

from __future__ import annotations

import re

import numpy as np
import pytest

import zakai
from zakai.algebra.choice import chosen

SIX = [f"x{i}" for i in range(6)]


def refusal(method="auto", **keys):
    with pytest.raises(zakai.ConditionError) as error:
        chosen(zakai.Model(**keys), method)
    first, second = str(error.value).splitlines()
    assert second.endswith("`zakai methods MODEL` lists every assumption")
    return first, second


def test_a_grid_of_six_states_is_refused_and_particles_are_named():
    first, second = refusal("yau-yau", state=SIX, drift=[f"x{(i + 1) % 6} - x{i}**3" for i in range(6)], observation=SIX)
    assert "yau-yau does not hold: it fails that the state has at most four" in first
    assert second.startswith('guided-particles holds: method="auto" takes it;')


def test_a_method_that_does_not_hold_names_one_that_does():
    first, second = refusal("benes", state=["x"], drift=["x - x**3"], observation=["x"])
    assert first.startswith("model: benes does not hold: it fails that ")
    assert second.startswith('yau-yau holds: method="auto" takes it;')


@pytest.mark.parametrize("kind", ["increments", "samples"])
def test_multiplicative_noise_is_rewritten_in_logarithms_and_the_rewriting_is_right(kind):
    keys = {"state": ["s"], "drift": ["a*s"], "diffusion": [["b*s"]], "parameters": {"a": 0.1, "b": 0.4}}
    _, second = refusal("kalman-bucy", **keys, observation=["log(s)"], observation_kind=kind)
    found = re.search(r"write the model in log_s = log\(s\): dlog_s = \((.*)\) dt \+ \.\.\., for which kalman-bucy holds", second)
    drift = zakai.Model(state=["log_s"], drift=[found[1]], observation=["log_s"], parameters={"a": 0.1, "b": 0.4}).drift[0]
    assert float(drift.subs({"a": 0.1, "b": 0.4}).evalf(subs={s: {"a": 0.1, "b": 0.4}[s.name] for s in drift.free_symbols})) == (
        pytest.approx(0.1 - 0.08, abs=1e-15)
    )


def test_many_states_with_multiplicative_noise_are_rewritten_together():
    diffusion = [[name if i == j else "0" for j in range(6)] for i, name in enumerate(SIX)]
    drift = [f"{name} - {name}*log({name})" for name in SIX]
    _, second = refusal("yau-yau", state=SIX, drift=drift, diffusion=diffusion, observation=[f"log({name})" for name in SIX])
    assert second.startswith("guided-particles holds")
    assert "the logarithms of x0, x1, x2, x3, x4, x5: dlog_x0 = (1/2 - log_x0) dt + ..., for which kalman-bucy holds" in second


def test_noise_that_is_not_proportional_is_not_rewritten():
    _, second = refusal("kalman-bucy", state=["x"], drift=["-x"], diffusion=[["1 + x**2"]], observation=["x"])
    assert "log" not in second


def test_a_method_without_angles_says_to_leave_periodic_out():
    keys = {"state": ["a"], "periodic": ["a"], "drift": ["sin(a)"], "observation": ["cos(a)"]}
    _, second = refusal("kolmogorov-series", **keys)
    assert "leave out periodic = ['a'], for which kolmogorov-series holds" in second


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        (
            {"observation": ["a"], "observation_kind": "samples"},
            'list the observation in observed_angles, or set observation_family = "von-mises"',
        ),
        ({"observation": ["1 - a"], "observation_kind": "samples"}, "list the observation in observed_angles"),
        ({"observation": ["a"]}, "write it in cos(a) and sin(a), or leave a out of periodic"),
        ({"drift": ["-a"], "observation": ["sin(a)"]}, "write it in cos(a) and sin(a), or leave a out of periodic"),
    ],
)
def test_an_angle_that_is_used_as_a_number_says_what_to_write(keys, says):
    with pytest.raises(zakai.InputError, match=re.escape(says)):
        zakai.Model(**{"state": ["a"], "periodic": ["a"], "drift": ["0"], **keys})


def test_the_command_prints_both_lines(tmp_path, capsys):
    from zakai.cli import main

    (tmp_path / "m.toml").write_text(
        'state = ["x"]\ndrift = ["x"]\ndiffusion = [["x"]]\nobservation = ["log(x)"]\nobservation_kind = "increments"\n'
        '[prior]\nkind = "gaussian"\nmean = [1]\ncov = [[0.1]]\n'
    )
    (tmp_path / "r.csv").write_text("time,y\n0.1,0.2\n")
    code = main(["filter", str(tmp_path / "m.toml"), str(tmp_path / "r.csv"), "-o", str(tmp_path / "r.nc"), "--method", "benes"])
    lines = capsys.readouterr().err.splitlines()
    assert code == zakai.ConditionError.exit_code and len(lines) == 2 and lines[0].startswith("error: ")
    assert np.isin(["yau-yau"], re.findall(r"[a-z-]+", lines[1])).all()
