"""Poles of the drift: states at which a divisor of f vanishes, so that f is infinite there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.conditions import Condition
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

_SIZES = np.concatenate([[0.0], 2.0 ** np.arange(-20.0, 21.0)])  # of the states at which divisors are evaluated
_DIRECTIONS = 64
_BETWEEN = np.linspace(-30.0, 30.0, 1201)  # states of which most periodic divisors change their sign between two


def finite_drift(model: Model) -> Iterator[Condition]:
    """Yield the condition that no divisor of the drift vanishes at a state, nothing where no state is in a divisor."""
    divisors = _divisors(model)
    if not divisors:
        return
    directions = np.random.default_rng(1).standard_normal((_DIRECTIONS, model.n))
    far, near = _SIZES[:, None, None] * directions, _BETWEEN[:, None, None] * np.eye(model.n)
    points = np.concatenate([far.reshape(-1, model.n), near.reshape(-1, model.n)])
    u = np.zeros(len(model.u)) if model.u else None
    with np.errstate(all="ignore"):
        values = np.real(numpy_function(divisors, model)(points, model.start, model.theta(), u))
    vanishing = (values == 0).any(axis=0) | ((values < 0).any(axis=0) & (values > 0).any(axis=0))
    which = f"{short(str(divisors[int(np.argmax(vanishing))]))} vanishes" if vanishing.any() else "no divisor of f vanishes"
    yield Condition("f is finite at all states", not vanishing.any(), which, "e^phi is integrated over all states")


def _divisors(model: Model) -> list[sp.Expr]:
    """Return the formulas of the state by which the drift is divided."""
    found: dict[sp.Expr, None] = {}
    for entry in model.drift:
        for part in sp.preorder_traversal(entry):
            if isinstance(part, sp.Pow) and part.exp.could_extract_minus_sign():
                found[part.base] = None
            elif isinstance(part, sp.tan | sp.sec):
                found[sp.cos(part.args[0])] = None
            elif isinstance(part, sp.cot | sp.csc):
                found[sp.sin(part.args[0])] = None
            elif isinstance(part, sp.coth | sp.csch):
                found[sp.sinh(part.args[0])] = None
    return [part for part in found if part.has(*model.x)]
