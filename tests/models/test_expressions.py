import math
import time

import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from zakai.models.expressions import ExpressionError
from zakai.models.formulas import parse_expression

x, y, t = sympy.symbols("x y t", real=True)
NAMES = {"x": x, "y": y, "t": t}


def read(text):
    return parse_expression(text, NAMES, ("gamma",))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-x**2", -(x**2)),
        ("2**-1", sympy.Rational(1, 2)),
        ("2**3**2", sympy.Integer(512)),
        ("(2**3)**2", sympy.Integer(64)),
        ("-2**2", sympy.Integer(-4)),
        ("1 - 2 - 3", sympy.Integer(-4)),
        ("x/y/2", x / y / 2),
        ("x/y*2", 2 * x / y),
        ("--x", x),
        ("x*-y", -x * y),
        ("x - -y", x + y),
        ("0.1 + 0.2", sympy.Rational(3, 10)),
        ("1e-3*x", x / 1000),
        (".5*x + 2.", x / 2 + 2),
        ("x**0.5", sympy.sqrt(x)),
        ("x**(3/2)", x ** sympy.Rational(3, 2)),
        ("abs(x)", sympy.Abs(x)),
        ("sqrt(x**2)", sympy.Abs(x)),
        ("sin(pi/2) + erf(y)", 1 + sympy.erf(y)),
        ("t/40 *\tx", t * x / 40),
        ("atan(tanh(x)) + acos(y)", sympy.atan(sympy.tanh(x)) + sympy.acos(y)),
    ],
)
def test_a_formula_is_read_as_python_and_sympy_would(text, expected):
    assert read(text) == expected


def test_an_undetermined_function_takes_any_number_of_arguments():
    gamma = sympy.Function("gamma", real=True)
    assert read("gamma(x + y) - gamma(x, t)") == gamma(x + y) - gamma(x, t)


def test_the_absolute_value_of_what_may_not_be_real_is_not_simplified_away():
    assert read("abs(sqrt(x))").has(sympy.sqrt(x))


@pytest.mark.parametrize(
    ("text", "position", "words"),
    [
        ("", 1, "empty"),
        ("x +", 4, "ends where"),
        ("x y", 3, "write *"),
        ("2x", 2, "write *"),
        ("(x", 3, "')'"),
        ("x)", 2, "operator"),
        ("x^2", 2, "**"),
        ("1..2", 3, "operator"),
        ("1_000", 2, "operator"),
        ("z + 1", 1, "unknown name 'z'"),
        ("x + xx", 5, "did you mean 'x'"),
        ("snh(x)", 1, "did you mean 'sinh'"),
        ("sin + 1", 1, "parentheses"),
        ("x(2)", 1, "not a function"),
        ("sin(x, y)", 1, "takes 1 argument"),
        ("x**y", 4, "exponent"),
        ("x**pi", 4, "exponent"),
        ("2**x", 4, "exponent"),
        ("x**65", 4, "larger than 64"),
        ("x**(1/13)", 5, "at most 12"),
        ("1/0", 3, "division by zero"),
        ("x + 1/(x - x)", 8, "division by zero"),
        ("0**-1", 1, "division by zero"),
        ("y + log(-2)", 5, "log of"),
        ("log(0)", 1, "log of"),
        ("sqrt(-2)", 1, "square root"),
        ("sqrt(1 - sqrt(2))", 1, "square root"),
        ("(-8)**(1/3)", 1, "fractional power"),
        ("asin(2)", 1, "outside"),
        ("E", 1, "unknown name"),
        ("I*x", 1, "unknown name"),
    ],
)
def test_a_formula_that_cannot_be_read_is_refused_at_its_position(text, position, words):
    with pytest.raises(ExpressionError) as error:
        read(text)
    assert words in str(error.value)
    assert str(error.value).startswith(f"column {error.value.position}: ")
    assert error.value.position == position
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("__import__('os')", "unexpected character"),
        ("x.__class__", "attributes"),
        ("lambda: 1", "unexpected character"),
        ("x[0]", "indexing"),
        ("x < y", "comparisons"),
        ("'x'", "unexpected character"),
        ("x if y else t", "there is no if"),
        ("\uff13*x", "unexpected character"),
        ("\u0445 + 1", "unexpected character"),
        ("x\x00", "unexpected character"),
        ("x" * 10_000_000, "10000000 characters"),
        ("(" * 10_000 + "x" + ")" * 10_000, "characters"),
        ("(" * 4_000 + "x" + ")" * 4_000, "nested deeper"),
        ("sin(" * 200 + "x" + ")" * 200, "nested deeper"),
        ("x" + "**1" * 200, "nested deeper"),
        ("1/(1+" * 60 + "x" + ")" * 60, "nested deeper"),
        ("9**9**9", "larger than 64"),
        ("(10**40)**60", "too large"),
        ("((2*x)**64)**64", "degree"),
        ("*".join(["x"] * 300), "degree"),
        ("exp(exp(exp(100)))", "too large"),
        ("1e308*10", "too large"),
        ("1e200*x*1e200", "too large"),
        ("1e-300*1e-300", "too small"),
        ("1e400", "outside 1e-308 to 1e308"),
        ("1e5000000000", "outside 1e-308 to 1e308"),
        ("0." + "0" * 400 + "1", "outside 1e-308 to 1e308"),
        ("1" * 41, "40 significant digits"),
    ],
)
def test_a_hostile_formula_is_refused_at_once_in_one_short_line(text, words):
    began = time.process_time()
    with pytest.raises(ExpressionError, match=words) as error:
        read(text)
    assert time.process_time() - began < 5  # a bound on hostile input, not a timing
    assert len(str(error.value)) < 400 and str(error.value).isprintable()


