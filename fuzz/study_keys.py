"""Study files that are TOML: every byte chooses a key or what it holds.  No method is asked whether it holds."""

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from fuzz.oracle import value_or_one_line
from zakai.errors import InputError
from zakai.models._errors import named
from zakai.models.files import load_model, read_keys
from zakai.studies import _study_models, study_files

KEYS = (
    *("name", "models", "parameters", "methods", "seeds", "times", "records", "reference", "metrics", "densities", "lost_above"),
    *("batch", "first", "count", "until", "step", "substeps", "file", "truth", "model", "method", "options", "kalman-bucy"),
    *("yau-yau", "a", "tolerance", '"\\u001b[2J"', "x" * 100),
)
ATOMS = (
    *("0", "1", "-1", "2.5", "25", "1e-300", "1e999", "nan", "-inf", "true", "1979-05-27", "0xfffffffffffffffff", "9" * 500),
    *('"gallery:benes"', '"gallery:encoder"', '"gallery:none"', '"none.toml"', '"kalman-bucy"', '"yau-yau"', '"auto"', '"ekf"'),
    *('"nees"', '"distance"', '"1/3"', '""', '"\\u0000"', '"\\u001b[2J"', "[]", "{}"),
)
GOOD = (
    *('models = ["gallery:benes"]', 'models = ["gallery:kalman-bucy-1d", "gallery:encoder"]', "methods = {kalman-bucy = {}}"),
    *('methods = {a = {method = "auto"}, b = {method = "yau-yau", options = {tolerance = 1e-3}}}', "seeds = {count = 4}"),
    *("seeds = {first = 3, count = 1000}", "times = {until = 1, step = 0.1}", "times = {until = 2.5, step = 1, substeps = 4}"),
    *('reference = "a"', 'metrics = ["nees", "crps"]', "batch = 2", 'records = ["a.csv"]', "densities = 3", "lost_above = 1.5"),
    'models = [{model = "gallery:kalman-bucy-1d", parameters = {a = [1, "1/2"]}}]',
)
_study_models.load_model = lru_cache(load_model)  # type: ignore[attr-defined]  # the same few over and over


def text_of(data: bytes) -> str:
    """The study file that these bytes choose."""
    choices = iter(data)
    lines = []
    while (choice := next(choices, None)) is not None:
        if choice < 128:
            lines.append(GOOD[choice % len(GOOD)])
        else:
            lines.append(f"{KEYS[choice % len(KEYS)]} = {_value(choices, 0)}")
    return "\n".join(lines)


def _value(choices: Iterator[int], depth: int) -> str:
    choice = next(choices, 0)
    if choice < 128 or depth == 5:
        return ATOMS[choice % len(ATOMS)]
    count = choice // 4 % 4
    if choice % 2:
        return f"[{', '.join(_value(choices, depth + 1) for _ in range(count))}]"
    pairs = (f"{KEYS[next(choices, 0) % len(KEYS)]} = {_value(choices, depth + 1)}" for _ in range(count))
    return "{" + ", ".join(pairs) + "}"


def one_input(data: bytes) -> None:
    text = text_of(data)

    def read():
        with named("s.toml"):
            return study_files.study_of(read_keys(text, "study"), "s", Path("nowhere"))

    found = value_or_one_line(read)
    if isinstance(found, InputError):
        assert str(found).startswith("s.toml: ")
        return
    study, models = found
    assert len(study.points) == len(models) <= _study_models.MOST_POINTS and study.methods
    assert len(study.batches) <= study_files.MOST_BATCHES and len(study.key()) == 64
