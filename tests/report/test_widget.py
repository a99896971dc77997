"""The widget of a notebook, by its traits and messages, and what a result shows of itself."""

from __future__ import annotations

import sys
from html import unescape

import numpy as np
import pytest

import zakai
from report.frames import on_page, read
from zakai.errors import InputError
from zakai.report import widget as module

MODEL = """
state = ["x", "v"]
parameters = {{ a = {a} }}
drift = ["v", "-a*v"]
observation = ["x"]
observation_kind = "samples"
prior = {{ kind = "gaussian", mean = [0.0, 0.0], cov = [[1.0, 0.0], [0.0, 1.0]] }}
"""


def model(tmp_path, a):
    (tmp_path / "m.toml").write_text(MODEL.format(a=a))
    return zakai.load_model(tmp_path / "m.toml")


@pytest.fixture
def filtered(tmp_path):
    one = model(tmp_path, 0.5)
    truth, record = zakai.simulate(one, 0.01 * np.arange(1, 3001), seed=0)
    return zakai.filter(one, record), truth


def test_a_widget_holds_the_frame_of_all_times(filtered):
    result, truth = filtered
    shown = zakai.widget(result, "v", truth=truth)
    header, arrays = read(shown.frame)
    assert header["name"] == shown.coordinate == "v" and shown.names == ["x", "v"]
    assert header["window"] == [0.0, 30.0] and len(arrays["times"]) == 1000
    assert "truth" in {line["role"] for line in header["lines"]}
    assert "export default" in shown._esm and "import " not in shown._esm.replace("export default", "")


def test_the_picture_follows_the_coordinate_the_result_and_the_model(filtered, tmp_path):
    result, _ = filtered
    shown = zakai.widget(result)
    seen = []
    shown.observe(lambda change: seen.append(read(change["new"])[0]["name"]), "frame")
    shown.coordinate = "v"
    assert seen == ["v"]
    shown.model = model(tmp_path, 2.0)
    assert shown.result is not result and shown.result.model is shown.model and seen == ["v", "v"]
    np.testing.assert_array_equal(read(shown.frame)[1]["mean"][[0, -1]], shown.result.mean[[0, -1], 1])
    shown.result = zakai.smooth(result.model, zakai.Record(result.times[1:40], result.record.values[:39], "samples"))
    assert shown.model is shown.result.model and len(read(shown.frame)[1]["times"]) == 40


def test_a_reader_who_zooms_receives_the_densities_there(filtered):
    shown = zakai.widget(filtered[0])
    sent = []
    shown.send = lambda content, buffers=None: sent.append((content, buffers))
    shown._handle_custom_msg({"wanted": [10.0, 11.0]}, [])
    ((content, (frame,)),) = sent
    header, arrays = read(frame)
    assert content == {"coordinate": "x"} and header["complete"]
    assert arrays["times"][0] <= 10.0 and arrays["times"][-1] >= 11.0 and len(arrays["times"]) < 110
    assert header["key"] == read(shown.frame)[0]["key"]


def test_a_wrong_coordinate_is_refused(filtered):
    with pytest.raises(InputError, match="there is no state 'w'"):
        zakai.widget(filtered[0], "w")


def test_without_anywidget_the_extra_is_named(filtered, monkeypatch):
    module._widget_class.cache_clear()
    monkeypatch.setitem(sys.modules, "anywidget", None)
    with pytest.raises(InputError, match=r'pip install "zakai\[notebook\]"'):
        zakai.widget(filtered[0])
    module._widget_class.cache_clear()


def test_a_result_in_a_notebook_has_its_picture_in_a_document_that_fetches_nothing(filtered):
    html = filtered[0]._repr_html_()
    assert html.count("<iframe") == 1 and 'sandbox="allow-scripts"' in html and "<script" not in html
    page = unescape(html[html.index("srcdoc=") : html.index(" loading=")])
    header, arrays = on_page(page)["picture"]
    assert header["name"] == "x" and len(arrays["times"]) == 600
    assert "default-src 'none'" in page and "https:" not in page
    assert len(html) < 600_000


def test_a_stored_result_is_shown_without_filtering_its_record_again(filtered, tmp_path, monkeypatch):
    filtered[0].save(tmp_path / "result.nc", densities=True)
    stored = zakai.load_result(tmp_path / "result.nc")
    monkeypatch.setattr("zakai.engine.loop.advance", lambda *_: pytest.fail("the record was filtered again"))
    html = stored._repr_html_()
    page = unescape(html[html.index("srcdoc=") : html.index(" loading=")])
    _, arrays = on_page(page)["picture"]
    assert "cells" not in arrays and len(arrays["times"]) == 600
