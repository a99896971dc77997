"""When the state is Gaussian given the observed path: the theorem of Liptser and Shiryaev."""

from __future__ import annotations

from collections.abc import Iterable

import sympy as sp

from zakai.algebra._readable import short
from zakai.algebra.conditions import Condition
from zakai.algebra.exact_theorems import posterior_on_the_line
from zakai.algebra.systems import affine_parts, determined
from zakai.models import features
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model

SOURCE = "Liptser and Shiryaev 1977, theorem 12.7"


@once_for_a_model
def conditionally_gaussian(model: Model) -> tuple[Condition, ...]:
    """f and h affine in x, and g, Q, S and C free of x, given t, inputs and the observed path."""
    first, path = determined(model), features.OBSERVED_PATH in model.features
    words = model.features.get(features.OBSERVED_PATH, "kalman-bucy is this filter without such formulas")
    given = Condition("a formula contains the observed path", path, words, SOURCE)
    if first.holds is not True or not path:
        return first, given
    noises = (model.diffusion, model.process_noise, model.observation_noise, model.cross_noise)
    return (
        first,
        given,
        _affine("f is affine in x given the path", model.drift, model),
        _affine("h is affine in x given the path", model.observation, model),
        _free("g, Q, S and C do not depend on x", (entry for noise in noises for entry in noise.todok().values()), model),
        *posterior_on_the_line(model),
    )


def _affine(statement: str, field: sp.MatrixBase, model: Model) -> Condition:
    curved = next((entry for entry in field if affine_parts(sp.Matrix([entry]), model.x) is None), None)
    evidence = "affine" if curved is None else f"{short(str(curved))} is not affine in {', '.join(model.state)}"
    return Condition(statement, curved is None, evidence, SOURCE)


def _free(statement: str, entries: Iterable[sp.Expr], model: Model) -> Condition:
    found = next((entry for entry in entries if entry.free_symbols & set(model.x)), None)
    return Condition(statement, found is None, "free of x" if found is None else short(str(found)), SOURCE)
