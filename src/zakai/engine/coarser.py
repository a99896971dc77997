"""How far the moments of a run may be off: their distance from those of the same run at a coarser tolerance.

The estimates that a method adds up from step to step are bounds, and may exceed the error by orders of magnitude. The error of
the coarser run is the larger one, so that the distance bounds the error too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from zakai._progress import announced
from zakai.engine.setting import Setting
from zakai.errors import ZakaiError
from zakai.methods._protocol import Infos
from zakai.numerics.sums.mixture import wrapped

Array = NDArray[np.float64]
Done = Callable[[float], None]
Again = Callable[[Setting, Done], Infos]
COARSE = 1e-2  # tolerance of the second run: the largest that is fine enough for three digits
TIMES, COARSEST = 10.0, 0.1  # by which it is coarser than a tolerance that is as large; the largest that a method takes
LOST = 1.0  # deviations between the runs from which the coarser one has lost the density, and says nothing of later rows


def distances(setting: Setting, mean: Array, cov: Array, again: Again) -> Array | None:
    """Return the distance of the moments from those at a coarser tolerance, in deviations (K,).

    Args:
        setting: the method of the run.
        mean: (K, n), after each interval.
        cov: (K, n, n).
        again: returns what another setting reports after each interval, and calls a function of the number of them after each.

    Returns:
        The largest relative difference of a mean or a deviation; infinite after the coarser run has lost the density. None where
        the method has no tolerance, or the coarsest, or an estimate that is no bound, and where another option is given: it may
        set an error that no tolerance changes.
    """
    if not setting.method.cautious or "tolerance_ratio" not in setting.method.bounds or "tolerance" not in setting.options:
        return None
    defaults = setting.method.options
    if any(value != defaults.get(name) for name, value in setting.options.items() if name != "tolerance"):
        return None
    own = setting.options["tolerance"] or 0.0
    tolerance = COARSE if own < COARSE else min(TIMES * own, COARSEST)
    if tolerance <= own:
        return None
    try:
        what = f"{setting.method.name}: comparing with a result of tolerance={tolerance:g}, to estimate the error,"
        with announced(what) as advance:
            coarser = setting._replace(options={**setting.options, "tolerance": tolerance})
            infos = again(coarser, lambda done: advance(done, len(mean), len(mean)))
    except ZakaiError:
        return None
    angles = tuple(i for i, name in enumerate(setting.model.state) if name in setting.model.periodic)
    with np.errstate(all="ignore"):
        deviations, others = (np.sqrt(np.diagonal(one, axis1=1, axis2=2)) for one in (cov, infos.cov))
        apart = np.abs(wrapped(mean - infos.mean, angles)) / deviations
        found = np.maximum(apart, np.abs(others / deviations - 1.0)).max(axis=1)
    found = np.where(np.isfinite(found), found, np.inf)
    lost = np.flatnonzero(found >= LOST)
    found[lost[0] + 1 if len(lost) else len(found) :] = np.inf
    return np.asarray(found)
