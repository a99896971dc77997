"""A folder of zakai imports only folders before it, no file imports itself in a circle, and only `peers` imports JAX."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import zakai

# A file imports files of its own folder, and of those before it in this list; imports inside functions count.
FOLDERS = [
    *("numerics", "numerics/sums", "numerics/gaussian", "numerics/line", "numerics/series", "numerics/space"),
    *("numerics/particles", "numerics/trains", "densities", "models", "algebra", "records", "simulation"),
    *("methods", "methods/system", "methods/gaussian", "methods/gaussian/extended", "methods/sums", "methods/yau"),
    *("methods/line", "methods/reflecting", "methods/space", "methods/grid", "methods/particles", "methods/frame"),
    *("methods/series", "notes", "engine", "diagnostics", "inference", "peers", "studies", "report", "studio", "cli"),
]
EVERYWHERE = {"errors", "_display", "_progress", "_registry"}
SOURCE = Path(zakai.__file__).parent
ROOT = Path(__file__).parents[1]
# What a public object offers and a later module makes from it: imported when it is asked for, by a method of this name.
ENTRIES = {
    ("densities/_density.py", "plot"): "zakai.report.axes",
    ("densities/_density.py", "save"): "zakai.records.density_files",
    ("algebra/analysis.py", "plot"): "zakai.report.axes",
    ("engine/results.py", "plot"): "zakai.report.axes",
    ("engine/results.py", "report"): "zakai.report",
    ("engine/results.py", "_repr_html_"): "zakai.report",
    ("engine/results.py", "residuals"): "zakai.diagnostics.residuals",
    ("engine/results.py", "predict_observations"): "zakai.diagnostics.observed_ahead",
    ("inference/fit.py", "plot"): "zakai.report.axes",
}
# The registry at the root imports every package by name; no import of a package stands in it.
FILES = sorted(path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if path.parent != SOURCE)
JAX = {"jax", "jaxlib", "cuthbert", "cuthbertlib", "dynamax", "tensorflow_probability"}
# Inside functions, for what a caller who uses JAX passes: a key, or the parameters under `jax.grad`.
WHERE_JAX_IS_LOADED = {"densities/_values.py", "engine/likelihood.py", "engine/likelihood_in_jax.py", "inference/bayes.py"}
KNOWS_NO_MODEL = {"models", "algebra", "densities", "records", "methods", "notes", "engine"}  # what numerics/ may not import


class Import(NamedTuple):
    """A dotted name; whether it is imported with the file; and the function that imports it, "" outside of functions."""

    name: str
    at_top: bool
    function: str = ""


@cache
def imports(file: str) -> list[Import]:
    """Return each import of a file but those for the type checker."""
    return list(_imports(ast.parse((SOURCE / file).read_text()), file))


def _imports(node: ast.AST, file: str, relative: bool = False, function: str = "") -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            yield from (Import(alias.name, not function, function) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert relative or child.level == 0, f"{file}: a relative import"
            for alias in child.names:
                whole = f"{child.module}.{alias.name}"
                yield Import(whole if child.module == "zakai" or is_module(whole) else str(child.module), not function, function)
        inner = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        yield from _imports(child, file, relative, child.name if inner and not function else function)


@cache
def is_module(name: str) -> bool:
    """Return whether a dotted name is a file or a folder of zakai."""
    root, *rest = name.split(".")
    path = SOURCE.joinpath(*rest)
    return root == "zakai" and (path.is_dir() or path.with_suffix(".py").is_file())


def folder_of(name: str) -> str:
    """Return the folder of a module, as in `FOLDERS`; the name of a file at the root."""
    path = SOURCE.joinpath(*name.split(".")[1:])
    folder = path.parent if path.with_suffix(".py").is_file() and path.parent != SOURCE else path
    return folder.relative_to(SOURCE).as_posix()


def faults(file: str, found: Iterable[Import]) -> list[str]:
    """Return the imports of a file that the order of the folders does not allow."""
    folder = Path(file).parent.as_posix()
    allowed = {*FOLDERS[: FOLDERS.index(folder) + 1], *EVERYWHERE}
    if folder in ("cli", "studio"):
        allowed |= {"__version__", ".", "citations"}
    return [
        f"{file} imports {name}"
        for name, at_top, function in found
        if name.partition(".")[0] == "zakai"
        and folder_of(name) not in allowed
        and (at_top or ENTRIES.get((file, function)) != name)
    ]


def modules_imported(file: str) -> set[str]:
    """Return the modules of zakai that a file imports, but for its entries."""
    names = {name for name, _, function in imports(file) if ENTRIES.get((file, function)) != name}
    return {name for name in names if is_module(name)}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """The modules that remain when those that import no other are removed: some import one another in a circle, or none."""
    left = {name: set(targets) for name, targets in graph.items()}
    while leaves := [name for name, targets in left.items() if not targets & left.keys() - {name}]:
        for name in leaves:
            del left[name]
    return sorted(left)


def test_no_modules_import_one_another_in_a_circle():
    names = {file: f"zakai.{file.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__") for file in FILES}
    graph = {name: modules_imported(file) for file, name in names.items()}
    assert circle(graph) == []
    assert circle({**graph, "zakai.models.tables": {"zakai.models.files"}}) != []  # the test can fail


def test_a_folder_imports_only_folders_before_it():
    assert {Path(file).parent.as_posix() for file in FILES} == set(FOLDERS)
    assert [fault for file in FILES for fault in faults(file, imports(file))] == []


def test_every_module_that_is_imported_exists():
    given = {f"zakai.{name}" for name in (*zakai.__all__, "__version__")}
    others = [path for folder in ("tests", "benchmarks", "fuzz", "examples") for path in (ROOT / folder).rglob("*.py")]
    found = [(file, name) for file in FILES for name, *_ in imports(file)]
    found += [(str(path), name) for path in others for name, *_ in _imports(ast.parse(path.read_text()), str(path), True)]
    names = {(file, name) for file, name in found if name.partition(".")[0] == "zakai"}
    assert [(file, name) for file, name in sorted(names) if not is_module(name) and name not in given] == []


def test_every_entry_is_there():
    found = {(file, function): name for file in FILES for name, top, function in imports(file) if (file, function) in ENTRIES}
    assert found == ENTRIES


def test_only_peers_import_jax_or_a_library_of_filters():
    found = [
        f"{file} imports {name}"
        for file in FILES
        for name, top, _ in imports(file)
        if not file.startswith("peers/")
        and (name.partition(".")[0] in JAX or name.startswith("zakai.peers"))
        and (top or file not in WHERE_JAX_IS_LOADED)
    ]
    assert found == []


def test_whoever_imports_jax_sets_double_precision():
    names = {file: {name for name, top, _ in imports(file) if top} for file in FILES if file.startswith("peers/")}
    importing = {file for file, own in names.items() if any(name.partition(".")[0] in JAX for name in own)}
    setting = {file for file, own in names.items() if any(name.startswith("zakai.peers") for name in own)}
    assert importing and importing <= setting | {"peers/_float64.py"}


def test_numerics_imports_neither_sympy_nor_a_model():
    names = [(file, name) for file in FILES if file.startswith("numerics/") for name, *_ in imports(file)]
    forbidden = [f"zakai.{package}" for package in KNOWS_NO_MODEL]
    assert names
    assert [found for found in names if found[1].startswith("sympy") or ".".join(found[1].split(".")[:2]) in forbidden] == []


def test_the_order_of_folders_can_fail():
    assert faults("engine/driver.py", [Import("zakai.report", True)]) == ["engine/driver.py imports zakai.report"]
    assert faults("methods/line/filter.py", [Import("zakai.methods.space.filter", False, "step")]) != []
    assert faults("engine/results.py", [Import("zakai.diagnostics.residuals", True)]) != []
    assert faults("engine/results.py", [Import("zakai.diagnostics.residuals", False, "save")]) != []
    assert faults("engine/results.py", [Import("zakai.diagnostics.residuals", False, "residuals")]) == []
