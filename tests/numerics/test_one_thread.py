"""Linear algebra has one thread while a record is filtered, and the number of before it after that."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  # loads its own library of linear algebra
from threadpoolctl import threadpool_info, threadpool_limits

import zakai


def numbers():
    return {library["filepath"]: library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def model():
    prior = {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]}
    return zakai.Model(state=["x"], drift=["x - x**3"], observation=["x"], observation_kind="samples", prior=prior)


def test_a_filter_leaves_the_number_of_threads_as_it_was(model):
    record = zakai.Record([0.1, 0.4], [0.2, -0.1], "samples")
    with threadpool_limits(3, "blas"):
        before = numbers()
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda _: zakai.filter(model, record), range(8)))
        with pytest.raises(zakai.InputError):
            zakai.filter(model, zakai.Record([0.1], [[0.2, 0.1]], "samples"))
        assert numbers() == before


def test_the_threads_of_a_user_do_not_change_the_answer(model, monkeypatch):
    record, seen = zakai.Record([0.1, 0.4], [0.2, -0.1], "samples"), []
    found = np.linalg.eigh

    def watched(*arguments, **keys):
        seen.extend(numbers().values())
        return found(*arguments, **keys)

    monkeypatch.setattr(np.linalg, "eigh", watched)
    with threadpool_limits(3, "blas"):
        many = zakai.filter(model, record)
    with threadpool_limits(1, "blas"):
        one = zakai.filter(model, record)
    assert np.array_equal(many.mean, one.mean)
    assert many.log_likelihood == one.log_likelihood
    assert set(seen) <= {1}
