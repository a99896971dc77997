"""What the worker keeps: models, records and results.

A request names everything that it needs (the model's text, the record, the method), so that a new worker answers it as the old
one would have; what was read or computed last is kept, by these texts.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.models.files import read_model
from zakai.models.model import Model
from zakai.records import Truth
from zakai.studio import data

Report = Callable[[int, int | None], None]  # receives what is done of how much
Answer = tuple[dict[str, Any], dict[str, np.ndarray]]
KEPT_MODELS, KEPT_RECORDS, KEPT_RESULTS = 8, 3, 8
MODEL = "model"  # what errors call the text of the page


class Held(NamedTuple):
    """A result and the true states, where they are known."""

    result: Any
    truth: Truth | None
    given: data.Given


class Session:
    """The models, records and results of a page."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.models: OrderedDict[str, Model] = OrderedDict()
        self.records: OrderedDict[tuple[str, str], data.Given] = OrderedDict()
        self.results: OrderedDict[str, Held] = OrderedDict()
        self.online: Any = None

    def model(self, request: Mapping[str, Any]) -> Model:
        """Return the model of a request's text, with its own values of parameters where it gives some."""
        text = request.get("text")
        if not isinstance(text, str) or not text.strip():
            raise InputError(f"{MODEL}: is empty; write state, drift and observation, or take one of the gallery")
        model = _kept(self.models, text, KEPT_MODELS, lambda: read_model(text, MODEL, self.tables()))
        values = request.get("values")
        return model.with_parameters(**{str(k): v for k, v in values.items()}) if values else model

    def tables(self) -> Path | None:
        """Return the folder of the model file that was named on the command line, where its tables are."""
        note = self.folder / "tables-are-in"
        return Path(note.read_text(encoding="utf-8")) if note.is_file() else None

    def given(self, model: Model, request: Mapping[str, Any]) -> data.Given:
        """Return the record of a request."""
        wanted = request.get("data")
        if not isinstance(wanted, Mapping):
            raise InputError("no record: drop a CSV file, or simulate one")
        text = request["text"] if wanted.get("kind") == "file" else wanted.get("from") or request["text"]
        key = (str(text), json.dumps(wanted, sort_keys=True))
        if wanted.get("kind") == "file":
            return _kept(self.records, key, KEPT_RECORDS, lambda: data.given(model, wanted, self.folder))
        # A simulated record stays that of its text while parameters are changed.
        source = self.model({"text": text})
        found = _kept(self.records, key, KEPT_RECORDS, lambda: data.given(source, wanted, self.folder))
        return found if text == request["text"] else data.simulated_by(source, found, model)

    def held(self, request: Mapping[str, Any], key: str = "name") -> Held:
        """Return the result that a request names."""
        name = str(request.get(key) or "main")
        if name not in self.results:
            raise InputError("this result is no longer here; press Run again")
        self.results.move_to_end(name)
        return self.results[name]

    def keep(self, name: str, held: Held) -> None:
        """Keep a result under a name, of many the last."""
        self.results[name] = held
        self.results.move_to_end(name)
        while len(self.results) > KEPT_RESULTS:
            self.results.popitem(last=False)

    def forget(self) -> None:
        """Forget everything, after the memory was full."""
        for kept in (self.models, self.records, self.results):
            kept.clear()
        self.online = None


def state_of(result: Any, request: Mapping[str, Any], key: str = "state") -> int:
    """Return the number of the state that a request names."""
    name = request.get(key)
    names = list(result.state)
    if name in names:
        return names.index(name)
    if name in (None, ""):
        return 0
    raise InputError(f"there is no state {str(name)[:40]!r}; press Run again")


def _kept(kept: OrderedDict[Any, Any], key: Any, most: int, make: Callable[[], Any]) -> Any:
    if key not in kept:
        kept[key] = make()
        while len(kept) > most:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]
