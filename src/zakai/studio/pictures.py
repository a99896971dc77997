"""What the page draws of a result: only what can be seen, at the resolution at which it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from zakai.errors import InputError
from zakai.report.axes import joint_map
from zakai.report.frames import pack, unpack
from zakai.report.picture import picture_bytes

MOST_COLUMNS, MOST_ROWS = 1_200, 400
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


def joint_picture(result: Any, pair: tuple[int, int], k: int) -> tuple[dict[str, Any], Arrays]:
    """Return the density of two states at time number k, with the levels that bound the regions that hold 95% and 50%."""
    density = result.density(k).marginal(pair)
    x, y, values, levels = joint_map(density)
    top = float(values.max()) or 1.0
    image = np.rint(255.0 * values / top).astype(np.uint8)
    cov = density.cov()
    scale = float(np.sqrt(max(cov[0, 0] * cov[1, 1], np.finfo(float).tiny)))
    header = {"time": float(result.times[k]), "levels": (levels / top).tolist(), "correlation": float(cov[0, 1]) / scale}
    return header, {"x": np.asarray(x, float), "y": np.asarray(y, float), "density": image}
