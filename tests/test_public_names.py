"""`import zakai` gives the public names, each loaded when it is used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import zakai
from zakai import _registry
from zakai.algebra.theorems import THEOREMS


def test_what_is_imported_is_what_is_used():
    """Nothing by the import, no compiler by an analysis, a simulation or a record, and JAX by none of zakai's own methods."""
    code = (
        "import sys, zakai\n"
        "assert not {'jax', 'numba', 'numpy', 'scipy', 'sympy', 'xarray'} & set(sys.modules)\n"
        "for name in ('wong', 'kalman-bucy-2d'):\n"
        "    model = zakai.load_model('gallery:' + name)\n"
        "    found = zakai.analyze(model); found.algebra.dimension, print(found), found.to_json(), found.to_latex()\n"
        "zakai.simulate(model, [0.1, 0.2], seed=0); zakai.Record; zakai.read_record\n"
        "assert not {'jax', 'numba'} & set(sys.modules)\n"
        "model = zakai.load_model('gallery:kalman-bucy-1d')\n"
        "_, record = zakai.simulate(model, [0.1, 0.2, 0.3], seed=0)\n"
        "for method in ('kalman-bucy', 'yau-yau'):\n"
        "    zakai.filter(model, record, method).density(-1).quantile([0.1, 0.9])\n"
        "    zakai.online(model, method=method).update(0.1, record.values[0])\n"
        "    zakai.log_likelihood(model, record, method=method)\n"
        "    assert 'jax' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, timeout=120)


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
