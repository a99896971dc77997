"""`import zakai` gives the public names, each loaded when it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import zakai
from zakai import _registry
from zakai.algebra.theorems import THEOREMS


def in_a_fresh_process(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60).stdout


def test_importing_zakai_loads_nothing_heavy():
    heavy = in_a_fresh_process(
        "import sys, zakai; print([name for name in ('jax', 'numpy', 'scipy', 'sympy', 'xarray') if name in sys.modules])"
    )
    assert heavy.strip() == "[]"


def test_a_model_is_analysed_and_simulated_and_records_are_read_without_jax():
    in_a_fresh_process(
        "import sys, zakai\n"
        "model = zakai.load_model('gallery:kalman-bucy-2d')\n"
        "print(zakai.analyze(model)); zakai.analyze(model).to_json(); zakai.analyze(model).to_latex()\n"
        "zakai.simulate(model, [0.1, 0.2], seed=0); zakai.Record; zakai.read_record\n"
        "assert 'jax' not in sys.modules"
    )


@pytest.mark.parametrize("name", zakai.__all__)
def test_every_public_name_is_there(name):
    assert getattr(zakai, name) is not None
    assert name in dir(zakai)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing"):
        zakai.nothing  # noqa: B018


def test_every_method_has_a_theorem_and_its_own_name():
    assert set(_registry.METHODS) <= set(THEOREMS)
    assert set(_registry.AUTO) <= set(_registry.METHODS)
    for name in _registry.METHODS:
        method = _registry.load(name)
        assert method.name == name
        assert method.theorem is THEOREMS[name]


def test_an_unknown_method_is_answered_with_the_one_that_was_meant():
    with pytest.raises(zakai.InputError, match='did you mean "limited-direct"'):
        _registry.load("limited")
