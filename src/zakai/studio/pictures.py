"""What the page draws of a result: only what can be seen, at the resolution at which it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.report.frames import pack, unpack
from zakai.report.picture import picture_bytes
from zakai.report.plane import plane_bytes

MOST_COLUMNS, MOST_ROWS = 1_200, 400
JOINT_TIMES = 41  # at which the density of two states can be seen
Arrays = dict[str, np.ndarray]


class View(NamedTuple):
    """The times that are seen, all without a window, and how finely."""

    window: tuple[float, float] | None = None
    columns: int = 800
    rows: int = 256

    @classmethod
    def of(cls, request: Mapping[str, Any]) -> View:
        """Return the view that a request names; what it leaves out is everything."""
        wanted = {key: request.get(key) for key in ("from", "to", "columns", "rows")}
        if not all(value is None or isinstance(value, int | float) for value in wanted.values()):
            raise InputError("the view of the picture is not in numbers; reload the page")
        begin, end = wanted["from"], wanted["to"]
        columns = int(np.clip(wanted["columns"] or cls._field_defaults["columns"], 2, MOST_COLUMNS))
        rows = int(np.clip(wanted["rows"] or cls._field_defaults["rows"], 8, MOST_ROWS))
        return cls(None if begin is None or end is None else (float(begin), float(end)), columns, rows)


def density_picture(result: Any, state: int, truth: Any, view: View, extent: Any = None) -> Arrays:
    """Return the frame of the density of one state, as bytes in an array; `extent` are the first and last time of the axis."""
    frame = picture_bytes(result, state, view.window, view.columns, view.rows, truth)
    if extent is not None:
        header, arrays = unpack(frame)
        frame = pack({**header, "extent": [float(end) for end in extent]}, arrays)
    return {"frame": np.frombuffer(frame, np.uint8)}


def joint_picture(result: Any, pair: tuple[int, int], truth: Any) -> Arrays:
    """Return the frame of the density of two states at evenly spaced times, the start and the end among them."""
    last = len(result.times) - 1
    index = np.unique(np.linspace(0, last, min(JOINT_TIMES, last + 1)).round().astype(int))
    return {"frame": np.frombuffer(plane_bytes(result, pair, index.tolist(), truth=truth), np.uint8)}
