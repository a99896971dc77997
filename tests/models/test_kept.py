"""What is computed for a model is stored in the model: it ends with the model, and copies do not have it."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref

import numpy as np
import pytest

import zakai
from zakai.models.kept import once_for_a_model


def _model(rate=1.0, **keys):
    """Return dx = (x - rate x^3) dt + dv with samples of x, or a part of it replaced."""
    known = {"state": ["x"], "drift": [f"x - {rate}*x**3"], "observation": ["x"], "observation_kind": "samples"}
    prior = {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}
    return zakai.Model(**{**known, "observation_noise": [[0.1]], "prior": prior, **keys})


RECORD = zakai.Record(np.array([0.1, 0.25, 0.3]), np.array([[0.3], [0.1], [-0.2]]), "samples")


@pytest.mark.parametrize(("method", "drift", "most"), [("kalman-bucy", "-x", 1), ("yau-yau", "-x**3", 8)])
def test_models_that_nobody_holds_are_freed(method, drift, most):
    references = []
    for _ in range(12):
        model = _model(drift=[drift])
        zakai.analyze(model)
        zakai.filter(model, RECORD, method)
        references.append(weakref.ref(model))
    del model
    gc.collect()
    assert sum(reference() is not None for reference in references) <= most


def test_a_model_that_was_used_can_be_pickled_and_copied():
    model = _model()
    expected = zakai.filter(model, RECORD, "yau-yau").mean
    for other in (pickle.loads(pickle.dumps(model)), copy.copy(model)):
        assert np.array_equal(zakai.filter(other, RECORD, "yau-yau").mean, expected)
        assert zakai.analyze(other).recommended == zakai.analyze(model).recommended


def test_a_function_of_a_model_is_computed_once_for_each_argument():
    calls = []

    @once_for_a_model
    def name(model, suffix, upper=False):
        calls.append((model.name, suffix))
        return (model.name + suffix).upper() if upper else model.name + suffix

    one, other = _model(name="one"), _model(name="other")
    found = [name(one, "a"), name(one, "b"), name(one, "a"), name(other, "a"), name(one, "a", upper=True)]
    assert found == ["onea", "oneb", "onea", "othera", "ONEA"] and len(calls) == 4
