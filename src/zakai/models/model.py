"""The model: what the system is, checked once and then immutable. SymPy inside, no numerics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import sympy

from zakai import _display
from zakai.densities import Density
from zakai.errors import InputError
from zakai.models import _entries, checks
from zakai.models._errors import did_you_mean, listing, named
from zakai.models._law_keys import read_law, read_observed
from zakai.models._toml import to_toml
from zakai.models.domain import Interval, check_prior, read_domain
from zakai.models.expressions import MAX_LENGTH
from zakai.models.features import features_of, formulas_of
from zakai.models.formulas import parse_expression
from zakai.models.observation_law import ObservationLaw
from zakai.models.prior import Prior, read_prior
from zakai.models.tables import Table, read_tables

KEYS = (
    "name",
    "state",
    "drift",
    "observation",
    "observation_kind",
    "diffusion",
    "process_noise",
    "observation_noise",
    "start",
    "periodic",
    "functions",
    "parameters",
    "prior",
    "inputs",
    "input_hold",
    "cross_noise",
    "observation_family",
    "degrees_of_freedom",
    "concentration",
    "observation_log_density",
    "observed",
    "domain",
    "tables",
)
HOLDS = ("zero", "linear")
Formulas = Sequence[str | float | sympy.Expr]
FormulaRows = Sequence[Formulas]
MOST_STATES = 1024  # of states, sensors and noises: a default identity matrix has this many squared entries
MOST_CHARACTERS = 250_000  # of all different formulas together: what a computer reads in seconds
MOST_PARENTHESES = 8_192
OBSERVATION_KINDS = ("increments", "path", "rates", "samples")


class Model:
    """A continuous-time stochastic system and what is observed of it.

        dx = f(x,u,t) dt + g(x,u,t) dv    E dv dv' = Q(t) dt                        x in R^n, u known
        dy = h(x,u,t) dt + dw             E dw dw' = S(t) dt, E dv dw' = C(t) dt    ("increments", "path", "rates")
        z_k ~ p(z | x(t_k), u(t_k), t_k)  N(h, S) by default                        ("samples")

    Keywords, each as in a model file; a formula is a text, a number or a SymPy expression whose symbols are
    meant by name:

    * `state`: n names; `drift`: f, n formulas; `observation`: h, m formulas (these three are required);
    * `observation_kind`: increments (the default), path, rates or samples;
    * `diffusion`: g, n rows of r formulas (Ito); `process_noise`: Q, r x r; `observation_noise`: S, m x m; `cross_noise`:
      C, r x m; Q, C and S in t and parameters only, S of samples in the state and inputs too; by default identities, and
      zero for C; covariances are per unit time, or per observation for samples;
    * `inputs`: names of known signals u(t); `input_hold`: "zero" (the default) or "linear";
    * `observation_family`, for samples: "gaussian", "student-t" (`degrees_of_freedom`), "poisson", "bernoulli" or "von-mises"
      (`concentration`), for all coordinates or a list; or `observation_log_density` instead of `observation`: log p(z | x) in
      the state and the names in `observed`, normalised over z if the evidence is to mean something;
    * `domain`: state -> {"lower": a, "upper": b, "boundary": "natural" or "reflecting"};
    * `tables`: name -> (x, values), (x, y, values) or a table as in a model file;
    * `start`: the time at which the prior holds; `periodic`: states that are angles (period 2 pi);
    * `parameters`: name -> number; `functions`: names of undetermined functions, for analysis only;
    * `prior`: a table as in a model file, or a `GaussianPrior`, `MixturePrior` or `DensityPrior`; `name`: a
      title.

    Raises InputError, in one line that names the key, for anything that is missing, unknown or does not fit.

        >>> Model(state=["x"], drift=["-a*x"], observation=["sin(x)"], parameters={"a": 0.5}).drift
        Matrix([[-a*x]])
    """

    name: str
    state: tuple[str, ...]
    x: tuple[sympy.Symbol, ...]
    t: sympy.Symbol
    n: int
    m: int
    parameters: dict[str, sympy.Rational]
    parameter_symbols: tuple[sympy.Symbol, ...]
    drift: sympy.ImmutableMatrix
    diffusion: sympy.ImmutableMatrix
    process_noise: sympy.ImmutableMatrix
    observation: sympy.ImmutableMatrix
    observation_noise: sympy.ImmutableMatrix
    observation_kind: str
    start: float
    periodic: tuple[str, ...]
    functions: tuple[str, ...]
    prior: Prior | None
    source: str
    inputs: tuple[str, ...]
    u: tuple[sympy.Symbol, ...]
    input_hold: str
    cross_noise: sympy.ImmutableMatrix
    observation_family: tuple[str, ...]
    family_parameters: dict[tuple[str, int], sympy.Expr]
    log_density: sympy.Expr | None
    observed: tuple[str, ...]
    z: tuple[sympy.Symbol, ...]
    domain: dict[str, Interval]
    tables: dict[str, Table]

    def __init__(
        self,
        *,
        state: Sequence[str] | None = None,
        drift: Formulas | None = None,
        observation: Formulas | None = None,
        observation_kind: str | None = None,
        prior: Prior | Density | Mapping[str, Any] | None = None,
        diffusion: FormulaRows | None = None,
        process_noise: FormulaRows | None = None,
        observation_noise: FormulaRows | None = None,
        cross_noise: FormulaRows | None = None,
        parameters: Mapping[str, Any] | None = None,
        start: float | None = None,
        periodic: Sequence[str] | None = None,
        name: str | None = None,
        inputs: Sequence[str] | None = None,
        input_hold: str | None = None,
        observation_family: str | Sequence[str] | None = None,
        degrees_of_freedom: Any = None,
        concentration: Any = None,
        observation_log_density: str | sympy.Expr | None = None,
        observed: Sequence[str] | None = None,
        domain: Mapping[str, Mapping[str, Any]] | None = None,
        tables: Mapping[str, Any] | None = None,
        functions: Sequence[str] | None = None,
        **unknown: Any,
    ):
        given = {key: value for key, value in locals().items() if key in KEYS and value is not None}
        self._read({**given, **unknown}, source="<python>", text=None, folder=Path())

    @classmethod
    def _from_file(cls, keys: Mapping[str, Any], source: str, text: str | None, folder: Path | None = None) -> Model:
        model = object.__new__(cls)
        model._read(keys, source, text, folder)
        return model

    def _read(self, keys: Mapping[str, Any], source: str, text: str | None, folder: Path | None) -> None:
        _entries.known_keys(keys, KEYS)
        for key in ("state", "drift", "observation"):
            if keys.get(key) is None and not (key == "observation" and keys.get("observation_log_density") is not None):
                raise InputError(f"{key}: missing; a model needs state, drift and observation")
        canonical: dict[str, Any] = {}
        vars(self).update(source=source, _keys=canonical, log_density=None, z=(), observed=())
        with named("tables"):
            vars(self)["tables"] = read_tables(keys.get("tables") or {}, folder)
            canonical["tables"] = {name: table.keys() for name, table in self.tables.items()}
            for name in self.tables:
                _entries.allowed_name(name)
        if any(isinstance(table, Mapping) and "file" in table for table in (keys.get("tables") or {}).values()):
            text = None  # the text of a model stands for itself, and this one needs a file
        self._read_names(keys)
        self._read_formulas(keys)
        with named("domain"):
            vars(self)["domain"] = read_domain(keys.get("domain") or {}, self.state, self.periodic)
            canonical["domain"] = {name: interval.keys() for name, interval in self.domain.items()}
        with named("start"):
            vars(self)["start"] = canonical["start"] = _entries.number(keys.get("start", 0.0))
        with named("prior"):
            vars(self)["prior"], canonical["prior"] = self._prior(keys.get("prior"))
        check_prior(self, self.prior)
        checks.check_constant_noise(self)
        checks.check_periodic(self)
        if text is not None:
            vars(self)["text"] = text

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("a Model is immutable; make another one, or use with_parameters")

    __delattr__ = __setattr__  # type: ignore[assignment]

    def __repr__(self) -> str:
        observed = _display.counted(self.m, "observation")
        return f"Model({self.name!r}: state {_display.short_names(self.state)}, {observed} as {self.observation_kind})"

    def _repr_html_(self) -> str:
        samples = self.observation_kind == "samples"
        rows = [(f"d{name}", f"({_short(formula)}) dt + noise") for name, formula in zip(self.state, self.drift, strict=True)]
        if self.log_density is not None:
            rows.append(("log p(z | x)", _short(self.log_density)))
        else:
            place = [""] if self.m == 1 else [str(j + 1) for j in range(self.m)]
            left, right = ("z", "{} with noise") if samples else ("dy", "({}) dt + noise")
            rows += [(f"{left}{j}", right.format(_short(formula))) for j, formula in zip(place, self.observation, strict=True)]
        rows += [(f"{name} =", _display.number(float(value))) for name, value in self.parameters.items()]
        return _display.html_table(repr(self), ("", ""), rows)

    def _read_names(self, keys: Mapping[str, Any]) -> None:
        canonical, attributes = self._keys, vars(self)
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
            _refuse_clash(functions, tuple(self.tables), "a table")
        with named("parameters"):
            parameters = _read_parameters(keys.get("parameters") or {})
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
                _refuse_clash(self.tables, tuple(others), what)
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
        canonical.update(state=state, functions=functions, parameters=parameters, periodic=periodic, observation_kind=kind)
        canonical.update(inputs=inputs, input_hold=hold)

    def _read_formulas(self, keys: Mapping[str, Any]) -> None:
        canonical, n = self._keys, self.n
        with named("drift"):
            canonical["drift"] = _entries.vector_of_formulas(keys["drift"], n, f"a list of {n} formulas (one a state)")
        custom = keys.get("observation_log_density") is not None
        if custom:
            canonical["observation"] = ["0"] * read_observed(self, keys)
        with nullcontext() if custom else named("observation"):
            if not custom:
                formulas = "a list of formulas (one a sensor)"
                canonical["observation"] = _entries.vector_of_formulas(keys["observation"], None, formulas)
            if not 1 <= len(canonical["observation"]) <= MOST_STATES:
                raise InputError(f"expected a list of 1 to {MOST_STATES} formulas (one a sensor)")
        m = vars(self)["m"] = len(canonical["observation"])
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
                if self.observation_kind == "samples":
                    raise InputError("samples have no noise between their times; it is for increments, path and rates")
                rows = f"{r} rows (one a noise) of {m} formulas (one a sensor)"
                canonical["cross_noise"] = _entries.matrix_of_formulas(given["cross_noise"], r, m, rows)
        for key, size, what in (("process_noise", r, "noise"), ("observation_noise", m, "sensor")):
            if given[key] is None:
                canonical[key] = _identity(size)
                continue
            with named(key):
                rows = f"{size} rows of {size} formulas (one a {what})"
                canonical[key] = _entries.matrix_of_formulas(given[key], size, size, rows)
        _refuse_long(canonical)
        read = self._reader()
        for key in ("drift", "observation"):
            with named(key):
                column = [[read(text, f"[{i}]")] for i, text in enumerate(canonical[key])]
            vars(self)[key] = sympy.ImmutableMatrix(column)
        for key in checks.COEFFICIENTS:
            with named(key):
                entries = {
                    (i, j): read(text, f"[{i}][{j}]")
                    for i, row in enumerate(canonical[key])
                    for j, text in enumerate(row)
                    if text != "0"
                }
                vars(self)[key] = _matrix(len(canonical[key]), len(canonical[key][0]), entries)
                if key != "diffusion" and not (key == "observation_noise" and self.observation_kind == "samples"):
                    checks.check_independent_of_state(vars(self)[key], self)
        read_law(self, keys, read)

    def _reader(self, in_time: bool = True) -> Callable[..., sympy.Expr]:
        """A function that reads a formula at a place; it remembers, for large matrices repeat few formulas."""
        symbols = dict(zip((*self.state, *self.parameters), (*self.x, *self.parameter_symbols), strict=True))
        if in_time:
            symbols |= {"t": self.t, **dict(zip(self.inputs, self.u, strict=True))}
        known: dict[str, sympy.Expr] = {}

        def read(text: str, place: str = "") -> sympy.Expr:
            if text not in known:
                with named(place) if place else nullcontext():
                    known[text] = parse_expression(text, symbols, self.functions, self.tables)
            return known[text]

        return read

    @cached_property
    def covariance(self) -> sympy.ImmutableMatrix:
        """G = g Q g', the covariance of the state's noise per unit time, of shape (n, n)."""
        return sympy.ImmutableMatrix(self.diffusion * self.process_noise * self.diffusion.T)

    @cached_property
    def features(self) -> dict[str, str]:
        """What the model has beyond f(x, t), g(t), h(x, t) and Gaussian noise, each feature with the words that show it."""
        return features_of(self)

    @cached_property
    def depends_on_time(self) -> bool:
        """Whether a formula depends on t or on an input."""
        return bool(self.inputs) or any(self.t in formula.free_symbols for formula in formulas_of(self))

    @cached_property
    def observation_law(self) -> ObservationLaw:
        """The law of an observation given the state, as NumPy functions."""
        return ObservationLaw(self)

    @cached_property
    def text(self) -> str:
        """The model file, as it was read or as `to_toml` writes it."""
        return self.to_toml()

    def theta(self) -> np.ndarray:
        """The values of the parameters in their order, of shape (p,), in double precision."""
        return np.array([float(value) for value in self.parameters.values()], dtype=float)

    def with_parameters(self, /, **values: Any) -> Model:
        """The same model with other values of some parameters.

        `values` are numbers by parameter name. Raises InputError for an unknown name, or if a noise matrix
        is no longer one.

            >>> from zakai.models import load_model
            >>> model = load_model("gallery:kalman-bucy-1d")
            >>> model.with_parameters(a=0.7).parameters["a"]
            7/10
        """
        with named(f"{self.source}: parameters"):
            for name in values:
                if name not in self.parameters:
                    known = f"(the parameters are {listing(self.parameters)})"
                    raise InputError(f"unknown parameter {name!r}{did_you_mean(name, self.parameters)} {known}")
            parameters = {**self.parameters, **_read_parameters(values)}
        other = object.__new__(Model)
        kept = {key: value for key, value in vars(self).items() if key not in ("text", "observation_law")}
        vars(other).update({**kept, "parameters": parameters, "_keys": {**self._keys, "parameters": parameters}})
        with named(self.source):
            checks.check_constant_noise(other)
        return other

    def with_prior(self, prior: Prior | Density | Mapping[str, Any], start: float | None = None) -> Model:
        """Return the same model with another prior, such as the density at the end of an earlier record.

        Args:
            prior: a density (`result.density(-1)`, `zakai.load_density`), a prior, or a table as in a model file.
            start: the time at which the prior holds, by default the model's own.

        Raises:
            InputError: a density of other states, or one that a grid does not resolve.

        Example:
            >>> from zakai.models import load_model
            >>> model = load_model("gallery:benes")
            >>> later = model.with_prior({"kind": "gaussian", "mean": [0.3], "cov": [[0.1]]}, start=2.0)
            >>> later.start, later.prior.mean.tolist()
            (2.0, [0.3])
        """
        other = object.__new__(Model)
        vars(other).update({key: value for key, value in vars(self).items() if key not in ("text", "observation_law")})
        changed: dict[str, Any] = {}
        with named(self.source):
            if start is not None:
                with named("start"):
                    changed["start"] = vars(other)["start"] = _entries.number(start)
            with named("prior"):
                vars(other)["prior"], changed["prior"] = self._prior(prior)
            vars(other)["_keys"] = {**self._keys, **changed}
            check_prior(other, other.prior)
            checks.check_periodic(other)
        return other

    def _prior(self, given: Any) -> tuple[Prior | None, dict[str, Any] | None]:
        return read_prior(given, self.x, self._reader(in_time=False), tuple(name in self.periodic for name in self.state))

    def to_toml(self) -> str:
        """The model as the text of a model file that gives this model again."""
        return to_toml(self._keys)

    @property
    def keys_of_features(self) -> dict[str, Any]:
        """The keys of inputs, families, domains and tables, as in a model file, without those that hold their default."""
        kept = {key: self._keys[key] for key in KEYS[KEYS.index("inputs") :] if self._keys.get(key)}
        needless = {"input_hold": not self.inputs, "cross_noise": self.cross_noise.is_zero_matrix}
        return {key: value for key, value in kept.items() if not needless.get(key)}

    @property
    def _keys(self) -> dict[str, Any]:
        return vars(self)["_keys"]


def _short(formula: sympy.Expr) -> str:
    text = str(formula)
    return text if len(text) <= 80 else f"{text[:77]}..."


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


def _read_parameters(table: Any) -> dict[str, sympy.Rational]:
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