@pytest.mark.parametrize(
    "text",
    [
        "+".join(["x*y"] * 2400),
        "-" * 9_000 + "x",
        "sin(" * 90 + "x" + ")" * 90,
        "abs(1+x*" * 33 + "x" + ")" * 33,
        "abs(" + "-".join(f"sqrt({k})" for k in range(2, 900)) + ")",
        "*".join(f"{k}**(1/{k % 11 + 2})" for k in range(2, 200)),
        "sqrt((x+y+t+1)**64*tanh((x+2*y+3*t+1)**64))",
        "cosh(abs((((tanh(sinh((tanh(((((t)**64*abs(2)*(pi*x)*cosh(1/3)*(y/2)*atan(y)))**-2)**(3/2)))**-2)))**-2)**2)**2))",
    ],
)
def test_a_large_formula_within_the_bounds_is_read_in_a_moment(text):
    began = time.process_time()
    read(text)
    assert time.process_time() - began < 5


_PIECES = st.sampled_from(
    ["x", "y", "t", "pi", "2", "0.5", "1e3", "-", "+", "*", "/", "**", "(", ")", "sin(", "log(", "abs(", "tanh(",
     "sqrt(", ",", " ", "gamma(", "__", ".", "e", "\x00", "64"]
)  # fmt: skip


@settings(max_examples=300, deadline=1000)
@given(st.one_of(st.text(max_size=60), st.lists(_PIECES, max_size=40).map("".join)))
def test_any_text_is_read_or_refused_with_a_position(text):
    try:
        read(text)
    except ExpressionError as error:
        assert 1 <= error.position <= len(text) + 1
        assert str(error).isprintable()


@settings(max_examples=100, deadline=1000)
@given(st.integers(-(10**6), 10**6), st.integers(0, 12))
def test_a_decimal_is_its_exact_value(digits, places):
    text = f"{digits}e-{places}"
    assert read(text) == sympy.Rational(digits, 10**places)


def test_numbers_up_to_the_largest_double_are_read():
    assert math.isfinite(float(read("1e308"))) and read("1e308") == 10**308
