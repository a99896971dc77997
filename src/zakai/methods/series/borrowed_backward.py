"""The backward pass of methods whose own operators move densities only: their density times the message of `yau-yau`.

The message p(observations after t | x) obeys the adjoint of the Kolmogorov equation, whichever method solves that equation
forward.  The evidence therefore compares two solutions that share no operator.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from zakai.densities import GridDensity
from zakai.methods._protocol import Backward, through
from zakai.methods.grid import yau_yau
from zakai.methods.line.prepared import State as LineState
from zakai.numerics.line import window as lw
from zakai.numerics.space.field import Field
from zakai.numerics.space.grid import Grid

FIGURES = ("error_estimate", "tolerance_ratio")
OF_MESSAGE = {"tolerance_ratio": yau_yau.BOUNDS["tolerance_ratio"]}
ROUNDING = -30.0  # logarithm of the error of the small values of a density, relative to its maximum


@lru_cache(maxsize=8)
def _of_grid(prepared: Any) -> tuple[Backward[Any, Any, Any], Any]:
    """Return the backward pass of `yau-yau`, and what it prepares for the same schedule."""
    model = prepared.system.model
    method = yau_yau.variant(model, {})
    assert method.backward is not None
    return method.backward, method.prepare(model, prepared.schedule, prepared.system.theta)


def _on_line(density: GridDensity) -> LineState:
    """Return a density of one state on a grid of `yau-yau`; all of them have the same origin and unit."""
    own = lw.Window(0.0, float(density.centre[0]), float(density.basis[0, 0]), len(density.weights), False, 1.0)
    check = lw.grid_check(density.weights, False)
    low, high = own.offsets[check.first], own.offsets[check.last]
    window = lw.quantized(own, float(low), float(high), own.spacing * max(check.resolving, 1.0), most=lw.SIZES[-1])
    values = lw.resampled(density.weights, own, window)
    return LineState(values / values.sum(), 0.0, window.centre, window.spacing, 1.0, False, max(check.aliasing, 0.0), ROUNDING)


def _state(prepared: Any, density: GridDensity) -> Any:
    """Return a density as a state of `yau-yau`."""
    if prepared.system.model.n == 1:
        return _on_line(density)
    grid = Grid(density.centre, density.basis, density.log_values.shape, (False,) * len(density.centre))
    return _of_grid(prepared)[1].started(Field(density.weights / grid.cell, grid, 0.0), 0.0)


def borrowed(density: Callable[[Any, Any], GridDensity], accuracy: Callable[[Any], float]) -> Backward[Any, Any, Any]:
    """Return the backward pass of a method.

    Args:
        density: the method's own; what it prepares has a `schedule`, and a `system` with `model` and `theta`.
        accuracy: the error of the evidence that one of its intervals may leave, for what is prepared.
    """
    return through(
        _of_grid,
        lambda prepared, state: _state(prepared, density(prepared, state)),
        lambda prepared, state, health: {name: health[name] for name in FIGURES},
        accuracy,
    )
