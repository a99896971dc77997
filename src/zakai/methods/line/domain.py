"""One state between natural ends, in a variable w on the whole line.

    x = lower + e^w,    x = upper - e^-w,    x = lower + (upper - lower) / (1 + e^-w)

By Ito's formula w has the drift f / x' - G x'' / (2 x'^3) and the diffusion g / x'.  A natural end is not reached, so that the
density of w is negligible far out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy as sp

from zakai.densities.mapped import IntervalMap
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

Array = Any
# attributes that a model computes from its formulas
_DERIVED = ("text", "observation_law", "covariance", "features", "depends_on_time", "_kept")


class Variable(IntervalMap):
    """The map, with its formula."""

    def formula(self, w: sp.Symbol) -> sp.Expr:
        """Return x as a formula."""
        lower, upper = (sp.nsimplify(end, rational=True) if np.isfinite(end) else None for end in self)
        if upper is None:
            return lower + sp.exp(w)
        if lower is None:
            return upper - sp.exp(-w)
        return lower + (upper - lower) / (1 + sp.exp(-w))


def variable_of(model: Model) -> Variable | None:
    """Return the variable of a model whose state has a domain with natural ends."""
    interval = model.domain.get(model.state[0])
    if interval is None or interval.reflecting:
        return None
    return Variable(interval.lower, interval.upper)


@once_for_a_model
def on_the_line(model: Model) -> Model:
    """Return the model for w, whose state has the same symbol; a model without a domain is returned as it is."""
    variable = variable_of(model)
    if variable is None:
        return model
    w = model.x[0]
    x = variable.formula(w)
    first, second = sp.diff(x, w), sp.diff(x, w, 2)

    arranged = sp.expand if np.isinf(variable.upper - variable.lower) else sp.together

    def moved(formula: sp.Expr, factor: Any = 1, more: Any = 0) -> sp.Expr:
        return sp.powsimp(arranged(formula.subs(w, x) * factor + more))

    def matrix(formulas: sp.MatrixBase, factor: Any = 1) -> sp.ImmutableMatrix:
        return sp.ImmutableMatrix(formulas.applyfunc(lambda entry: moved(entry, factor)))

    ito = -model.covariance[0, 0].subs(w, x) * second / (2 * first**3)
    other = object.__new__(Model)
    vars(other).update({key: value for key, value in vars(model).items() if key not in _DERIVED})
    vars(other).update(
        domain={},
        prior=None,
        drift=sp.ImmutableMatrix([[moved(model.drift[0], 1 / first, ito)]]),
        diffusion=matrix(model.diffusion, 1 / first),
        observation=matrix(model.observation),
        observation_noise=matrix(model.observation_noise),
        family_parameters={key: moved(value) for key, value in model.family_parameters.items()},
        log_density=None if model.log_density is None else moved(model.log_density),
    )
    return other
