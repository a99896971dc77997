"""The theorems on finite-dimensional estimation algebras, each for one model: its assumptions, its conclusion, what decided them.

    print(theorem_5(model))

Numbers are those of Yau's report (1993), and of Dong, Chen and Yau (2021) for the lemmas.  Each function gives a
`TheoremCheck`; where an assumption fails, the conclusion is that of the model all the same, and the theorem says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy as sp

from zakai.algebra._readable import readable, short
from zakai.algebra.arguments import Unreadable
from zakai.algebra.conditions import Condition, all_hold
from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.estimation_algebra import EstimationAlgebra, estimation_algebra
from zakai.algebra.normal_form import operator_symbols
from zakai.algebra.operators import Symbol
from zakai.algebra.systems import affine_observation, definite_covariance
from zakai.algebra.yau import YauForm, yau_form
from zakai.errors import InputError
from zakai.models.model import Model

YAU = "Yau 1993"
DONG = "Dong, Chen and Yau 2021"


@dataclass(frozen=True)
class TheoremCheck:
    """`name` and `statement` of a theorem, its `assumptions` and its `conclusion` as conditions of one system."""

    name: str
    statement: str
    assumptions: tuple[Condition, ...]
    conclusion: Condition

    @property
    def applies(self) -> bool | None:
        """Whether every assumption holds; None if that is not decided."""
        return all_hold(self.assumptions)

    def __str__(self) -> str:
        words = {True: "holds", False: "fails", None: "undecided"}
        lines = [f"{self.name}: {self.statement}"]
        for kind, conditions in (("assumption", self.assumptions), ("conclusion", (self.conclusion,))):
            lines += [f"  {kind} {words[c.holds]}: {c.statement} ({c.evidence})" for c in conditions]
        return "\n".join(lines)


def theorem_1(model: Model) -> TheoremCheck:
    """Omega is constant if and only if f = L x + l + G grad phi."""
    form = yau_form(model)
    holds = isinstance(form, YauForm)
    evidence = f"phi = {short(form.phi)}" if isinstance(form, YauForm) else form.evidence
    found = Condition("f = L x + l + G grad phi", True if holds else form.holds, evidence, YAU)  # type: ignore[union-attr]
    statement = "Omega is constant if and only if f is affine plus G times a gradient"
    return TheoremCheck(f"{YAU}, Theorem 1", statement, (_omega_is_constant(model),), found)


def theorem_2(model: Model) -> TheoremCheck:
    """If Omega is constant and E finite dimensional, h is affine."""
    statement = "if Omega is constant and E finite dimensional, every h_i is affine"
    return TheoremCheck(f"{YAU}, Theorem 2", statement, (_omega_is_constant(model), _is_finite(model)), _h_is_affine(model))


def theorem_3(function: sp.Expr, x: Sequence[sp.Symbol], path: Sequence[sp.Expr], time: sp.Symbol) -> TheoremCheck:
    """No drift f has sum_i d_i f_i + f_i^2 = F for a polynomial F that falls to minus infinity along a tube.

    `function` is F, a polynomial in `x`; `path` the n polynomials C_i(`time`) in the middle of the tube, which leads to infinity.
    F(C(t) + y) is a polynomial in t with coefficients that depend on y; where that of the highest power is negative at y = 0,
    it is so on a ball.  The corollary, that it is enough that F falls along the path, is `corollary_3`.
    """
    away, falls = _along(function, x, path, time)
    offsets = sp.symbols(f"y1:{len(x) + 1}", real=True)
    moved = function.subs({s: c + y for s, c, y in zip(x, path, offsets)}, simultaneous=True)
    leading = sp.Poly(sp.expand(moved), time)
    at_centre = leading.LC().subs({y: 0 for y in offsets})
    evidence = f"F(C(t) + y) = ({leading.LC()}) {time}^{leading.degree()} + ..."
    holds = True if leading.degree() > 0 and at_centre.is_negative else False if falls.holds is False else None
    tube = Condition("sup F(C(t) + y), |y| < delta, tends to minus infinity for some delta", holds, evidence, YAU)
    statement = "no smooth f satisfies sum d_i f_i + f_i^2 = F if F falls to minus infinity along a tube"
    return TheoremCheck(f"{YAU}, Theorem 3", statement, (away, tube), _no_drift((away, tube)))


def corollary_3(function: sp.Expr, x: Sequence[sp.Symbol], path: Sequence[sp.Expr], time: sp.Symbol) -> TheoremCheck:
    """The same for a polynomial F and a polynomial path, along which alone F must fall."""
    assumptions = _along(function, x, path, time)
    statement = (
        "no smooth f satisfies sum d_i f_i + f_i^2 = F if the polynomial F falls to minus infinity along a polynomial path"
    )
    return TheoremCheck(f"{YAU}, Corollary of Theorem 3", statement, assumptions, _no_drift(assumptions))


def theorem_4_i(model: Model) -> TheoremCheck:
    """If Omega is constant, h affine and eta of degree two at most, E is finite, and eta - h'S^-1 h positive semidefinite.

    The basis is L_0, operators sum_j alpha_j D_j + beta with constant alpha and affine beta, and affine functions.
    """
    algebra = estimation_algebra(model)
    assumptions = (_omega_is_constant(model), _h_is_affine(model), _eta_is_quadratic(model))
    energy = _quadratic_part(model)
    semidefinite = None if energy is None else energy.is_positive_semidefinite
    holds = {"finite": semidefinite, "infinite": False}.get(algebra.verdict)
    evidence = f"E is {algebra.verdict}, basis {list(algebra.basis)}; quadratic part {energy.tolist() if energy else 'unknown'}"
    conclusion = Condition("E is finite dimensional and the quadratic part of eta - h'S^-1 h semidefinite", holds, evidence, YAU)
    statement = "a constant Omega, affine h and a quadratic eta make E finite dimensional"
    return TheoremCheck(f"{YAU}, Theorem 4 (i)", statement, assumptions, conclusion)


def theorem_4_ii(model: Model) -> TheoremCheck:
    """If Omega is constant, E finite and the observation matrix of rank n, eta is of degree two at most."""
    assumptions = (_omega_is_constant(model), _is_finite(model), _full_rank(model))
    statement = "if Omega is constant, E finite dimensional and the observation matrix of rank n, eta is quadratic"
    return TheoremCheck(f"{YAU}, Theorem 4 (ii)", statement, assumptions, _eta_is_quadratic(model))


def theorem_5(model: Model) -> TheoremCheck:
    """If Omega is constant, E finite and the observation matrix of rank n, E has the basis 1, x_i, D_i, L_0."""
    algebra = estimation_algebra(model)
    assumptions = (_omega_is_constant(model), _is_finite(model), _full_rank(model))
    statement = "if Omega is constant, E finite dimensional and the observation matrix of rank n, E has dimension 2 n + 2"
    return TheoremCheck(f"{YAU}, Theorem 5", statement, assumptions, _has_dimension(algebra, (2 * model.n + 2,)))


def theorem_7(model: Model) -> TheoremCheck:
    """If n = 1, G > 0 and E is finite, its dimension is 4, 2 or 1."""
    one = Condition("n = 1", model.n == 1, f"n = {model.n}", YAU)
    assumptions = (one, _is_regular(model), _is_finite(model))
    conclusion = _has_dimension(estimation_algebra(model), (4, 2, 1))
    return TheoremCheck(f"{YAU}, Theorem 7", "with one state, a finite E has dimension 4, 2 or 1", assumptions, conclusion)


def theorem_8(model: Model) -> TheoremCheck:
    """If n = 2, G is regular and E is finite of maximal rank, its dimension is 6."""
    algebra = estimation_algebra(model)
    two = Condition("n = 2", model.n == 2, f"n = {model.n}", YAU)
    rank = Condition("E has maximal rank", algebra.linear_rank == model.n, f"linear rank {algebra.linear_rank}", YAU)
    statement = "with two states, a finite E of maximal rank has dimension 6"
    assumptions = (two, _is_regular(model), _is_finite(model), rank)
    return TheoremCheck(f"{YAU}, Theorem 8", statement, assumptions, _has_dimension(algebra, (6,)))


def lemma_2_5(model: Model, g: sp.Expr, i: Sequence[int], h: sp.Expr, j: Sequence[int]) -> TheoremCheck:
    """[g D^i, h D^j] = sum_l (i_l g d_l h - j_l h d_l g) D^(i + j - e_l) modulo operators of order r + s - 2 (G = I).

    `g` and `h` are functions in the ring of the model's formulas, `i` and `j` multi-indices with |i| = r and |j| = s, r + s >= 2.
    Raises InputError where the operators D_i are not defined, and for a function that is not in the ring.
    """
    operators = _operators(model)
    if isinstance(operators, Condition):
        raise InputError(f"{model.source}: the operators D_i are not defined: {operators.evidence}")
    ring, r, s = operators.ring, sum(i), sum(j)
    try:
        a, b = operators.reader.read(g), operators.reader.read(h)
    except Unreadable as reason:
        raise InputError(f"g, h: {reason}; give functions in the ring of the model's formulas") from None
    bracket = ring.bracket(a * operators.power_of_D(i), b * operators.power_of_D(j))
    for l in range(ring.n):
        c = i[l] * a * ring.total_derivative(b, l) - j[l] * b * ring.total_derivative(a, l)
        exponents = [p + q - (k == l) for k, (p, q) in enumerate(zip(i, j))]
        if not c.is_zero():
            bracket = bracket - c * operators.power_of_D(exponents)
    order = ring.order(ring.normal(bracket))
    evidence = f"the difference has order {order}, r + s - 2 = {r + s - 2}"
    conclusion = Condition("the bracket is the sum, modulo lower orders", order <= r + s - 2, evidence, DONG)
    assumption = Condition("r + s >= 2", r + s >= 2, f"r = {r}, s = {s}", DONG)
    return TheoremCheck(f"{DONG}, Lemma 2.5", "brackets of g D^i and h D^j to leading order", (assumption,), conclusion)


def lemma_3_3(model: Model) -> TheoremCheck:
    """If h is affine in x_1 alone, omega_1j = 0 and eta = P_2(x_1) + phi(x_2, ...), then E has the basis L_0, D_1, x_1, 1."""
    x, affine = model.x, affine_observation(model)
    alone = affine is not None and any(affine[0][:, 0]) and not any(affine[0][:, 1:])
    assumptions = (
        Condition(f"h is affine in {x[0]} alone and not constant", alone, str(list(model.observation)), DONG),
        *_first_coordinate_splits(model),
    )
    algebra, (L0, D) = estimation_algebra(model), operator_symbols(model)
    basis = [str(e) for e in algebra.basis]
    holds = {"finite": algebra.basis == (L0, D[0], x[0], 1), "infinite": False}.get(algebra.verdict)
    conclusion = Condition(f"E has the basis L_0, D_1, {x[0]}, 1", holds, f"{algebra.verdict}, basis {basis}", DONG)
    return TheoremCheck(f"{DONG}, Lemma 3.3", "E has the basis L_0, D_1, x_1, 1", assumptions, conclusion)


def _first_coordinate_splits(model: Model) -> tuple[Condition, Condition]:
    """Whether omega_1j = 0, and whether d_1 eta is affine in x_1 alone."""
    first, second = "omega_1j = 0", f"eta = P_2({model.x[0]}) + phi of the rest"
    operators = _operators(model)
    if isinstance(operators, Condition):
        return replace(operators, statement=first, source=DONG), replace(operators, statement=second, source=DONG)
    ring = operators.ring
    slope = ring.total_derivative(operators.eta, 0)
    mixed = [ring.total_derivative(slope, j) for j in range(1, ring.n)]
    third = ring.total_derivative(ring.total_derivative(slope, 0), 0)
    splits = third.is_zero() and all(m.is_zero() for m in mixed)
    moving = next((f"omega_1,{j + 1} = {_text(e, operators)}" for (i, j), e in operators.omega.items() if i == 0 and e != 0), "")
    return (
        Condition(first, not moving, moving or first, DONG),
        Condition(second, splits, f"d_1 eta = {_text(slope, operators)}", DONG),
    )


def _operators(model: Model) -> DmzOperators | Condition:
    """Those of a regular G; or the condition, without its statement, that there are none."""
    try:
        operators = DmzOperators(model, dict(zip(model.parameter_symbols, model.parameters.values(), strict=True)))
    except Unreadable as reason:
        return Condition("", None, str(reason), YAU)
    return Condition("", False, "G is singular", YAU) if operators.g is None else operators


def _text(function: Symbol, operators: DmzOperators) -> str:
    return short(str(readable(operators.reader.expression(function))))


def _is_regular(model: Model) -> Condition:
    return replace(definite_covariance(model), source=YAU)


def _omega_is_constant(model: Model) -> Condition:
    operators = _operators(model)
    if isinstance(operators, Condition):
        return replace(operators, statement="Omega is constant")
    for (i, j), entry in operators.omega.items():
        if not operators.is_polynomial(entry, 0):
            return Condition("Omega is constant", False, f"omega_{i + 1},{j + 1} = {_text(entry, operators)}", YAU)
    entries = {f"{i + 1},{j + 1}": _text(e, operators) for (i, j), e in operators.omega.items() if e != 0}
    return Condition("Omega is constant", True, f"omega = {entries}" if entries else "Omega = 0", YAU)


def _is_finite(model: Model) -> Condition:
    algebra = estimation_algebra(model)
    holds = {"finite": True, "infinite": False}.get(algebra.verdict)
    return Condition("E is finite dimensional", holds, algebra.verdict, algebra.certificate.source if algebra.certificate else "")


def _h_is_affine(model: Model) -> Condition:
    holds = affine_observation(model) is not None
    return Condition("every h_i is affine", holds, f"h = {list(model.observation)}", YAU)


def _full_rank(model: Model) -> Condition:
    affine = affine_observation(model)
    rank = None if affine is None else affine[0].rank()
    return Condition("the observation matrix is constant, of rank n", rank == model.n, f"rank {rank}, n = {model.n}", YAU)


def _eta_is_quadratic(model: Model) -> Condition:
    statement, operators = "eta is a polynomial of degree two at most", _operators(model)
    if isinstance(operators, Condition):
        return replace(operators, statement=statement)
    return Condition(statement, operators.is_polynomial(operators.eta, 2), f"eta = {_text(operators.eta, operators)}", YAU)


def _quadratic_part(model: Model) -> sp.Matrix | None:
    """That of eta - h'S^-1 h, where eta is a polynomial of degree two."""
    operators = _operators(model)
    if isinstance(operators, Condition) or not operators.is_polynomial(operators.eta, 2) or affine_observation(model) is None:
        return None
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    h, S = model.observation.xreplace(values), model.observation_noise.xreplace(values)
    rest = operators.reader.expression(operators.eta) - (h.T * S.LUsolve(h))[0, 0]
    return sp.hessian(sp.expand(rest), model.x) / 2


