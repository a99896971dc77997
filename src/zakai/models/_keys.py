"""From the keys of a model file to the attributes of a `Model`: names, formulas and matrices, each error with its key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import sympy

from zakai.errors import InputError
from zakai.models import _entries, checks
from zakai.models._errors import did_you_mean, listing, named
from zakai.models._law_keys import read_law, read_observed, read_path
from zakai.models.expressions import MAX_LENGTH
from zakai.models.formulas import parse_expression

if TYPE_CHECKING:
    from zakai.models.model import Model

HOLDS = ("zero", "linear")
MOST_STATES = 1024  # of states, sensors and noises: a default identity matrix has this many squared entries
MOST_CHARACTERS = 250_000  # of all different formulas together: what a computer reads in seconds
MOST_PARENTHESES = 8_192
OBSERVATION_KINDS = ("increments", "path", "rates", "samples")


def read_names(model: Model, keys: Mapping[str, Any]) -> None:
    """Read the names, the numbers of states and sensors, and the kind of observation."""
    canonical, attributes = model._keys, vars(model)
    with named("name"):
        name = keys.get("name", "unnamed")
        if not isinstance(name, str):
            raise InputError(f"expected a text, got {_entries.kind_of(name)}")
        attributes["name"] = canonical["name"] = name
    with named("state"):
        state = _entries.names(keys["state"], "a list of names")
        if not 1 <= len(state) <= MOST_STATES:
            raise InputError(f"expected a list of 1 to {MOST_STATES} names, got {len(state)}")
    with named("functions"):
        functions = _entries.names(keys.get("functions", ()), "a list of names")
        if len(functions) > MOST_STATES:
            raise InputError(f"expected a list of at most {MOST_STATES} names, got {len(functions)}")
        _refuse_clash(functions, state, "a state")
        _refuse_clash(functions, tuple(model.tables), "a table")
    with named("parameters"):
        parameters = read_parameters(keys.get("parameters") or {})
        _refuse_clash(parameters, state, "a state")
        _refuse_clash(parameters, functions, "an undetermined function")
    with named("inputs"):
        inputs = _entries.names(keys.get("inputs", ()), "a list of names of known signals")
        if len(inputs) > MOST_STATES:
            raise InputError(f"expected a list of at most {MOST_STATES} names, got {len(inputs)}")
        for others, what in ((state, "a state"), (functions, "an undetermined function"), (parameters, "a parameter")):
            _refuse_clash(inputs, tuple(others), what)
    with named("tables"):
        for others, what in ((state, "a state"), (parameters, "a parameter"), (inputs, "an input")):
            _refuse_clash(model.tables, tuple(others), what)
    with named("input_hold"):
        hold = _one_of(keys.get("input_hold", "zero"), HOLDS)
        if "input_hold" in keys and not inputs:
            raise InputError("there are no inputs to hold; give inputs, or leave it out")
    with named("periodic"):
        periodic = _entries.names(keys.get("periodic", ()), "a list of states that are angles")
        for angle in periodic:
            if angle not in state:
                hint = did_you_mean(angle, state)
                raise InputError(f"{angle!r} is not a state{hint} (the states are {listing(state)})")
    with named("observation_kind"):
        kind = _one_of(keys.get("observation_kind", "increments"), OBSERVATION_KINDS)
    attributes.update(
        kind_given=keys.get("observation_kind") is not None,
        state=state,
        functions=functions,
        parameters=parameters,
        periodic=periodic,
        observation_kind=kind,
        inputs=inputs,
        input_hold=hold,
        u=tuple(sympy.Symbol(name, real=True) for name in inputs),
        n=len(state),
        x=tuple(sympy.Symbol(name, real=True) for name in state),
        t=sympy.Symbol("t", real=True),
        parameter_symbols=tuple(sympy.Symbol(name, real=True) for name in parameters),
    )
    canonical.update(state=state, functions=functions, parameters=parameters, periodic=periodic)
    if model.kind_given:
        canonical["observation_kind"] = kind
    canonical.update(inputs=inputs, input_hold=hold)


def read_formulas(model: Model, keys: Mapping[str, Any]) -> None:
    """Read the drift, the observation, the noises and the law of an observation."""
    canonical, n = model._keys, model.n
    with named("drift"):
        canonical["drift"] = _entries.vector_of_formulas(keys["drift"], n, f"a list of {n} formulas (one a state)")
    custom = keys.get("observation_log_density") is not None
    if custom:
        canonical["observation"] = ["0"] * read_observed(model, keys)
    with nullcontext() if custom else named("observation"):
        if not custom:
            formulas = "a list of formulas (one a sensor)"
            canonical["observation"] = _entries.vector_of_formulas(keys["observation"], None, formulas)
        if not 1 <= len(canonical["observation"]) <= MOST_STATES:
            raise InputError(f"expected a list of 1 to {MOST_STATES} formulas (one a sensor)")
    m = vars(model)["m"] = len(canonical["observation"])
    given = {key: keys.get(key) for key in checks.COEFFICIENTS}
    if given["diffusion"] is not None:
        with named("diffusion"):
            rows = f"{n} rows (one a state) of formulas (one a noise)"
            canonical["diffusion"] = _entries.matrix_of_formulas(given["diffusion"], n, None, rows)
    else:
        canonical["diffusion"] = _identity(n)
    r = len(canonical["diffusion"][0])
    if r > MOST_STATES:
        raise InputError(f"diffusion: at most {MOST_STATES} noises are read, got rows of {r}")
    with named("cross_noise"):
        if given["cross_noise"] is None:
            canonical["cross_noise"] = [["0"] * m for _ in range(r)]
        else:
            if model.observation_kind == "samples":
                raise InputError("samples have no noise between their times; it is for increments, path and rates")
            rows = f"{r} rows (one a noise) of {m} formulas (one a sensor)"
            canonical["cross_noise"] = _entries.matrix_of_formulas(given["cross_noise"], r, m, rows)
    for key, size, what in (("process_noise", r, "noise"), ("observation_noise", m, "sensor")):
        if given[key] is None:
            canonical[key] = _identity(size)
            continue
        with named(key):
            rows = f"{size} rows of {size} formulas (one a {what})"
            canonical[key] = _entries.square_of_formulas(given[key], size, rows)
    _refuse_long(canonical)
    if not custom:
        read_path(model, keys)
    read = reader(model)
    for key in ("drift", "observation"):
        with named(key):
            column = [[read(text, f"[{i}]")] for i, text in enumerate(canonical[key])]
        vars(model)[key] = sympy.ImmutableMatrix(column)
    for key in checks.COEFFICIENTS:
        with named(key):
            entries = {
                (i, j): read(text, f"[{i}][{j}]")
                for i, row in enumerate(canonical[key])
                for j, text in enumerate(row)
                if text != "0"
            }
            vars(model)[key] = _matrix(len(canonical[key]), len(canonical[key][0]), entries)
            if key != "diffusion" and not (key == "observation_noise" and model.observation_kind == "samples"):
                checks.check_independent_of_state(key, model)
    read_law(model, keys, read)


def reader(model: Model, in_time: bool = True) -> Callable[..., sympy.Expr]:
    """Return a function that reads a formula at a place; it remembers, for large matrices repeat few formulas."""
    symbols = dict(zip((*model.state, *model.parameters), (*model.x, *model.parameter_symbols), strict=True))
    if in_time:
        symbols |= {"t": model.t, **dict(zip(model.inputs, model.u, strict=True))}
        if model.observation_kind != "samples":
            symbols |= dict(zip(model.observed, model.z, strict=True))
    known: dict[str, sympy.Expr] = {}

    def read(text: str, place: str = "") -> sympy.Expr:
        if text not in known:
            with named(place) if place else nullcontext():
                known[text] = parse_expression(text, symbols, model.functions, model.tables)
        return known[text]

    return read


def _matrix(rows: int, columns: int, entries: Mapping[tuple[int, int], sympy.Expr]) -> sympy.ImmutableMatrix:
    """The matrix with these entries and zeros; noises of a thousand states are a million zeros, which SymPy need not see."""
    return sympy.ImmutableDenseMatrix._fromrep(sympy.SparseMatrix(rows, columns, entries)._rep)


def _refuse_long(canonical: Mapping[str, Any]) -> None:
    """Raise InputError if all formulas together are more than can be read in a moment, before any of them is."""
    rows = [row for key in checks.COEFFICIENTS for row in canonical[key]]
    texts = set(canonical["drift"]).union(canonical["observation"], *rows)
    characters, parentheses = sum(map(len, texts)), sum(text.count("(") for text in texts)
    if characters > MOST_CHARACTERS and max(map(len, texts)) <= MAX_LENGTH:
        raise InputError(f"its formulas have {characters} characters together; at most {MOST_CHARACTERS} are read")
    if parentheses > MOST_PARENTHESES and max(text.count("(") for text in texts) <= MOST_PARENTHESES:
        raise InputError(f"its formulas have {parentheses} parentheses together; at most {MOST_PARENTHESES} are read")


def _identity(size: int) -> list[list[str]]:
    return [["1" if i == j else "0" for j in range(size)] for i in range(size)]


def read_parameters(table: Any) -> dict[str, sympy.Rational]:
    if not isinstance(table, Mapping):
        raise InputError(f"expected a table of names and numbers, got {_entries.kind_of(table)}")
    if len(table) > MOST_STATES:
        raise InputError(f"expected a table of at most {MOST_STATES} numbers, got {len(table)}")
    parameters = {}
    for name, value in table.items():
        _entries.allowed_name(str(name))
        with named(name):
            parameters[name] = _entries.exact_number(value)
    return parameters


def _one_of(value: Any, options: tuple[str, ...]) -> str:
    if not isinstance(value, str) or value not in options:
        hint = did_you_mean(value, options) if isinstance(value, str) else ""
        raise InputError(f"expected one of {listing(options)}, got {_entries.kind_of(value)}{hint}")
    return value


def _refuse_clash(names: Any, others: tuple[str, ...], what: str) -> None:
    for name in names:
        if name in others:
            raise InputError(f"the name {name!r} is already {what}")
