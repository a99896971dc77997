"""A function has at most eight arguments, more of them are fields of a tuple or a class with a name; a file at most 500 lines."""

from __future__ import annotations

import ast
from pathlib import Path

import zakai

SOURCE = Path(zakai.__file__).parent
MOST, LONGEST = 8, 500
# The signatures of public functions and of commands are what users call, with keywords.
PUBLIC = {"zakai.inference.bayes.sample", "zakai.models.model.__init__"}
WITHOUT = ("cli", "peers", "studies")


def arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the number of arguments, without that of the object."""
    found = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    return sum(argument.arg not in ("self", "cls") for argument in found)


def long_functions(text: str, module: str) -> list[str]:
    """Return the names of the functions with more than eight arguments."""
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    return [f"{module}.{one.name}" for one in functions if arguments(one) > MOST]


def found_by_folder() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for path in sorted(SOURCE.rglob("*.py")):
        file = path.relative_to(SOURCE)
        module = ".".join(("zakai", *file.with_suffix("").parts))
        names = [name for name in long_functions(path.read_text(), module) if name not in PUBLIC]
        if names and file.parts[0] not in WITHOUT:
            found.setdefault(file.parent.as_posix(), []).extend(names)
    return found


def test_functions_have_at_most_eight_arguments():
    assert found_by_folder() == {}


def test_a_function_with_nine_arguments_is_found():
    nine = "def f(a, b, c, d, /, e, f, *, g, h, i): ...\nclass C:\n    def g(self, a, b, c, d, e, f, g, h): ..."
    assert long_functions(nine, "m") == ["m.f"]


def test_files_have_at_most_500_lines():
    lengths = {path.relative_to(SOURCE).as_posix(): len(path.read_text().splitlines()) for path in SOURCE.rglob("*.py")}
    assert len(lengths) > 400 and {name: length for name, length in lengths.items() if length > LONGEST} == {}
