"""Points that fill a cube evenly, always the same."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


@lru_cache(maxsize=8)
def quasi_random(count: int, n: int) -> NDArray[Any]:
    """Return points of a fixed Sobol sequence in the unit cube (n, count): draws are a function of the density alone."""
    from scipy.stats import qmc

    return np.ascontiguousarray(qmc.Sobol(n, scramble=True, rng=np.random.default_rng(1)).random(count).T)
