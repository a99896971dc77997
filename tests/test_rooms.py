"""A room of the package imports only rooms to its left, so that the data has one way through it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import zakai

ROOMS = ["models", "algebra", "kolmogorov", "densities", "records", "filters", "peers", "studies", "report", "cli"]
EVERYWHERE = {"errors", "_float64", "_registry", "_compiled"}
SOURCE = Path(zakai.__file__).parent
# Simulating makes a record, which is a later room's; inside functions, so that nothing is loaded in a circle.
LAZILY = {("models/simulate.py", "records")}
# The registry at the root may be asked for a peer by its name; no import of a room stands in it.
FILES = sorted(path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if path.parent != SOURCE)
NUMERIC = {"models/compile.py", "models/simulate.py", "models/_trigonometry.py"}  # of the rooms that know no numerics


def imports(file: str) -> Iterator[tuple[str, bool]]:
    """(dotted name, whether it stands at the top and is run) for each import of a file."""
    tree = ast.parse((SOURCE / file).read_text())
    skipped: set[ast.AST] = set()
    inside: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            skipped |= {below for statement in node.body for below in ast.walk(statement)}
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inside |= set(ast.walk(node))
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, node not in inside) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            whole = node.module == "zakai"
            names = [f"zakai.{alias.name}" for alias in node.names] if whole else [str(node.module)]
            yield from ((name, node not in inside) for name in names)


def faults(file: str, found: Iterator[tuple[str, bool]]) -> list[str]:
    """What the order of the rooms does not allow among the imports of a file."""
    room = file.partition("/")[0]
    allowed = set(ROOMS[: ROOMS.index(room) + 1]) | EVERYWHERE
    if room == "cli":
        allowed.add("__version__")
    said = []
    for name, at_the_top in found:
        package, _, rest = name.partition(".")
        target = rest.partition(".")[0]
        if package != "zakai" or target in allowed or (not target and room == "cli"):
            continue
        if (file, target) in LAZILY and not at_the_top:
            continue
        said.append(f"{file} imports {name}")
    return said


@pytest.mark.parametrize("file", FILES)
def test_a_room_imports_only_rooms_to_its_left(file):
    assert file.partition("/")[0] in ROOMS
    assert faults(file, imports(file)) == []


@pytest.mark.parametrize("file", [file for file in FILES if file.startswith(("models/", "algebra/")) and file not in NUMERIC])
def test_models_and_algebra_do_not_import_jax(file):
    assert [name for name, _ in imports(file) if name.partition(".")[0] in ("jax", "jaxlib")] == []


@pytest.mark.parametrize("file", FILES)
def test_whoever_imports_jax_sets_double_precision_before_an_array_is_made(file):
    names = {name for name, at_the_top in imports(file) if at_the_top}
    assert "zakai._float64" in names or not any(name.partition(".")[0] == "jax" for name in names)


def test_the_order_of_rooms_can_fail():
    assert faults("filters/driver.py", iter([("zakai.report", True)])) == ["filters/driver.py imports zakai.report"]
    assert faults("models/simulate.py", iter([("zakai.records", True)])) != []
    assert faults("models/simulate.py", iter([("zakai.records", False)])) == []
