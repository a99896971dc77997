"""The model: what the system is, checked once and then immutable. SymPy inside, no numerics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from zakai.models._keys import read_formulas, read_names, read_parameters, reader
from zakai.models._toml import to_toml
from zakai.models.domain import Interval, check_prior, read_domain
from zakai.models.features import features_of, formulas_of
from zakai.models.observation_law import ObservationLaw
from zakai.models.prior import Prior, read_prior
from zakai.models.tables import Table, read_tables

KEYS = (
    "name", "state", "drift", "observation", "observation_kind", "diffusion", "process_noise", "observation_noise", "start",
    "periodic", "functions", "parameters", "prior", "inputs", "input_hold", "cross_noise", "observation_family",
    "degrees_of_freedom", "concentration", "trials", "dispersion", "observation_log_density", "observed", "domain", "tables",
    "observation_names", "observed_angles",
)  # fmt: skip
Formulas = Sequence[str | float | sympy.Expr]
FormulaRows = Sequence[Formulas]
_OWN = ("text", "observation_law", "_kept")  # what depends on the values of the parameters, or on the prior


_SOURCE = "model"  # what errors call a model that is not from a file


class Model:
    """A continuous-time stochastic system and what is observed of it.

        dx = f(x,u,t) dt + g(x,u,t) dv    E dv dv' = Q(t) dt                        x in R^n, u known
        dy = h(x,u,t) dt + dw             E dw dw' = S(t) dt, E dv dw' = C(t) dt    ("increments", "path", "rates")
        z_k ~ p(z | x(t_k), u(t_k), t_k)  N(h, S) by default                        ("samples")

    Keywords, each as in a model file; a formula is a text, a number or a SymPy expression whose symbols are
    meant by name:

    * `state`: n names; `drift`: f, n formulas; `observation`: h, m formulas (these three are required);
    * `observation_kind`: increments, path, rates or samples; it may be left out for analysis and simulation, which then take
      increments; `observation_names`: m names for the columns of records, by default the state where h is just a state, else
      y1, y2, ...;
    * `diffusion`: g, n rows of r formulas (Ito); `process_noise`: Q, r x r; `observation_noise`: S, m x m; `cross_noise`:
      C, r x m; Q, C and S in t and parameters only, S of samples in the state and inputs too; by default identities, and
      zero for C; covariances are per unit time, or per observation for samples;
    * `inputs`: names of known signals u(t); `input_hold`: "zero" (the default) or "linear";
    * `observation_family`, for samples: "gaussian", "student-t" (`degrees_of_freedom`), "poisson", "bernoulli", "von-mises"
      (`concentration`), "binomial" (`trials`), "negative-binomial" (`dispersion`), "log-normal" or "exponential", for all
      coordinates or a list; or `observation_log_density` instead of `observation`: log p(z | x) in the state and the names in
      `observed`, normalised over z if the evidence is to mean something;
    * `observed_angles`: names of samples that are angles, with differences modulo 2 pi, as those of an `atan2(...)` always are;
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
    observation_names: tuple[str, ...]
    kind_given: bool
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
    observed_angles: tuple[str, ...]
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
        trials: Any = None,
        dispersion: Any = None,
        observation_log_density: str | sympy.Expr | None = None,
        observed: Sequence[str] | None = None,
        observed_angles: Sequence[str] | None = None,
        domain: Mapping[str, Mapping[str, Any]] | None = None,
        tables: Mapping[str, Any] | None = None,
        functions: Sequence[str] | None = None,
        observation_names: Sequence[str] | None = None,
        **unknown: Any,
    ):
        given = {key: value for key, value in locals().items() if key in KEYS and value is not None}
        self._read({**given, **unknown}, source=_SOURCE, text=None, folder=Path())

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
        vars(self).update(source=source, _keys=canonical, log_density=None, z=(), observed=(), observed_angles=())
        with named("tables"):
            vars(self)["tables"] = read_tables(keys.get("tables") or {}, folder)
            canonical["tables"] = {name: table.keys() for name, table in self.tables.items()}
            for name in self.tables:
                _entries.allowed_name(name)
        if any(isinstance(table, Mapping) and "file" in table for table in (keys.get("tables") or {}).values()):
            text = None  # the text of a model stands for itself, and this one needs a file
        read_names(self, keys)
        read_formulas(self, keys)
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

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in vars(self).items() if key not in _OWN}

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
            parameters = {**self.parameters, **read_parameters(values)}
        other = object.__new__(Model)
        same = {key: value for key, value in vars(self).items() if key not in _OWN}
        vars(other).update({**same, "parameters": parameters, "_keys": {**self._keys, "parameters": parameters}})
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
        vars(other).update({key: value for key, value in vars(self).items() if key not in _OWN})
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
        periodic = tuple(name in self.periodic for name in self.state)
        bounded = tuple(name in self.domain and self.domain[name].bounded for name in self.state)
        return read_prior(given, self.x, reader(self, in_time=False), periodic, bounded)

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
