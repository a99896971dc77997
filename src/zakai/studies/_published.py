"""What every reproduction gives: published figures beside ours with a verdict, pictures as soon as they can be drawn, JSON."""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from zakai.records.writing import atomic_write

WIDTH = 118
CHANCE = 3.0  # standard errors up to which two figures are said to agree
Cell = float | str | None  # None: there is no such figure


@dataclass(frozen=True)
class Comparison:
    """One figure: what it is, what is published, ours with one standard error, and whether they agree, in words."""

    what: str
    published: Cell
    ours: Cell
    standard_error: float | None = None
    verdict: str = ""

    @property
    def compared(self) -> bool:
        """Whether there was enough to compare."""
        return self.verdict.startswith(("agrees", "differs"))


def by_chance(
    what: str, published: float, ours: float | None, error: float | None, because: str, published_error: float = 0.0
) -> Comparison:
    """A figure that has chance in it: it agrees within `CHANCE` standard errors of the difference, or differs `because`."""
    if ours is None or error is None:
        return Comparison(what, published, ours, error, "too few runs to say")
    spread = (error**2 + published_error**2) ** 0.5
    if spread == 0.0:
        return by_computation(what, published, ours, ours == published, because or "neither has any chance in it")
    apart = abs(ours - published) / spread
    said = "agrees" if apart <= CHANCE else "differs"
    reason = f": {because}" if because and said == "differs" else ""
    return Comparison(what, published, ours, error, f"{said}, {apart:.1f} standard errors apart{reason}")


def by_computation(what: str, published: Cell, ours: Cell, holds: bool, because: str = "") -> Comparison:
    """A figure without chance: it agrees where `holds`, or differs `because`."""
    return Comparison(what, published, ours, None, "agrees" if holds else f"differs: {because}")


@dataclass(frozen=True)
class Table:
    """Further figures: a heading, the names of the columns, and a row of cells a line."""

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def lines(self) -> list[str]:
        """The heading and the table, the first column to the left."""
        cells = [self.columns, *([_plain(cell) for cell in row] for row in self.rows)]
        widths = [max(len(row[i]) for row in cells) for i in range(len(self.columns))]
        rows = ["  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))]) for row in cells]
        return [*textwrap.wrap(self.heading, WIDTH), "", *(row.rstrip() for row in rows)]


@dataclass(frozen=True, eq=False)
class Reproduction:
    """A published experiment, reproduced.

    `scope` says what is published and what is checked; `figures` are all numbers, ready for JSON.
    """

    title: str
    scope: str
    comparisons: tuple[Comparison, ...]
    verdict: str
    tables: tuple[Table, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def figures(self) -> dict[str, Any]:
        """The comparisons, the tables, the settings and the verdict."""
        return {
            **self.settings,
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
            "tables": [asdict(table) for table in self.tables],
            "verdict": self.verdict,
        }

    def text(self) -> str:
        """What is printed."""
        lines = [self.title, "", *textwrap.wrap(self.scope, WIDTH), "", *comparison_lines(self.comparisons)]
        for table in self.tables:
            lines += ["", *table.lines()]
        return "\n".join([*lines, "", *textwrap.wrap(f"Verdict{self._count()}: {self.verdict}", WIDTH)])

    def _count(self) -> str:
        """How many of the figures that can be compared agree."""
        words = [comparison.verdict.startswith("agrees") for comparison in self.comparisons if comparison.compared]
        return f" ({sum(words)} of {len(words)} figures agree)" if words else ""

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write figures.json and table.txt."""
        write_figures(folder, self.text(), self.figures)


def write_figures(folder: str | os.PathLike[str], text: str, figures: Mapping[str, Any]) -> None:
    """figures.json and table.txt."""
    for name, content in (("figures.json", json.dumps(figures, indent=1, default=_number)), ("table.txt", text)):
        with atomic_write(Path(folder) / name) as temporary:
            temporary.write_text(content + "\n", encoding="utf-8")
        print(f"written: {Path(folder) / name}", flush=True)


def comparison_lines(comparisons: Sequence[Comparison]) -> list[str]:
    """The table of figures, published and ours, with the verdict on each."""
    rows = [("", "published", "ours", "")]
    rows += [(c.what, _plain(c.published), measured(c.ours, c.standard_error), c.verdict) for c in comparisons]
    widths = [max(len(row[i]) for row in rows) + 2 for i in range(3)]
    width = max(40, WIDTH - sum(widths))
    lines = []
    for what, published, ours, verdict in rows:
        front = what.ljust(widths[0]) + published.rjust(widths[1] - 2) + "  " + ours.rjust(widths[2] - 2) + "  "
        said = textwrap.wrap(verdict, width) or [""]
        lines += [(front + said[0]).rstrip(), *(" " * len(front) + line for line in said[1:])]
    return lines


def measured(value: Cell, error: float | None) -> str:
    """A number with one standard error, to two digits of it."""
    if isinstance(value, str) or value is None or error is None:
        return _plain(value)
    return f"{value:.3f} +- {error:.3f}" if error >= 1e-3 else f"{value:.4g} +- {error:.1g}"


def _plain(value: Cell) -> str:
    return "-" if value is None else value if isinstance(value, str) else f"{value:.4g}"


def _number(value: Any) -> Any:
    """What JSON makes of a NumPy number."""
    return value.item()


class Pictures:
    """Pictures that are drawn into a folder as soon as they can be, PNG and PDF; none where the folder is None."""

    def __init__(self, folder: str | os.PathLike[str] | None = None):
        self.folder = None if folder is None else Path(folder)

    def add(self, name: str, draw: Callable[[], Any]) -> None:
        """Write the Matplotlib figure that `draw` gives as `name`.png and `name`.pdf, and say so."""
        if self.folder is None:
            return
        figure = draw()
        for kind in ("png", "pdf"):
            path = self.folder / f"{name}.{kind}"
            with atomic_write(path) as temporary:
                figure.savefig(temporary, format=kind, dpi=160)
            print(f"written: {path}", flush=True)


class Progress:
    """Counts what is done."""

    def __init__(self, report: Callable[[int, int], None] | None, total: int):
        self.report, self.total, self.done = report, total, 0

    def add(self, count: int = 1) -> None:
        """So much more is done."""
        self.done += count
        if self.report is not None:
            self.report(self.done, self.total)
