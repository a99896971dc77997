"""python -m fuzz TARGET [options of libFuzzer]: coverage-guided fuzzing with atheris; see README.md."""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path

FOLDER = Path(__file__).parent
SECONDS = 2  # of this process, for one input; libFuzzer's own limit counts what other programs take
DEFAULTS = ("-timeout=60", "-rss_limit_mb=1500", "-max_len=400", "-print_final_stats=1")


def main(arguments: list[str]) -> None:
    targets = sorted(path.name for path in (FOLDER / "corpus").iterdir())
    if not arguments or arguments[0] not in targets:
        sys.exit(f"usage: python -m fuzz TARGET [options of libFuzzer]; the targets are {', '.join(targets)}")
    try:
        import atheris
    except ImportError:
        sys.exit("the fuzzer needs atheris: pip install 'zakai[fuzz]'")
    name, options = arguments[0], arguments[1:]
    with atheris.instrument_imports(include=["zakai", "tomllib"]):
        one_input = import_module(f"fuzz.{name}").one_input

    def in_time(data: bytes) -> None:
        began = time.process_time()
        one_input(data)
        assert time.process_time() - began < SECONDS, "it took too long"

    found = FOLDER / "out" / name
    found.mkdir(parents=True, exist_ok=True)
    # Words spare the fuzzer from guessing them letter by letter.
    words = FOLDER / "words" / f"{name}.dict"
    dictionary = [f"-dict={words}"] if words.exists() else []
    # What it finds goes to the first folder, the second is only read.
    folders = [str(found), str(FOLDER / "corpus" / name)]
    atheris.Setup([sys.argv[0], *DEFAULTS, f"-artifact_prefix={found}-", *dictionary, *options, *folders], in_time)
    atheris.Fuzz()


main(sys.argv[1:])
