"""The text of a model: an error is found at its place, and a value is replaced where it stands."""

from __future__ import annotations

import tomllib

import pytest

import zakai
from zakai.models.files import read_model
from zakai.studio.text import place_of_error, shown, with_values

TEXT = """# A comment that stays.
name  = "two states"
state = ["x", "v"]   # position, velocity
drift = [
  "v",
  "-x - a*v",        # damped
]
diffusion = [["0"], ["1"]]
observation = ["x"]
observation_kind = "samples"

[parameters]
a = 0.50

[prior]
kind = "gaussian"
mean = [0, 0]
cov = [1, 2]
"""


def wrong(text: str) -> str:
    """What is marked in a text that is no model."""
    with pytest.raises(zakai.InputError) as caught:
        read_model(text, "model")
    place = place_of_error(text, str(caught.value).removeprefix("model: "))
    assert place is not None
    assert text[: place.start].count("\n") + 1 == place.line
    return text[place.start : place.stop]


@pytest.mark.parametrize(
    ("old", "new", "marked"),
    [
        ("-x - a*v", "-x - b*v", "b*v"),
        ('"x"]\nobs', '"x +* 2"]\nobs', "* 2"),
        ("name  =", "nam =", "nam ="),
        ("[1, 2]", "[1, -2]", "[1, -2]"),
        ('"samples"', '"sample"', '"sample"'),
        ("[parameters]", "[parameters", "[parameters"),
        ('["0"], ["1"]', '["0"], ["u"]', "u"),
        ("a = 0.50", 'a = "zero"', "zero"),
        ('"v",\n', '"v"\n', '"-x - a*v",        # damped'),
    ],
)
def test_the_place_of_an_error_is_found(old: str, new: str, marked: str):
    assert TEXT.count(old) == 1
    found = wrong(TEXT.replace(old, new))
    assert found.startswith(marked) or marked in found


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"parameters": {"a": "0.75"}}, "a = 0.75\n"),
        ({"drift": ["v", "-x"]}, 'drift = ["v", "-x"]\n'),
        ({"parameters": {"a": "0.50", "b": "2"}}, "a = 0.50\nb = 2\n"),
        ({"observation_noise": [["0.1"]]}, 'observation_noise = [["0.1"]]\n'),
        ({"name": 'with "quotes"'}, 'name  = "with \\"quotes\\""\n'),
        ({"start": "1.5"}, "start = 1.5\n"),
        ({"prior": {"kind": "gaussian", "mean": ["1", "0"], "cov": ["1", "2"]}}, "mean = [1, 0]\n"),
        ({"domain": {"x": {"lower": "0"}}}, "[domain]\nx = { lower = 0 }\n"),
    ],
)
def test_a_value_is_replaced_where_it_stands_and_the_rest_is_kept(changes, line: str):
    text = with_values(TEXT, changes)
    assert line in text
    assert text.startswith("# A comment that stays.\n")
    before, after = tomllib.loads(TEXT), tomllib.loads(text)
    assert {key: after[key] for key in before if key not in changes} == {key: before[key] for key in before if key not in changes}


def test_a_number_of_thousands_of_digits_is_kept():
    text = f"start = 0x{'f' * 5000}\nname = 'x'\n"
    assert tomllib.loads(with_values(text, {"name": "y"})) == {"start": int("f" * 5000, 16), "name": "y"}
    assert shown(tomllib.loads(text))["start"].startswith("0xfff")


def test_a_key_is_removed():
    assert "parameters" not in tomllib.loads(with_values(TEXT, {"parameters": None}))
    assert "name" not in tomllib.loads(with_values(TEXT, {"name": None}))
    assert with_values(TEXT, {"inputs": None}) == TEXT