def _has_dimension(algebra: EstimationAlgebra, dimensions: tuple[int, ...]) -> Condition:
    words = " or ".join(map(str, dimensions))
    holds = {"finite": algebra.dimension in dimensions, "infinite": False}.get(algebra.verdict)
    evidence = algebra.verdict if algebra.dimension is None else f"dimension {algebra.dimension}, basis {list(algebra.basis)}"
    return Condition(f"E has dimension {words}", holds, evidence, YAU)


def _along(function: sp.Expr, x: Sequence[sp.Symbol], path: Sequence[sp.Expr], time: sp.Symbol) -> tuple[Condition, Condition]:
    away = any(sp.degree(c, time) > 0 for c in map(sp.sympify, path) if c.has(time))
    value = sp.expand(function.subs(dict(zip(x, path)), simultaneous=True))
    falls = sp.limit(value, time, sp.oo) == -sp.oo
    return (
        Condition("C(t) leads to infinity", away, f"C = {list(path)}", YAU),
        Condition("F(C(t)) tends to minus infinity", falls, f"F(C(t)) = {value}", YAU),
    )


def _no_drift(assumptions: tuple[Condition, ...]) -> Condition:
    holds = True if all_hold(assumptions) else None
    return Condition("no smooth drift has this F", holds, "by the theorem" if holds else "the theorem says nothing", YAU)
