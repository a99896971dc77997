"""A page of the documentation as a notebook."""

from __future__ import annotations

import nbformat
import pytest
from notebooks import notebook

from docs.documents import ROOT, blocks

PAGE = """# Title

See [another page](other.md#part).

```{code-block} toml
:caption: model.toml
state = ["x"]
```

```python
print("a")
```

```text
not run
```

The end.
"""


def test_a_page_becomes_a_valid_notebook_with_its_outputs():
    made = notebook(PAGE, [("", []), ("a\n", [b"picture"]), ("", [])])
    nbformat.validate(nbformat.from_dict(made))
    kinds = [cell["cell_type"] for cell in made["cells"]]
    assert kinds == ["markdown", "code", "code", "markdown"]
    text, file, code, end = made["cells"]
    assert text["source"] == "# Title\n\nSee another page."
    assert file["source"] == '%%writefile model.toml\nstate = ["x"]'
    assert code["source"] == 'print("a")' and code["outputs"][0]["text"] == "a\n"
    assert code["outputs"][1]["data"]["image/png"] == "cGljdHVyZQ=="
    assert "not run" in end["source"]


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs/tutorials").glob("*.md") if path.stem != "index"))
def test_a_notebook_has_all_the_code_of_its_tutorial(page):
    source = (ROOT / "docs/tutorials" / page).read_text()
    shown = blocks(f"docs/tutorials/{page}")
    made = notebook(source, [("", [])] * source.count("\n```\n"))
    run = [block for block in shown if block.language in ("python", "sh") or block.file]
    assert [cell["source"].split("%%bash\n")[-1] for cell in made["cells"] if cell["cell_type"] == "code"] == [
        (f"%%writefile {block.file}\n" if block.file else "") + block.code.rstrip("\n") for block in run
    ]
