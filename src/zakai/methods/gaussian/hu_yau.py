"""The filters of Hu and Yau (2002): f = G grad F + l with affine l, affine h, and eta quadratic; any initial density.

With S, H and P as in Theorems 4 to 6, u~ = e^{S - F} sigma, taken along (b, a, c), solves a linear equation without data,

    u~_t = 1/2 G:Hess u~ - H.grad u~ - P u~,     u~(0) = e^{S - F} sigma_0,
    Theorem 4: S = 0, H = l     Theorem 5: S = F, H = f     Theorem 6: G grad S = -l, H = 0, P = eta / 2,

and the survey of Chen and Dong, Theorem 1, is Theorem 5 with G = I.  `form="stepwise"` starts again at every observation and is
stable over any time; Theorems 4 and 5 then are one method, for e^F cancels.  `form="one-shot"` is the papers' own: see
`gaussian/one_shot.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import sympy as sp

from zakai.algebra.exact_theorems import hu_yau as condition
from zakai.algebra.gauges import affine_system
from zakai.algebra.identities import all_zero
from zakai.errors import InputError
from zakai.methods._options import one_of, real_number
from zakai.methods._protocol import Info, Method, through
from zakai.methods.gaussian import families, one_shot
from zakai.methods.gaussian.affine_system import AffineSystem
from zakai.methods.gaussian.backward import BACKWARD
from zakai.models.features import INPUTS
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.flow import Coefficients
from zakai.numerics.gaussian.exponents import Exponents
from zakai.numerics.transition import Array, symmetric, transposed
from zakai.records.schedule import Schedule

THEOREMS = ("theorem-4", "theorem-5", "theorem-6", "survey-1")


class WithoutDrift(AffineSystem):
    """The equation of e^S v with G grad S = -(L x + l): no drift, and the potential -(q + (L x + l)'G^-1 (L x + l) - tr L)/2."""

    def coefficients(
        self, times: Array, theta: Array, origin: Array, inside: Array, u: Array | None = None
    ) -> Coefficients:
        """Return the coefficients at times (J,)."""
        c = super().coefficients(times, theta, origin, inside, u)
        n, first = c.matrix.shape[1], np.arange(c.constant.shape[1]) == 0
        slope = np.linalg.solve(c.covariance, np.concatenate([c.matrix, c.offset[:, :, :1]], axis=2))
        backward, end = transposed(c.matrix), slope[:, :, n:]
        trace = np.trace(c.matrix, axis1=1, axis2=2)
        energy = (transposed(c.offset[:, :, :1]) @ end)[:, 0, 0]
        return Coefficients(
            0.0 * c.matrix,
            0.0 * c.offset,
            c.covariance,
            c.quadratic - 0.5 * backward @ slope[:, :, :n],
            c.linear - backward @ end * first,
            c.constant + 0.5 * (trace - energy)[:, None] * first,
        )

    def quadratic(self, theta: Array, origin: Array) -> tuple[Array, Array] | None:
        """Return K (n, n) and k (n,) of S = -x'K x / 2 - k.x; the coefficients are constant."""
        L, l, G, *_ = self.letters(np.zeros(1), theta, origin)
        slope = np.linalg.solve(G[0], np.concatenate([L[0], l[0]], axis=1))
        return symmetric(slope[:, :-1]), slope[:, -1]


def prepare(
    model: Model, schedule: Schedule, theta: Array, *, form: str = "stepwise", theorem: str = "theorem-4", tolerance: float = 1e-6
) -> Any:
    """Return the transition of every interval.

    Args:
        model: A model for which the theorem holds.
        schedule: The intervals.
        theta: The parameters (p,).
        form: "stepwise", or "one-shot" from the start on, which is refused once eps exp(2 mu t), its error relative to the size
            of the statistics, exceeds `tolerance`, mu being their largest growth rate; the error in nats is
            `health["lost_digits"]`.
        theorem: Whose S, H and P are used: "theorem-4", "theorem-5", "theorem-6" or "survey-1".
        tolerance: Bound on the error of "one-shot".

    Raises:
        InputError: an option does not fit.
    """
    one_of("form", form, ("stepwise", "one-shot"))
    one_of("theorem", theorem, THEOREMS)
    real_number("tolerance", tolerance, "a positive number", lambda value: value > 0)
    _check_theorem(model, theorem, np.asarray(theta).real)
    kind = WithoutDrift if theorem == "theorem-6" else AffineSystem
    if form == "stepwise":
        return families.prepare(model, schedule, theta, kind)
    return one_shot.prepare(model, schedule, theta, kind, tolerance)


def _check_theorem(model: Model, theorem: str, theta: Array) -> None:
    system = affine_system(model)
    assert system is not None
    G, form = model.covariance, system[0]
    if theorem == "survey-1" and all_zero(list(G - sp.eye(model.n))) is not True:
        raise InputError(
            f'{model.source}: option theorem: "survey-1" is stated for G = I, but G = {G.tolist()}; take "theorem-5"'
        )
    if theorem == "theorem-6":
        varying = any(entry.free_symbols & {model.t, *model.u} for entry in (*G, *form.matrix, *form.offset))
        entries = np.eye(model.n) if varying else numpy_function(G, model, G.shape)(np.zeros(model.n), model.start, theta)
        if np.linalg.matrix_rank(entries) < model.n:
            raise InputError(f'{model.source}: option theorem: "theorem-6" needs a G that has an inverse; take "theorem-4"')
        # G^-1 D is symmetric if and only if D G is.
        product = form.matrix * G
        if all_zero(list(product - product.T)) is not True or varying:
            raise InputError(
                f'{model.source}: option theorem: "theorem-6" needs constant coefficients and a symmetric G^-1 D; '
                'take "theorem-4"'
            )


def step(prepared: families.Prepared, k: int, state: families.State, values: Array) -> tuple[families.State, Info]:
    """Advance one interval; nothing cancels in the stepwise form."""
    state, info = families.step(prepared, k, state, values)
    return state, info._replace(health={"lost_digits": 0.0, **info.health})


def smoothed(prepared: families.Prepared, state: families.State, later: Exponents) -> tuple[Exponents, Info]:
    """Return the message normalised, and the smoothed moments."""
    later, info = BACKWARD.smoothed(prepared, state, later)
    return later, info._replace(health={"lost_digits": 0.0, **info.health})


def variant(model: Model, options: Mapping[str, Any]) -> Method[Any, Any]:
    """Return the method in the form of its options."""
    return ONE_SHOT if options["form"] == "one-shot" else METHOD


BOUNDS: Mapping[str, tuple[float, str]] = {
    **families.BOUNDS,
    "lost_digits": (1e-6, 'rounding of the evidence in nats, as the statistics of one shot cancel; take form="stepwise"'),
}

STEPWISE = replace(BACKWARD, smoothed=smoothed, segment=None)
METHOD: Method[Any, Any] = Method(
    name="hu-yau",
    source="Hu and Yau 2002, Theorems 3 to 6, corrected; any prior: Makowski 1986",
    exactness="exact for y that is linear between observations, and for samples; the prior to 1e-12",
    theorem=condition,
    options={"form": "stepwise", "theorem": "theorem-4", "tolerance": 1e-6},
    prepare=prepare,
    init=families.init,
    step=step,
    density=families.density,
    state=families.State,
    bounds=BOUNDS,
    variant=variant,
    valid=families.valid,
    handles=frozenset({INPUTS}),
    backward=STEPWISE,
)
ONE_SHOT = replace(
    METHOD, init=one_shot.init, step=one_shot.step, density=one_shot.density, state=one_shot.State, absolute=True, valid=None,
    backward=through(
        lambda prepared: (STEPWISE, prepared.base),
        one_shot.stepwise,
        lambda prepared, state, health: {**health, "lost_digits": one_shot.rounding(prepared, state)},
    ),
)  # fmt: skip
