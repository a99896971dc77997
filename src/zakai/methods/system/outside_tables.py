"""Where formulas of the state leave the range of a table, beyond which a table is constant."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.models.features import formulas_of
from zakai.models.functions import TableFunction
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

Array = np.ndarray[Any, np.dtype[Any]]


class OutsideTables:
    """The calls of tables in the formulas of a model that depend on the state; false where there are none."""

    def __init__(self, model: Model):
        calls = {call for part in formulas_of(model) for call in part.atoms(TableFunction) if call.has(*model.x)}
        self._calls = [
            (call.table, numpy_function(list(call.args), model, (len(call.args),))) for call in sorted(calls, key=str)
        ]

    def __bool__(self) -> bool:
        return bool(self._calls)

    def __call__(self, x: Array, t: Any, theta: Array, u: Array | None = None) -> Array:
        """Return which states x (..., n) lead beyond the range of a table."""
        found = np.zeros(x.shape[:-1], bool)
        for table, arguments in self._calls:
            found |= table.outside(*np.moveaxis(arguments(x, t, theta, u).real, -1, 0))
        return found
