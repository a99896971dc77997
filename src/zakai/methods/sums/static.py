"""What a Gaussian-sum method knows of a model without data and parameters: its system, its gauge, and how the sum is kept."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
import sympy as sp

from zakai.algebra.yau import YauForm
from zakai.errors import InputError
from zakai.methods.sums.gauge import SumGauge, directions_of, span
from zakai.methods.sums.system import System, system_of
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

# Components by the number of directions in which they must be narrow.
COMPONENTS = {0: 1, 1: 20, 2: 64, 3: 128}
MOST_DIRECTIONS = 5
# Up to so many directions the start of an affine h, which is exact from there on, is not reduced.
MOST_WHOLE = 2
# The share of the components that the companion has.  The error falls about like the inverse of their number, so that the
# distance of the two is about the error of the longer one, or more.
_COMPANION = 0.35


class Sum:
    """What does not depend on data or parameters: the system, its gauge, and how the sum is kept."""

    def __init__(self, model: Model, splitting: str, components: int | None, reduction: str, tolerance: float, alpha: float):
        self.model = model
        self.system: System = system_of(model, splitting)
        self.gauge = SumGauge(self.system.form, model, self.system.origin)
        self.angles = tuple(model.state.index(name) for name in model.periodic)
        self.affine = self.system.affine
        formulas = list(model.observation) if self.system.law is None else self.system.law.formulas
        self.directions = np.zeros((model.n, 0)) if self.affine else directions_of(formulas, model)
        self.start_directions = span(np.hstack([self.directions, self.gauge.directions]))
        k = self.start_directions.shape[1]
        if max(k, self.directions.shape[1]) > MOST_DIRECTIONS:
            raise InputError(
                f"{model.source}: h and phi vary in {k} directions of the state; quadrature takes {MOST_DIRECTIONS} at most"
            )
        self.asked, self.components = components, COMPONENTS.get(k, 192) if components is None else components
        self.reduction, self.tolerance, self.alpha = reduction, tolerance, alpha
        self.split_merge = reduction == "split-merge"
        # The last factor of an interval corrects for what both halves lose; other reductions may have negative parts.
        self.corrections = 1 + self.system.halves if self.split_merge else 0
        # Whether an interval is split in time: its error is that of the companion, which takes two steps of half the length.
        self.split_time = not self.system.rates and not self.system.sampled
        # Whether components are split before each observation rather than after it.
        self.split_before = self.system.sampled and bool(self.directions.shape[1]) and self.split_merge

    @cached_property
    def plain(self) -> Sum:
        """The same for sums that need no gauge, and whose angles are any real numbers."""
        other = copy(self)
        other.angles = ()
        flat = sp.ImmutableMatrix.zeros(self.model.n, 1)
        none = YauForm(sp.ImmutableMatrix.zeros(self.model.n, self.model.n), flat, sp.Integer(0), flat, flat)
        other.gauge = SumGauge(none, self.model, self.system.origin)
        return other

    def limits(self, count: int) -> tuple[int, int]:
        """Return how many components the sum and its companion may have, for a prior that was cut into `count` Gaussians."""
        k = self.start_directions.shape[1]
        if k == 0 or self.affine and self.asked is None and k <= MOST_WHOLE:  # nothing is merged
            used = count if self.affine else self.components
            return used, used
        used = min(self.components, count) if self.affine else self.components
        return used, round(_COMPANION * used) if used >= 6 else used + 4


@once_for_a_model
def sum_of(model: Model, splitting: str, components: int | None, reduction: str, tolerance: float, alpha: float) -> Sum:
    """Return what does not depend on data or parameters, made once."""
    return Sum(model, splitting, components, reduction, tolerance, alpha)
