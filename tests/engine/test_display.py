"""What objects say of themselves: one short line, and a table in a notebook."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import zakai


@pytest.fixture(scope="module")
def objects():
    model = zakai.load_model("gallery:kalman-bucy-2d")
    times = 0.05 * np.arange(1, 31)
    truth, record = zakai.simulate(model, times, seed=0)
    result = zakai.filter(model, record)
    online = zakai.online(model)
    online.update(0.05, record.values[0])
    line = zakai.load_model("gallery:kalman-bucy-1d")
    return {
        "Model": model,
        "Truth": truth,
        "Record": record,
        "Inputs": zakai.Inputs(times, np.ones((30, 1))),
        "FilterResult": result,
        "SmoothingResult": zakai.smooth(model, record),
        "Prepared": zakai.prepare(model, times),
        "Online": online,
        "Estimate": online.last,
        "GaussianMixture": result.density(-1),
        "Analysis": zakai.analyze(model),
        "maximum likelihood": zakai.fit(line, zakai.simulate(line, times, seed=0)[1], ["a"]),
    }


def test_every_object_says_at_a_glance_what_it_holds(objects):
    for name, one in objects.items():
        text = repr(one)
        assert text.startswith(name) and len(text.splitlines()[0]) <= 200, text
        assert name == "maximum likelihood" or "\n" not in text
        assert "array(" not in text


def test_every_object_is_a_table_in_a_notebook(objects):
    for name, one in objects.items():
        html = one._repr_html_()
        assert html.startswith("<div>") and html.count("<table>") == html.count("</table>") == 1, name
        assert len(html.partition("<iframe")[0]) < 6000, name


def test_the_numbers_in_a_table_are_those_of_the_object(objects):
    result = objects["FilterResult"]
    assert f"<td>{result.mean[-1, 1]:.6g}</td>" in result._repr_html_()
    low, high = result.density(-1).quantile([0.025, 0.975])[:, 0]
    assert f"<td>{low:.6g}</td><td>{high:.6g}</td>" in result.density(-1)._repr_html_()
    assert "18 more" in objects["Truth"]._repr_html_() or "19 more" in objects["Truth"]._repr_html_()


def test_names_from_files_are_escaped():
    model = zakai.Model(name="<script>alert(1)</script>", state=["x"], drift=["-x"], observation=["x"])
    assert "<script>" not in model._repr_html_() and "&lt;script&gt;" in model._repr_html_()


def test_many_states_are_abbreviated():
    names = [f"x{i}" for i in range(40)]
    model = zakai.Model(state=names, drift=[f"-{name}" for name in names], observation=names)
    assert "state x0, x1, x2, x3, ..., x39" in repr(model)
    assert "68 more" in model._repr_html_()


def test_the_signature_of_a_model_lists_its_keys():
    from zakai.models.model import KEYS

    parameters = inspect.signature(zakai.Model).parameters
    assert {*parameters} - {"unknown"} == {*KEYS}
    assert all(one.kind is one.KEYWORD_ONLY for name, one in parameters.items() if name != "unknown")
    with pytest.raises(zakai.InputError, match="did you mean 'drift'"):
        zakai.Model(state=["x"], drft=["-x"], observation=["x"])
