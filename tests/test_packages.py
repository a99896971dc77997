"""A package of zakai imports only packages to its left, and only `peers` imports JAX."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import zakai

PACKAGES = [
    "densities",
    "models",
    "algebra",
    "numerics",
    "records",
    "simulation",
    "methods",
    "notes",
    "engine",
    "diagnostics",
    "inference",
    "peers",
    "studies",
    "report",
    "cli",
]
EVERYWHERE = {"errors", "_display", "_progress", "_registry"}
SOURCE = Path(zakai.__file__).parent
# What a user plots or reports is drawn by a later package.
LAZILY = {
    ("engine/results.py", "report"),
    ("engine/results.py", "diagnostics"),
    ("densities/_density.py", "report"),
    ("densities/_density.py", "records"),
    ("inference/fit.py", "report"),
    ("algebra/analysis.py", "report"),
}
# The registry at the root imports every package by name; no import of a package stands in it.
FILES = sorted(path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if path.parent != SOURCE)
JAX = {"jax", "jaxlib", "cuthbert", "cuthbertlib", "dynamax", "tensorflow_probability"}
# Inside functions, for what a caller who uses JAX passes: a key, or the parameters under `jax.grad`.
WHERE_JAX_IS_LOADED = {"densities/_density.py", "engine/likelihood.py", "engine/likelihood_in_jax.py", "inference/bayes.py"}
KNOWS_NO_MODEL = {"models", "algebra", "densities", "records", "methods", "notes", "engine"}  # what numerics/ may not import


@cache
def imports(file: str) -> list[tuple[str, bool]]:
    """(dotted name, whether it is imported with the file) for each import of a file."""
    return list(_imports(file))


def _imports(file: str) -> Iterator[tuple[str, bool]]:
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


def faults(file: str, found: Iterable[tuple[str, bool]]) -> list[str]:
    """The imports of a file that the order of the packages does not allow."""
    package = file.partition("/")[0]
    allowed = set(PACKAGES[: PACKAGES.index(package) + 1]) | EVERYWHERE
    if package == "cli":
        allowed.add("__version__")
    said = []
    for name, at_the_top in found:
        root, _, rest = name.partition(".")
        target = rest.partition(".")[0]
        if root != "zakai" or target in allowed or (not target and package == "cli"):
            continue
        if (file, target) in LAZILY and not at_the_top:
            continue
        said.append(f"{file} imports {name}")
    return said


# What a method of an object needs when it is called: it is written in a later module, which imports the object's.
CALLED = {
    "densities/_density.py": {"zakai.report.axes", "zakai.records.density_files", "zakai.densities.region"},
    "engine/results.py": {
        "zakai.report",
        "zakai.report.axes",
        "zakai.engine.forecast",
        "zakai.diagnostics.observed_ahead",
        "zakai.diagnostics.residuals",
        "zakai.engine.stored",
    },
}


def modules_imported(file: str, known: dict[str, str]) -> set[str]:
    """The modules of zakai that a file imports, at the top or inside of functions, but for those in `CALLED`."""
    tree, found = ast.parse((SOURCE / file).read_text()), set()
    typed = [node for node in ast.walk(tree) if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    skipped = {below for node in typed for statement in node.body for below in ast.walk(statement)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node not in skipped:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name if name in known else str(node.module) for name in names}
    return {name for name in found if name in known} - CALLED.get(file, set())


def circle(graph: dict[str, set[str]]) -> list[str]:
    """The modules that remain when those that import no other are removed: some import one another in a circle, or none."""
    left = {name: set(targets) for name, targets in graph.items()}
    while leaves := [name for name, targets in left.items() if not targets & left.keys() - {name}]:
        for name in leaves:
            del left[name]
    return sorted(left)


def test_no_modules_import_one_another_in_a_circle():
    known = {f"zakai.{file.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__"): file for file in FILES}
    graph = {name: modules_imported(file, known) for name, file in known.items()}
    assert circle(graph) == []
    assert circle({**graph, "zakai.models.tables": {"zakai.models.files"}}) != []  # the test can fail


def test_a_package_imports_only_packages_to_its_left():
    assert {file.partition("/")[0] for file in FILES} <= set(PACKAGES)
    assert [fault for file in FILES for fault in faults(file, imports(file))] == []


def test_only_peers_import_jax_or_a_library_of_filters():
    found = [
        f"{file} imports {name}"
        for file in FILES
        for name, top in imports(file)
        if not file.startswith("peers/")
        and (name.partition(".")[0] in JAX or name.startswith("zakai.peers"))
        and (top or file not in WHERE_JAX_IS_LOADED)
    ]
    assert found == []


def test_whoever_imports_jax_sets_double_precision():
    names = {file: {name for name, top in imports(file) if top} for file in FILES if file.startswith("peers/")}
    importing = {file for file, own in names.items() if any(name.partition(".")[0] in JAX for name in own)}
    setting = {file for file, own in names.items() if any(name.startswith("zakai.peers") for name in own)}
    assert importing and importing <= setting | {"peers/_float64.py"}


def test_numerics_imports_neither_sympy_nor_a_model():
    names = [(file, name) for file in FILES if file.startswith("numerics/") for name, _ in imports(file)]
    forbidden = [f"zakai.{package}" for package in KNOWS_NO_MODEL]
    assert names
    assert [found for found in names if found[1].startswith("sympy") or ".".join(found[1].split(".")[:2]) in forbidden] == []


def test_the_order_of_packages_can_fail():
    assert faults("engine/driver.py", [("zakai.report", True)]) == ["engine/driver.py imports zakai.report"]
    assert faults("engine/results.py", [("zakai.diagnostics", True)]) != []
    assert faults("engine/results.py", [("zakai.diagnostics", False)]) == []
