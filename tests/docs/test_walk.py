"""The walk through one observation in CONTRIBUTING.md is the order in which functions are called."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

import zakai

SOURCE = Path(zakai.__file__).parent
PAGE = Path(__file__).parents[2] / "CONTRIBUTING.md"


def rows() -> list[tuple[str, str]]:
    """Return the files and the functions of the table."""
    section = PAGE.read_text().split("## One observation, from start to end")[1].split("\n## ")[0]
    lines = [line.split("|")[1:3] for line in section.splitlines() if line.startswith("| `")]
    return [(file.strip(" `"), function.strip(" `").split(".")[-1]) for file, function in lines]


def called(work: Callable[[], Any], wanted: set[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return which functions of zakai are called, in the order of their first calls; a kernel when it is passed its types."""
    found: dict[tuple[str, str], None] = {}

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        file = frame.f_code.co_filename
        if event == "call" and file.startswith(str(SOURCE)):
            name = Path(file).relative_to(SOURCE).as_posix(), frame.f_code.co_name
            if name in wanted:
                found.setdefault(name)

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(before)
    return list(found)


def test_the_calls_of_one_observation_come_in_the_order_of_the_page():
    model = zakai.Model(
        state=["x"],
        drift=["4*x - 4*x**3"],
        diffusion=[["1"]],
        observation=["x"],
        observation_kind="samples",
        observation_noise=[["1/25"]],
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )
    _, record = zakai.simulate(model, [0.3, 1.1, 1.35, 2.9], seed=1)
    listed = rows()
    kernel = ("numerics/line/modes_loop.py", "advance")  # compiled: no call of Python's
    assert kernel in listed and "def advance(" in (SOURCE / kernel[0]).read_text()
    expected = [row for row in listed if row != kernel]
    assert len(expected) > 15
    assert called(lambda: np.asarray(zakai.filter(model, record).density(-1).mean()), set(expected)) == expected
