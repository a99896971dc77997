"""What the documents show is what happens."""

from __future__ import annotations

import re
import shlex
import sys
from types import ModuleType

import pytest
from executed_blocks import Session

import zakai
from docs import language
from docs.documents import ROOT, blocks, table
from zakai import _registry
from zakai.algebra import theorems
from zakai.cli import main
from zakai.models.files import read_model

PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*/*.md"))
DOCUMENTS = ["README.md", "docs/index.md", *PAGES]


@pytest.mark.parametrize("name", [name for name in DOCUMENTS if blocks(name)])
def test_the_blocks_of_a_document_run_and_print_what_is_shown(name, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    session = Session(tmp_path, name)
    for block in blocks(name):
        if block.language == "python" or name != "README.md":
            output = session.run(block.language, block.code, block.file)
            assert block.output is None or output.text == block.output


def test_every_code_block_of_the_documentation_is_one_that_is_run():
    shown = {block.language for name in PAGES for block in blocks(name)}
    assert shown <= {"python", "sh", "toml", "text"}


def test_every_public_name_is_in_the_reference():
    page = (ROOT / "docs/reference/python.md").read_text()
    listed = set(re.findall(r"^   (\w+)$", page, re.MULTILINE))
    assert set(zakai.__all__) - {"__version__", "gallery"} <= listed


def test_every_test_that_a_page_of_figures_names_exists():
    page = (ROOT / "docs/reference/figures.md").read_text()
    names = re.findall(r"`((?:tests|benchmarks)/[\w/]+\.py)`|python (benchmarks/\w+\.py)", page)
    assert names and [name for pair in names for name in pair if name and not (ROOT / name).exists()] == []


@pytest.mark.parametrize("name", language.FOLDERS)
def test_the_project_uses_the_standard_terms(name):
    assert list(language.hits(ROOT / name)) == []


def test_a_word_that_is_not_used_is_found(tmp_path):
    (tmp_path / "page.md").write_text("A lattice is laid anew; bathrooms and displaying are words.")
    assert [what for _, _, what, _ in language.hits(tmp_path)] == ["lattice", "laid", "anew"]


def test_the_first_shell_session_runs_and_prints_what_is_shown(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    sessions = [block for block in blocks("README.md", "sh") if "zakai " in block.code]
    assert sessions
    for block in sessions:
        for line in block.code.replace("\\\n", " ").splitlines():
            assert main(shlex.split(line, comments=True)[1:]) == 0
        assert block.output is None or capsys.readouterr().out == block.output


def test_every_command_and_exit_code_is_in_the_page_of_the_command(capsys):
    main(["--help"])
    commands = re.findall(r"^│ ([a-z]+) ", capsys.readouterr().out, re.MULTILINE)
    page = (ROOT / "docs/reference/command.md").read_text()
    assert len(commands) >= 6
    assert [command for command in commands if f"| `zakai {command} " not in page] == []
    for error in (zakai.InputError, zakai.ConditionError):
        assert f"| {error.exit_code} |" in page


def test_the_methods_of_the_reference_are_those_that_exist():
    assert [row[0] for row in table("docs/reference/methods.md", "method")] == list(_registry.METHODS)


def test_every_model_of_the_gallery_has_its_picture_in_the_reference():
    page = (ROOT / "docs/reference/gallery.md").read_text()
    parts = dict(part.split("\n", 1) for part in page.split("\n## ")[1:])
    assert list(parts) == list(zakai.gallery.names())
    for name, part in parts.items():
        assert zakai.gallery.describe(name) in part
        assert f'picture("{name}", ' in part or f'structure("{name}")' in part


MODEL = blocks("docs/reference/model-file.md", "toml")[0].code


def test_the_model_file_that_is_shown_is_one():
    model = read_model(MODEL, "model.toml")
    assert read_model(model.to_toml(), "again").drift == model.drift


@pytest.mark.parametrize(("line", "error"), table("docs/reference/model-file.md", "the line"))
def test_a_wrong_line_of_a_model_file_gives_the_error_that_is_shown(line, error):
    key = line.partition("=")[0].strip()
    changed, count = re.subn(rf"^{key} *=.*$", lambda _: line, MODEL, count=1, flags=re.MULTILINE)
    with pytest.raises(zakai.InputError) as raised:
        read_model(changed if count else f"{line}\n{MODEL}", "model.toml")
    assert str(raised.value) == f"model.toml: {error}"


@pytest.mark.parametrize(("text", "error"), table("docs/reference/record-file.md", "the file"))
def test_a_wrong_record_gives_the_error_that_is_shown(text, error, tmp_path):
    path = tmp_path / "record.csv"
    path.write_text(text.replace("\\n", "\n") + "\n")
    with pytest.raises(zakai.InputError) as raised:
        zakai.read_record(path, zakai.load_model("gallery:benes"))
    assert str(raised.value) == f"{path}: {error}"


def test_every_key_of_a_model_file_is_in_its_page():
    from zakai.models.model import KEYS

    rows = [row[0].strip("[]") for row in table("docs/reference/model-file.md", "key")]
    assert sorted(rows) == sorted(KEYS)


def test_the_method_that_contributing_adds_works_as_it_stands_there(monkeypatch):
    theorem, entry, method, registry, test = (block.code for block in blocks("CONTRIBUTING.md", "python"))
    name = "finite-volume"

    names = dict(vars(theorems))
    exec(compile(theorem, "CONTRIBUTING.md", "exec"), names)
    monkeypatch.setattr(theorems, "finite_volume", names["finite_volume"], raising=False)
    monkeypatch.setattr(theorems, "THEOREMS", {**theorems.THEOREMS, **eval(f"{{{entry}}}", names)})

    entries = eval(f"{{{registry}}}", vars(_registry))
    module = ModuleType(entries[name].module)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(method, "CONTRIBUTING.md", "exec"), vars(module))
    monkeypatch.setitem(_registry.METHODS, name, entries[name])
    assert _registry.load(name).theorem is theorems.THEOREMS[name]

    tests: dict = {}
    exec(compile(test, "CONTRIBUTING.md", "exec"), tests)
    for function in [value for key, value in tests.items() if key.startswith("test_")]:
        function()
    with pytest.raises(zakai.ConditionError, match="it fails that no coefficient depends on t"):
        model = zakai.load_model("gallery:spiral-sensor")
        zakai.filter(model, zakai.Record([0.1], [[0.2, 0.1]], "increments"), name)


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", *DOCUMENTS])
def test_every_link_inside_the_repository_leads_somewhere(name):
    text = re.sub(r"^```.*?^```$", "", (ROOT / name).read_text(), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert ((ROOT / name).parent / target).exists(), target


def test_every_misprint_of_the_errata_has_its_test():
    printed: set[str] = set()
    for path in (ROOT / "tests/errata").glob("test_*printed*.py"):
        printed |= set(re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE))
    rows = [row[3] for row in table("docs/explanation/errata.md", "where")]
    assert [row for row in rows if row.startswith("test_") and row not in printed] == []
    formulas = set(re.findall(r"^def (test_\w+)", (ROOT / "tests/errata/test_printed_formulas.py").read_text(), re.MULTILINE))
    assert formulas <= set(rows)
