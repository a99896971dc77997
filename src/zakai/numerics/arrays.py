"""The types of arrays and numbers."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
Number = float | complex  # complex where a derivative is carried in the imaginary part
