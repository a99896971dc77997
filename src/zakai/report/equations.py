"""The model's equations as MathML, which browsers typeset without a library."""

from __future__ import annotations

from html import escape
from typing import Any

import sympy
from sympy.printing.mathml import MathMLPresentationPrinter

_LARGEST_MATRIX = 12
_LARGEST_DENOMINATOR = 1000
_SPACE = '<mspace width="0.17em"/>'
_NORMAL = '<mi mathvariant="script">N</mi>'
_WITH_NOISE = ("gaussian", "student-t", "log-normal")  # z or log z = h + r; of other families h is the parameter of their law
_LAWS = {
    "poisson": None, "bernoulli": None, "von-mises": "concentration", "binomial": "trials", "negative-binomial": "dispersion",
    "exponential": None,
}  # fmt: skip


def equations(model: Any) -> str:
    """The state equation, the observation equation and the prior of a model, as HTML with MathML."""
    parts = [*_state(model), *_observation(model), *_prior(model)]
    return f'<div class="equations">{"".join(parts)}</div>'


def _state(model: Any) -> list[str]:
    noises = model.diffusion.shape[1]
    rows = []
    for i, symbol in enumerate(model.x):
        terms = [(model.drift[i, 0], [_differential(model.t)])]
        letter = _letter(model, "v")
        entries = sorted(model.diffusion.row(i).todok().items())
        terms += [(entry, [_differential(_indexed(letter, j, noises))]) for (_, j), entry in entries]
        rows.append(_row(_differential(symbol), _operator("="), *_sum(terms)))
    said = "State" + (
        f": {_names(model.periodic)} {'is an angle' if len(model.periodic) == 1 else 'are angles'}, on the circle"
        if model.periodic
        else ""
    )
    ends = [_row(_mathml(one), _operator("∈"), *_interval(model.domain[one.name])) for one in model.x if one.name in model.domain]
    rows += ends
    return [_words(said), _block(rows), *_covariance("Process noise", _letter(model, "v"), "Q", model.process_noise, model)]


def _interval(interval: Any) -> list[str]:
    low, high = ("[", "]") if interval.reflecting else ("(", ")")
    ends = [f"<mn>{_short(end)}</mn>".replace("inf", "∞") for end in (interval.lower, interval.upper)]
    said = f"<mtext>, {'reflecting' if interval.reflecting else 'natural'} ends</mtext>"
    return [_operator(low), ends[0], _operator(","), ends[1], _operator(high), said]


def _observation(model: Any) -> list[str]:
    samples = model.observation_kind == "samples"
    said = {
        "increments": "Observation: the record holds the increments of y over each interval",
        "path": "Observation: the record holds the path y itself",
        "rates": "Observation: the record holds the increments of y divided by the length of the interval",
        "samples": "Observation: the record holds samples z at the times t<sub>k</sub>; h is taken there",
    }[model.observation_kind]
    if model.log_density is not None:
        names = ", ".join(escape(str(symbol)) for symbol in model.z)
        law = [_operator("log"), "<mi>p</mi>", _operator("("), f"<mtext>{names} | x</mtext>", _operator(")"), _operator("=")]
        return [_words(said), _block([_row(*law, _mathml(model.log_density))])]
    noisy = [j for j, family in enumerate(model.observation_family) if not samples or family in _WITH_NOISE]
    parts = [_words(said), _block([_sample(model, j) if samples else _increment(model, j) for j in range(model.m)])]
    if noisy:
        letter = _letter(model, "r" if samples else "w")
        parts += _covariance("Observation noise", letter, "S", model.observation_noise, model)
    if not model.cross_noise.is_zero_matrix:
        parts += _covariance("Noise of state and observation", _letter(model, "v"), "C", model.cross_noise, model)
    return parts


