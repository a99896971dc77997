"""A smooth system as an extended Kalman filter takes it: its formulas with their derivatives, and the parts of intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import sympy as sp

from zakai.methods.gaussian.affine_system import RESOLVED, precision_of
from zakai.methods.system.input_pieces import Pieces
from zakai.models.functions import without_jumps
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import NumericFunction, numpy_function
from zakai.numerics.flow import Coefficients, integrate
from zakai.numerics.transition import Array


class Formulas:
    """The formulas of a model, and their derivatives, as functions of x, t, the parameters and the inputs."""

    def __init__(self, model: Model):
        n, m = model.n, model.m
        drift, observation = sp.Matrix(model.drift), sp.Matrix(model.observation)
        slope, change = jacobian(drift, model.x), [jacobian(drift, [symbol]) for symbol in (model.t, *model.u)]
        self.shapes, self.angles = (n, m), model.observation_law.angles
        self.motion = numpy_function([*drift, *slope, *model.covariance, *sp.Matrix.hstack(*change)], model)
        self.sensor = numpy_function([*observation, *jacobian(observation, model.x)], model)
        self.noise = numpy_function(model.observation_noise, model, (m, m))
        self.cross = None if model.cross_noise.is_zero_matrix else self._cross(model)
        self.noise_of_state = bool(model.observation_noise.free_symbols & set(model.x))
        self.noise_varies = bool(model.observation_noise.has(model.t)) and model.observation_kind != "samples"

    @staticmethod
    def _cross(model: Model) -> NumericFunction:
        """Return a = g C (n, m) and (a_j.grad) a_i (n) for all i and j, one after the other."""
        a, x = model.diffusion * model.cross_noise, model.x
        columns = range(model.m)
        along = [sum((a[l, j] * without_jumps(a[k, i], x[l]) for l in range(model.n)), sp.S.Zero)
                 for k in range(model.n) for i in columns for j in columns]  # fmt: skip
        return numpy_function([*a, *along], model)

    def correlated(self, x: Array, t: float, theta: Array, u: Array | None, gain: Array) -> tuple[Array, Array]:
        """Return a = g C (n, m), and sum K_ij (a_j.grad) a_i / 2 (n,), Stratonovich's term of y that is linear in time."""
        assert self.cross is not None
        n, m = self.shapes
        values = self.cross(x, np.asarray(t), theta, u)
        return values[: n * m].reshape(n, m), 0.5 * values[n * m :].reshape(n, m * m) @ gain.ravel()

    def drift(self, x: Array, t: float, theta: Array, u: Array | None, rate: Array) -> tuple[Array, Array, Array, Array]:
        """Return f (n,), df/dx (n, n), df/dt (n,) along inputs whose derivative is `rate`, and G (n, n)."""
        n, values = self.shapes[0], self.motion(x, np.asarray(t), theta, u)
        slope, covariance, change = np.split(values[n:], [n * n, 2 * n * n])
        change = change.reshape(n, -1) @ np.concatenate([np.ones(1), rate])
        return values[:n], slope.reshape(n, n), change, covariance.reshape(n, n)

    def observe(self, x: Array, t: float, theta: Array, u: Array | None) -> tuple[Array, Array]:
        """Return h (m,) and dh/dx (m, n)."""
        n, m = self.shapes
        values = self.sensor(x, np.asarray(t), theta, u)
        return values[:m], values[m:].reshape(m, n)


def jacobian(field: sp.MatrixBase, symbols: Sequence[sp.Symbol]) -> sp.Matrix:
    """Return the derivatives of a column of formulas almost everywhere."""
    return sp.Matrix([[without_jumps(formula, symbol) for symbol in symbols] for formula in field])


def formulas_of(model: Model) -> Formulas:
    """Return the functions of a model, made once."""
    return kept(model, Formulas, lambda: Formulas(model))


class Part(NamedTuple):
    """A part of an interval: where it begins, its length, its inputs there and their derivative."""

    start: float
    length: float
    u: Array | None
    rate: Array

    def at(self, t: float) -> Array | None:
        """Return the inputs at a time."""
        return None if self.u is None else self.u + (t - self.start) * self.rate


def part_of(parts: Pieces, j: int) -> Part:
    """Return one of the parts."""
    start, length = float(parts.starts[j]), float(parts.stops[j] - parts.starts[j])
    return Part(start, length, parts.first[j] if parts.first.shape[1] else None, parts.change[j] / length)


def subdivided(pieces: Pieces, count: int) -> Pieces:
    """Return the equal parts of pieces."""
    place = np.tile(np.arange(count), len(pieces.row))
    row, starts, stops, first, change = (np.repeat(field, count, axis=0) for field in pieces)
    length, change = (stops - starts) / count, change / count
    begins = starts + place * length
    return Pieces(row, begins, begins + length, first + place[:, None] * change, change)


def rate_noise_of(
    model: Model, formulas: Formulas, parts: Pieces, theta: Array, inside: Array
) -> tuple[Array, tuple[str, ...]]:
    """Return the covariances (J, 2, m, m) of the rates of the coordinates `inside` (J, m) in the halves of parts, and notes."""
    count, m = inside.shape
    origin, lengths = np.zeros(model.n), 0.5 * (parts.stops - parts.starts)
    alone = (np.eye(m) * ~inside[:, None, :])[:, None]
    notes: tuple[str, ...] = ()
    with np.errstate(all="ignore"):
        if not formulas.noise_varies:
            noise = formulas.noise(origin, np.zeros(count), theta, parts.first)
            both = inside[:, :, None] & inside[:, None, :]
            rate = np.where(both, noise / lengths[:, None, None], 0.0)[:, None]
            return np.repeat(rate + alone, 2, axis=1), notes

        def coefficients(times: Array, rows: Array) -> Coefficients:
            precision = precision_of(formulas.noise(origin, times, theta), inside[rows // 2])
            zero = np.zeros_like(precision)
            return Coefficients(zero, zero[:, :, :1], precision, zero, zero[:, :, :1], zero[:, 0, :1])

        # The noise that a state without drift gathers is the integral of its covariance.
        starts = np.column_stack([parts.starts, parts.starts + lengths]).ravel()
        found = integrate(coefficients, starts, starts + np.repeat(lengths, 2), False)
        worst = float(found.error.max(initial=0.0))
        if worst > RESOLVED:
            notes = (
                f"observation_noise varies so fast within an interval that its integral is known to {worst:.1g} only; "
                "give shorter intervals",
            )
        precision = found.transition.noise.reshape(count, 2, m, m)
        return np.linalg.inv(precision + alone), notes
