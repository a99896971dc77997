"""Whether the arrays of a state that was read from a file fit together, before a kernel receives them."""

from __future__ import annotations

import numpy as np

from zakai.methods.frame.state import Prepared, State


def valid(prepared: Prepared, state: State) -> bool:
    """Return whether a state has the shapes that a step of this filter makes."""
    n = prepared.model.n
    if len(state.cores) != n or any(np.ndim(core) != 3 or core.dtype != float for core in state.cores):
        return False
    ranks = [core.shape[0] for core in state.cores] + [state.cores[-1].shape[2]]
    joined = all(core.shape[2] == after for core, after in zip(state.cores, ranks[1:], strict=True))
    if not joined or ranks[0] != 1 or ranks[-1] != 1 or min(core.size for core in state.cores) < 1:
        return False
    if any(np.shape(part) != (n,) for part in (state.centre, state.low, state.step, state.closed)):
        return False
    parts = (*state.cores, state.centre, state.basis, state.low, state.step)
    if np.shape(state.basis) != (n, n) or not all(np.isfinite(part).all() for part in parts):
        return False
    closed = np.asarray(state.closed)
    if closed.dtype != bool or (closed & ~prepared.system.base.angles).any() or not (np.asarray(state.step) > 0).all():
        return False
    return bool(abs(np.linalg.det(state.basis)) > 0 and state.control.interval >= 0 and np.isfinite(state.control.time.substeps))