def _sample(model: Any, j: int) -> str:
    time = "<msub><mi>t</mi><mi>k</mi></msub>"
    left = _row(_indexed("z", j, model.m), _operator("("), time, _operator(")"))
    h = _sum([(model.observation[j, 0], [])])
    family = model.observation_family[j]
    if family in _WITH_NOISE:
        left = _row(_operator("log"), left) if family == "log-normal" else left
        return _row(left, _operator("="), *h, _operator("+"), _indexed(_letter(model, "r"), j, model.m))
    key = _LAWS[family]
    parameter = [] if key is None else [_operator(","), f"<mtext>{key}</mtext>", _operator("="), _feature(model, key)]
    law = f"<mtext>{family}</mtext>"
    return _row(left, _operator("∼"), law, _operator("("), *h, *parameter, _operator(")"))


def _feature(model: Any, key: str) -> str:
    """The value of a key of the model file: a number, or the text of a formula."""
    return f"<mtext>{escape(str(model.keys_of_features[key]))}</mtext>"


def _increment(model: Any, j: int) -> str:
    noise = (sympy.Integer(1), [_differential(_indexed(_letter(model, "w"), j, model.m))])
    terms = [(model.observation[j, 0], [_differential(model.t)]), noise]
    return _row(_differential(_indexed("y", j, model.m)), _operator("="), *_sum(terms))


def _covariance(said: str, noise: str, letter: str, matrix: Any, model: Any) -> list[str]:
    value = []
    if max(matrix.shape) <= _LARGEST_MATRIX:
        value = [_operator(","), f"<mi>{letter}</mi>", _operator("="), _mathml(matrix if max(matrix.shape) > 1 else matrix[0, 0])]
    if letter == "S" and model.observation_kind == "samples":
        family, degrees = _NORMAL, []
        if "student-t" in model.observation_family:
            known = [_operator(","), "<mtext>degrees of freedom</mtext>", _operator("=")]
            family, degrees = "<mi>t</mi>", [*known, _feature(model, "degrees_of_freedom")]
        law = [f"<mi>{noise}</mi>", _operator("∼"), family, _operator("("), "<mn>0</mn>", _operator(","), f"<mi>{letter}</mi>"]
        return [_words(said), _block([_row(*law, *degrees, _operator(")"), *value)])]
    first = _differential(f"<mi>{noise}</mi>")
    second = _differential(f"<mi>{_letter(model, 'w')}</mi>") if letter == "C" else first
    product = _row("<mi>E</mi>", _operator("["), first, f"<msup>{second}<mi>⊤</mi></msup>", _operator("]"))
    return [
        _words(said),
        _block([_row(product, _operator("="), f"<mi>{letter}</mi>", _differential(model.t), *value)]),
    ]


def _letter(model: Any, usual: str) -> str:
    """Return the letter of a noise: the usual one, or a Greek one where the model has a name like it."""
    written = {symbol.name for symbol in (*model.x, *model.parameter_symbols)} | set(getattr(model, "inputs", ()))
    names = written | {name.rstrip("0123456789_") for name in written}  # v1 is written as the first of several v
    choices = {"v": ("v", "β", "ξ"), "w": ("w", "η", "ζ"), "r": ("r", "ε", "ρ")}[usual]
    greek = {"β": "beta", "ξ": "xi", "η": "eta", "ζ": "zeta", "ε": "epsilon", "ρ": "rho"}
    return next(letter for letter in choices if not {letter, greek.get(letter)} & names or letter == choices[-1])


def _prior(model: Any) -> list[str]:
    prior = model.prior
    if prior is None:
        return []
    said = f"Prior of the state at the start, {escape(model.t.name)} = {_short(model.start)}"
    if isinstance(prior.log_density, sympy.Basic):
        body = _row(
            "<mi>p</mi>",
            _operator("∝"),
            _operator("exp"),
            _operator("("),
            _mathml(prior.log_density),
            _operator(")"),
        )
        return [_words(said), _block([body])]
    if hasattr(prior, "weights"):
        rows = [_row(_number(w), _normal(m, c)) for w, m, c in list(zip(prior.weights, prior.means, prior.covs, strict=True))[:8]]
        omitted = len(prior.weights) - len(rows)
        said += f": a mixture of {len(prior.weights)} Gaussians" + (f", of which the first {len(rows)}" if omitted else "")
        return [_words(said), _block(rows)]
    return [_words(said), _block([_normal(prior.mean, prior.cov)])]


