"""The formulas of a model with one state as functions of points and times, with its inputs."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.methods.system.outside_tables import OutsideTables
from zakai.models.angles import without_branch
from zakai.models.features import CROSS_NOISE, OF_OBSERVATION, STATE_DEPENDENT_DIFFUSION
from zakai.models.functions import Floor, Maximum, Minimum, TableFunction
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.models.prior import GaussianPrior, MixturePrior
from zakai.numerics.arrays import Array
from zakai.records.inputs import Inputs

Function = Callable[..., Array]

_JUMPS = (sp.sign, sp.Heaviside, Floor, sp.atan2)
_KINKS = (sp.Abs, Minimum, Maximum)


class Formulas(NamedTuple):
    """Functions of x (..., 1), t (...), theta (p,) and the inputs; None where a derivative is not that of a smooth function.

    `slope` is f', `spread` G' and G''; `cross` is g C with its derivative and h' (3, m), None for independent noises.
    `separated` are the functions a (R,) of t and g (R, 2 + m) of x with (f, f', h) = sum a_r g_r; `kinks` (K,) are zero where
    f, G or an h that acts within intervals has a kink or a jump.  `polynomials` (D, R) are the coefficients of the factors a, the
    highest power of t first, None unless all coefficients in time that act within an interval are polynomials of t of degree five
    at most: the six Gauss nodes resolve them.
    """

    drift: Function
    slope: Function | None
    covariance: Function
    spread: Function | None
    observation: Function
    noise: Function
    cross: Function | None
    outside: OutsideTables
    separated: tuple[Function, Function] | None
    kinks: Function | None
    polynomials: Function | None


@once_for_a_model
def _formulas(model: Model) -> Formulas:
    """Return the functions of a model, made once."""
    x, m = model.x[0], model.m
    f, G, h = model.drift[0], model.covariance[0], list(model.observation)
    joint = list(model.diffusion * model.cross_noise) if CROSS_NOISE in model.features else []
    cross = [*joint, *[sp.diff(entry, x) for entry in [*joint, *h]]]
    terms = _separated(model)
    return Formulas(
        numpy_function(model.drift, model, (1,)),
        numpy_function([sp.diff(f, x)], model, (1,)) if _continuous(f, x) else None,
        numpy_function(model.covariance, model, (1, 1)),
        numpy_function([sp.diff(G, x), sp.diff(G, x, 2)], model, (2,)) if _continuous(G, x) and not _rough(G, x) else None,
        numpy_function(model.observation, model, (m,)),
        numpy_function(model.observation_noise, model, (m, m)),
        numpy_function(cross, model, (3, m)) if joint else None,
        OutsideTables(model),
        None if terms is None else (
            numpy_function(list(terms), model, (len(terms),)), numpy_function(_terms_of_x(terms, x), model, (len(terms), 2 + m))
        ),
        numpy_function(roots, model, (len(roots),)) if (roots := _roots(model)) else None,
        _polynomials(model, list(terms)) if terms is not None and _resolved(model, [*terms, G]) else None,
    )


def _roots(model: Model) -> list[sp.Expr]:
    """Return functions of x alone that are zero where f, G, or an h that acts within intervals, has a kink or a jump.

    The h of samples counts where it jumps. Where there are such functions, those of its kinks follow.
    """
    dynamics, h = [model.drift[0], model.covariance[0]], without_branch(model)
    samples = model.observation_kind == "samples"
    result = _zeros(model, dynamics if samples else [*dynamics, *model.observation])
    if samples and not model.periodic and (not model.domain or _reflecting(model)):
        result |= _zeros(model, h, _JUMPS)
    return sorted(result | _zeros(model, [*dynamics, *h]), key=str) if result else []


def _reflecting(model: Model) -> bool:
    return any(interval.reflecting for interval in model.domain.values())


def _zeros(model: Model, formulas: list[sp.Expr], calls: tuple[Any, ...] = (*_JUMPS, *_KINKS, TableFunction)) -> set[sp.Expr]:
    """Return functions of x alone that are zero where formulas have a kink or a jump, by some of the functions that have any."""
    x, given = model.x[0], {model.t, *model.u}
    result: set[sp.Expr] = set()
    for part in formulas:
        for call in part.atoms(*calls):
            first = call.args[0]
            if isinstance(call, (Minimum, Maximum)):
                result.add(first - call.args[1])
            elif isinstance(call, Floor):
                result.add(sp.sin(sp.pi * first))
            elif isinstance(call, TableFunction):
                if call.table.degree == 1 and len(call.args) == 1 and not call.table.periodic:
                    result.update(first - sp.Float(node, 17) for node in call.table.axes[0])
            else:
                result.add(first)
    return {root for root in result if root.has(x) and not root.free_symbols & given}


def _separated(model: Model) -> dict[sp.Expr, list[sp.Expr]] | None:
    """Return the factors in t of f and h, and the functions of x that they multiply, None where none are shown."""
    x, given = model.x[0], {model.t, *model.u}
    terms: dict[sp.Expr, list[sp.Expr]] = {}
    for row, formula in enumerate([model.drift[0], *model.observation]):
        for form in (formula, sp.expand(_added(formula, model), power_exp=False, power_base=False, log=False)):
            pairs = [term.as_independent(x, as_Add=False) for term in sp.Add.make_args(form)]
            separable = not any(part.free_symbols & given for _, part in pairs)
            if separable:
                break
        if not separable:
            return None
        for factor, part in pairs:
            factor, part = (factor, part) if factor.free_symbols & given else (sp.Integer(1), factor * part)
            terms.setdefault(factor, [sp.Integer(0)] * (1 + model.m))[row] += part
    if len(terms) > _MOST_TERMS:
        return None
    return terms


def _terms_of_x(terms: dict[sp.Expr, list[sp.Expr]], x: sp.Symbol) -> sp.Matrix:
    """Return the parts of f, f' and h that the factors in t multiply."""
    return sp.Matrix([[row[0], sp.diff(row[0], x) if _continuous(row[0], x) else sp.nan, *row[1:]] for row in terms.values()])


def _resolved(model: Model, coefficients: list[sp.Expr]) -> bool:
    """Return whether coefficients, and S within intervals, are polynomials of t of degree five at most."""
    inside = [] if model.observation_kind == "samples" else list(model.observation_noise)
    varying = [part for part in coefficients if part.free_symbols & {model.t, *model.u}]
    steady = not any(part.free_symbols & {model.t, *model.u} for part in inside)
    return steady and all(
        not part.free_symbols & set(model.u) and part.is_polynomial(model.t) and sp.degree(part, model.t) <= 5 for part in varying
    )


def _polynomials(model: Model, factors: list[sp.Expr]) -> Function:
    """Return the coefficients of polynomials of t, the highest power of t first."""
    columns = [sp.Poly(factor, model.t).all_coeffs() for factor in factors]
    count = max(2, *map(len, columns))
    rows = [[column[i - count] if i >= count - len(column) else sp.Integer(0) for column in columns] for i in range(count)]
    return numpy_function(sp.Matrix(rows), model, (count, len(factors)))


_MOST_TERMS = 8
MOST_PIECES = 8  # formulas with a kink


def _added(formula: sp.Expr, model: Model) -> sp.Expr:
    """Return a formula with sin(a + b) and cos(a + b), a of x alone and b of t and inputs, by the theorem of addition."""
    x, given, known = model.x[0], {model.t, *model.u}, {}
    for call in formula.atoms(sp.sin, sp.cos):
        b, a = call.args[0].as_independent(x, as_Add=True)
        if a != 0 and b.free_symbols & given and not a.free_symbols & given:
            turned = sp.sin(a) * sp.cos(b) + sp.cos(a) * sp.sin(b), sp.cos(a) * sp.cos(b) - sp.sin(a) * sp.sin(b)
            known[call] = turned[0 if isinstance(call, sp.sin) else 1]
    return formula.xreplace(known)


def _continuous(formula: sp.Expr, x: sp.Symbol) -> bool:
    return not any(part.has(x) for part in formula.atoms(*_JUMPS))


def _rough(formula: sp.Expr, x: sp.Symbol) -> bool:
    """Return whether the derivative of a formula may jump."""
    linear = any(part.table.degree == 1 and part.has(x) for part in formula.atoms(TableFunction))
    return linear or any(part.has(x) for part in formula.atoms(*_KINKS))


@once_for_a_model
def in_pieces(model: Model) -> bool:
    """Return whether densities of a state are polynomials between ends and kinks.

    That is where ends reflect, and where f, G, an h that acts within intervals or the h of samples has jumps, or one of the first
    three kinks; but for a continuous f without time between samples of a continuous h, for which a uniform grid is as accurate.
    """
    if _reflecting(model):
        return True
    roots = _roots(model)
    if model.n > 1 or model.domain or model.periodic or not 0 < len(roots) <= MOST_PIECES or not _few(model, roots):
        return False
    f, G, x = model.drift[0], model.covariance[0], model.x[0]
    steady = model.observation_kind == "samples" and not (f.free_symbols | G.free_symbols) & {model.t, *model.u}
    return not (steady and all(_continuous(part, x) for part in (f, G, *without_branch(model))) and not _rough(G, x))


MOST_KINKS = 128  # in an interval between which a density is a polynomial
KINK_PROBES = 1025  # points between which kinks are sought
ONE_KINK = 1e-10  # distance, of the interval, of the kinks of two coefficients that are one
_PLACES = 4099  # where roots are sought: distances that differ show those of a period as well


def _few(model: Model, roots: list[sp.Expr]) -> bool:
    """Return whether roots are few where the prior is: those of fine quantisation are not."""
    if not isinstance(model.prior, GaussianPrior | MixturePrior):
        return True
    _, means, covs = model.prior.components
    reach = 6.0 * np.sqrt(covs[:, 0, 0])
    low, high = float(np.min(means[:, 0] - reach)), float(np.max(means[:, 0] + reach))
    x = low + (high - low) * np.sort(np.arange(1, _PLACES) * 0.6180339887498949 % 1.0)
    negative = numpy_function(roots, model, (len(roots),))(x[:, None], model.start, model.theta()) < 0
    return int(np.sum(negative[1:] != negative[:-1])) <= MOST_KINKS


class System:
    """The formulas of a model with one state as functions of points, times and parameters; `inputs` are those of a record."""

    def __init__(self, model: Model):
        x, given = model.x[0], {model.t, *model.u}
        self.model, self.m = model, model.m
        self.samples = model.observation_kind == "samples"
        self._bind(None)
        # Whether G depends on the state, and whether samples have a law that is not N(h, S(t)).
        self.state_dependent = STATE_DEPENDENT_DIFFUSION in model.features
        self.reflecting = _reflecting(model)
        self.general = bool(OF_OBSERVATION & model.features.keys())
        # Whether h, or the law of what is observed, has no jump and no kink.
        law = [*without_branch(model), *([] if model.log_density is None else [model.log_density])]
        self.smooth_observation = not any(not _continuous(part, x) or _rough(part, x) for part in law)
        # Whether h has kinks, or jumps at which a density is not divided.
        self.kinked_observation = not self.smooth_observation
        self.jumping_observation = not all(_continuous(part, x) for part in without_branch(model))
        self.kinked_drift = self.slope is not None and _rough(model.drift[0], x)
        self.rough = any(not _continuous(part, x) or _rough(part, x) for part in (model.drift[0], model.covariance[0]))
        self.moving = bool((model.drift.free_symbols | model.covariance.free_symbols) & given)
        self.steady_observation = not model.observation.free_symbols & given
        self.steady_covariance = not model.covariance.free_symbols & given
        self.steady_noise = not model.observation_noise.free_symbols & given
        self.steady_cross = not (model.diffusion.free_symbols | model.cross_noise.free_symbols) & given
        # Whether the equation of an interval has constant coefficients, and whether they need not be computed for each.
        steady_noises = self.steady_observation and self.steady_noise and self.steady_cross
        self.steady = not self.moving and (self.samples or steady_noises)
        self.varying = not self.steady or self.cross is not None

    def given(self, inputs: Inputs | None) -> System:
        """Return the same with the inputs of a record."""
        if inputs is None:
            return self
        result = copy(self)
        result._bind(inputs)
        return result

    def _bind(self, inputs: Inputs | None) -> None:
        self.inputs, formulas = inputs, _formulas(self.model)
        self.drift, self.covariance = self._bound(formulas.drift), self._bound(formulas.covariance)
        self.observation, self.noise = self._bound(formulas.observation), self._bound(formulas.noise)
        self.slope, self.spread = self._optional(formulas.slope), self._optional(formulas.spread)
        self.cross, self.kinks = self._optional(formulas.cross), self._optional(formulas.kinks)
        self.separated = None if formulas.separated is None else (self._bound(formulas.separated[0]), formulas.separated[1])
        self.polynomials, self.resolved = formulas.polynomials, formulas.polynomials is not None
        self.tabulated, self._outside = bool(formulas.outside), self._bound(formulas.outside)

    def _bound(self, function: Function) -> Function:
        """Return a function of points, times and parameters alone."""
        inputs, hold = self.inputs, self.model.input_hold
        if inputs is None:
            return function

        def bound(x: Array, t: Array, theta: Array) -> Array:
            return function(x, t, theta, inputs.at(t, hold))

        return bound

    def _optional(self, function: Function | None) -> Function | None:
        return None if function is None else self._bound(function)

    def inputs_at(self, t: float) -> Array | None:
        """Return the inputs at a time."""
        return None if self.inputs is None else self.inputs.at(t, self.model.input_hold)

    def pieces(self, start: float, stop: float) -> list[tuple[float, float]]:
        """Return the parts of an interval in which the inputs have no jump and no kink."""
        if self.inputs is None:
            return [(start, stop)]
        times = [start, *self.inputs.within(start, stop).tolist(), stop]
        return list(zip(times[:-1], times[1:], strict=True))

    def kinks_between(self, lower: float, upper: float, t: float, theta: Array) -> Array:
        """Return the states between two, in increasing order, where coefficients have kinks or jumps; none if these are many."""
        if self.kinks is None:
            return np.zeros(0)
        x = np.linspace(lower, upper, KINK_PROBES)
        negative = self.kinks(x[:, None], t, theta) < 0
        at, which = np.nonzero(negative[1:] != negative[:-1])
        if len(at) > MOST_KINKS:
            return np.zeros(0)
        low, high, left = x[at], x[at + 1], negative[at, which]
        for _ in range(60):
            middle = 0.5 * (low + high)
            same = (self.kinks(middle[:, None], t, theta)[np.arange(len(at)), which] < 0) == left
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        found = np.sort(0.5 * (low + high))
        return found[np.diff(found, prepend=-np.inf) > ONE_KINK * (upper - lower)]

    def outside(self, points: Array, t: float, theta: Array) -> Array:
        """Return which points (N,) lead beyond the range of a table."""
        return self._outside(points[:, None], t, theta)


@once_for_a_model
def system_of(model: Model) -> System:
    """Return the formulas of a model, made once."""
    return System(model)


def within(times: Array, start: Array | float, stop: Array | float) -> Array:
    """Return times of a piece, in which the end counts as the limit from inside."""
    return np.minimum(np.maximum(times, start), np.nextafter(stop, start))


def finite(values: Array) -> Array:
    """Return the values with zero where a formula has no value."""
    return np.where(np.isfinite(values.real), values, 0.0)
