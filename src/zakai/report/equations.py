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


def equations(model: Any) -> str:
    """The state equation, the observation equation and the prior of a model, as HTML with MathML."""
    parts = [*_state(model), *_observation(model), *_prior(model)]
    return f'<div class="equations">{"".join(parts)}</div>'


def _state(model: Any) -> list[str]:
    noises = model.diffusion.shape[1]
    rows = []
    for i, symbol in enumerate(model.x):
        terms = [(model.drift[i, 0], [_differential(model.t)])]
        terms += [
            (entry, [_differential(_indexed("v", j, noises))]) for (_, j), entry in sorted(model.diffusion.row(i).todok().items())
        ]
        rows.append(_row(_differential(symbol), _operator("="), *_sum(terms)))
    said = "State" + (
        f": {_names(model.periodic)} {'is an angle' if len(model.periodic) == 1 else 'are angles'}, on the circle"
        if model.periodic
        else ""
    )
    return [_words(said), _block(rows), *_covariance("Process noise", "v", "Q", model.process_noise, model)]


def _observation(model: Any) -> list[str]:
    rows = []
    samples = model.observation_kind == "samples"
    for j in range(model.m):
        if samples:
            time = "<msub><mi>t</mi><mi>k</mi></msub>"
            left = _row(_indexed("z", j, model.m), _operator("("), time, _operator(")"))
            right = [*_sum([(model.observation[j, 0], [])]), _operator("+"), _indexed("r", j, model.m)]
        else:
            left = _differential(_indexed("y", j, model.m))
            terms = [
                (model.observation[j, 0], [_differential(model.t)]),
                (sympy.Integer(1), [_differential(_indexed("w", j, model.m))]),
            ]
            right = _sum(terms)
        rows.append(_row(left, _operator("="), *right))
    said = {
        "increments": "Observation: the record holds the increments of y over each interval",
        "path": "Observation: the record holds the path y itself",
        "rates": "Observation: the record holds the increments of y divided by the length of the interval",
        "samples": "Observation: the record holds samples z at the times t<sub>k</sub>; h is taken there",
    }[model.observation_kind]
    name = "r" if samples else "w"
    return [
        _words(said),
        _block(rows),
        *_covariance("Observation noise", name, "S", model.observation_noise, model),
    ]


def _covariance(said: str, noise: str, letter: str, matrix: Any, model: Any) -> list[str]:
    size = matrix.shape[0]
    value = []
    if size <= _LARGEST_MATRIX:
        value = [_operator(","), f"<mi>{letter}</mi>", _operator("="), _mathml(matrix if size > 1 else matrix[0, 0])]
    if noise == "r":
        law = _row(f"<mi>{noise}</mi>", _operator("∼"), _NORMAL, _operator("("), "<mn>0</mn>", _operator(","))
        return [_words(said), _block([_row(law, f"<mi>{letter}</mi>", _operator(")"), *value)])]
    step = _differential(f"<mi>{noise}</mi>")
    square = _row("<mi>E</mi>", _operator("["), step, f"<msup>{step}<mi>⊤</mi></msup>", _operator("]"))
    return [
        _words(said),
        _block([_row(square, _operator("="), f"<mi>{letter}</mi>", _differential(model.t), *value)]),
    ]


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


def _mathml(expression: Any) -> str:
    """An expression as MathML; names are escaped before, since SymPy's printer writes them as they are."""
    replaced: dict[Any, Any] = {}
    for symbol in expression.free_symbols:
        replaced[symbol] = sympy.Symbol(escape(symbol.name, quote=False), **symbol.assumptions0)
    for number in expression.atoms(sympy.Rational):
        if number.q > _LARGEST_DENOMINATOR:  # 0.12345 says more than 2469/20000
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
