"""The ring of operators: its laws, and that it acts on functions as SymPy's derivatives do."""

from __future__ import annotations

import math

import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from zakai.algebra.arguments import Unreadable
from zakai.algebra.generators import Reader
from zakai.algebra.operators import JetTowerEnds

X = sp.symbols("x y", real=True)
GAMMA = sp.Function("gamma", real=True)
SYSTEMS = {
    "polynomial": [X[0] * X[1]],
    "tanh": [sp.tanh(X[0] - 2 * X[1])],
    "circle": [sp.sin(X[0]), sp.cos(2 * X[0] + X[1])],
    "exponential": [sp.exp(-X[0]), sp.exp(2 * X[0] + X[1])],
    "hyperbolic": [sp.cosh(X[0]), sp.tanh(X[0])],
    "quotient": [1 / (1 + X[0] ** 2), X[1] / (2 + X[1] ** 2)],
    "logarithm": [sp.log(1 + X[0] ** 2)],
    "tangent": [sp.tan(X[0])],
    "undetermined": [GAMMA(X[0] + X[1])],
    "undetermined of two arguments": [GAMMA(X[0], X[0] * X[1])],
}
READERS = {name: Reader(expressions, X, ()) for name, expressions in SYSTEMS.items()}


def elements(name: str) -> st.SearchStrategy:
    """Small operators: sums of products of the variables of the ring, the highest jets left out."""
    reader = READERS[name]
    ring = reader.ring
    variables = [*ring.xi, *ring.x, *[reader.read(e) for e in SYSTEMS[name]]]
    monomial = st.lists(st.sampled_from(range(len(variables))), max_size=3)
    terms = st.lists(st.tuples(st.integers(-3, 3), monomial), min_size=1, max_size=3)

    def build(found):
        total = ring.zero
        for c, factors in found:
            total = total + c * math.prod((variables[k] for k in factors), start=ring.one)
        return ring.normal(total)

    return terms.map(build)


names = pytest.mark.parametrize("name", list(SYSTEMS))
few = settings(max_examples=12, deadline=None, derandomize=True)


@names
@few
@given(data=st.data())
def test_composition_is_associative_and_distributes(name, data):
    ring = READERS[name].ring
    a, b, c = (data.draw(elements(name)) for _ in range(3))
    assert ring.compose(ring.compose(a, b), c) == ring.compose(a, ring.compose(b, c))
    assert ring.compose(a, b + c) == ring.compose(a, b) + ring.compose(a, c)
    assert ring.bracket(a, b) == ring.compose(a, b) - ring.compose(b, a)


@names
@few
@given(data=st.data())
def test_brackets_are_antisymmetric_obey_jacobi_and_derive_products(name, data):
    ring = READERS[name].ring
    a, b, c = (data.draw(elements(name)) for _ in range(3))
    bracket, compose = ring.bracket, ring.compose
    assert (bracket(a, b) + bracket(b, a)).is_zero()
    jacobi = bracket(a, bracket(b, c)) + bracket(b, bracket(c, a)) + bracket(c, bracket(a, b))
    assert ring.normal(jacobi).is_zero()
    assert bracket(a, compose(b, c)) == ring.normal(compose(bracket(a, b), c) + compose(b, bracket(a, c)))


def applied(reader: Reader, symbol, function: sp.Expr) -> sp.Expr:
    """What an operator makes of a function, with SymPy's derivatives."""
    ring, total = reader.ring, sp.Integer(0)
    for monomial, c in symbol.to_dict().items():
        xi, rest = monomial[: ring.n], (*[0] * ring.n, *monomial[ring.n :])
        coefficient = reader.expression(ring.context.from_dict({rest: c}))
        total += coefficient * sp.diff(function, *[(s, k) for s, k in zip(X, xi)])
    return total


@names
@settings(max_examples=4, deadline=None, derandomize=True)
@given(data=st.data())
def test_composition_acts_as_one_operator_after_the_other(name, data):
    reader = READERS[name]
    a, b = data.draw(elements(name)), data.draw(elements(name))
    test_function = sp.exp(X[0] - X[1] / 2) + X[0] ** 2 * X[1] ** 3
    once = applied(reader, reader.ring.compose(a, b), test_function)
    twice = applied(reader, a, applied(reader, b, test_function))
    concrete = (once - twice).replace(GAMMA, lambda *z: sp.sin(sum(k * e for k, e in enumerate(z, 1)))).doit()
    point = {X[0]: sp.Rational(7, 5), X[1]: sp.Rational(3, 4)}
    assert abs(concrete.subs(point).evalf(40)) < 1e-25


