"""The filters of Hu and Yau (2002): f = G grad F + l with affine l, affine h, and eta quadratic; any initial density.

With S, H and P as in Theorems 4 to 6, u~ = e^{S - F} sigma, taken along (b, a, c), solves a linear equation without data,

    u~_t = 1/2 G:Hess u~ - H.grad u~ - P u~,     u~(0) = e^{S - F} sigma_0,
    Theorem 4: S = 0, H = l     Theorem 5: S = F, H = f     Theorem 6: G grad S = -l, H = 0, P = eta / 2,

and the survey of Chen and Dong, Theorem 1, is Theorem 5 with G = I.  `form="stepwise"` starts anew at every reading and is
stable for ever; Theorems 4 and 5 then are one method, for e^F cancels.  `form="one-shot"` is the papers' own: see `_one_shot`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
import sympy as sp

from zakai import _float64  # noqa: F401
from zakai.algebra.exact_theorems import hu_yau as theorem
from zakai.algebra.gauges import affine_system
from zakai.algebra.identities import all_zero
from zakai.errors import InputError
from zakai.filters import _family_filter as families
from zakai.filters import _one_shot
from zakai.filters._affine_system import AffineSystem, affine_system_of
from zakai.filters._formulas import Formulas, formulas
from zakai.filters._protocol import Info, Method, Schedule
from zakai.kolmogorov.flow import Coefficients
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

CHOICES = ("theorem-4", "theorem-5", "theorem-6", "survey-1")


class WithoutDrift(AffineSystem):
    """The equation of e^S v with G grad S = -(L x + l): no drift, and the potential -(q + (L x + l)'G^-1 (L x + l) - tr L)/2."""

    def coefficients(self, t: Any, argument: tuple[Any, Any]) -> Coefficients:
        c = super().coefficients(t, argument)
        matrix, offset = c.matrix, c.offset[:, 0]
        slope = self._slope(c)
        n, first = len(matrix), np.arange(len(c.constant)) == 0
        return Coefficients(
            0.0 * matrix,
            0.0 * c.offset,
            c.covariance,
            c.quadratic - 0.5 * matrix.T @ slope[:, :n],
            c.linear - (matrix.T @ slope[:, n])[:, None] * first,
            c.constant + 0.5 * (matrix.trace() - offset @ slope[:, n]) * first,
        )

    def _slope(self, c: Coefficients) -> Any:
        """G^-1 (L, l), (n, n + 1)."""
        xp = numpy_or_jax(c.matrix)
        return xp.linalg.solve(c.covariance, xp.hstack([c.matrix, c.offset[:, :1]]))

    def quadratic(self, t: Any, theta: Any) -> families.Quadratic:
        slope = self._slope(super().coefficients(t, (theta, np.zeros(self.outputs))))
        n = len(slope)
        return families.Quadratic(0.5 * (slope[:, :n] + slope[:, :n].T), slope[:, n])


@lru_cache(maxsize=32)
def _without_drift(of: Formulas) -> WithoutDrift:
    return WithoutDrift(of.model)


def prepare(
    model: Model, schedule: Schedule, *, form: str = "stepwise", choice: str = "theorem-4", tolerance: float = 1e-6
) -> Any:
    """The flow of every interval, offline.

    form: "stepwise", or "one-shot" from the start on, which is refused once eps exp(2 mu t), its error relative to the size of
    the statistics, passes `tolerance`, mu being their largest growth rate; the error in nats is `health["lost_digits"]`.
    choice: which theorem's S, H and P. Raises InputError where an option does not fit.
    """
    if form not in ("stepwise", "one-shot"):
        raise InputError(f'option form: "{form}" is neither "stepwise" nor "one-shot"')
    if choice not in CHOICES:
        raise InputError(f'option choice: "{choice}" is none of {", ".join(CHOICES)}')
    if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not tolerance > 0:
        raise InputError(f"option tolerance: {tolerance!r} is not a positive number")
    _check_choice(model, choice)
    system = (_without_drift if choice == "theorem-6" else affine_system_of)(formulas(model))
    if form == "stepwise":
        return families.prepare(model, schedule, system)
    return _one_shot.prepare(model, schedule, system, tolerance)


def _check_choice(model: Model, choice: str) -> None:
    G, matrix = model.covariance, affine_system(model)[0].matrix  # type: ignore[index]
    if choice == "survey-1" and all_zero(list(G - sp.eye(model.n))) is not True:
        raise InputError(f'{model.source}: option choice: "survey-1" is stated for G = I, but G = {G.tolist()}; take "theorem-5"')
    if choice == "theorem-6":
        entries = numpy_function(G, model, G.shape)(np.zeros(model.n), model.start, model.theta())
        if np.linalg.matrix_rank(entries) < model.n:
            raise InputError(f'{model.source}: option choice: "theorem-6" needs a G that has an inverse; take "theorem-4"')
        # G^-1 D is symmetric if and only if D G is.
        product = matrix * G
        varying = any(entry.has(model.t) for entry in (*G, *matrix, *affine_system(model)[0].offset))  # type: ignore[index]
        if all_zero(list(product - product.T)) is not True or varying:
            raise InputError(
                f'{model.source}: option choice: "theorem-6" needs constant coefficients and a symmetric G^-1 D; take "theorem-4"'
            )


def _by_form(name: str) -> Any:
    """A part of the method, of the form that was prepared."""

    def part(first, *rest):
        one_shot = isinstance(first, _one_shot.Prepared | _one_shot.Interval)
        return getattr(_one_shot if one_shot else families, name)(first, *rest)

    part.__name__ = name
    return part


def _step(interval: Any, state: Any, observation: Any) -> tuple[Any, Info]:
    """One interval; nothing cancels in the stepwise form."""
    state, info = _by_form("step")(interval, state, observation)
    return state, info._replace(health={"lost_digits": jnp.zeros(()), **info.health})


def _correct(prepared: Any, prior: Any, observation: Any) -> tuple[Any, Info]:
    """A sample at the start."""
    state, info = _by_form("correct")(prepared, prior, observation)
    return state, info._replace(health={"lost_digits": jnp.zeros(()), **info.health})


METHOD = Method(
    name="hu-yau",
    source="Hu and Yau 2002, Theorems 3 to 6, corrected; any prior: Makowski 1986",
    exactness="exact for y that is linear between readings, and for samples; the prior to 1e-12",
    theorem=theorem,
    options={"form": "stepwise", "choice": "theorem-4", "tolerance": 1e-6},
    prepare=prepare,
    init=_by_form("init"),
    correct=_correct,
    observations=_by_form("observations"),
    rule=_by_form("rule"),
    lasting=families.lasting,  # a live filter has no other form
    step=_step,
    density=_by_form("density"),
    with_parameters=_by_form("with_parameters"),
    bounds={
        **families.BOUNDS,
        "lost_digits": (1e-6, 'rounding of the evidence in nats, as the statistics of one shot cancel; take form="stepwise"'),
    },
)
