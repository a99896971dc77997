"""The backward pass of methods whose own operators move densities only: their density times the message of `yau-yau`.

The message p(observations after t | x) obeys the adjoint of the Kolmogorov equation, whichever method solves that equation
forward.  The evidence therefore compares two solutions that share no operator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from zakai.densities import GridDensity
from zakai.methods import yau_yau
from zakai.methods._grid_backward import BACKWARD as GRID
from zakai.methods._line_system import State as LineState
from zakai.methods._protocol import Backward, Info, Infos
from zakai.numerics import line_window as lw
from zakai.numerics.space_field import Field
from zakai.numerics.space_grid import Grid

FIGURES = ("error_estimate", "tolerance_ratio")
OF_MESSAGE = {"tolerance_ratio": yau_yau.BOUNDS["tolerance_ratio"]}
ROUNDING = -30.0  # logarithm of the error of the small values of a density, relative to its maximum


@lru_cache(maxsize=8)
def _grid(prepared: Any) -> Any:
    """Return what `yau-yau` prepares for the same schedule."""
    return yau_yau.prepare(prepared.system.model, prepared.schedule, prepared.system.theta)


def _on_line(density: GridDensity) -> LineState:
    """Return a density of one state on a grid of `yau-yau`; all of them have the same origin and unit."""
    own = lw.Window(0.0, float(density.centre[0]), float(density.basis[0, 0]), len(density.weights), False, 1.0)
    look = lw.figures(density.weights, False)
    low, high = own.offsets[look.first], own.offsets[look.last]
    window = lw.quantized(own, float(low), float(high), own.spacing * max(look.resolving, 1.0), most=lw.SIZES[-1])
    values = lw.resampled(density.weights, own, window)
    return LineState(values / values.sum(), 0.0, window.centre, window.spacing, 1.0, False, max(look.aliasing, 0.0), ROUNDING)


def _state(prepared: Any, density: GridDensity) -> Any:
    """Return a density as a state of `yau-yau`."""
    if prepared.system.model.n == 1:
        return _on_line(density)
    grid = Grid(density.centre, density.basis, density.log_values.shape, (False,) * len(density.centre))
    return _grid(prepared).started(Field(density.weights / grid.cell, grid, 0.0), 0.0)


def borrowed(density: Callable[[Any, Any], GridDensity], accuracy: Callable[[Any], float]) -> Backward[Any, Any, Any]:
    """Return the backward pass of a method.

    Args:
        density: the method's own; what it prepares has a `schedule`, and a `system` with `model` and `theta`.
        accuracy: the error of the evidence that one of its intervals may leave, for what is prepared.
    """

    def state_of(prepared: Any, state: Any) -> Any:
        return _state(prepared, density(prepared, state))

    def message(prepared: Any, state: Any) -> Any:
        return GRID.message(_grid(prepared), state_of(prepared, state))

    def step(prepared: Any, k: int, later: Any, values: np.ndarray, state: Any) -> Any:
        return GRID.step(_grid(prepared), k, later, values, state_of(prepared, state))

    def smoothed(prepared: Any, state: Any, later: Any) -> tuple[Any, Info]:
        own, info = GRID.smoothed(_grid(prepared), state_of(prepared, state), later)
        return own, info._replace(health={name: info.health[name] for name in FIGURES})

    def segment(prepared: Any, rows: slice, states: Sequence[Any], later: Any, values: np.ndarray) -> tuple[Any, Infos] | None:
        if prepared.system.model.n > 1:
            return None
        assert GRID.segment is not None
        found = GRID.segment(_grid(prepared), rows, [state_of(prepared, state) for state in states], later, values)
        assert found is not None
        return found[0], found[1]._replace(health={name: found[1].health[name] for name in FIGURES})

    def smoothed_density(prepared: Any, state: Any, later: Any) -> Any:
        return GRID.density(_grid(prepared), state_of(prepared, state), later)

    def draw(
        prepared: Any, k: int, later: np.ndarray, values: np.ndarray, state: Any, rng: np.random.Generator
    ) -> tuple[np.ndarray, float]:
        assert GRID.draw is not None
        return GRID.draw(_grid(prepared), k, later, values, state_of(prepared, state), rng)

    def allowed(prepared: Any) -> float:
        return max(accuracy(prepared), GRID.accuracy(_grid(prepared)))

    return Backward(message, step, smoothed, smoothed_density, segment, draw, allowed)
