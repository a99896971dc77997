"""Is an expression identically zero?

A point where it is clearly not zero, found in 50-digit arithmetic, refutes.  The proof is algebra: trigonometric and
hyperbolic functions become exponentials, exponentials of rationally independent arguments are independent variables, and
the result is a rational function whose numerator is expanded.  This knows sin^2 + cos^2, 1 - tanh^2 - sech^2, double angles
and the like.  Where that would be too long, an expression that is analytic on the whole line and vanishes to 40 digits at a
dozen random points is taken to be zero.  Everything else is undecided, and said so.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mpmath
import sympy as sp
from sympy.core.function import AppliedUndef

from zakai.models.functions import Floor, Maximum, Minimum, TableFunction

DIGITS = 60
POINTS = 12
SHORT = 160  # operations up to which the algebraic proof is tried
UNDERFLOW = 80  # argument of an exponential and its like from which a sum loses it in so many digits
LARGEST_ARGUMENT = 10**6  # of an exponential and its like

CIRCULAR = (sp.sin, sp.cos, sp.tan, sp.cot, sp.sec, sp.csc)
HYPERBOLIC = (sp.sinh, sp.cosh, sp.tanh, sp.coth, sp.sech, sp.csch)
_FUNCTIONS = {
    **{f: getattr(mpmath, f.__name__) for f in (*CIRCULAR, *HYPERBOLIC)},
    sp.exp: mpmath.exp,
    sp.log: mpmath.log,
    sp.asin: mpmath.asin,
    sp.acos: mpmath.acos,
    sp.atan: mpmath.atan,
    sp.erf: mpmath.erf,
    sp.Abs: abs,
    sp.sign: mpmath.sign,
}
_EXPONENTIAL = (sp.exp, sp.erf, *HYPERBOLIC)
_RELATIVE = (sp.exp, sp.cosh, sp.sech, sp.csch)  # whose derivative is not much larger than they are
_SLOW_GROWING = (sp.log, sp.Abs, sp.sign)
_ENTIRE = (sp.sin, sp.cos, sp.sinh, sp.cosh, sp.tanh, sp.sech, sp.exp, sp.erf, sp.atan)


def is_zero(expression: sp.Expr) -> bool | None:
    """True if the expression is identically zero, False if it is not, None if neither could be shown."""
    if expression.is_number and expression.is_Rational:
        return bool(expression == 0)
    symbols = sorted(expression.free_symbols, key=lambda s: s.name)
    sample = _determined(expression)
    vanished = 0
    for point in _points(symbols):
        answer = _vanishes(sample, point)
        if answer is False:
            return False
        vanished += answer is True
    if expression.count_ops() <= SHORT and _provably_zero(expression):
        return True
    return True if vanished >= POINTS and _is_analytic(expression) else None


def _determined(expression: sp.Expr) -> sp.Expr:
    """With a particular smooth function for each undetermined one: what is not zero for these is not identically zero."""
    if not expression.has(AppliedUndef):
        return expression
    names = sorted({part.func.__name__ for part in expression.atoms(AppliedUndef)})
    for k, name in enumerate(names, 2):
        expression = expression.replace(
            lambda part, name=name: isinstance(part, AppliedUndef) and part.func.__name__ == name,
            lambda part, k=k: sp.sin(sp.Add(*[(j + k) * z for j, z in enumerate(part.args)])) * sp.exp(part.args[0] / k),
        )
    return expression.doit()


def all_zero(expressions: Iterable[sp.Expr]) -> bool | None:
    """`is_zero` for several expressions at once: False wins over None, None over True."""
    every: bool | None = True
    for expression in expressions:
        answer = is_zero(expression)
        if answer is False:
            return False
        every = every if answer else None
    return every


def is_quadratic(q: sp.Expr, x: Sequence[sp.Symbol]) -> bool | None:
    """Whether q is a polynomial of degree two at most in x, its coefficients being any functions of the other symbols.

    Its third differences along random lines refute; a zero third derivative proves, if q is the same formula everywhere.
    """
    free = q.free_symbols
    # The number of third derivatives grows with the cube of that of the states; most terms have few of them.
    x, others = [s for s in x if s in free], sorted(free - set(x), key=lambda s: s.name)
    vanished = 0
    for point in _points([*x, *others]):
        rng = random.Random(repr(sorted((s.name, str(v)) for s, v in point.items())))
        step = {s: mpmath.mpf(rng.randint(500, 2000)) / 1511 for s in x}
        with mpmath.workdps(DIGITS):
            known: list[dict] = [{} for _ in range(4)]
            values = [evaluate(q, {s: v + k * step.get(s, 0) for s, v in point.items()}, known[k]) for k in range(4)]
            if any(v is None for v in values):
                continue
            difference = abs(values[3] - 3 * values[2] + 3 * values[1] - values[0])
            if difference > sum(abs(v) for v in values) * _margin() + _margin():
                return False
            vanished += not any(_underflows(one) for one in known)
    if q.count_ops() <= SHORT:
        # Unlike the differences they are free of the quadratic part, which hides a term with a coefficient like 1e-40.
        thirds = (sp.diff(q, a, b, c) for i, a in enumerate(x) for j, b in enumerate(x[i:], i) for c in x[j:])
        vanish = all_zero(thirds)
        if vanish is False or (vanish and is_in_one_piece(q, x)):
            return vanish
    return True if vanished >= POINTS and _is_analytic(q) else None


def evaluate(expression: sp.Expr, values: Mapping[sp.Symbol, mpmath.mpf], known: dict | None = None):
    """The value in mpmath's current precision, or None where the expression has none."""
    known = {} if known is None else known

    def value(e: sp.Expr):
        if e not in known:
            known[e] = compute(e)
        return known[e]

    def within(argument: Any) -> Any:
        # The exponential of an exponential of an exponential has more digits than any memory.
        if abs(argument) > LARGEST_ARGUMENT:
            raise OverflowError
        return argument

    def compute(e: sp.Expr):
        if e.is_Rational:
            return mpmath.mpf(int(e.p)) / int(e.q)
        if e.is_Symbol:
            return values[e]
        if isinstance(e, sp.Add):
            return mpmath.fsum(value(a) for a in e.args)
        if isinstance(e, sp.Mul):
            return mpmath.fprod(value(a) for a in e.args)
        if isinstance(e, sp.Pow):
            return mpmath.power(value(e.base), int(e.exp) if e.exp.is_Integer else within(value(e.exp)))
        if e.func in _FUNCTIONS:
            argument = value(e.args[0])
            return _FUNCTIONS[e.func](argument if e.func in _SLOW_GROWING else within(argument))
        if e.is_number:
            return mpmath.mpmathify(e.evalf(mpmath.mp.dps))
        raise ValueError(e)  # an undetermined function

    try:
        result = value(expression)
        return result if mpmath.isfinite(result) else None
    except (ZeroDivisionError, ValueError, OverflowError, TypeError, KeyError):
        return None


