"""Formulas into the operator ring: which functions become generators, and that these are algebraically independent.

    tanh      t = tanh(u):  d_i t = (1 - t^2) d_i u       (alone; beside exponentials, a rational function of exp(u))
    exp, ...  e = exp(u):   d_i e = e d_i u
    sin, cos  s, c:         d_i s = c d_i u, d_i c = -s d_i u, c^2 = 1 - s^2
    log       l = log(p):   d_i l = d_i p / p
    1/q       v = 1/Q, Q the product of all denominators' factors:  d_i v = -v^2 d_i Q,  v Q = 1
              (and a constant 1/P for the factors that are constant)
    gamma     an undetermined function: one generator for each partial derivative up to a highest, its jets

The independence of exponentials is decided in `arguments.py`; logarithms of multiplicatively independent polynomials are
independent (Ostrowski 1946); an undetermined function is one whose derivatives satisfy no algebraic equation.  Whatever is
not covered is refused with a reason, never approximated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import combinations_with_replacement

import sympy as sp
from flint import fmpq_mat
from sympy.core.function import AppliedUndef

from zakai.algebra.arguments import Unreadable, argument_basis
from zakai.algebra.operators import OperatorRing, Symbol
from zakai.algebra.quotients import Fraction, Fractions

PI = sp.Symbol("pi", positive=True)  # transcendental, so a constant like any other
INVERSE = sp.Dummy("inverse")  # 1/P
MOST_ARGUMENTS = 16  # of an undetermined function
HYPERBOLIC = (sp.exp, sp.sinh, sp.cosh, sp.tanh)
CIRCULAR = (sp.sin, sp.cos, sp.tan)


class Reader:
    """The ring that holds given formulas, and the way into and out of it.

    `expressions` are all formulas that will be read (or whose sums, products and derivatives in the ring will be needed),
    `x` the state, `constants` the symbols that stay symbols, `jets` the highest derivative of undetermined functions.
    Raises Unreadable.
    """

    def __init__(self, expressions: Iterable[sp.Expr], x: Sequence[sp.Symbol], constants: Sequence[sp.Symbol], jets: int = 6):
        self._x, self._constants = tuple(x), (*constants, PI, INVERSE)
        expressions = [_canonical(e) for e in expressions]
        atoms = sorted({a for e in expressions for a in _functions(e, set(x))}, key=str)
        self._plans: list[tuple[sp.Expr, Callable[[], list[Symbol] | None]]] = []  # what a generator is, its derivatives
        self._values: dict[sp.Expr, Callable[[], Fraction]] = {}
        self._inverse = self._plan(sp.Dummy("inverse of Q"), lambda: None)
        self._circles: list[tuple[int, int]] = []
        self._hyperbolic([a for a in atoms if isinstance(a, HYPERBOLIC)])
        self._circular([a for a in atoms if isinstance(a, CIRCULAR)])
        logarithms = [a for a in atoms if isinstance(a, sp.log)]
        for atom in logarithms:
            self._logarithm(atom)
        for atom in [a for a in atoms if isinstance(a, AppliedUndef)]:
            self._jets(atom, jets)
        self.ring = OperatorRing(len(self._x), len(self._plans), len(self._constants))
        symbols = dict(zip((*self._x, *self._constants), (*self.ring.x, *self.ring.c), strict=True))
        self._fractions = Fractions(self.ring, symbols, self._values, self._inverse)
        self.ring.relations = [self.ring.u[c] ** 2 + self.ring.u[s] ** 2 - 1 for c, s in self._circles]
        arguments = [self._fraction(a.args[0]) for a in logarithms]
        _refuse_dependent_logarithms(arguments, self.ring)
        self._log_arguments = [part for fraction in arguments for part in fraction]
        self._fractions.relate([self._fraction(e)[1] for e in expressions] + self._log_arguments)
        for k, (_, derivatives) in enumerate(self._plans):
            self.ring.derivatives[k] = derivatives()
        # The other generators' derivatives may contain v, but not its derivative.
        self._fractions.declare()

    @property
    def constant_denominator(self) -> Symbol:
        """P, whose inverse is the last constant of the ring."""
        return self._fractions.P

    def read(self, expression: sp.Expr) -> Symbol:
        """The element of the ring that an expression is."""
        return self._fractions.polynomial(self._fraction(_canonical(expression)))

    def expression(self, p: Symbol) -> sp.Expr:
        """An element without xi as a SymPy expression."""
        functions = (*(e for e, _ in self._plans), *self._x, *self._constants)
        terms = []
        for monomial, c in p.to_dict().items():
            powers = [self._named(base) ** k for base, k in zip(functions, monomial[self.ring.n :]) if k]
            terms.append(sp.Mul(sp.Rational(int(c.p), int(c.q)), *powers))
        return sp.Add(*terms)

    def _named(self, function: sp.Expr) -> sp.Expr:
        if function in (INVERSE, self._plans[self._inverse][0]):
            return 1 / self.expression(self._fractions.P if function is INVERSE else self._fractions.Q)
        return function.xreplace({PI: sp.pi})

    def is_smooth(self) -> bool:
        """Return whether the signs of coefficients show that every formula is smooth on all of R^n.

        A denominator, or the argument of a logarithm, is positive if it is a sum of positive multiples of even powers of
        states and any powers of exponentials, one of them without a state.
        """
        exponentials = [isinstance(function, sp.exp) for function, _ in self._plans]
        return all(self._is_positive(p, exponentials) for p in (self._fractions.Q, *self._log_arguments))

    def _is_positive(self, p: Symbol, exponentials: list[bool]) -> bool:
        for monomial, c in p.to_dict().items():
            _, u, x, constants = self.ring.split(monomial)
            if c <= 0 or any(constants) or any(k % 2 for k in x) or any(k and not e for k, e in zip(u, exponentials)):
                return False
        return any(not any(self.ring.split(monomial)[2]) for monomial in p.monoms())

    # ---- generators

    def _plan(self, function: sp.Expr, derivatives: Callable[[], list[Symbol] | None]) -> int:
        self._plans.append((function, derivatives))
        return len(self._plans) - 1

    def _fraction(self, e: sp.Expr) -> Fraction:
        return self._fractions.of(e)

    def _slopes(self, argument: sp.Expr) -> list[Symbol]:
        p = self._fractions.polynomial(self._fraction(argument))
        return [self.ring.total_derivative(p, i) for i in range(self.ring.n)]

    def _hyperbolic(self, atoms: list[sp.Expr]) -> None:
        basis, coordinates = argument_basis([a.args[0] for a in atoms], self._x, "exp, sinh, cosh and tanh")
        generators = []
        for j, u in enumerate(basis):
            users = [(a, row) for a, row in zip(atoms, coordinates) if row[j]]
            alone = all(isinstance(a, sp.tanh) and sum(map(abs, row)) == 1 for a, row in users)
            function = sp.tanh(u) if alone else sp.exp(u)
            k = len(self._plans)
            generators.append((k, alone))
            self._plan(function, partial(self._hyperbolic_derivatives, k, u, alone))
        for atom, row in zip(atoms, coordinates):
            self._values[atom] = partial(self._hyperbolic_value, atom, row, generators)

    def _hyperbolic_derivatives(self, k: int, u: sp.Expr, alone: bool) -> list[Symbol]:
        own = self.ring.u[k]
        return [(1 - own**2 if alone else own) * slope for slope in self._slopes(u)]

    def _hyperbolic_value(self, atom: sp.Expr, row: list[int], generators: list[tuple[int, bool]]) -> Fraction:
        u, one = self.ring.u, self.ring.one
        used = [(k, times, alone) for (k, alone), times in zip(generators, row) if times]
        if len(used) == 1 and used[0][2]:
            return used[0][1] * u[used[0][0]], one
        up = sp.prod([u[k] ** times for k, times, _ in used if times > 0], start=one)
        down = sp.prod([u[k] ** -times for k, times, _ in used if times < 0], start=one)
        return {
            sp.exp: (up, down),
            sp.sinh: (up**2 - down**2, 2 * up * down),
            sp.cosh: (up**2 + down**2, 2 * up * down),
            sp.tanh: (up**2 - down**2, up**2 + down**2),
        }[atom.func]

    def _circular(self, atoms: list[sp.Expr]) -> None:
        basis, coordinates = argument_basis([a.args[0] for a in atoms], self._x, "sin, cos and tan")
        generators = []
        for u in basis:
            # The cosine first, for what comes first is rewritten.
            c = len(self._plans)
            self._plan(sp.cos(u), partial(self._circular_derivatives, c + 1, -1, u))
            self._plan(sp.sin(u), partial(self._circular_derivatives, c, 1, u))
            self._circles.append((c, c + 1))
            generators.append(c)
        for atom, row in zip(atoms, coordinates):
            self._values[atom] = partial(self._circular_value, atom, row, generators)

    def _circular_derivatives(self, other: int, sign: int, u: sp.Expr) -> list[Symbol]:
        return [sign * self.ring.u[other] * slope for slope in self._slopes(u)]

    def _circular_value(self, atom: sp.Expr, row: list[int], generators: list[int]) -> Fraction:
        cosine, sine = self.ring.one, self.ring.zero
        for k, times in zip(generators, row):
            c, s = self.ring.u[k], self.ring.u[k + 1] * (1 if times > 0 else -1)
            for _ in range(abs(times)):
                cosine, sine = cosine * c - sine * s, cosine * s + sine * c
        cosine, sine = self.ring.normal(cosine), self.ring.normal(sine)
        return {sp.cos: (cosine, self.ring.one), sp.sin: (sine, self.ring.one), sp.tan: (sine, cosine)}[atom.func]

    def _logarithm(self, atom: sp.Expr) -> None:
        k = self._plan(atom, lambda: [self._fractions.polynomial((d, self.ring.one)) for d in self._log_slopes(atom.args[0])])
        self._values[atom] = lambda: (self.ring.u[k], self.ring.one)

    def _log_slopes(self, argument: sp.Expr) -> list[Symbol]:
        numerator, denominator = self._fraction(argument)
        up, down = (
            self._fractions.polynomial((self.ring.one, numerator)),
            self._fractions.polynomial((self.ring.one, denominator)),
        )
        ring = self.ring
        return [
            ring.normal(ring.total_derivative(numerator, i) * up - ring.total_derivative(denominator, i) * down)
            for i in range(ring.n)
        ]

    def _jets(self, atom: sp.Expr, highest: int) -> None:
        count = len(atom.args)
        highest = highest if count == 1 else max(2, highest - count)
        if count > MOST_ARGUMENTS:
            raise Unreadable(f"{atom.func.__name__} has more than {MOST_ARGUMENTS} arguments, and so too many derivatives")
        chosen = (c for k in range(highest + 1) for c in combinations_with_replacement(range(count), k))
        orders = sorted((tuple(c.count(j) for j in range(count)) for c in chosen), key=lambda o: (sum(o), o))
        first = len(self._plans)
        where = {order: first + j for j, order in enumerate(orders)}

        def derivatives(order: tuple[int, ...]) -> list[Symbol] | None:
            if sum(order) == highest:
                return None
            total = [self.ring.zero] * self.ring.n
            for j, argument in enumerate(atom.args):
                following = self.ring.u[where[tuple(o + (i == j) for i, o in enumerate(order))]]
                total = [t + slope * following for t, slope in zip(total, self._slopes(argument))]
            return total

        for order in orders:
            self._plan(_jet(atom, order), partial(derivatives, order))
        self._values[atom] = lambda: (self.ring.u[first], self.ring.one)


def _canonical(e: sp.Expr) -> sp.Expr:
    """With pi as a symbol, and the arguments of undetermined functions in one form: equal ones are the same function."""
    e = e.xreplace({sp.pi: PI})
    if not e.has(AppliedUndef):
        return e
    return e.replace(lambda part: isinstance(part, AppliedUndef), lambda part: part.func(*map(sp.cancel, part.args)))


def _functions(e: sp.Expr, x: set[sp.Symbol]) -> Iterable[sp.Expr]:
    """The functions in a formula that become generators; raises Unreadable at anything else."""
    for part in sp.preorder_traversal(e):
        if isinstance(part, sp.Pow) and not part.exp.is_Integer:
            raise Unreadable(f"{part} is not in the operator ring")
        if isinstance(part, sp.Function):
            if not part.free_symbols & x:
                kind = "undetermined" if isinstance(part, AppliedUndef) else "irrational"
                raise Unreadable(f"{part} is an {kind} constant")
            if not isinstance(part, (*HYPERBOLIC, *CIRCULAR, sp.log, AppliedUndef)):
                raise Unreadable(f"{part.func.__name__} is not in the operator ring")
            if any(isinstance(inside, sp.Function) for a in part.args for inside in sp.preorder_traversal(a)):
                raise Unreadable(f"{part} is a function of a function")
            yield part
        elif isinstance(part, sp.NumberSymbol):
            raise Unreadable(f"{part} is an irrational constant")


def _refuse_dependent_logarithms(arguments: list[Fraction], ring: OperatorRing) -> None:
    """Logarithms are independent if the exponents of the irreducible factors of their arguments are."""
    exponents: list[dict[str, int]] = []
    for numerator, denominator in arguments:
        found: dict[str, int] = {}
        for p, sign in ((numerator, 1), (denominator, -1)):
            for factor, k in p.factor()[1]:
                if any(factor.degrees()[: -len(ring.c)]):
                    found[str(factor)] = found.get(str(factor), 0) + sign * k
        exponents.append(found)
    names = sorted({name for row in exponents for name in row})
    if arguments and fmpq_mat([[row.get(name, 0) for name in names] for row in exponents]).rank() < len(arguments):
        raise Unreadable("the logarithms of the formulas are not independent")


def _jet(atom: sp.Expr, order: tuple[int, ...]) -> sp.Expr:
    """The partial derivative of an undetermined function, at its arguments."""
    if not any(order):
        return atom
    places = [sp.Dummy(f"z{j + 1}", real=True) for j in range(len(order))]
    derivative = sp.Derivative(atom.func(*places), *[(z, k) for z, k in zip(places, order) if k])
    return sp.Subs(derivative, tuple(places), tuple(atom.args))
