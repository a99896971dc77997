"""What a method prepares is never changed: a frozen class, and no statement that sets an attribute of a `prepared`."""

from __future__ import annotations

import ast
from pathlib import Path

import zakai

SOURCE = Path(zakai.__file__).parent
FILES = sorted(path for folder in ("methods", "peers", "engine") for path in (SOURCE / folder).rglob("*.py"))
PUBLIC = "engine/prepared.py"  # what `zakai.prepare` returns


def mutable(text: str) -> list[str]:
    """Return the classes named Prepared that are not frozen, and the statements that set an attribute of a `prepared`."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ClassDef) and node.name == "Prepared":
            bases = {ast.unparse(base).partition("[")[0] for base in node.bases}
            decorators = " ".join(ast.unparse(one) for one in node.decorator_list)
            if not bases & {"Protocol", "NamedTuple"} and "frozen=True" not in decorators:
                found.append(f"class Prepared in line {node.lineno}")
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AugAssign) else []
        for target in targets:
            if isinstance(target, ast.Attribute) and ast.unparse(target.value).split(".")[-1] == "prepared":
                found.append(f"{ast.unparse(target)} in line {node.lineno}")
    return found


def test_what_is_prepared_is_frozen():
    found = {path.relative_to(SOURCE).as_posix(): mutable(path.read_text()) for path in FILES}
    assert {file: what for file, what in found.items() if what and file != PUBLIC} == {}
    assert sum("class Prepared" in path.read_text() for path in FILES) >= 10


def test_a_change_of_what_is_prepared_is_found():
    assert mutable("class Prepared:\n    pass") == ["class Prepared in line 1"]
    assert mutable("self.prepared.notes = ()") == ["self.prepared.notes in line 1"]
    assert mutable("prepared.notes += ('a',)") == ["prepared.notes in line 1"]
