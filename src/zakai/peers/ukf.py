"""The unscented Kalman filter of dynamax: a Gaussian whose moments follow 2 n + 1 sigma points.

    x_0 = m,  x_i = m +- sqrt(n + lambda) (column i of the Cholesky factor of P),    lambda = alpha^2 (n + kappa) - n
    weights of the mean: lambda / (n + lambda), then 1 / (2 (n + lambda)); of the covariance the first has 1 - alpha^2 + beta more

(Saerkka 2013, algorithm 5.14).  dynamax' own defaults, alpha = sqrt 3, beta = 2, kappa = 1, put the points sqrt(3 n + 3)
deviations away, twice the reach of a Gaussian.  Here alpha = 1 and beta = 0, so that both sets of weights are the same.
kappa is 3 - n where that is not negative, which matches the fourth moment of a Gaussian along each axis (Julier and Uhlmann
1997); for more than three states it is 0, the cubature rule (Arasaratnam and Haykin 2009), whose weights are never negative.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from zakai.algebra.theorems import smooth_system as theorem
from zakai.errors import InputError
from zakai.methods._options import real_number
from zakai.methods._protocol import Method
from zakai.models.model import Model
from zakai.peers import _gaussian
from zakai.peers._dynamax import inference_ukf as dynamax
from zakai.peers._gaussian import Rule, State
from zakai.peers._translation import Prepared
from zakai.records.schedule import Schedule

import jax.numpy as jnp  # isort: skip


@lru_cache(maxsize=32)
def _rule(n: int, alpha: float, beta: float, kappa: float) -> Rule:
    """Return dynamax' functions with the weights of `n` states."""
    scale = dynamax._compute_lambda(alpha, kappa, n)
    weights = tuple(np.asarray(one) for one in dynamax._compute_weights(n, alpha, beta, scale))

    def predict(mean: Any, cov: Any, function: Any, noise: Any) -> tuple[Any, Any]:
        return dynamax._predict(mean, cov, lambda x, _: function(x), noise, scale, *weights, 0.0)[:2]

    def condition(mean: Any, cov: Any, function: Any, value: Any) -> tuple[Any, Any]:
        unit = jnp.eye(len(value))
        return dynamax._condition_on(mean, cov, lambda x, _: function(x), unit, scale, *weights, 0.0, value)[1:]

    return Rule(predict, condition)


def prepare(
    model: Model,
    schedule: Schedule,
    theta: np.ndarray,
    *,
    alpha: float = 1.0,
    beta: float = 0.0,
    kappa: float | None = None,
    scheme: str = "midpoint",
    substeps: int = 1,
) -> Prepared:
    """Return what is known of the intervals without data.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        alpha: spread of the sigma points, positive.
        beta: additional weight of the first point in the covariance.
        kappa: second spread of the sigma points, above -n; by default 3 - n, at least 0.
        scheme: "midpoint" or "euler".
        substeps: equal parts of each interval.

    Raises:
        InputError: another value of an option.
    """
    n = model.n
    alpha = real_number("alpha", alpha, "a positive number", lambda value: 0 < value < np.inf)
    beta = real_number("beta", beta, "a finite number", np.isfinite)
    kappa = max(3.0 - n, 0.0) if kappa is None else kappa
    kappa = real_number("kappa", kappa, f"a number above -{n}, the number of states", lambda value: -n < value < np.inf)
    return _gaussian.prepared_by(_rule(n, alpha, beta, kappa), model, schedule, theta, scheme, substeps)


def init(prepared: Prepared, prior: Any) -> State:
    """Return the prior's mean and covariance.

    Raises:
        InputError: the covariance is singular, so that sigma points cannot be placed.
    """
    state = _gaussian.init(prepared, prior)
    try:
        np.linalg.cholesky(state.cov)
    except np.linalg.LinAlgError:
        raise InputError(
            f"{prepared.model.source}: prior: its covariance is singular, and ukf places its points by the Cholesky factor; "
            "give every state a small variance, or take ekf"
        ) from None
    return state


METHOD: Method[Prepared, State] = Method(
    name="ukf",
    source="dynamax, unscented Kalman filter (Saerkka 2013, algorithm 5.14; Julier and Uhlmann 1997)",
    exactness=f"approximate: moments through sigma points; for a linear system {_gaussian.FIRST_ORDER}",
    theorem=theorem,
    options={"alpha": 1.0, "beta": 0.0, "kappa": None, "scheme": "midpoint", "substeps": 1},
    prepare=prepare,
    init=init,
    step=_gaussian.step,
    segment=_gaussian.segment,
    density=_gaussian.density,
    state=State,
    bounds=_gaussian.BOUNDS,
    differentiable=False,
    valid=_gaussian.valid,
)