def _normal(mean: Any, cov: Any) -> str:
    size = len(mean)
    if size == 1:
        inside = [_number(mean[0]), _operator(","), _number(cov[0][0])]
    elif size <= _LARGEST_MATRIX:
        column = [[entry] for entry in mean]
        inside = [_table(column), _operator(","), _table(cov)]
    else:
        inside = [f"<mtext>{size} coordinates</mtext>"]
    return _row(_NORMAL, _operator("("), *inside, _operator(")"))


def _table(rows: Any) -> str:
    cells = "".join("<mtr>" + "".join(f"<mtd>{_number(c)}</mtd>" for c in row) + "</mtr>" for row in rows)
    return f"<mtable>{cells}</mtable>"


def _sum(terms: list[tuple[Any, list[str]]]) -> list[str]:
    """Terms `coefficient * factors` joined by + and -, without zeros and without a coefficient of one."""
    written: list[str] = []
    for expression, factors in terms:
        if expression == 0:
            continue
        negative = expression.could_extract_minus_sign() and not expression.is_Add
        if negative:
            expression = -expression
        if negative or written:
            written.append(_operator("−" if negative else "+"))
        body = [] if expression == 1 and factors else [_mathml(expression)]
        if expression.is_Add and (factors or negative):
            body = [_operator("("), *body, _operator(")")]
        space = [_SPACE] if body and factors else []
        written += [*body, *space, *factors]
    return written or ["<mn>0</mn>"]


class _Printer(MathMLPresentationPrinter):
    """SymPy's presentation MathML, with decimals as short as they were written."""

    def _print_Float(self, expression: Any) -> Any:
        number = self.dom.createElement("mn")
        number.appendChild(self.dom.createTextNode(_short(expression, 10)))
        return number

    def mathml_tag(self, e: Any) -> str:
        """Return the name of a function, as in a model file where that differs."""
        name = str(super().mathml_tag(e))
        return {"maximum": "max", "minimum": "min"}.get(name, "atan2" if isinstance(e, sympy.atan2) else name)


def _mathml(expression: Any) -> str:
    """An expression as MathML; names are escaped before, since SymPy's printer writes them as they are."""
    replaced: dict[Any, Any] = {}
    for symbol in expression.free_symbols:
        replaced[symbol] = sympy.Symbol(escape(symbol.name, quote=False), **symbol.assumptions0)
    for number in expression.atoms(sympy.Rational):
        # 0.4 as it is usually written, and 0.12345 instead of 2469/20000; 1/2 and 3/4 stay.
        if (number.q % 5 == 0 and 10**4 % number.q == 0) or number.q > _LARGEST_DENOMINATOR:
            replaced[number] = sympy.Float(number)
    text = str(_Printer({"mat_delim": ""})._print(expression.xreplace(replaced)).toxml())
    return text.replace("<mo>&InvisibleTimes;</mo>", _SPACE).replace("<mo>-</mo>", "<mo>−</mo>")


def _number(value: Any) -> str:
    if isinstance(value, sympy.Basic) and value.free_symbols:
        return _mathml(value)
    return f"<mn>{_short(value)}</mn>"


def _short(value: Any, digits: int = 6) -> str:
    return f"{float(value):.{digits}g}".replace("-", "−")


def _indexed(letter: str, position: int, count: int) -> str:
    return f"<mi>{letter}</mi>" if count == 1 else f"<msub><mi>{letter}</mi><mn>{position + 1}</mn></msub>"


def _differential(symbol: Any) -> str:
    long = not isinstance(symbol, str) and len(symbol.name) > 1
    body = symbol if isinstance(symbol, str) else (_SPACE if long else "") + _mathml(symbol)
    return f'<mrow><mi mathvariant="normal">d</mi>{body}</mrow>'


def _operator(sign: str) -> str:
    return f"<mo>{sign}</mo>"


def _row(*parts: str) -> str:
    return f"<mrow>{''.join(parts)}</mrow>"


def _block(rows: list[str]) -> str:
    return "".join(f'<div><math displaystyle="true">{row}</math></div>' for row in rows)


def _words(text: str) -> str:
    return f"<p>{text}.</p>"


def _names(names: Any) -> str:
    return ", ".join(f"<i>{escape(name)}</i>" for name in names)
