"""The extended Kalman filter of dynamax: a Gaussian that follows the discretised system, linearised at its mean.

    predict      m -> F(m),  P -> F' P F'^T + Q              F, Q: a substep of the system
    condition    K = P H^T (H P H^T + R)^-1,  m -> m + K (z - h(m)),  P -> P - K (H P H^T + R) K^T

(Saerkka 2013, algorithm 5.4, as in dynamax.nonlinear_gaussian_ssm).  dynamax can also iterate the condition step; each pass there
starts from the covariance of the pass before, so that an observation counts several times, and this is not offered.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from zakai.algebra.theorems import smooth_system as theorem
from zakai.methods._protocol import Method
from zakai.models.model import Model
from zakai.peers import _gaussian
from zakai.peers._dynamax import inference_ekf
from zakai.peers._gaussian import Rule, State
from zakai.peers._translation import Prepared
from zakai.records.schedule import Schedule

import jax  # isort: skip
import jax.numpy as jnp  # isort: skip


@lru_cache(maxsize=1)
def _rule() -> Rule:
    """Return dynamax' functions, which take an input beside the state."""

    def predict(mean: Any, cov: Any, function: Any, noise: Any) -> tuple[Any, Any]:
        return inference_ekf._predict(mean, cov, lambda x, _: function(x), lambda x, _: jax.jacfwd(function)(x), noise, 0.0)

    def condition(mean: Any, cov: Any, function: Any, value: Any) -> tuple[Any, Any]:
        slope = jax.jacfwd(function)
        unit = jnp.eye(len(value))
        return inference_ekf._condition_on(mean, cov, lambda x, _: function(x), lambda x, _: slope(x), unit, 0.0, value, 1)

    return Rule(predict, condition)


def prepare(
    model: Model, schedule: Schedule, theta: np.ndarray, *, scheme: str = "midpoint", substeps: int = 1
) -> Prepared:
    """Return what is known of the intervals without data.

    Args:
        model: the system.
        schedule: its K intervals.
        theta: values of the parameters (p,).
        scheme: "midpoint" or "euler".
        substeps: equal parts of each interval.

    Raises:
        InputError: another value of an option.
    """
    return _gaussian.prepared_by(_rule(), model, schedule, theta, scheme, substeps)


METHOD: Method[Prepared, State] = Method(
    name="ekf",
    source="dynamax, extended Kalman filter (Saerkka 2013, algorithm 5.4)",
    exactness=f"approximate: linearised at the mean; for a linear system {_gaussian.FIRST_ORDER}",
    theorem=theorem,
    options={"scheme": "midpoint", "substeps": 1},
    prepare=prepare,
    init=_gaussian.init,
    step=_gaussian.step,
    segment=_gaussian.segment,
    density=_gaussian.density,
    state=State,
    bounds=_gaussian.BOUNDS,
    differentiable=False,
    valid=_gaussian.valid,
)
