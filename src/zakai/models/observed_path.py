"""Formulas that contain what is observed, y(t): the model with y as an input, and the model of (x, y) for simulations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import sympy

from zakai.errors import InputError
from zakai.models.features import formulas_of
from zakai.models.kept import once_for_a_model

if TYPE_CHECKING:
    from zakai.models.model import Model

_DERIVED = ("text", "observation_law", "covariance", "features", "depends_on_time", "_kept")


def observed_in_formulas(model: Model) -> np.ndarray:
    """Return which of the m observations stand in formulas for their current values."""
    if model.log_density is not None or not model.z:
        return np.zeros(model.m, bool)
    symbols = set().union(*(formula.free_symbols for formula in formulas_of(model)))
    return np.array([symbol in symbols for symbol in model.z])


@once_for_a_model
def with_path_as_inputs(model: Model) -> Model:
    """Return the model in which the observed values y(t) are inputs, after its own and linear between their times."""
    found = object.__new__(type(model))
    same = {key: value for key, value in vars(model).items() if key not in _DERIVED}
    inputs, symbols = (*model.inputs, *model.observed), (*model.u, *model.z)
    vars(found).update({**same, "inputs": inputs, "u": symbols, "input_hold": "linear", "observed": (), "z": ()})
    return found


@once_for_a_model
def with_path_as_states(model: Model) -> Model:
    """Return the model of the state (x, y), dy = h dt + dw, whose noise is independent of it: for simulations alone.

        dw = C' Q^-1 dv + L dv',   L L' = S - C' Q^-1 C,   dv' of unit covariance

    Raises:
        InputError: C is not zero and Q is singular.
    """
    n, m, r = model.n, model.m, model.process_noise.rows
    S, Q, gain = model.observation_noise, model.process_noise, sympy.zeros(m, r)
    if not model.cross_noise.is_zero_matrix:
        if Q.det() == 0:
            raise InputError(f"{model.source}: process_noise: is singular; with cross_noise give one noise for each row instead")
        gain = model.cross_noise.T * Q.inv()
        S = S - gain * model.cross_noise
    root = _root(sympy.Matrix(S))
    diffusion = sympy.zeros(n + m, r + m)
    diffusion[:n, :r], diffusion[n:, :r], diffusion[n:, r:] = model.diffusion, gain, root
    noise = sympy.zeros(r + m, r + m)
    noise[:r, :r], noise[r:, r:] = Q, sympy.eye(m)
    found = object.__new__(type(model))
    same = {key: value for key, value in vars(model).items() if key not in _DERIVED}
    changed = {
        "state": (*model.state, *model.observed), "x": (*model.x, *model.z), "n": n + m, "observed": (), "z": (), "prior": None,
        "drift": sympy.ImmutableMatrix([*model.drift, *model.observation]), "diffusion": sympy.ImmutableMatrix(diffusion),
        "process_noise": sympy.ImmutableMatrix(noise), "cross_noise": sympy.ImmutableMatrix.zeros(r + m, m),
    }  # fmt: skip
    vars(found).update({**same, **changed})
    return found


def _root(S: sympy.Matrix) -> sympy.Matrix:
    """Return Cholesky's factor of a matrix of formulas."""
    size = S.rows
    factor = sympy.zeros(size, size)
    for i in range(size):
        for j in range(i + 1):
            rest = sympy.together(S[i, j] - sum((factor[i, k] * factor[j, k] for k in range(j)), sympy.S.Zero))
            factor[i, j] = sympy.sqrt(rest) if i == j else rest / factor[j, j]
    return factor
