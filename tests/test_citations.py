"""`zakai.cite`: the papers of the methods that were used, and no others."""

from __future__ import annotations

import re

import numpy as np
import pytest

import zakai
from zakai import citations
from zakai._registry import METHODS, PEERS, load
from zakai.errors import InputError


def keys(text):
    return re.findall(r"^@\w+\{(.+),$", text, re.MULTILINE)


def test_every_method_has_papers_and_every_paper_is_cited():
    assert {*citations.PAPERS} == {*METHODS, *PEERS}
    used = {key for papers in citations.PAPERS.values() for key in papers}
    assert used | {"zakai", "byrd-lu-nocedal-zhu-1995"} == {*citations._entries()}


@pytest.mark.parametrize("name", METHODS)
def test_the_papers_are_those_that_the_method_names(name):
    text, source = zakai.cite(name), load(name).source
    years = {*re.findall(r"year = \{(\d+)\}", text)}
    assert {*re.findall(r"\b(?:19|20)\d\d\b", source)} == years
    for author in re.findall(r"author = \{(.+)\}", text)[1:]:
        assert re.sub(r"[^A-Za-z]", "", author.split(",")[0].replace(r"\v s", "s")) in source.replace("š", "s")


def test_entries_are_bibtex():
    text = zakai.cite(*METHODS, *PEERS)
    for entry in re.split(r"\n(?=@)", text):
        assert entry.count("{") == entry.count("}")
        fields = re.findall(r"^  (\w+) = \{", entry, re.MULTILINE)
        assert {"author", "title"} <= {*fields} and len({*fields}) == len(fields)
    assert len(keys(text)) == len({*keys(text)})


def test_results_fits_and_blocks_are_cited_by_their_methods():
    model = zakai.load_model("gallery:kalman-bucy-1d")
    _, record = zakai.simulate(model, 0.1 * np.arange(1, 11), seed=0)
    result = zakai.filter(model, record)
    expected = ["zakai", "kalman-bucy-1961", "makowski-1986"]
    assert keys(zakai.cite(result)) == keys(zakai.cite(zakai.online(model))) == expected
    assert keys(zakai.cite(zakai.fit(model, record, ["a"]))) == [*expected, "byrd-lu-nocedal-zhu-1995"]
    assert zakai.__version__ in zakai.cite(result) and repr(zakai.cite(result)) == str(zakai.cite(result))
    result.method = "blocks: 3 x limited-direct, benes"
    assert keys(zakai.cite(result)) == ["zakai", "chen-luo-yau-2017", "benes-1981", "makowski-1986"]


@pytest.mark.parametrize("wrong", ["kalman", 3, None])
def test_what_no_method_made_is_refused(wrong):
    with pytest.raises(InputError, match="cite: .* is unknown; give a result, or the name of a method: kalman-bucy"):
        zakai.cite(wrong)
