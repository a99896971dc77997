"""The states of a segment as arrays, from which a state is made when it is taken."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

S = TypeVar("S")


class StackedStates(Sequence[S], Generic[S]):
    """States that differ in some fields: state i is `base` with `fields[name][i]`; `fields` are arrays or lists."""

    def __init__(self, base: Any, fields: Mapping[str, Any]):
        self.base, self.fields = base, dict(fields)

    def __len__(self) -> int:
        return len(next(iter(self.fields.values())))

    @overload
    def __getitem__(self, index: int) -> S: ...
    @overload
    def __getitem__(self, index: slice) -> StackedStates[S]: ...
    def __getitem__(self, index: int | slice) -> S | StackedStates[S]:
        chosen = {name: values[index] for name, values in self.fields.items()}
        if isinstance(index, slice):
            return StackedStates(self.base, chosen)
        return self.base._replace(**chosen)  # type: ignore[no-any-return]

    @property
    def nbytes(self) -> int:
        """The bytes of the arrays."""
        return sum(getattr(values, "nbytes", 8 * len(values)) for values in self.fields.values())


class Joined(Sequence[S], Generic[S]):
    """Sequences of states, one after the other."""

    def __init__(self, parts: Iterable[Sequence[S]] = ()):
        self.parts: list[Sequence[S]] = []
        self.ends: list[int] = []
        for part in parts:
            self.append(part)

    def append(self, part: Sequence[S]) -> None:
        """Append a sequence."""
        self.parts.append(part)
        self.ends.append(len(self) + len(part))

    def __len__(self) -> int:
        return self.ends[-1] if self.ends else 0

    @overload
    def __getitem__(self, index: int) -> S: ...
    @overload
    def __getitem__(self, index: slice) -> list[S]: ...
    def __getitem__(self, index: int | slice) -> S | list[S]:
        places = range(len(self))[index]
        if isinstance(places, range):
            return [self[place] for place in places]
        part = bisect_right(self.ends, places)
        return self.parts[part][places - self.ends[part]]


def field_of(states: Sequence[Any], name: str) -> np.ndarray:
    """Return one field of all states as an array, without making those that are stacked."""
    if isinstance(states, Joined):
        return np.concatenate([field_of(part, name) for part in states.parts])
    if isinstance(states, StackedStates) and name in states.fields:
        return np.asarray(states.fields[name])
    return np.array([getattr(state, name) for state in states])
