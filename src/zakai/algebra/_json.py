"""An Analysis as JSON, for programs: all that its page says, with expressions as text."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import sympy as sp

from zakai.algebra._readable import readable
from zakai.algebra.conditions import all_hold
from zakai.models.model import Model

if TYPE_CHECKING:
    from zakai.algebra.analysis import Analysis
    from zakai.algebra.blocks import Block
    from zakai.algebra.estimation_algebra import EstimationAlgebra
    from zakai.algebra.observed_block import ObservedBlock
    from zakai.algebra.wei_norman import WeiNorman


def text(analysis: Analysis) -> str:
    """The equations, and what was found."""
    form, explosion, block = analysis.yau_form, analysis.explosion, analysis.observed_block
    content = {
        **_equations(analysis.model),
        "omega": None if analysis.omega is None else _rows(analysis.omega),
        "eta": None if analysis.eta is None else _text(analysis.eta),
        "yau_form": None
        if form is None
        else {
            "L": _rows(form.matrix),
            "l": _list(form.offset),
            "phi": None if form.potential is None else _text(form.potential),
            "grad_phi": _list(form.gradient),
        },
        "no_yau_form": analysis.no_yau_form,
        "q": None if analysis.q is None else _text(analysis.q),
        "algebra": _algebra(analysis.algebra),
        "observed_block": None if block is None else _observed_block(block),
        "conditionally_linear": {
            "states": list(analysis.conditionally_linear),
            "given": list(analysis.conditionally_linear.given),
            "reason": analysis.conditionally_linear.reason,
        },
        "blocks": [_part(block, part) for block, part in zip(analysis.blocks, analysis.by_blocks)],
        "explosion": None if explosion is None else {"start": explosion.start, "time": explosion.time},
        "methods": {
            name: {"holds": all_hold(conditions), "conditions": [vars(c) for c in conditions]}
            for name, conditions in analysis.methods.items()
        },
        "recommended": analysis.recommended,
    }
    return json.dumps(content, indent=2, ensure_ascii=False)


def _equations(model: Model) -> dict[str, Any]:
    return {
        "model": model.name,
        "source": model.source,
        "state": list(model.state),
        "periodic": list(model.periodic),
        "drift": _list(model.drift),
        "diffusion": _rows(model.diffusion),
        "process_noise": _rows(model.process_noise),
        "covariance": _rows(model.covariance),
        "observation": _list(model.observation),
        "observation_noise": _rows(model.observation_noise),
        "observation_kind": model.observation_kind,
        "features": dict(model.features),
        **{key: value for key, value in model.keys_of_features.items() if model.features},
        "parameters": {name: str(value) for name, value in model.parameters.items()},
        "functions": list(model.functions),
    }


def _algebra(algebra: EstimationAlgebra) -> dict[str, Any]:
    proof, equations = algebra.certificate, algebra.wei_norman
    return {
        "verdict": algebra.verdict,
        "dimension": algebra.dimension,
        "basis": _list(algebra.basis),
        "brackets": {f"{i},{j}": _text(e) for (i, j), e in algebra.brackets.items()},
        "structure_constants": {f"{i},{j}": _list(row) for (i, j), row in algebra.structure_constants.items()},
        "linear_rank": algebra.linear_rank,
        "certificate": None
        if proof is None
        else {key: getattr(proof, key) for key in ("code", "statement", "source", "witness")},
        "wei_norman": None if equations is None else _wei_norman(equations),
        "no_wei_norman": algebra.no_wei_norman,
        "note": algebra.note,
        "parameters": algebra.parameters,
    }


def _wei_norman(equations: WeiNorman) -> dict[str, Any]:
    return {
        "product": equations.product,
        "statistics": _list(equations.statistics),
        "path": _list(equations.path),
        "rates": _list(equations.rates),
        "robust": {str(r): _text(rate) for r, rate in equations.robust.items()},
        "stratonovich": {str(r): _text(rate) for r, rate in equations.stratonovich.items()},
    }


def _observed_block(block: ObservedBlock) -> dict[str, Any]:
    lists = {key: _list(getattr(block, key)) for key in ("coordinates", "symbols", "drift", "observation")}
    return {**lists, "covariance": _rows(block.covariance), "linear": block.linear}


def _part(block: Block, part: Analysis) -> dict[str, Any]:
    return {
        "state": block.model.state,
        "observations": block.observations,
        "algebra": _algebra(part.algebra),
        "recommended": part.recommended,
    }


def _text(expression: sp.Expr) -> str:
    return str(readable(expression))


def _list(expressions: Iterable[sp.Expr]) -> list[str]:
    return [_text(e) for e in expressions]


def _rows(matrix: sp.MatrixBase) -> list[list[str]]:
    return [_list(row) for row in matrix.tolist()]
