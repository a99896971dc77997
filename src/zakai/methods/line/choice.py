"""Which mechanism takes the density of one state over an interval: one table, tried from the top.

The first three rows are the compiled loop (`line/loop.py`): it advances intervals together until a step misses the tolerance, or
needs a grid that does not exist.  Such an interval is cut into parts, or taken alone by the first of the other rows whose
condition holds and which is accurate.  docs/explanation/any-smooth-system.md shows this table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zakai.methods.line.coefficients import on_grid_for_drift, travel
from zakai.methods.line.kernel import by_kernel, kernel_of
from zakai.methods.line.panels import contracted
from zakai.methods.line.prepared import Prepared, TimeInterval
from zakai.methods.line.report import Report
from zakai.methods.line.transition import Prediction, by_decomposition, by_substeps
from zakai.methods.line.update import refitted
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.gaussian_kernels import Channel
from zakai.numerics.line.grid_choice import FAR

MOVING = 0.3  # ranges of a density that it moves in an interval without modes, above which grids move with it


@dataclass
class Density:
    """A density before an interval that is filtered alone: its values (N,) and their grid.

    `kernel` is the Gaussian kernel of the interval, None where there is none; `travel` by how many of its ranges the drift moves
    the density.
    """

    prepared: Prepared
    values: Array
    window: lw.Window
    interval: TimeInterval
    report: Report
    kernel: Channel | None
    travel: float = 0.0

    def on_grid_of_operators(self) -> None:
        """Move the density to a grid on which operators act: those of kernels are finer, and may hide the drift."""
        prepared, interval = self.prepared, self.interval
        if prepared.gaussian:
            check = lw.grid_check(self.values, self.window.closed, prepared.negligible)
            self.values, self.window = refitted(prepared, self.values, self.window, check, prepared.generous)
        span = interval.start, interval.length
        self.values, self.window = on_grid_for_drift(prepared, self.values, self.window, *span)
        self.travel = travel(prepared, self.values, self.window, *span)


class Mechanism(NamedTuple):
    """A row of the table.

    `holds` decides for an interval that is taken alone, and `predict` returns the density after it, None where it is not
    accurate; both are None for other rows.  `positive` tells that small values are accurate.  `test` is the test that fails
    without the mechanism.
    """

    name: str
    condition: str
    cost: str
    test: str
    holds: Callable[[Density], bool] | None = None
    predict: Callable[[Density], Prediction | None] | None = None
    positive: bool = False


def _has_kernel(density: Density) -> bool:
    return density.kernel is not None


def _by_kernel(density: Density) -> Prediction | None:
    assert density.kernel is not None
    return by_kernel(density.prepared, density.values, density.window, density.interval, density.kernel, density.report)


def _is_steady(density: Density) -> bool:
    return not (density.travel > FAR or density.prepared.system.varying or density.interval.inside.any())


def _by_modes(density: Density) -> Prediction | None:
    return by_decomposition(density.prepared, density.values, density.window, density.interval.length, density.report)


def _always(density: Density) -> bool:
    return True


def _by_panels(density: Density) -> Prediction | None:
    moving = density.travel > MOVING
    return contracted(density.prepared, density.values, density.window, density.interval, density.report, moving)


def _by_substeps(density: Density) -> Prediction:
    moving = density.travel > MOVING
    return by_substeps(density.prepared, density.values, density.window, density.interval, density.report, moving)


TESTS = "tests/methods/"
MECHANISMS = (
    Mechanism(
        "Gaussian kernels, compiled", "the equation of the interval is linear-quadratic in the gauge e^phi (a Yau system)",
        "about 15 µs", TESTS + "test_limited_direct_steep_gauge.py",
    ),
    Mechanism(
        "splitting, compiled", "constant G, smooth f and h; increments act inside, or f depends on t",
        "20 to 100 µs", TESTS + "test_line_short_waves.py",
    ),
    Mechanism(
        "modes, compiled", "samples; f and G do not depend on t, and G is positive",
        "20 µs on a grid that stays, 100 µs on a new one for a narrow posterior", TESTS + "test_line_sharp.py",
    ),
    Mechanism(
        "parts of an interval", "noise makes the density far wider in the interval, or its coefficients vary much in time",
        "that of each part", TESTS + "test_line_parts.py",
    ),
    Mechanism(
        "a Gaussian kernel", "the equation of the interval is linear-quadratic, and its kernel wider than the spacing",
        "0.2 ms", TESTS + "test_limited_direct.py", _has_kernel, _by_kernel, True,
    ),
    Mechanism(
        "modes of the operator", "no coefficient depends on t, no increment acts inside, it travels at most three of its ranges",
        "1 ms, and 1 to 9 ms for a new grid", TESTS + "test_line_separate_modes.py", _is_steady, _by_modes,
    ),
    Mechanism(
        "panels", "the drift contracts the density by much, coefficients have kinks or jumps, or a natural end is near",
        "2 to 10 ms", TESTS + "test_line_broad_priors.py", _always, _by_panels,
    ),
    Mechanism(
        "substeps of Magnus' series", "always; the grid moves with a density that travels",
        "1 ms for each substep", TESTS + "test_line_moving.py", _always, _by_substeps,
    ),
)  # fmt: skip


def predicted(
    prepared: Prepared, values: Array, window: lw.Window, interval: TimeInterval, report: Report
) -> tuple[Prediction, float]:
    """Return the density after an interval that is filtered alone, and the factor by which its kernel contracts deviations."""
    if not np.isfinite(values.real).all():  # a density that is lost stays lost
        return Prediction(values, window, np.float64(np.nan), None), 1.0
    kernel = kernel_of(prepared, interval, window, report)
    density = Density(prepared, values, window, interval, report, kernel)
    for mechanism in MECHANISMS:
        if mechanism.holds is None or mechanism.predict is None:
            continue
        if report.positive and not mechanism.positive:
            report.positive = False
            density.on_grid_of_operators()
        prediction = mechanism.predict(density) if mechanism.holds(density) else None
        if prediction is not None:
            return prediction, 1.0 if kernel is None else float(np.real(kernel.scale))
    raise AssertionError("the last mechanism returns a density")