@names
def test_formulas_are_read_as_what_they_are(name):
    reader = READERS[name]
    point = {X[0]: sp.Rational(7, 5), X[1]: sp.Rational(3, 4)}
    for expression in SYSTEMS[name]:
        back = (reader.expression(reader.read(expression)) - expression).replace(GAMMA, lambda *z: sp.sin(sum(z)))
        assert abs(back.subs(point).evalf(40)) < 1e-30


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (sp.exp(2 * X[0]), sp.exp(X[0]) ** 2),
        (sp.exp(X[0] + X[1]), sp.exp(X[0]) * sp.exp(X[1])),
        (sp.sin(2 * X[0]), 2 * sp.sin(X[0]) * sp.cos(X[0])),
        (sp.cos(X[0] + X[1]), sp.cos(X[0]) * sp.cos(X[1]) - sp.sin(X[0]) * sp.sin(X[1])),
        (sp.tanh(2 * X[0]), 2 * sp.tanh(X[0]) / (1 + sp.tanh(X[0]) ** 2)),
        (sp.tanh(X[0]), (sp.exp(X[0]) - sp.exp(-X[0])) / (sp.exp(X[0]) + sp.exp(-X[0]))),
        (sp.cosh(X[0]) ** 2, 1 + sp.sinh(X[0]) ** 2),
        (sp.tan(X[0]), sp.sin(X[0]) / sp.cos(X[0])),
        (1 / X[0] - 1 / (X[0] + 1), 1 / (X[0] * (X[0] + 1))),
        (sp.sin(sp.pi * X[0]) ** 2, 1 - sp.cos(sp.pi * X[0]) ** 2),
        (1 / (1 - sp.cos(X[0]) ** 2), 1 / sp.sin(X[0]) ** 2),
    ],
)
def test_what_is_algebraically_dependent_is_written_in_one_generator(one, other):
    reader = Reader([one, other], X, ())
    assert reader.read(one) == reader.read(other)
    assert reader.read(one) != reader.read(other) + reader.ring.one


def test_an_undetermined_function_of_equal_arguments_is_one_function():
    one, other = GAMMA(X[0] * (X[0] + X[1])), GAMMA(X[0] ** 2 + X[0] * X[1])
    assert one != other
    reader = Reader([one, other, GAMMA(X[0])], X, ())
    assert reader.read(one) == reader.read(other) != reader.read(GAMMA(X[0]))


def test_relations_that_overlap_are_completed():
    # From v c = 1 and c^2 + s^2 = 1 follows v s^2 = v - c.
    reader = Reader([1 / sp.cos(X[0]), sp.sin(X[0])], X, ())
    v, c, s = (reader.read(e) for e in (1 / sp.cos(X[0]), sp.cos(X[0]), sp.sin(X[0])))
    assert reader.ring.normal(v * s**2) == reader.ring.normal(v - c)


def test_independent_functions_stay_apart():
    functions = [sp.exp(X[0]), sp.exp(X[0] ** 2), sp.sin(X[0]), sp.cos(X[0]), sp.log(X[0]), sp.exp(X[1]), sp.tanh(X[0] + X[1])]
    reader = Reader(functions, X, ())
    assert len({str(reader.read(f)) for f in functions}) == len(functions)


@pytest.mark.parametrize(
    ("expressions", "words"),
    [
        ([sp.sqrt(X[0])], "sqrt"),
        ([sp.Abs(X[0])], "Abs is not in the operator ring"),
        ([sp.erf(X[0])], "erf is not in the operator ring"),
        ([sp.exp(X[0] + 1), sp.exp(X[0])], "differ by a constant"),
        ([sp.sin(1) * X[0]], "irrational constant"),
        ([sp.E * X[0]], "irrational constant"),
        ([sp.sqrt(2) * X[0]], "not in the operator ring"),
        ([sp.log(X[0]), sp.log(X[0] ** 2, evaluate=False)], "not independent"),
        ([sp.sin(sp.exp(X[0]))], "function of a function"),
        ([sp.exp(1 / X[0])], "not a polynomial"),
    ],
)
def test_what_the_ring_cannot_hold_is_refused_with_the_reason(expressions, words):
    with pytest.raises(Unreadable, match=words):
        Reader(expressions, X, ())


def test_a_tower_of_derivatives_that_runs_out_raises():
    reader = Reader([GAMMA(X[0])], X, (), jets=2)
    p = reader.read(GAMMA(X[0]))
    p = reader.ring.total_derivative(reader.ring.total_derivative(p, 0), 0)
    with pytest.raises(JetTowerEnds):
        reader.ring.total_derivative(p, 0)


def test_more_arguments_than_there_may_be_are_refused_and_many_are_quick():
    x = sp.symbols("x1:41", real=True)
    assert Reader([GAMMA(*x[:16])], x[:16], ()).ring.generators == 1 + 153  # one inverse, and (18 over 2) derivatives
    with pytest.raises(Unreadable, match="more than 16 arguments"):
        Reader([GAMMA(*x)], x, ())
