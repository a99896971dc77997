"""Which columns of a file or a table are the observations of a model: by their names, else by their position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from zakai.errors import InputError
from zakai.records.header import columns_fault, quoted
from zakai.records.writing import default_names

HINT = "or give the columns in the order of the observations, by columns=[...] where they are read (command: --columns a,b)"


class Columns(NamedTuple):
    """The places of the observations among named columns, and a sentence where they are taken by their position."""

    places: list[int]
    note: str = ""


def observed_columns(
    names: Sequence[str], observed: Sequence[str], inputs: Sequence[str] = (), columns: Sequence[str] | None = None
) -> Columns:
    """Return the places of observations among columns with these names, without that of the time.

    There are as many as observations, besides those of known inputs. They are matched by the names of the observations, or by y1,
    y2, ..., in any order, if these are their names, and else taken by their position.

    Args:
        names: the names of the columns.
        observed: the names of the observations.
        inputs: the names of the known inputs.
        columns: the names of the columns to take, in the order of the observations.

    Raises:
        InputError: a name in `columns` is not there once, or there are more or fewer columns than observations.
    """
    m, said = len(observed), _listed(observed)
    if columns is not None:
        return Columns(_chosen(names, observed, columns))
    rest = [i for i, name in enumerate(names) if name not in inputs]
    own = [names[i] for i in rest]
    fault = columns_fault(["time", *own], m, "observations")
    if fault is not None:
        more = [name for name in own if name not in observed]
        which = f"{_listed(more)} {'is' if len(more) == 1 else 'are'} none of" if more else "the columns must be"
        raise InputError(f"{fault}; {which} the observations {said}: leave out what is none, {HINT}")
    for wanted in (observed, default_names(m)):
        if sorted(own) == sorted(wanted):
            return Columns([rest[own.index(name)] for name in wanted])
    for place, name in enumerate(own):
        if name in observed and observed[place] != name and name not in default_names(m):
            raise InputError(
                f"the column {quoted(name)} is at the place of the observation {observed[place]}, and not all of the names "
                f"{said} are there; name all columns so, {HINT}"
            )
    note = ""
    if m > 1 and list(own) != list(observed):
        note = (
            f"the columns {_listed(own)} of the record are taken by their position as the observations {said}; give the model "
            f"observation_names = [{', '.join(map(_text, own[:8]))}{', ...' if len(own) > 8 else ''}], {HINT}"
        )
    return Columns(rest, note)


def _chosen(names: Sequence[str], observed: Sequence[str], columns: Sequence[str]) -> list[int]:
    """Return the places of the columns with the names that were asked for, one for each observation."""
    wanted = [columns] if isinstance(columns, str) else list(columns)
    if len(wanted) != len(observed):
        raise InputError(f"columns: {len(wanted)} names; the model has {len(observed)} observations, {_listed(observed)}")
    for name in wanted:
        count = list(names).count(name)
        if count != 1 or wanted.count(name) != 1:
            what = "is not a column" if count == 0 else "is there twice"
            raise InputError(f"columns: {quoted(str(name))} {what}; the columns are {_listed(names)}")
    return [list(names).index(name) for name in wanted]


def _text(name: str) -> str:
    return f'"{name}"' if name.isprintable() and len(name) <= 40 and '"' not in name else quoted(name)


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(quoted(str(name))[1:-1] for name in names[:8])
    return f"{shown}, ... ({len(names)})" if len(names) > 8 else shown or "none"
