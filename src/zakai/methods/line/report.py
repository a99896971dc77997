"""The health of one step of one state: the worst figures of its densities, and the error estimate that they add up to."""

from __future__ import annotations

from zakai.methods.line.prepared import Prepared
from zakai.numerics.line import window as lw
from zakai.numerics.line.resolution import RELIABLE, error_made


class Report:
    """The worst health figures within one step."""

    def __init__(self) -> None:
        self.aliasing = self.edge = self.time = self.noise = self.depth = self.growth = self.negative = self.lawless = 0.0
        self.positive = True  # small values are accurate

    def density(self, check: lw.GridCheck) -> None:
        """Note the figures of a density."""
        self.aliasing = max(self.aliasing, check.aliasing)
        self.negative = max(self.negative, check.negative)
        self.edge = max(self.edge, check.left, check.right)

    def figures(self, prepared: Prepared, floor: float, before: float, spacings: float) -> tuple[float, dict[str, float]]:
        """Return the error estimate after a step and its health figures.

        Args:
            floor: the error of small values of the prediction, relative to the maximum.
            before: the remainder of the error before the step.
            spacings: the standard deviation of the density, in spacings.
        """
        made = error_made(self.aliasing, self.edge, self.negative, self.time, floor * self.growth)
        error = float(max(made + before, RELIABLE * prepared.promised))
        health = {
            "error_estimate": error,
            "tolerance_ratio": made / prepared.promised,
            "edge_mass": self.edge,
            "negative_mass": self.negative,
            "aliasing": self.aliasing,
            "time_error": self.time,
            "tail_depth": self.depth / prepared.deepest(floor),
            "std_in_spacings": spacings,
        }
        if prepared.system.general:
            health["without_law"] = self.lawless
        return error, health
