"""The table of the mechanisms of one state: what it says is in the docs, and each mechanism takes the intervals it names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import zakai
from zakai.methods.line import choice

ROOT = Path(__file__).parents[2]


def test_the_docs_show_the_table_of_mechanisms():
    page = (ROOT / "docs/explanation/any-smooth-system.md").read_text()
    rows = [f"| {row.name} | {row.condition} | {row.cost} |" for row in choice.MECHANISMS]
    assert "\n".join(rows) in page


def test_each_mechanism_names_a_test_that_exists():
    assert [row.test for row in choice.MECHANISMS if not (ROOT / row.test).is_file()] == []


def taken(monkeypatch, drift, kind, prior=1.0, method="yau-yau", **keys):
    """Return the names of the mechanisms that took the intervals of a record alone."""
    names = []

    def noted(row):
        def predict(density):
            prediction = row.predict(density)
            names.extend([row.name] * (prediction is not None))
            return prediction

        return row._replace(predict=predict) if row.predict else row

    monkeypatch.setattr(choice, "MECHANISMS", tuple(noted(row) for row in choice.MECHANISMS))
    prior = {"kind": "gaussian", "mean": [0.5], "cov": [[prior]]}
    model = zakai.Model(state=["x"], drift=[drift], observation=["x"], observation_kind=kind, prior=prior, **keys)
    zakai.filter(model, zakai.Record(np.array([0.5, 1.3, 1.5]), np.array([[0.4], [0.8], [0.6]]), kind), method)
    return set(names)


@pytest.mark.parametrize(
    ("name", "case"),
    [
        ("a Gaussian kernel", {"drift": "tanh(x)", "kind": "samples", "method": "limited-direct", "prior": 1e-4}),
        ("panels", {"drift": "x - x**3", "kind": "samples", "prior": 100.0}),
        ("substeps of Magnus' series", {"drift": "1 + sin(x)/2", "kind": "samples", "diffusion": [["0.03"]]}),
        ("modes of the operator", {"drift": "-x", "kind": "samples", "prior": 400.0}),
    ],
)
def test_a_mechanism_takes_the_intervals_it_is_for(monkeypatch, name, case):
    assert name in taken(monkeypatch, **case)
