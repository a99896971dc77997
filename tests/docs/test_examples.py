"""The examples of docstrings run."""

from __future__ import annotations

import doctest
import inspect

import pytest

import zakai
from docs.examples import Example, examples, run

EXAMPLES = list(examples())


@pytest.mark.parametrize("example", EXAMPLES, ids=[f"{example.module}.{example.name}" for example in EXAMPLES])
def test_the_example_of_a_docstring_runs(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(example)


def test_every_public_function_has_an_example():
    named = {example.name for example in EXAMPLES}
    functions = [name for name in zakai.__all__ if inspect.isfunction(getattr(zakai, name))]
    assert [name for name in functions if name not in named] == []


def test_an_example_with_another_output_fails():
    with pytest.raises(doctest.DocTestFailure):
        run(Example("zakai", "wrong", ">>> 1 + 1\n3\n"))
