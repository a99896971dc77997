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
        "import sys, zakai\n"
        "print([name for name in ('jax', 'numba', 'numpy', 'scipy', 'sympy', 'xarray') if name in sys.modules])"
    )
    assert heavy.strip() == "[]"


def test_a_model_is_analysed_and_simulated_and_records_are_read_without_a_compiler():
    in_a_fresh_process(
        "import sys, zakai\n"
        "model = zakai.load_model('gallery:kalman-bucy-2d')\n"
        "print(zakai.analyze(model)); zakai.analyze(model).to_json(); zakai.analyze(model).to_latex()\n"
        "zakai.simulate(model, [0.1, 0.2], seed=0); zakai.Record; zakai.read_record\n"
        "assert not {'jax', 'numba'} & set(sys.modules)"
    )


@pytest.mark.parametrize("method", ["kalman-bucy", "yau-yau"])
def test_a_record_is_filtered_online_and_fitted_without_jax(method):
    in_a_fresh_process(
        "import sys, zakai\n"
        "model = zakai.load_model('gallery:kalman-bucy-1d')\n"
        "_, record = zakai.simulate(model, [0.1, 0.2, 0.3], seed=0)\n"
        f"result = zakai.filter(model, record, '{method}'); result.density(-1).quantile([0.1, 0.9])\n"
        f"zakai.online(model, method='{method}').update(0.1, record.values[0])\n"
        f"zakai.log_likelihood(model, record, method='{method}')\n"
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
