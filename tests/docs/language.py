"""Words that the project does not use, and the standard terms that it uses instead.

    python tests/docs/language.py [FOLDER ...]

prints how often each word occurs in each folder, and with `--show` every line.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Pattern, a regular expression that leaves out the standard meaning of its word, and the term to write.
WORDS = {
    r"lattices?": "grid",
    r"readings|(?:a|an|each|every|one|next|last|previous|first|this|that|per) reading": "observation",
    r"(?:a|the|two|next|last|each|every|between) looks?|look(?:s|ed|ing)? at": "check, grid check",
    r"stand(?:s|ing)? still|stood still|still windows?": "fixed grid",
    r"laid|la(?:y|ys|ying) (?:it |them )?anew|anew": "regrid, again",
    r"told(?! apart)": "reported, receives",
    r"(?:is|are|was|be|not|as) well as it|(?:is|are|was|not) (?:well|ill)": "within bounds, failed",
    r"undone|ma(?:de|kes?) up for": "corrected",
    r"left over|what is left": "residual",
    r"(?<!heated[- ])rooms?": "margin; of the code: package",
    r"lanes?": "batch entries",
    r"lasting": "loop-invariant",
    r"bends?|bent": "curvature",
    r"narrowest feature": "smallest standard deviation along an axis",
    r"(?:is|are|what is) no numbers?|numbers? that do(?:es)? not exist": "NaN, non-finite value",
    r"strangers?": "untrusted files",
    r"live(?! (?:in|on|at|beside|there|here|outside|alone))": "online",
    r"done again": "reproductions",
    r"(?-i:(?<![\[`./_'\"])[Pp]eers?(?![\]`./_'\"-]))": "other libraries",
    r"of ours": "(delete it)",
    r"bare": "without, plain",
    r"begun anew|begin anew": "restart",
    r"as far as|that which": "(a short sentence)",
    r"`(?:missed|surprise|exponent|resolution|negative|lost)`": "the present names of the health figures",
}
_PATTERNS = {word: re.compile(rf"(?<![\w`]){word}(?!\w)" if word[0] != "`" else word, re.IGNORECASE) for word in WORDS}
# One pass over a file finds whether any word of it matters.
_PLAIN = "|".join(word for word in WORDS if word[0] != "`")
_ANY = re.compile("|".join([rf"(?<![\w`])(?:{_PLAIN})(?!\w)", *(word for word in WORDS if word[0] == "`")]), re.IGNORECASE)
_KINDS = {".py", ".md", ".toml", ".css", ".js", ""}
FOLDERS = ("README.md", "CONTRIBUTING.md", "docs", "src", "tests", "benchmarks", "examples", "fuzz")
_NOT_TEXT = ("katex", "corpus", "_build", "_generated", "generated", "__pycache__")


def files(path: Path) -> Iterator[Path]:
    """Yield the text files of a folder that the project has written, or the file itself."""
    if path.is_file():
        yield path
        return
    for file in sorted(path.rglob("*")):
        parts = file.relative_to(path).parts
        if file.is_file() and file.suffix in _KINDS and not any(
            part.startswith(".") or part in _NOT_TEXT for part in parts
        ):
            yield file


def hits(path: Path) -> Iterator[tuple[str, int, str, str]]:
    """Yield file, line, what was found, and the term to write instead."""
    for file in files(path):
        if file.resolve() in (Path(__file__).resolve(), Path(__file__).resolve().parent / "test_documents.py"):
            continue
        text = file.read_text(encoding="utf-8", errors="replace")
        if _ANY.search(text):
            for number, line in enumerate(text.splitlines(), 1):
                for word, pattern in _PATTERNS.items():
                    for match in pattern.finditer(line):
                        yield str(file), number, match.group(), WORDS[word]


def main(arguments: list[str]) -> None:
    """Print the counts of each folder."""
    names = [name for name in arguments if not name.startswith("-")]
    for name in names or FOLDERS:
        found = list(hits(ROOT / name))
        counts = Counter(what.lower() for _, _, what, _ in found).most_common()
        print(f"{name}: {len(found)}" + "".join(f", {what} {count}" for what, count in counts))
        if "--show" in arguments:
            for file, number, what, instead in found:
                print(f"  {Path(file).relative_to(ROOT)}:{number}: {what}; write: {instead}")


if __name__ == "__main__":
    main(sys.argv[1:])
