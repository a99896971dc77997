"""The gauge e^phi of a Yau system as the exact filters use it: a sum of exponentials, or a function of one or two directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy as sp
from sympy.functions.elementary.hyperbolic import HyperbolicFunction

from zakai.algebra._readable import tidy
from zakai.algebra.affine import affine
from zakai.algebra.identities import is_zero
from zakai.algebra.quadratics import Quadratic, decided_q
from zakai.algebra.tower import OutOfBounds
from zakai.algebra.yau import YauForm, affine_drift, yau_decision, yau_form
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function

_MOST_TERMS = 32


@dataclass(frozen=True)
class Gauge:
    """e^phi of the Yau form `form`, a function of `directions` x (k, n) alone.

    Where e^phi = sum_j e^{c_j + q_j.x}, `logs` c (K, 1) and `slopes` q (K, n) are given, else None.
    """

    form: YauForm
    directions: sp.ImmutableMatrix
    logs: sp.ImmutableMatrix | None
    slopes: sp.ImmutableMatrix | None

    @property
    def is_log_cosh(self) -> bool:
        """Whether phi = log cosh(q.x + delta) but for an affine function, which may as well be part of l: two exponentials."""
        return self.slopes is not None and self.slopes.rows == 2


@once_for_a_model
def affine_system(model: Model) -> tuple[YauForm, Quadratic | None] | None:
    """Return the Yau form with -q/2 without the observation's energy, where that is quadratic; None without a Yau form.

    An affine drift has one whatever other features the model has.
    """
    drift = affine_drift(model)
    if drift.slope is not None and drift.intercept is not None:
        zero = sp.ImmutableMatrix.zeros(model.n, 1)
        form = YauForm(drift.slope, drift.intercept, sp.Integer(0), zero, zero)
        return form, Quadratic(sp.ImmutableMatrix.zeros(model.n, model.n), zero, -drift.slope.trace())
    found = yau_form(model)
    return (found, decided_q(model, False).quadratic) if isinstance(found, YauForm) else None


@once_for_a_model
def gauge(model: Model) -> Gauge | None:
    """The gauge of a model with a Yau form, or None where phi depends on more than two directions."""
    system = affine_system(model)
    assert system is not None
    form = system[0]
    if not form.curved:
        none, flat = sp.ImmutableMatrix.zeros(0, model.n), sp.ImmutableMatrix.zeros(1, model.n)
        return Gauge(form, none, sp.ImmutableMatrix([0]), flat)
    terms = None if form.potential is None else exponential_terms(form.potential, model)
    if terms is not None:
        logs, slopes = terms
        rows = _independent(slopes, model)
        return None if len(rows) > 2 else Gauge(form, slopes.extract(rows, range(model.n)), logs, slopes)
    directions = _directions(form, model)
    return None if directions is None else Gauge(form, directions, None, None)


Terms = dict[tuple[sp.Expr, ...], sp.Expr]


def exponential_terms(potential: sp.Expr, model: Model) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix] | None:
    """Return c (K, 1) and q (K, n) with e^phi = sum_j e^{c_j + q_j.x}, None where it is no such sum of positive terms."""
    terms = _exponentials(potential, model.x)
    if terms is None:
        return None
    factors = [_without_exponential(coefficient) for coefficient in terms.values()]
    if not _positive(sp.ImmutableMatrix([number for number, _ in factors]), model):
        return None
    logs = sp.ImmutableMatrix([sp.log(number) + exponent for number, exponent in factors])
    return logs, sp.ImmutableMatrix([list(slope) for slope in terms])


def _exponentials(potential: sp.Expr, x: tuple[sp.Symbol, ...]) -> Terms | None:
    """e^phi as {slope: coefficient}, or None where it is no finite sum of exponentials of affine forms."""
    product: Terms = {(sp.Integer(0),) * len(x): sp.Integer(1)}
    powers: list[tuple[Terms, sp.Expr]] = []
    for term in sp.Add.make_args(sp.expand(potential, log=False, power_base=False)):
        logs = [factor for factor in sp.Mul.make_args(term) if isinstance(factor, sp.log) and factor.has(*x)]
        factor = _sum_of_exponentials(logs[0].args[0] if logs else sp.exp(term), x)
        count = tidy(term / logs[0]) if logs else sp.Integer(1)
        if factor is None or len(logs) > 1 or count.has(*x):
            return None
        if logs:
            factor = _gathered(powers, factor, count)
        product = _product(product, factor)
    for factor, count in powers:
        while not count.is_Integer and (root := _square_root(factor)) is not None:
            factor, count = root, tidy(2 * count)
        if not count.is_Integer or not 0 <= count <= _MOST_TERMS:
            return None
        for _ in range(int(count)):
            if len(product) * len(factor) > 4 * _MOST_TERMS:
                return None
            product = _product(product, factor)
    return product if len(product) <= _MOST_TERMS else None


def _square_root(terms: Terms) -> Terms | None:
    """a e^{u.x} + b e^{v.x} with a, b > 0, if its square is given, as 1 + cosh(2 x) is that of sqrt(2) cosh(x)."""
    for slope, middle in terms.items() if len(terms) == 3 else ():
        (one, first), (two, second) = ((other, c) for other, c in terms.items() if other != slope)
        between = all(is_zero(a + b - 2 * s) is True for a, b, s in zip(one, two, slope, strict=True))
        if between and is_zero(middle - 2 * sp.sqrt(first) * sp.sqrt(second)) is True:
            return {tuple(e / 2 for e in outer): sp.sqrt(c) for outer, c in ((one, first), (two, second))}
    return None


def _gathered(powers: list[tuple[Terms, sp.Expr]], terms: Terms, count: sp.Expr) -> Terms:
    """Count `terms`^count with the powers of the same sum but for one exponential; that exponential's power is given back.

    An integral of a quotient of exponentials comes as log(1 + e^-2x)/2 + log(1 + e^2x)/2, which is log(1 + e^2x) - x.
    """
    first = next(iter(terms))
    for index, (known, before) in enumerate(powers):
        for key in known if len(known) == len(terms) else ():
            shift = [a - b for a, b in zip(key, first, strict=True)]
            shifted = {tuple(sp.expand(a + b) for a, b in zip(slope, shift, strict=True)): c for slope, c in terms.items()}
            ratio = terms[first] / known[key]
            if shifted.keys() == known.keys() and all(is_zero(shifted[slope] - ratio * known[slope]) is True for slope in known):
                powers[index] = known, tidy(before + count)
                return {tuple(sp.expand(-count * entry) for entry in shift): ratio**count}
    powers.append((terms, count))
    return {(sp.Integer(0),) * len(first): sp.Integer(1)}


def _sum_of_exponentials(expression: sp.Expr, x: tuple[sp.Symbol, ...]) -> Terms | None:
    found: Terms = {}
    # Only what contains x: a sine of t would become complex exponentials.
    plain = expression.replace(lambda e: isinstance(e, HyperbolicFunction) and e.has(*x), lambda e: e.rewrite(sp.exp, deep=False))
    for term in sp.Add.make_args(sp.expand(plain, power_exp=False)):
        slope, coefficient = sp.zeros(len(x), 1), sp.Integer(1)
        for factor in sp.Mul.make_args(term):
            if not factor.has(*x):
                coefficient *= factor
                continue
            parts = affine(sp.Matrix([factor.args[0]]), x) if isinstance(factor, sp.exp) else None
            if parts is None or parts.slope is None or parts.intercept is None:
                return None
            slope += parts.slope.T
            coefficient *= sp.exp(parts.intercept[0])
        key = tuple(sp.expand(entry) for entry in slope)
        found[key] = found.get(key, sp.Integer(0)) + coefficient
    return found


def _product(a: Terms, b: Terms) -> Terms:
    out: Terms = {}
    for p, c in a.items():
        for q, d in b.items():
            key = tuple(sp.expand(i + j) for i, j in zip(p, q, strict=True))
            out[key] = out.get(key, sp.Integer(0)) + c * d
    return out


def _without_exponential(coefficient: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """The coefficient as number e^exponent, lest an exponential of time be evaluated where it over- or underflows."""
    split = []
    for term in sp.Add.make_args(sp.expand(coefficient)):
        number, exponent = sp.Integer(1), sp.Integer(0)
        for factor in sp.Mul.make_args(term):
            base, power = factor.as_base_exp()
            number, exponent = (number, exponent + power) if base == sp.E else (number * factor, exponent)
        split.append((number, exponent))
    first = split[0][1]
    return sp.Add(*[number * sp.exp(sp.expand(exponent - first)) for number, exponent in split]), first


def _positive(coefficients: sp.MatrixBase, model: Model) -> bool:
    """Whether all are positive, at the start and at times after it."""
    times = model.start + np.concatenate([[0.0], np.geomspace(1e-3, 1e2, 20)])
    with np.errstate(all="ignore"):
        values = numpy_function(coefficients, model, coefficients.shape)(np.zeros(model.n), times, model.theta())
    return bool(np.all(values[..., :] > 0))


def _independent(slopes: sp.MatrixBase, model: Model) -> list[int]:
    """The rows of a basis of the span of all slopes, at the start."""
    values = numpy_function(slopes, model, slopes.shape)(np.zeros(model.n), model.start, model.theta())
    rows: list[int] = []
    for i in range(len(values)):
        if np.linalg.matrix_rank(values[[*rows, i]]) > len(rows):
            rows.append(i)
    return rows


def _directions(form: YauForm, model: Model) -> sp.ImmutableMatrix | None:
    """One or two directions on which phi depends: a common one of its gradient, or coordinates."""
    used = [i for i, entry in enumerate(form.gradient) if entry != 0]
    ratios = _ratios(model) if model.n > 1 else [sp.Integer(1)]
    if ratios is not None:
        return sp.ImmutableMatrix([ratios])
    if len(used) <= 2:
        return sp.ImmutableMatrix(sp.eye(model.n).extract(used, range(model.n)))
    return None


def _ratios(model: Model) -> list[sp.Expr] | None:
    """Return a direction that the gradient of phi always has, as ratios to its first entry, or None."""
    proof = yau_decision(model).proof
    if proof is None:
        return None
    T = proof.reader
    T.begin()
    try:
        below = next(p for p in proof.p if p).inverse()
        ratios = [p * below for p in proof.p]
        still = not any(T.diff(ratio, s) for ratio in ratios for s in model.x)
        return [T.expression(ratio) for ratio in ratios] if still else None
    except OutOfBounds:
        return None
