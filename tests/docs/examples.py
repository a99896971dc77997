"""The examples of docstrings: where they are, and how to run them."""

from __future__ import annotations

import ast
import doctest
import importlib
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

import zakai
from docs.documents import ROOT

# What a reader of an example has: a model with a parameter, a record of it, and a result.
KEYS: dict[str, Any] = {
    "state": ["x"], "drift": ["-a*x"], "observation": ["x"], "observation_kind": "samples", "parameters": {"a": 0.5},
    "observation_noise": [[0.1]], "prior": {"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
}  # fmt: skip

# They take minutes; their tests are elsewhere.
LONG = {"sample", "reproduce", "run_study"}


class Example(NamedTuple):
    """The example of a docstring: its module, the name of the object, and the text."""

    module: str
    name: str
    code: str


def examples() -> Iterator[Example]:
    """Yield the examples of all public docstrings of the source."""
    for path in sorted((ROOT / "src/zakai").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__")
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "Example:" in text else ():
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                _, found, code = (ast.get_docstring(node) or "").partition("\nExample:\n")
                if found:
                    lines = code.strip("\n").split("\n")
                    end = next((i for i, line in enumerate(lines) if line and not line.startswith("    ")), len(lines))
                    yield Example(module, node.name, textwrap.dedent("\n".join(lines[:end])))


def namespace(module: str) -> dict[str, Any]:
    """Return the names that an example of a module may use."""
    model = zakai.Model(**KEYS)
    truth, record = zakai.simulate(model, np.arange(1, 11) / 4, seed=0)
    other = zakai.Model(**{**KEYS, "drift": ["-a*x**3"]})
    own = {"model": model, "a": model, "b": other, "truth": truth, "record": record, "result": zakai.filter(model, record)}
    return {**vars(importlib.import_module(module)), "zakai": zakai, "np": np, "scipy": scipy, "Path": Path, **own}


def run(example: Example) -> None:
    """Run an example; of one with prompts compare the output too. A long one is compiled only.

    Raises:
        Exception: what the example raises.
        doctest.DocTestFailure: the output is another.
    """
    if example.name in LONG:
        compile(example.code, f"example of {example.name}", "exec")
        return
    names = namespace(example.module)
    if ">>>" in example.code:
        test = doctest.DocTestParser().get_doctest(example.code, names, example.name, example.module, 0)
        doctest.DebugRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).run(test)
    else:
        exec(compile(example.code, f"example of {example.name}", "exec"), names)
