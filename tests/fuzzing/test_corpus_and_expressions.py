"""A short run of what fuzz/ does at length: its corpus again, and Hypothesis for what can be said about whole expressions."""

from __future__ import annotations

import ast
import time
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from fuzz.oracle import value_or_one_line
from fuzz.trees import decimal, printed, without_positions
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from zakai.cli import main
from zakai.engine.stored import load_result
from zakai.models.expressions import ExpressionError, Name, Negative, Node, Number, Power, Product, Sum, parse

CORPUS = Path(__file__).parents[2] / "fuzz" / "corpus"
# HDF5 is only ever given a file in a process of its own, and forking one from here would copy JAX's threads.
TARGETS = sorted(folder.name for folder in CORPUS.iterdir() if folder.name != "result")


@pytest.mark.parametrize("target", TARGETS)
def test_no_input_of_the_corpus_is_a_finding(target):
    one_input = import_module(f"fuzz.{target}").one_input
    for path in sorted((CORPUS / target).iterdir()):
        began = time.process_time()
        one_input(path.read_bytes())
        assert time.process_time() - began < 2, path.name


def test_results_of_the_corpus_are_read_or_refused():
    for path in sorted((CORPUS / "result").iterdir()):
        value_or_one_line(lambda path=path: load_result(path))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(TARGETS), st.data())
def test_nothing_near_the_corpus_is_a_finding(target, data):
    content = bytearray(data.draw(st.sampled_from(sorted((CORPUS / target).iterdir()))).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(content)))
        content[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    import_module(f"fuzz.{target}").one_input(bytes(content))


@pytest.mark.parametrize("target", ["model_file", "record"])
def test_the_command_takes_what_the_corpus_holds_or_leaves_with_code_2_and_one_line(target, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.toml").write_text('state = ["x"]\ndrift = ["x"]\nobservation = ["x"]\n')
    for path in sorted((CORPUS / target).iterdir()):
        arguments = ["methods", str(path)] if target == "model_file" else ["filter", "model.toml", str(path), "-o", "result.nc"]
        code, said = main(arguments), capsys.readouterr().err
        assert code == 2 and said.startswith("error: ") and said.count("\n") == 1 or code == 0, path.name


# ---- expressions: what our parser says a formula is, against Python's own parser and exact arithmetic

NAMES = {"x": Fraction(3, 7), "y": Fraction(-5, 2), "t": Fraction(11)}
numbers = st.integers(0, 99).map(str) | st.builds("{}e-{}".format, st.integers(0, 99), st.integers(0, 3))
atoms = numbers | st.sampled_from(sorted(NAMES))
formulas = st.recursive(
    atoms,
    lambda inner: st.one_of(
        st.builds("{} {} {}".format, inner, st.sampled_from("+-*/"), inner),
        st.builds("{}{}{}".format, inner, st.sampled_from("+-*/"), inner),
        st.builds("({})".format, inner),
        st.builds("{}{}".format, st.sampled_from(["-", "+", "--", "-+-"]), inner),
        st.builds("{}**{}".format, inner, st.sampled_from(["2", "-1", "3", "--2", "(1+1)", "-2**0"])),
    ),
    max_leaves=12,
)


def by_python(text: str) -> Fraction:
    """The value of a formula by Python's parser, whose numbers are read again as exact decimals."""

    def value(node: Any) -> Fraction:
        match node:
            case ast.Constant():
                return Fraction(ast.get_source_segment(text, node))
            case ast.Name():
                return NAMES[node.id]
            case ast.UnaryOp():
                return -value(node.operand) if isinstance(node.op, ast.USub) else value(node.operand)
            case ast.BinOp():
                return arithmetic(type(node.op).__name__, value(node.left), value(node.right))
        raise AssertionError(ast.dump(node))

    return value(ast.parse(text, mode="eval").body)


def arithmetic(operation: str, a: Fraction, b: Fraction) -> Fraction:
    if operation == "Pow":
        if b.denominator > 1 or abs(b) > 64:
            raise OverflowError
        return a ** int(b)
    return {"Add": lambda: a + b, "Sub": lambda: a - b, "Mult": lambda: a * b, "Div": lambda: a / b}[operation]()


def by_our_tree(node: Node) -> Fraction:
    match node:
        case Number():
            return node.value
        case Name():
            return NAMES[node.name]
        case Negative():
            return -by_our_tree(node.operand)
        case Power():
            return arithmetic("Pow", by_our_tree(node.base), by_our_tree(node.exponent))
        case Sum():
            return sum((by_our_tree(term) if plus else -by_our_tree(term) for plus, term in node.terms), Fraction(0))
        case Product():
            product = Fraction(1)
            for multiply, factor in node.factors:
                product = arithmetic("Mult" if multiply else "Div", product, by_our_tree(factor))
            return product
    raise AssertionError(node)


@settings(max_examples=300, deadline=None)
@given(formulas)
def test_a_formula_is_worth_what_python_says(text):
    try:
        expected = by_python(text)
    except (ZeroDivisionError, OverflowError) as error:
        with pytest.raises(type(error)):
            by_our_tree(parse(text))
    else:
        assert by_our_tree(parse(text)) == expected


@settings(max_examples=300, deadline=None)
@given(formulas)
def test_a_tree_that_is_printed_is_read_as_the_same_tree(text):
    tree = parse(text)
    assert without_positions(parse(printed(tree))) == without_positions(tree)


@given(st.integers(0, 10**40 - 1), st.integers(-260, 260))
def test_a_decimal_is_printed_as_itself(digits, exponent):
    value = digits * Fraction(10) ** exponent
    assert parse(decimal(value)) == Number(value, 1)


@settings(max_examples=500, deadline=None)
@given(st.text(max_size=40) | st.text("xyt0123456789.eE+-*/(), \n\t\0sincolgabrt_^", max_size=40))
def test_any_text_is_a_tree_or_refused_at_a_position(text):
    try:
        parse(text)
    except ExpressionError as error:
        assert 1 <= error.position <= len(text) + 1 and str(error).isprintable()
