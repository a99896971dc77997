"""The Yau form of a drift, Wong's Omega, and the function q of a time-varying Yau system.

A drift has Yau form if f(x, t) = L(t) x + l(t) + G(t) grad phi(x, t).  With g = G^-1 f that is so if and only if Wong's
matrix omega_ij = d_i g_j - d_j g_i does not depend on x (Yau 1993, Theorem 1, for G = I).  Then u = e^phi v takes the
Kolmogorov equation to one whose drift is affine and whose potential is -q/2, with

    q = 2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L + h'S^-1 h.

The printed q (Chen, Luo and Yau 2017, (20)) lacks 2 phi_t and its Yau form (17) lacks the G before grad phi.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sp

from zakai.algebra._readable import readable, short
from zakai.algebra.grouping import MANY_TERMS, grouped, terms_of, tidy
from zakai.algebra.identities import is_zero
from zakai.models.features import INPUTS, JUMP_FUNCTIONS, of_dynamics
from zakai.models.model import Model

DEEPEST = 4  # functions inside of each other that are integrated


@dataclass(frozen=True)
class YauForm:
    """f = `matrix` x + `offset` + G grad `potential`: L (n, n), l (n, 1), phi; `gradient` is grad phi (n, 1)."""

    matrix: sp.ImmutableMatrix
    offset: sp.ImmutableMatrix
    potential: sp.Expr
    gradient: sp.ImmutableMatrix


@dataclass(frozen=True)
class NoYauForm:
    """Why no Yau form was found: `holds` is False if there is none, None if that is not known."""

    holds: bool | None
    evidence: str


def inverse(matrix: sp.MatrixBase) -> sp.MatrixBase:
    """The inverse, by cofactors and with tidied entries where they are not numbers."""
    if matrix.is_diagonal():
        return sp.diag(*[1 / entry for entry in matrix.diagonal()])
    if all(entry.is_Rational for entry in matrix):
        return matrix.inv()
    return matrix.inv(method="ADJ").applyfunc(tidy)


def wong_omega(model: Model) -> sp.Matrix | None:
    """Wong's matrix omega_ij = d_i g_j - d_j g_i with g = G^-1 f, or None where G is singular."""
    if of_dynamics(model) or is_zero(model.covariance.det()) is not False:
        return None
    g = inverse(model.covariance) * model.drift
    return curl(g, model.x)


def curl(field: sp.MatrixBase, x: tuple[sp.Symbol, ...]) -> sp.Matrix:
    """The matrix d_i field_j - d_j field_i, with what is provably zero set to zero."""
    n = len(x)
    omega = sp.zeros(n, n)
    for i in range(n):
        for j in range(i + 1, n):
            entry = sp.expand(sp.diff(field[j], x[i]) - sp.diff(field[i], x[j]))
            omega[i, j] = sp.Integer(0) if is_zero(entry) else tidy_state(entry, x)
            omega[j, i] = -omega[i, j]
    return omega


def tidy_state(expression: sp.Expr, x: tuple[sp.Symbol, ...]) -> sp.Expr:
    """Like terms in the state collected, with tidied coefficients."""
    return sp.Add(*[c * function for function, c in grouped(expression, x).items()])


def yau_form(model: Model) -> YauForm | NoYauForm:
    """The Yau form of the drift; affine parts, and quadratic parts of the potential, are kept in L and l."""
    x, n = model.x, model.n
    features = [words for feature, words in of_dynamics(model).items() if feature != INPUTS]
    if features:
        return NoYauForm(False, f"{'; '.join(features)}: the Yau form is for f(x, u, t) with g(u, t)")
    matrix, offset, rest = _affine_and_rest(model.drift, x)
    if all(term == 0 for term in rest):
        zero = sp.ImmutableMatrix.zeros(n, 1)
        return YauForm(sp.ImmutableMatrix(matrix), sp.ImmutableMatrix(offset), sp.Integer(0), zero)
    covariance, inputs = model.covariance, set(model.u)
    if driven := (covariance.free_symbols | rest.free_symbols) & inputs:
        return NoYauForm(False, f"phi would depend on the input {min(map(str, driven))}, and jump where it jumps")
    if is_zero(covariance.det()) is not False:
        return NoYauForm(False, "the drift is not affine and G is singular, so that G grad phi cannot be solved for phi")
    gradient = (inverse(covariance) * rest).applyfunc(lambda e: tidy_state(e, x))
    omega = curl(gradient, x)
    for i in range(n):
        for j in range(i + 1, n):
            for symbol in x:
                answer = is_zero(sp.diff(omega[i, j], symbol))
                if answer is not True:
                    what = f"omega_{i + 1}{j + 1} = {readable(omega[i, j])} depends on {symbol}"
                    return NoYauForm(answer, what if answer is False else f"it is not decided whether {what}")
    # A constant curl belongs to L: f contains -G omega x / 2.
    matrix = matrix - covariance * omega / 2
    gradient = gradient + omega * sp.Matrix(x) / 2
    potential = _potential(gradient, x)
    if potential is None:
        return NoYauForm(None, f"no closed form was found for phi with grad phi = {list(gradient)}")
    if jumps := potential.atoms(*JUMP_FUNCTIONS):
        return NoYauForm(False, f"phi contains {readable(min(jumps, key=str))}, and would jump in time")
    return YauForm(
        sp.ImmutableMatrix(matrix.applyfunc(tidy)),
        sp.ImmutableMatrix(offset.applyfunc(tidy)),
        potential,
        sp.ImmutableMatrix(gradient),
    )


