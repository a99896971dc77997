"""One state with a domain: natural ends, the tests of Feller, what a grid loses there, and paths that reach infinity.

Between natural ends the equation is solved for a variable w on the whole line,

    x = lower + e^w,    x = upper - e^-w,    x = lower + (upper - lower) / (1 + e^-w).

By Ito's formula w has the drift f / x' - G x'' / (2 x'^3) and the diffusion g / x'.  A natural end is not reached, so that the
density of w is negligible far out.

Feller's tests: near an end, at the distance d, let the drift away from it be f and G = g^2 ~ d^k.  With kappa = 2 f d / G at d
-> 0 the end is reached if kappa < 1 and G / d^2 -> oo, or without noise to speak of if f / d -> -oo.  Where it is reached, a
process can be reflected if its speed measure is finite, kappa > k - 1; elsewhere it is absorbed, and part of its law is a point
mass at the end.

The leak: outside of a grid the density is zero, so that the grid absorbs the paths that leave it.  Paths come as near as d with
a probability ~ d^(kappa - 1), and the density of log d is ~ d^(kappa + 1 - k).  A grid that ends where that density is e loses
about

    e^p,    p = (kappa - 1) / (kappa + 1 - k).

At the limit of Feller, kappa = 1, that is no small number for any e.  Panels without flux at their ends lose nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import sympy as sp

from zakai.densities.mapped import IntervalMap
from zakai.errors import InputError
from zakai.methods.line.coefficients import covariance_at
from zakai.methods.line.prepared import Prepared
from zakai.methods.system.escape import Density, Motion, check_one_state, divisors_of
from zakai.models.domain import Interval
from zakai.models.kept import kept, once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.arrays import Array
from zakai.numerics.line import window as lw
from zakai.numerics.line.resolution import RESOLVED, SUPPORT, TRANSITION_SHARE

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

    def transformed(formula: sp.Expr, factor: sp.Expr | int = 1, more: sp.Expr | int = 0) -> sp.Expr:
        return sp.powsimp(arranged(formula.subs(w, x) * factor + more))

    def matrix(formulas: sp.MatrixBase, factor: sp.Expr | int = 1) -> sp.ImmutableMatrix:
        return sp.ImmutableMatrix(formulas.applyfunc(lambda entry: transformed(entry, factor)))

    ito = -model.covariance[0, 0].subs(w, x) * second / (2 * first**3)
    other = object.__new__(Model)
    vars(other).update({key: value for key, value in vars(model).items() if key not in _DERIVED})
    vars(other).update(
        domain={},
        prior=None,
        drift=sp.ImmutableMatrix([[transformed(model.drift[0], 1 / first, ito)]]),
        diffusion=matrix(model.diffusion, 1 / first),
        observation=matrix(model.observation),
        observation_noise=matrix(model.observation_noise),
        family_parameters={key: transformed(value) for key, value in model.family_parameters.items()},
        log_density=None if model.log_density is None else transformed(model.log_density),
    )
    return other


def reflecting_ends(prepared: Prepared) -> tuple[float, float]:
    """Return the ends of the domain where these reflect, else infinite ones."""
    domain = prepared.model.domain.get(prepared.model.state[0], Interval())
    return (domain.lower, domain.upper) if prepared.system.reflecting else (-np.inf, np.inf)


NEAR_END = 1e-9  # distance from an end other than zero, relative to it and to the length of the domain
NEAR_ZERO = 1e-40  # distance from zero, near which numbers have no rounding of their own
RATIO_OF_DISTANCES = 1e3  # ratio of the two distances that show a power
GROWS = 1.5  # ratio of values there that have no finite limit
EXACT = 1e-5  # by which kappa may miss its limit


def check_ends(model: Model, theta: Array, inputs: Array | None) -> None:
    """Raise InputError where the law of the state has no density between the ends of its domain.

    Args:
        model: One state, with or without a domain.
        theta: The parameters (p,).
        inputs: The values (T, number of inputs) of the known inputs, None where there are none.
    """
    interval = model.domain.get(model.state[0])
    if interval is None or (model.inputs and inputs is None):
        return
    u = None if inputs is None else np.unique(inputs, axis=0)

    def formulas() -> Callable[..., Array]:
        return numpy_function([model.drift[0], model.covariance[0, 0]], model)

    function = kept(model, check_ends, formulas)
    for end, side in ((interval.lower, 1.0), (interval.upper, -1.0)):
        if not np.isfinite(end):
            continue
        scale = abs(end) if not interval.bounded else max(abs(end), interval.upper - interval.lower)
        near = end + side * np.array([RATIO_OF_DISTANCES, 1.0]) * (NEAR_ZERO if end == 0 else NEAR_END * scale)
        d = np.abs(near - end)
        with np.errstate(all="ignore"):
            values = function(near[:, None], model.start, theta.real, None if u is None else u[:, None]).reshape(-1, 2, 2)
            f, G = side * values[..., 0].real, values[..., 1].real
            if not (np.isfinite(values).all() and (G > 0).all()):
                continue
            kappa, k = 2 * f * d / G, np.log(G[:, 0] / G[:, 1]) / np.log(d[0] / d[1])
            noisy, driven = (np.abs(a[:, 1]) > GROWS * np.abs(a[:, 0]) for a in (G / d**2, f / d))
        # A drift towards the end whose kappa grows without limit outweighs the noise.
        reached = (noisy & (kappa[:, 1] < 1 - EXACT)) | (driven & (f[:, 1] < 0))
        absorbed = reached & ((kappa[:, 1] < k - 1 + EXACT) | ~noisy)
        name = f"{model.source}: domain: the process reaches the end {end:g} of {model.state[0]!r}"
        if absorbed.any():
            raise InputError(
                f"{name} and is absorbed there, so that its law has no density; a drift away from that end keeps it inside"
            )
        if reached.any() and not interval.reflecting:
            raise InputError(
                f'{name}; give boundary = "reflecting", by which it returns at once'
                + (f": 2 f / (g^2)' = {kappa[:, 1].min():.3g} there is less than 1" if k[0] > 0.5 else "")
            )


FAR_DISTANCES = np.array([10.0, 20.0])  # logarithms of distances at which coefficients are powers of the distance
NOISE_GROWS = 0.1  # exponent of the noise below which it does not grow towards an end


def ends_of_leak(prepared: Prepared, window: lw.Window, ends: Array, start: float, length: float) -> Array | None:
    """Return offsets (2,) beyond which there is no density after an interval, None where a grid loses no more than is allowed.

    Args:
        ends: the ends of the density as offsets from the origin (2,).
        start, length: the interval.
    """
    variable = variable_of(prepared.model)
    if variable is None:
        return None
    system, theta = prepared.system, prepared.theta.real
    result, leaking = np.array(ends, float), False
    for i, (own, end, side) in enumerate(zip((variable.lower, variable.upper), ends, (-1.0, 1.0), strict=True)):
        points = window.origin + float(end) + side * np.concatenate([[0.0], FAR_DISTANCES])
        drift = system.drift(points[:, None], start, theta)[:, 0].real
        noise = covariance_at(system, points, start, theta).real * np.ones(3)
        # The noise at the end of the density counts, by which it may reach the end of the domain.
        if not np.isfinite(own) or not noise[0] * length * SUPPORT**2 > 1.0 or not (np.isfinite(drift) & (noise > 0)).all():
            continue
        grows = float(np.log(noise[2] / noise[1]) / (FAR_DISTANCES[1] - FAR_DISTANCES[0]))  # 2 - k
        inward = max(float(-2.0 * side * drift[1] / noise[1]), 0.0)  # kappa - 1
        if grows > NOISE_GROWS and RESOLVED ** (inward / (inward + grows)) > TRANSITION_SHARE * prepared.tolerance:
            leaking = True
            result[i] += side * -np.log(RESOLVED) / (inward + grows)
    return result if leaking else None


def check_escape(prepared: Prepared, k: int, points: Array, values: Array) -> None:
    """Raise InputError where paths escape from a density in interval k; `values` (N,) are the probabilities of `points` (N,)."""
    model, length = prepared.model, float(prepared.lengths[k])
    if model.periodic or length <= 0:
        return
    system, variable = prepared.system, variable_of(model)
    start, theta = float(prepared.schedule.starts[k]), prepared.theta.real
    divisors = divisors_of(on_the_line(model))

    def at(t: Array | float) -> Array | None:
        return None if system.inputs is None else system.inputs_at(float(np.nextafter(start + t, start)))

    def coefficients(x: Array, t: float) -> tuple[Array, Array]:
        at_time = start + t
        f = system.drift(x[:, None], at_time, theta)[..., 0].real
        return f, np.broadcast_to(system.covariance(x[:, None], at_time, theta)[..., 0, 0].real, f.shape)

    # A natural end is not reached: that was checked.
    interval = model.domain.get(model.state[0], Interval())
    lower, upper = interval.lower, interval.upper
    if variable is not None:
        ends = -np.finfo(float).max, np.finfo(float).max
        lower, upper = (end if np.isfinite(own) else own for own, end in zip((lower, upper), ends, strict=True))
    motion = Motion(
        model, (lambda w: w) if variable is None else lambda w: float(variable.x(np.array([[w]])).item()),
        coefficients, None if divisors is None else lambda x: divisors(x[:, None], start + 0.5 * length, theta, at(0.5 * length)),
        lower, upper, k, start, length, not system.moving,
    )  # fmt: skip
    real = np.maximum(np.nan_to_num(values.real), 0.0)
    if real.sum() > 0:
        check_one_state(motion, Density(points, real / real.sum()))
