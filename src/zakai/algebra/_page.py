"""An Analysis as a readable page and as LaTeX."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import sympy as sp

from zakai.algebra._readable import brief, for_latex, readable, times
from zakai.algebra.conditions import Condition, all_hold
from zakai.algebra.wei_norman import WeiNorman, path_symbols
from zakai.algebra.yau import is_regular
from zakai.models.model import Model

if TYPE_CHECKING:
    from zakai.algebra.analysis import Analysis
    from zakai.algebra.estimation_algebra import EstimationAlgebra
    from zakai.algebra.observed_block import ObservedBlock

WIDTH = 110
_WORDS = {True: "holds", False: "fails", None: "undecided"}
_TOO_LONG = "a formula that is too long to show"
_SINGULAR = "not defined: G = g Q g' is singular"
_MEANING = {
    "increments": "the record holds the increments of y",
    "path": "the record holds y itself",
    "rates": "the record holds the increments of y over the length of their interval",
    "samples": "the record holds z",
}


def text(analysis: Analysis) -> str:
    """The page that `print(analysis)` shows."""
    model = analysis.model
    title = "".join(character if character.isprintable() else " " for character in model.name)
    energy = _undefined(model) if analysis.eta is None else f"eta = {brief(readable(analysis.eta))}"
    blocks = [
        [title, "=" * len(title), *_equations(model)],
        *([["Explosion", *_wrapped("  ", str(analysis.explosion), 4)]] if analysis.explosion is not None else []),
        ["Omega_ij = d_i g_j - d_j g_i  with g = G^-1 f", *_omega(analysis)],
        ["eta = f'G^-1 f + div f + h'S^-1 h", f"  {energy}"],
        ["Yau form  f = L x + l + G grad phi", *_yau_form(analysis)],
        ["Estimation algebra", *_algebra(analysis)],
    ]
    if analysis.algebra.verdict == "finite":
        blocks.append(["Wei-Norman equations, from r = 0 and y = 0", *_wei_norman(analysis.algebra)])
    if analysis.observed_block is not None and len(analysis.observed_block.symbols) < model.n:
        values = ", at the parameters' values" if model.parameters else ""
        blocks.append([f"Observed block, which moves by itself{values}", *_observed_block(analysis.observed_block)])
    if analysis.conditionally_linear and analysis.conditionally_linear.given:
        blocks.append(["Linear given the other states", *_conditionally_linear(analysis)])
    if analysis.by_blocks:
        blocks.append(["Blocks that have nothing to do with each other", *_parts(analysis)])
    for name, conditions in analysis.methods.items():
        blocks.append([f"Method {name}: {_WORDS[all_hold(conditions)]}", *_conditions(conditions)])
    blocks.append([_recommendation(analysis)])
    return "\n\n".join("\n".join(short.rstrip() for line in block for short in _fitted(line)) for block in blocks)


def _equations(model: Model) -> Iterator[str]:
    noises = model.diffusion.cols
    for i, name in enumerate(model.state):
        terms = [times(model.drift[i], "dt")]
        terms += [times(model.diffusion[i, j], f"dv{j + 1}" if noises > 1 else "dv") for j in range(noises)]
        angle = "   (an angle)" if name in model.periodic else ""
        yield f"  d{name} = {' + '.join(term for term in terms if term) or '0'}{angle}"
    yield f"  E dv dv' = Q dt,  Q = {_flat(model.process_noise)},  G = g Q g' = {_flat(model.covariance)}"
    samples = model.observation_kind == "samples"
    path, _ = path_symbols(model.m, {*model.state, *model.parameters, *model.functions})
    for j in range(model.m):
        number = f"{j + 1}" if model.m > 1 else ""
        if model.log_density is not None:
            continue
        if samples and model.observation_family[j] != "gaussian":
            yield f"  z{number} ~ {model.observation_family[j]}({model.observation[j]})"
        elif samples:
            yield f"  z{number} = {model.observation[j]} + r{number}"
        else:
            yield f"  d{path[j]} = {times(model.observation[j], 'dt') or '0'} + dw{number}"
    laws = ["r ~ N(0, S)" if samples else "E dw dw' = S dt", f"S = {_flat(model.observation_noise)}"]
    if not {"gaussian", "student-t"} & set(model.observation_family):
        laws = []
    if not model.cross_noise.is_zero_matrix:
        laws += [f"E dv dw' = C dt,  C = {_flat(model.cross_noise)}"]
    for key, j in model.family_parameters:
        laws += [f"{key}{f' {j + 1}' if model.m > 1 else ''} = {model.family_parameters[key, j]}"]
    if model.log_density is not None:
        laws = [f"log p({', '.join(model.observed)} | x) = {model.log_density}"]
    yield f"  {',  '.join(laws)}{';  ' if laws else ''}{_MEANING[model.observation_kind]}"
    if model.inputs:
        yield f"  known inputs ({model.input_hold} hold): {', '.join(model.inputs)}"
    for name, interval in model.domain.items():
        yield f"  {name} {interval} ends"
    if model.parameters:
        yield "  with " + ", ".join(f"{name} = {float(value):.10g}" for name, value in model.parameters.items())
    if model.functions:
        yield f"  undetermined: {', '.join(model.functions)}"


def _undefined(model: Model) -> str:
    if model.features:
        return f"not defined: {'; '.join(model.features.values())}"
    return _TOO_LONG if is_regular(model) else _SINGULAR


def _omega(analysis: Analysis) -> Iterator[str]:
    omega, n = analysis.omega, analysis.model.n
    if omega is None:
        yield f"  {_undefined(analysis.model)}"
    elif not any(e != 0 for e in omega):
        yield "  Omega = 0" + ("" if n > 1 else "  (as for every system with one state)")
    else:
        for i in range(n):
            yield from (f"  omega_{i + 1},{j + 1} = {brief(readable(omega[i, j]))}" for j in range(i + 1, n) if omega[i, j] != 0)


def _yau_form(analysis: Analysis) -> Iterator[str]:
    form = analysis.yau_form
    if form is None:
        yield f"  none was found: {analysis.no_yau_form}"
        return
    yield f"  L = {_flat(form.matrix)},  l = {[*form.offset]}"
    yield f"  phi = {form.phi}"
    sampled = analysis.model.observation_kind == "samples"
    energy = "" if sampled else " + h'S^-1 h"
    yield f"  q = 2 phi_t + G:Hess phi + grad phi'G grad phi + 2 (L x + l).grad phi + 2 tr L{energy}"
    yield f"    = {_TOO_LONG if analysis.q is None else brief(analysis.q)}"


def _algebra(analysis: Analysis) -> Iterator[str]:
    algebra, proof = analysis.algebra, analysis.algebra.certificate
    size = "" if algebra.dimension is None else f" of dimension {algebra.dimension}"
    yield from _wrapped("  ", f"{algebra.verdict}{size}: {algebra.note}", 4)
    if algebra.parameters:
        yield from _wrapped("  ", algebra.parameters, 4)
    if algebra.basis:
        yield from _wrapped("  basis: ", ", ".join(str(readable(e)) for e in algebra.basis), 9)
        named = "D_i = d_i - g_i" if analysis.omega is not None else "D_i = d_i"
        yield f"  with {algebra.basis[0]} = (D'G D - eta)/2, {named}" if analysis.omega is not None else f"  with {named}"
    for (i, j), bracket in algebra.brackets.items():
        if bracket != 0:
            yield from _wrapped("  ", f"[{readable(algebra.basis[i])}, {readable(algebra.basis[j])}] = {readable(bracket)}", 6)
    if algebra.basis and algebra.brackets:
        yield "  all other brackets are 0" if any(algebra.brackets.values()) else "  all brackets are 0"
    if algebra.linear_rank is not None:
        found = "" if algebra.verdict == "finite" and algebra.dimension is not None else " (of what was explored)"
        yield f"  linear rank {algebra.linear_rank}{found}"
    if proof is not None:
        yield from _wrapped(f"  {proof.code}  ", f"{proof.statement} [{proof.source}]", 4)
        yield from _wrapped("    witness: ", proof.witness, 6)


def _wei_norman(algebra: EstimationAlgebra) -> Iterator[str]:
    equations = algebra.wei_norman
    for line in [f"none: {algebra.no_wei_norman}"] if equations is None else equations.lines():
        body = line.lstrip()
        margin = 2 + len(line) - len(body)
        yield from _wrapped(" " * margin, body, margin + 4)


def _observed_block(block: ObservedBlock) -> Iterator[str]:
    if not block.symbols:
        yield "  nothing of the state is observed"
        return
    for z, coordinate in zip(block.symbols, block.coordinates, strict=True):
        yield f"  {z} = {coordinate}"
    for k, (z, drift) in enumerate(zip(block.symbols, block.drift, strict=True), 1):
        noise = f"dn{k}" if len(block.symbols) > 1 else "dn"
        yield f"  d{z} = {' + '.join(term for term in (times(readable(drift), 'dt'), noise) if term)}"
    yield f"  E dn dn' = {_flat(block.covariance)} dt,  h = {[*block.observation]}"
    if block.linear:
        yield "  it is linear: for a normal prior its filter is that of Kalman and Bucy, whatever the rest of the state does"


def _conditionally_linear(analysis: Analysis) -> Iterator[str]:
    found = analysis.conditionally_linear
    yield f"  {', '.join(found)}  given  {', '.join(found.given)}"
    for reason in found.reason.split("; "):
        yield from _wrapped("    ", reason, 6)


def _parts(analysis: Analysis) -> Iterator[str]:
    for part in analysis.by_blocks:
        algebra = part.algebra
        size = "" if algebra.dimension is None else f" of dimension {algebra.dimension}"
        rank = "" if algebra.linear_rank is None else f", linear rank {algebra.linear_rank}"
        proof = "" if algebra.certificate is None else f" ({algebra.certificate.code})"
        best = "no method that auto tries holds" if part.recommended is None else f"auto takes {part.recommended}"
        yield from _wrapped(f"  {', '.join(part.model.state)}: ", f"{algebra.verdict}{size}{rank}{proof}; {best}", 4)
    verdicts = {part.algebra.verdict for part in analysis.by_blocks}
    if "infinite" in verdicts:
        yield "  E is infinite dimensional, for that of a block is"
    elif verdicts == {"finite"}:
        yield "  E is finite dimensional, for those of all blocks are"


def _conditions(conditions: tuple[Condition, ...]) -> Iterator[str]:
    for condition in conditions:
        yield from _wrapped(f"  {_WORDS[condition.holds]:<9}  ", condition.statement)
        yield from _wrapped(" " * 13, f"{condition.evidence}  [{condition.source}]")


def _fitted(line: str) -> list[str]:
    margin = len(line) - len(line.lstrip())
    return [line] if len(line) <= WIDTH else _wrapped(" " * margin, line.lstrip(), margin + 4)


def _wrapped(head: str, body: str, indent: int = 13) -> list[str]:
    return textwrap.wrap(
        body, WIDTH, initial_indent=head, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False
    )


def _recommendation(analysis: Analysis) -> str:
    if analysis.recommended is None:
        others = [name for name, conditions in analysis.methods.items() if all_hold(conditions) is True]
        named = f"; if it is named, {' or '.join(others)} can be used" if others else ""
        return f"Recommended: none, for no method that auto tries holds{named}"
    prior = "" if analysis.model.prior is not None else "; to filter, the model needs a prior"
    blocks = "" if analysis.division is None else f"; {analysis.division.why}"
    return "\n".join(_wrapped("", f"Recommended: {analysis.recommended}{blocks}{prior}", 2))


def _flat(matrix: sp.MatrixBase) -> str:
    return str(matrix[0, 0]) if matrix.shape == (1, 1) else str(matrix.tolist())


def latex(analysis: Analysis) -> str:
    """The equations and what was found, as LaTeX displays, and the methods, as a table."""
    model = analysis.model
    # A name of several letters is not a product.
    names = {s: rf"\mathrm{{{s.name}}}" for s in (*model.x, *model.parameter_symbols) if sp.latex(s) == s.name and s.name[1:]}

    def tex(value: sp.Basic) -> str:
        if isinstance(value, sp.MatrixBase):
            value = value[0, 0] if value.shape == (1, 1) else value.applyfunc(for_latex)
        return sp.latex(for_latex(value) if isinstance(value, sp.Expr) else value, symbol_names=names)

    def in_dt(field: sp.MatrixBase) -> str:
        sums = field.shape == (1, 1) and field[0, 0].is_Add
        return rf"\left({tex(field)}\right)\,dt" if sums else rf"{tex(field)}\,dt"

    noise = "" if model.diffusion == sp.ones(1, 1) else rf"{tex(model.diffusion)}\,"
    lines = [
        rf"d{tex(sp.Matrix(model.x))} &= {in_dt(model.drift)} + {noise}dv,"
        rf" & \mathrm E\,dv\,dv^\top &= {tex(model.process_noise)}\,dt",
    ]
    S = tex(model.observation_noise)
    if model.observation_kind == "samples":
        lines.append(rf"z_k &= {tex(model.observation)} + r_k, & r_k &\sim N\left(0, {S}\right)")
    else:
        path, _ = path_symbols(1, {*model.state, *model.parameters, *model.functions})
        lines.append(rf"d{tex(path[0])} &= {in_dt(model.observation)} + dw, & \mathrm E\,dw\,dw^\top &= {S}\,dt")
    if analysis.omega is not None:
        eta = "" if analysis.eta is None else rf", & \eta &= {tex(analysis.eta)}"
        lines.append(rf"\Omega &= {tex(analysis.omega)}{eta}")
    form = analysis.yau_form
    if form is not None:
        lines.append(rf"L &= {tex(form.matrix)}, & l &= {tex(form.offset)}")
        phi = rf"\nabla\phi &= {tex(form.gradient)}" if form.potential is None else rf"\phi &= {tex(form.potential)}"
        lines.append(phi if analysis.q is None else rf"{phi}, & q &= {tex(analysis.q)}")
    block = analysis.observed_block
    if block is not None and 0 < len(block.symbols) < model.n:
        z, coordinates = tex(sp.Matrix(block.symbols)), tex(sp.Matrix(block.coordinates))
        moves = rf"{in_dt(sp.Matrix(block.drift))} + dn,\quad \mathrm E\,dn\,dn^\top = {tex(block.covariance)}\,dt"
        lines.append(rf"{z} &= {coordinates}, & d{z} &= {moves}")
    lines.extend(_algebra_in_tex(analysis.algebra, tex))
    body = " \\\\\n".join(lines)
    return f"\\begin{{align*}}\n{body}\n\\end{{align*}}\n{_methods_in_tex(analysis)}"


def _methods_in_tex(analysis: Analysis) -> str:
    """A row for each method, with what failed or was not decided."""
    rows = []
    for name, conditions in analysis.methods.items():
        open_ones = [one for one in conditions if one.holds is not True]
        first = next((one for one in open_ones if one.holds is False), open_ones[0] if open_ones else None)
        reason = "" if first is None else f"{_prose(first.statement)}: {_prose(first.evidence)}"
        word = {True: "yes", False: "no", None: "undecided"}[all_hold(conditions)]
        rows.append(rf"\texttt{{{name}}} & {word} & {reason} \\")
    table = "\n".join(rows)
    head = r"\begin{tabular}{llp{0.6\linewidth}}" + "\n" + r"method & holds & fails, or is not decided \\ \hline"
    return f"{head}\n{table}\n\\end{{tabular}}"


def _algebra_in_tex(algebra: EstimationAlgebra, tex: Callable[[sp.Basic], str]) -> Iterator[str]:
    proof = algebra.certificate
    said = algebra.note if proof is None else f"{proof.statement} [{proof.source}] Witness: {proof.witness}."
    dimension = algebra.dimension if algebra.dimension is not None else r"\text{unknown}"
    size = r"\infty" if algebra.verdict == "infinite" else dimension
    code = "" if proof is None else rf" & &\text{{({proof.code})}}"
    # What stands between two rows of a display has no end of its own.
    yield rf"\intertext{{The estimation algebra is {_prose(_verdict(algebra))}: {_prose(said)}}}" + f"\n\\dim E &= {size}{code}"
    if algebra.linear_rank is not None:
        relation = "=" if algebra.verdict == "finite" and algebra.dimension is not None else r"\ge"
        yield rf"\text{{linear rank}} &{relation} {algebra.linear_rank}"
    if algebra.basis:
        yield rf"E &= \left\langle {', '.join(map(tex, algebra.basis))} \right\rangle"
    for (i, j), bracket in algebra.brackets.items():
        if bracket != 0:
            yield rf"\left[{tex(algebra.basis[i])}, {tex(algebra.basis[j])}\right] &= {tex(bracket)}"
    if algebra.wei_norman is not None:
        yield from _wei_norman_in_tex(algebra.wei_norman, tex)


def _verdict(algebra: EstimationAlgebra) -> str:
    words = {"finite": "finite dimensional", "infinite": "infinite dimensional"}
    return words.get(algebra.verdict, algebra.verdict) + (f", {algebra.parameters}" if algebra.parameters else "")


def _prose(words: str) -> str:
    """Text with what LaTeX takes for commands as it stands."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in words)


def _wei_norman_in_tex(equations: WeiNorman, tex: Callable[[sp.Basic], str]) -> Iterator[str]:
    powers = [_power_in_tex(r, e, tex) for r, e in zip(equations.statistics, equations.basis[1:], strict=True)]
    product = r"\,".join(f"e^{{{power}}}" for power in [*reversed(powers), f"t {tex(equations.basis[0])}"]) + r"\,\sigma_0"
    robust = r"e^{-h^\top S^{-1} y}\,\sigma", equations.robust, "robust"
    for left, rates, form in (robust, (r"\sigma", equations.stratonovich, "Stratonovich")):
        yield rf"{left} &= {product}, & r(0) &= 0 \quad \text{{({form})}}"
        yield from (rf"\dot{{{tex(r)}}} &= {tex(rate)}" for r, rate in rates.items())


def _power_in_tex(r: sp.Symbol, element: sp.Expr, tex: Callable[[sp.Basic], str]) -> str:
    if element == 1:
        return tex(r)
    return rf"{tex(r)} \left({tex(element)}\right)" if element.is_Add else f"{tex(r)} {tex(element)}"
