"""Which states are linear given the others."""

from __future__ import annotations

import json

import pytest

import zakai


def found(state, drift, observation, **more):
    names = state.split()
    keys = {"observation_kind": "samples", "diffusion": None, **more}
    return zakai.analyze(zakai.Model(state=names, drift=drift, observation=observation, **keys)).conditionally_linear


CASES = {
    "battery": ("s a b", ["-0.1", "-a", "-b/9"], ["tanh(s) - a - b"], {}, ("a", "b")),
    "vehicle": ("x y h v b", ["v*cos(h)", "v*sin(h)", "-b", "0", "0"], ["x", "y"], {}, ("x", "y", "v", "b")),
    "two kinds of product": ("x y z", ["-x*y", "-y", "x*z - z"], ["z"], {}, ("y", "z")),
    "hidden linearity": ("x y", ["(x + y)**2 - x**2 - 2*x*y - x", "-y**3"], ["x"], {}, ("x",)),
    "a kink": ("x y", ["-abs(y)", "x"], ["x"], {}, ("x",)),
    "a coefficient with a kink": ("x y", ["-abs(y)*x", "-y"], ["x"], {}, ("x",)),
    "noise": ("s v", ["-v/2", "1 - v"], ["s"], {"diffusion": [["sqrt(v**2 + 1)", "0"], ["0", "1"]]}, ("s",)),
    "counts": ("x y", ["y - x", "-y"], ["exp(x)"], {"observation_family": "poisson"}, ("y",)),
    "an angle": ("x y v", ["v", "0", "0"], ["atan2(y, x)"], {}, ("v",)),
    "a domain": ("x y", ["y - x", "-y"], ["x"], {"domain": {"y": {"lower": 0.0, "boundary": "reflecting"}}}, ("x",)),
    "noise of the observation": ("x y", ["y - x", "-y"], ["x"], {"observation_noise": [["exp(y)"]]}, ("x",)),
    "nothing": ("x y", ["-x**3", "-y**3"], ["x"], {}, ()),
    "everything": ("x y", ["y", "-x"], ["x"], {}, ("x", "y")),
}


@pytest.mark.parametrize("name", CASES)
def test_the_largest_set_of_states_is_found_that_is_linear_given_the_others(name):
    state, drift, observation, more, expected = CASES[name]
    result = found(state, drift, observation, **more)
    assert result == expected and isinstance(result, tuple)
    assert result.given == tuple(one for one in state.split() if one not in expected) and result.reason


def test_of_two_sets_of_equal_size_the_one_is_taken_that_moves_the_others_not_at_all():
    assert found("c k", ["-k*c", "0"], ["c"]) == ("c",)
    assert found("k c", ["0", "-k*c"], ["c"]) == ("c",)


def test_the_reason_names_the_formula_that_is_not_affine():
    reason = found("x h", ["cos(h)", "-h"], ["x"]).reason
    assert "given h, drift and observation are affine in x" in reason
    assert "h is not linear: the drift of x contains cos(h)" in reason
    assert "c and k are not linear together: the drift of c contains -c*k" in found("c k", ["-k*c", "0"], ["c"]).reason


def test_the_page_and_the_json_say_it():
    analysis = zakai.analyze(zakai.Model(state=["x", "h"], drift=["cos(h)", "-h"], observation=["x"]))
    assert "Linear given the other states\n  x  given  h\n" in str(analysis)
    assert json.loads(analysis.to_json())["conditionally_linear"]["states"] == ["x"]


def test_the_command_methods_says_what_particles_carry(tmp_path, capsys):
    from zakai.cli import inspecting

    path = tmp_path / "model.toml"
    path.write_text('state = ["x", "h"]\ndrift = ["cos(h)", "-h"]\nobservation = ["x"]\ndiffusion = [["1", "0"], ["0", "1"]]\n')
    inspecting.methods(str(path))
    assert "each particle carries the mean and the covariance of x given h" in " ".join(capsys.readouterr().out.split())
    path.write_text('state = ["x", "v"]\ndrift = ["v", "-v"]\nobservation = ["x**2"]\ndiffusion = [["0"], ["1"]]\n')
    inspecting.methods(str(path))
    assert "drawn with moves of the past: x, without noise of its own" in " ".join(capsys.readouterr().out.split())