def _margin() -> mpmath.mpf:
    return mpmath.mpf(10) ** (-(2 * DIGITS) // 3)


def _points(symbols: Sequence[sp.Symbol]):
    rng = random.Random(20170111)
    for _ in range(POINTS + 4):
        with mpmath.workdps(DIGITS):
            yield {s: mpmath.mpf(rng.randint(-4000, 4000)) / 3001 for s in symbols}


def _vanishes(expression: sp.Expr, point: Mapping[sp.Symbol, mpmath.mpf]) -> bool | None:
    with mpmath.workdps(DIGITS):
        known: dict = {}
        value = evaluate(expression, point, known)
        if value is None:
            return None
        if abs(value) > (1 + max((abs(v) for v in known.values()), default=0)) * _margin():
            return False
        if abs(value) > _scale(expression, known, {}) * _margin():
            return False
        return None if _underflows(known) else True


def _scale(expression: sp.Expr, known: Mapping[sp.Expr, mpmath.mpf], scales: dict[sp.Expr, mpmath.mpf]) -> mpmath.mpf:
    """The size of what was added up inside of an expression, which tells how many digits a true zero could have lost.

    It is relative where rounding is relative: a product or an exponential may be as small as it likes, and is not zero.
    """
    if expression not in scales:
        size = abs(known[expression])
        parts = [_scale(a, known, scales) for a in expression.args if a in known]
        if isinstance(expression, sp.Add):
            size = mpmath.fsum(parts)
        elif isinstance(expression, sp.Mul):
            size = mpmath.fprod(parts)
        elif isinstance(expression, sp.Pow):
            if expression.exp.is_Integer and expression.exp > 0:
                size = parts[0] ** int(expression.exp)
            elif known[expression.base]:
                size *= (1 + mpmath.fsum(parts[1:])) * parts[0] / abs(known[expression.base])
        elif parts:
            inner = mpmath.fsum(parts)
            size = size * (1 + inner) if isinstance(expression, _RELATIVE) else size + (1 + size) * inner
        scales[expression] = size
    return scales[expression]


def _underflows(known: Mapping[sp.Expr, mpmath.mpf]) -> bool:
    """Whether an exponential is so small, or its like so near to its limit, that a sum may have lost it."""
    return any(isinstance(e, _EXPONENTIAL) and abs(known.get(e.args[0], 0)) > UNDERFLOW for e in known)


def _is_analytic(expression: sp.Expr) -> bool:
    """Return whether the form of the expression shows that it is analytic on the real line, except at isolated points.

    A path through the complex plane goes around such points: an identity that holds somewhere holds everywhere.
    """
    for e in sp.preorder_traversal(expression):
        if isinstance(e, sp.Function):
            inside = isinstance(e, sp.log) and isinstance(e.args[0], sp.cosh)
            if not (isinstance(e, _ENTIRE) or inside) or isinstance(e, sp.atan | sp.log) and _has_poles(e.args[0]):
                return False
        elif isinstance(e, sp.Pow) and not (e.exp.is_Integer or not e.base.free_symbols):
            return False
    return True


def is_in_one_piece(expression: sp.Expr, x: Sequence[sp.Symbol]) -> bool:
    """Return whether the form of the expression shows that one analytic formula in x holds wherever it exists.

    asin(sin(x)), atan(tan(x)), atan(1/x) and sqrt(x**2) have different formulas on different intervals, each of them smooth.
    """
    for e in sp.preorder_traversal(expression):
        if not e.has(*x):
            continue
        if isinstance(e, sp.Abs | sp.sign | sp.asin | sp.acos | sp.atan2 | Floor | Minimum | Maximum | TableFunction):
            return False
        if isinstance(e, sp.atan) and _has_poles(e.args[0]):
            return False
        root = e.base if isinstance(e, sp.Pow) and not e.exp.is_Integer else e.args[0] if isinstance(e, sp.log) else None
        # A domain that is a half-space or everything is connected.
        if root is not None and not root.is_positive and any(sp.diff(root, s).has(*x) for s in x):
            return False
    return True


def _has_poles(expression: sp.Expr) -> bool:
    """Return whether the form of the expression allows that it has no value at some real point."""
    return any(
        isinstance(e, sp.tan | sp.cot | sp.sec | sp.csc | sp.coth | sp.csch)
        or (isinstance(e, sp.Pow) and e.exp.is_negative is not False and not (e.base.is_positive or e.base.is_negative))
        for e in sp.preorder_traversal(expression)
    )


def _provably_zero(expression: sp.Expr) -> bool:
    if sp.expand(expression) == 0:
        return True
    numerator = sp.expand(sp.fraction(sp.together(_as_rational(expression)))[0])
    return bool(sp.expand(sp.powdenest(numerator)) == 0)


def _as_rational(expression: sp.Expr) -> sp.Expr:
    """The expression as a rational function of symbols that stand for independent exponentials and other functions.

    exp(sum_k c_k m_k), c_k rational and m_k monomials, becomes prod_k e_k^(c_k / d_k), d_k the greatest common divisor of the
    factors of m_k.  Arguments are treated before what contains them.
    """
    generators: dict[sp.Expr, sp.Symbol] = {}
    divisors: dict[sp.Symbol, sp.Rational] = {}

    def exponential(argument: sp.Expr) -> sp.Expr:
        result = sp.Integer(1)
        for term in sp.Add.make_args(sp.expand(argument)):
            number, monomial = term.as_coeff_Mul(rational=True)
            symbol = generators.setdefault(monomial, sp.Dummy(f"e{len(generators)}", positive=True))
            divisors[symbol] = sp.gcd(divisors.get(symbol, sp.Integer(0)), number)
            result *= symbol**number
        return result

    def convert(e: sp.Expr) -> sp.Expr:
        if not e.args:
            return e
        arguments = [convert(argument) for argument in e.args]
        return exponential(arguments[0]) if isinstance(e, sp.exp) else e.func(*arguments)

    converted = convert(expression.rewrite((*CIRCULAR, *HYPERBOLIC), sp.exp))
    # Powers such as e^(10^10), of a state in small units, would have more terms than any memory.
    return converted.xreplace({symbol: symbol ** (1 / divisor) for symbol, divisor in divisors.items()})
