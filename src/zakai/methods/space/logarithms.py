"""States whose noise is proportional to them, as populations: with w = log x the noise does not depend on the state.

    dx_i = f_i dt + x_i s_i dv      dw_i = (f_i / x_i - |s_i|^2 / 2) dt + s_i dv      (Ito)

A density of x over several decades is narrow where x is small; that of w needs a tenth of the points along an axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import sympy

from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior
from zakai.numerics.prior_grid import PriorGrid, prior_grid

Array = Any
NEAREST = 0.05  # of the mean: the least state of the first grid of a prior, which becomes wider where there is mass
FAR_OUT = 15.0  # least squared deviations from the mean of the mass of a prior below zero
_NOT_OF_W = ("covariance", "features", "depends_on_time", "observation_law", "text", "_kept")  # computed from the formulas


@once_for_a_model
def with_logarithms(model: Model) -> tuple[Model, tuple[bool, ...]] | None:
    """Return the model of the logarithms of the states whose noise is proportional to them, and which (n,) they are.

    None where no noise is, where other noise depends on the state, and where the drift takes such a state to zero or beyond.
    """
    x, noise, n = model.x, model.covariance, model.n
    chosen = tuple(
        name not in model.periodic and noise[i, i].has(x[i]) and not _depends(noise[i, i] / x[i] ** 2, model)
        for i, name in enumerate(model.state)
    )
    if not any(chosen):
        return None
    scales = [x[i] if chosen[i] else sympy.S.One for i in range(n)]
    if any(_depends(noise[i, j] / (scales[i] * scales[j]), model) for i in range(n) for j in range(i + 1)):
        return None
    for name, logarithm in zip(model.state, chosen, strict=True):
        if name in model.domain and not (logarithm and model.domain[name].lower == 0.0 and model.domain[name].upper == math.inf):
            return None
    to_states = {x[i]: sympy.exp(x[i]) for i in range(n) if chosen[i]}
    drift = [_divided(model.drift[i], scales[i]) for i in range(n)]
    if any(chosen[i] and drift[i].subs(x[i], 0).has(sympy.zoo, sympy.nan, sympy.oo) for i in range(n)):
        return None
    drift = [drift[i] - (_divided(noise[i, i], scales[i] ** 2) / 2 if chosen[i] else 0) for i in range(n)]

    def of_w(value: Any) -> Any:
        return value.subs(to_states) if isinstance(value, sympy.Basic) else value

    rows = [[_divided(entry, scales[i]) for entry in model.diffusion.row(i)] for i in range(n)]
    formulas = {
        "drift": sympy.ImmutableMatrix(drift).subs(to_states),
        "diffusion": sympy.ImmutableMatrix(rows),
        "observation": model.observation.subs(to_states),
        "observation_noise": model.observation_noise.subs(to_states),
        "family_parameters": {key: of_w(value) for key, value in model.family_parameters.items()},
        "log_density": of_w(model.log_density),
        "domain": {},
    }
    found = object.__new__(Model)
    vars(found).update({key: value for key, value in vars(model).items() if key not in _NOT_OF_W} | formulas)
    return found, chosen


def _divided(formula: sympy.Expr, by: sympy.Expr) -> sympy.Expr:
    """Return a quotient, term by term."""
    return sympy.Add(*[term / by for term in sympy.Add.make_args(sympy.expand(formula))]) if by != 1 else formula


def _depends(formula: sympy.Expr, model: Model) -> bool:
    """Return whether a formula depends on the state."""
    return bool(sympy.cancel(formula).free_symbols & set(model.x))


def is_formula(prior: Any) -> bool:
    """Return whether a prior is a density by its logarithm, whose mass is only known on a grid."""
    return isinstance(prior, DensityPrior)


def mass_outside(prior: Any, logarithms: tuple[bool, ...], found: PriorGrid | None) -> tuple[float, float]:
    """Return the mass of a prior where a state with a logarithm is not positive, and the error of moments without it.

    The prior may be given on a grid.  The error of a variance, relative to it, is the mass times its squared distance.
    """
    chosen = np.flatnonzero(logarithms)
    if found is not None:
        weights = np.exp(found.log_values.real - found.log_values.real.max()).reshape(-1)
        weights, points = weights / weights.sum(), found.points.reshape(-1, len(logarithms))[:, chosen]
        mass, mean = float(weights[np.any(points <= 0, axis=1)].sum()), weights @ points
        variances = weights @ (points - mean) ** 2
    else:
        weights, means, deviations = (part[..., chosen] if part.ndim > 1 else part for part in _components(prior))
        below = np.array([[math.erfc(z / math.sqrt(2)) / 2 for z in row] for row in (means / deviations).tolist()])
        mass, mean = float(weights @ below.sum(axis=1)), weights @ means
        variances = weights @ (deviations**2 + (means - mean) ** 2)
    return mass, mass * max(FAR_OUT, float(np.max(mean**2 / variances)))


def prior_of_logarithms(
    model: Model, prior: Any, theta: Array, tolerance: float, periodic: tuple[bool, ...], logarithms: tuple[bool, ...],
    found: PriorGrid | None,
) -> PriorGrid:  # fmt: skip
    """Return a prior, of a formula on the grid `found` of the states, as a density of w on a grid.

    Its mass is where the states with logarithms are positive.
    """
    if found is not None:
        function = numpy_function([prior.log_density], model, ())
        logs = found.log_values.real - found.log_values.real.max()
        points = found.points[(logs > math.log(tolerance)) & np.all((found.points > 0) | ~np.array(logarithms), axis=-1)]
        ends = points.min(axis=0), points.max(axis=0)
    else:
        weights, means, deviations = _components(prior)
        reach = math.sqrt(-2 * math.log(tolerance)) * deviations
        nearest = np.where(logarithms, NEAREST * (weights @ means), -np.inf)
        ends = np.maximum((means - reach).min(axis=0), nearest), (means + reach).max(axis=0)

    def of_w(w: Array) -> Array:
        x = np.exp(w, where=logarithms, out=np.array(w, float))
        logs = prior.log_density(x) if found is None else function(x, model.start, theta)
        return np.asarray(logs) + np.sum(w, axis=-1, where=logarithms)

    low, high = (np.log(end, where=logarithms, out=end.copy()) for end in ends)
    return prior_grid(
        of_w, model.n, periodic, tolerance=tolerance, aligned=any(periodic), source=f"{model.source}: prior", box=(low, high)
    )


def _components(prior: Any) -> tuple[Array, Array, Array]:
    """Return the weights (k,), the means and the standard deviations (k, n) of a Gaussian or a mixture."""
    weights, means, covs = prior.components
    return weights, means, np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 1e-300))
