"""Untrusted model files: refused in one line before anything large is computed, whatever they hold."""

from __future__ import annotations

import time

import pytest

from zakai.errors import InputError
from zakai.models import load_model

GOOD = {"state": '["x"]', "drift": '["x"]', "observation": '["x"]'}


def model(**changes: str) -> str:
    return "\n".join(f"{key} = {value}" for key, value in (GOOD | changes).items())


def listed(form: str, count: int) -> str:
    return "[" + ", ".join(form.format(i=i) for i in range(count)) + "]"


def table(count: int) -> str:
    return "{" + ", ".join(f"p{i} = 1" for i in range(count)) + "}"


def sums(count: int, terms: int, form: str) -> str:
    return listed('"' + "+".join(form.format(j=j) for j in range(terms)) + '+{i}"', count)


BAD = {
    "90,000 states": (model(state=listed('"x{i}"', 90_000)), "state: expected a list of 1 to 1024 names, got 90000"),
    "90,000 sensors": (model(observation=listed('"x"', 90_000)), "observation: expected a list of 1 to 1024 formulas"),
    "90,000 noises": (model(diffusion=f"[{listed('1', 90_000)}]"), "diffusion: at most 1024 noises"),
    "70,000 parameters": (model(parameters=table(70_000)), "parameters: expected a table of at most 1024 numbers, got 70000"),
    "90,000 functions": (model(functions=listed('"f{i}"', 90_000)), "functions: expected a list of at most 1024 names"),
    "long formulas": (model(observation=sums(100, 900, "x**{j}")), "formulas have [0-9]* characters together; at most 250000"),
    "many calls": (model(observation=sums(100, 100, "sin({j}*x)")), "formulas have 10000 parentheses together; at most 8192"),
    "a long formula": (model(drift='["' + "x+" * 400_000 + 'x"]'), "drift.0.: column 10001: the formula has 800001 characters"),
    "many tables": ("".join(f"[a{i}.b.c.d.e.f]\n" for i in range(50_000)), "more than 8192 lines that begin with"),
    "many tables of one name": ("[[a]]\n" * 150_000, "more than 8192 lines that begin with"),
    "a key of many parts": ("a." * 400_000 + "a = 1", "a key of nine or more parts"),
    "many components": (
        model(prior=f'{{kind = "mixture", weights = {listed("1", 80_000)}, means = [], covs = []}}'),
        "prior: weights: expected at most 10000 numbers, got 80000",
    ),
    "half a million lists": ("state = " + "[" * 500_000, "nested too deep"),
    "a hundred thousand tables": ("a = " + "{a=" * 100_000, "nested too deep|is not TOML"),
    "a power of a billion": (model(drift='["x**(10**9)"]'), "the exponent of .* is larger than 64"),
    "an exponent of a billion": (model(start="1e999999999999"), "start: expected a finite number"),
    "a decimal of a million digits": (model(drift=f"[0.{'7' * 1_000_000}]"), "drift.0.: column"),
    "an integer of a million digits": (model(start="9" * 1_000_000), "a number that cannot be read"),
    "a text as long as a file": ("x" * (1 << 20), "is not TOML"),
    "more than a file": ("#" * (1 << 20) + "\n", "larger than 1 MiB"),
}


@pytest.mark.parametrize(("text", "says"), BAD.values(), ids=BAD.keys())
def test_a_model_file_from_a_stranger_is_refused_at_once(tmp_path, text, says):
    (tmp_path / "m.toml").write_text(text)
    began = time.process_time()
    with pytest.raises(InputError, match=f"m.toml: .*{says}") as error:
        load_model(tmp_path / "m.toml")
    assert time.process_time() - began < 2
    assert str(error.value).isprintable() and len(str(error.value)) < 600


def test_a_large_model_within_the_bounds_is_read(tmp_path):
    states = listed('"x{i}"', 100)
    rows = "[" + ", ".join('"' + " + ".join(f"0.{i}{j}*x{j}" for j in range(100)) + '"' for i in range(100)) + "]"
    (tmp_path / "m.toml").write_text(model(state=states, drift=rows, observation='["sin(x0)"]'))
    assert load_model(tmp_path / "m.toml").n == 100