def _affine_and_rest(field, x):
    """A field as matrix x + offset + rest, no term of the rest being affine."""
    n = len(x)
    matrix, offset, rest = sp.zeros(n, n), sp.zeros(n, 1), sp.zeros(n, 1)
    own = set(x)
    for i in range(n):
        constant, other = [], []  # added at once: of thousands of terms one by one each would be sorted into all before
        for function, coefficient in grouped(field[i], x).items():
            if function in own:
                matrix[i, x.index(function)] += coefficient
            elif own.isdisjoint(function.free_symbols):
                constant.append(coefficient * function)
            else:
                other.append(coefficient * function)
        offset[i], rest[i] = sp.Add(*constant), sp.Add(*other)
    return matrix, offset, rest


def _potential(gradient: sp.MatrixBase, x: tuple[sp.Symbol, ...]) -> sp.Expr | None:
    """phi with the given gradient, coordinate by coordinate, normalised to vanish nowhere in particular."""
    phi = sp.Integer(0)
    for i, symbol in enumerate(x):
        left = tidy_state(gradient[i] - sp.diff(phi, symbol), x)
        part = _antiderivative(left, symbol, x)
        if part is None:
            return None
        phi += part
    for i, symbol in enumerate(x):
        if is_zero(gradient[i] - sp.diff(phi, symbol)) is not True:
            return None
    return phi


def _antiderivative(expression: sp.Expr, symbol: sp.Symbol, x: tuple[sp.Symbol, ...]) -> sp.Expr | None:
    terms = []
    for function, coefficient in grouped(expression, x).items():
        part = _known_antiderivative(function, symbol)
        if part is None:
            if _nested(function, symbol) > DEEPEST or terms_of(function) > MANY_TERMS // 10:
                return None
            part = sp.integrate(function, symbol, conds="none")
            if part.has(sp.Integral) or part.has(sp.Piecewise):
                return None
        terms.append(coefficient * part)
    return sp.Add(*terms)


def _nested(expression: sp.Expr, symbol: sp.Symbol) -> int:
    """How many functions of the symbol stand inside of each other, at most."""
    if not expression.has(symbol) or not expression.args:
        return 0
    own = isinstance(expression, sp.Function) or (expression.is_Pow and not expression.exp.is_Integer)
    return int(own) + max(_nested(part, symbol) for part in expression.args)


def _known_antiderivative(function: sp.Expr, symbol: sp.Symbol) -> sp.Expr | None:
    """Antiderivatives of powers, and of F(a x + b) in the forms that stay smooth on the whole line, such as log cosh for tanh."""
    if not function.has(symbol):
        return function * symbol
    base, exponent = function.as_independent(symbol, as_Add=False)[1].as_base_exp()
    if base == symbol and exponent.is_Integer and exponent > 0:
        return function * symbol / (exponent + 1)
    rules = {
        sp.tanh: lambda u: sp.log(sp.cosh(u)),
        sp.coth: lambda u: sp.log(sp.sinh(u)),
        sp.sin: lambda u: -sp.cos(u),
        sp.cos: sp.sin,
        sp.sinh: sp.cosh,
        sp.cosh: sp.sinh,
        sp.tan: lambda u: -sp.log(sp.cos(u)),
        sp.exp: sp.exp,
    }
    rule = rules.get(function.func)
    if rule is None:
        return _logarithm(function, symbol)
    argument = function.args[0]
    slope = sp.diff(argument, symbol)
    if slope.has(symbol) or slope == 0:
        return None
    return rule(argument) / slope


def _logarithm(function: sp.Expr, symbol: sp.Symbol) -> sp.Expr | None:
    """Return c log D where the function is c D' / D."""
    denominator = sp.denom(sp.together(function))
    if not denominator.has(symbol) or terms_of(denominator) > 8:
        return None
    for inner in sp.Mul.make_args(sp.factor(denominator)):
        if inner.is_Add and inner.has(symbol):
            ratio = sp.powsimp(sp.cancel(function / sp.diff(sp.log(inner), symbol)))
            if not ratio.has(symbol):
                return ratio * sp.log(inner)
    return None


def q_without_observation(model: Model, form: YauForm) -> sp.Expr:
    """2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L."""
    x, G, gradient = model.x, model.covariance, form.gradient
    hessian = gradient.jacobian(x)
    affine = form.matrix * sp.Matrix(x) + form.offset
    return (
        2 * sp.diff(form.potential, model.t)
        + sp.expand(sum(G[i, j] * hessian[j, i] for i in range(model.n) for j in range(model.n)))
        + (gradient.T * G * gradient)[0, 0]
        + 2 * (affine.T * gradient)[0, 0]
        + 2 * form.matrix.trace()
    )


def observation_energy(model: Model) -> sp.Expr:
    """h'S^-1 h."""
    return (model.observation.T * inverse(model.observation_noise) * model.observation)[0, 0]


def eta(model: Model) -> sp.Expr | None:
    """Wong's eta = f'G^-1 f + div f + h'S^-1 h, or None where G is singular or the model has other features."""
    if model.features or is_zero(model.covariance.det()) is not False:
        return None
    kinetic = (model.drift.T * inverse(model.covariance) * model.drift)[0, 0]
    divergence = sum(sp.diff(model.drift[i], symbol) for i, symbol in enumerate(model.x))
    return kinetic + divergence + observation_energy(model)


def form_text(form: YauForm) -> str:
    """A Yau form for a sentence."""
    return f"L = {short(str(form.matrix.tolist()))}, l = {short(str(list(form.offset)))}, phi = {short(str(form.potential))}"
