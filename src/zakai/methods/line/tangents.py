"""The derivatives of densities of one state with respect to parameters, for the gradient of the log-likelihood.

The filter's own steps are taken, to the bit.  With each the derivatives of the density are carried for all parameters at once,
where the transition is by the modes of the operator; elsewhere by the step at parameters with infinitesimal imaginary parts, for
one parameter after the other (`numerics/complex_step.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from sympy import sympify

from zakai.methods._protocol import Infos, Tangents
from zakai.methods.line import filter as line_filter
from zakai.methods.line.backward_loop import log_likelihoods
from zakai.methods.line.coefficients import spectral
from zakai.methods.line.loop import Piece, grid_of, infos_of
from zakai.methods.line.parts import segment_of_parts
from zakai.methods.line.prepared import CoefficientsInTime, Parts, Prepared, State
from zakai.methods.line.update import factor_of
from zakai.numerics.arrays import Array
from zakai.numerics.complex_step import STEP
from zakai.numerics.line import window as lw
from zakai.numerics.line.splitting import Interval, TangentCoefficients, through
from zakai.numerics.line.steps import NEEDED, PAIRS, SPLIT, START, SUBSTEPS
from zakai.numerics.line.tangents import Varied, extended, resampled_tangents

IN_TIME = CoefficientsInTime._fields[:4]  # what varies with the parameters


def tangents(
    prepared: Prepared, shifted: Sequence[Prepared], rows: slice, state: State, shifted_states: Sequence[State], observed: Array
) -> Tangents[State] | None:
    """Return what `line_filter.segment` returns, with derivatives; None where likelihoods act in the weak sense.

    Args:
        shifted: the same at parameters of which the i-th has an infinitesimal imaginary part, for i < p.
        shifted_states: the same at the p parameters.
        observed: what is observed (K, m).
    """
    if prepared.weak:
        return None
    walk = _Walk(shifted, _derivatives(shifted_states, state.window))
    if prepared.parts is None:
        states, infos = walk.over(prepared, rows, state, observed)
    else:
        states, infos = walk.in_parts(prepared.parts, rows, state, observed)
    last = states[-1]
    return Tangents(states, infos, walk.slopes, [last._replace(values=last.values + 1j * STEP * one) for one in walk.tangents])


class _Walk:
    """The derivatives (p, N) of a density on their way through the intervals, and those (p,) of what was gained."""

    def __init__(self, shifted: Sequence[Prepared], tangents: Array):
        self.shifted, self.tangents, self.slopes = shifted, tangents, np.zeros(len(shifted))
        self.known: dict[lw.Window, Varied] = {}
        model = shifted[0].model
        own = [list(model.parameters)[int(np.argmax(one.theta.imag))] for one in shifted]
        parts = [*model.observation, *model.observation_noise, *model.family_parameters.values(), model.log_density or 0]
        symbols = {symbol.name for part in parts for symbol in sympify(part, strict=True).free_symbols}
        self.observing = [i for i, name in enumerate(own) if name in symbols]  # parameters of likelihoods

    def over(self, prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[Sequence[State], Infos]:
        """Take the intervals of a slice; return the states and the reports."""

        def noted(k: int, before: State, result: line_filter.FilteredSteps) -> None:
            values = observed[k - rows.start :]
            if isinstance(result, line_filter.SingleStep):
                if result.parts is None:
                    self._singly(k, before, result.state, values[0])
                else:
                    self.in_parts(result.parts, slice(0, 1), before, values[:1])
                return
            for piece in result:
                place = piece.first - k
                self._regrid(before.values, before.window, piece.before.window)
                own = values[place : place + piece.number]
                if piece.coarse is not None:
                    window = self._placed(prepared, piece, piece.coarse, own)
                else:
                    window = (self._by_splitting if prepared.gaussian else self._by_modes)(prepared, piece, own)
                self._regrid(piece.densities[-1], window, piece.last.window)
                before = piece.last

        return line_filter.segment_of_whole(prepared, rows, state, observed, noted)

    def in_parts(self, parts: Parts, rows: slice, state: State, observed: np.ndarray) -> tuple[Sequence[State], Infos]:
        """Take the intervals of a slice that are cut into parts; return the states and the reports."""
        whole = self.shifted
        self.shifted = [replace(parts.prepared, theta=one.theta) for one in whole]
        result = segment_of_parts(parts, rows, state, observed, self.over)
        self.shifted = whole
        return result

    def _singly(self, k: int, before: State, after: State, observed: np.ndarray) -> None:
        """Take one interval, for one parameter after the other."""
        states, known = [], extended(before.values, self.tangents)
        for i, prepared in enumerate(self.shifted):
            state = before._replace(values=before.values + 1j * STEP * known[i])
            state, info = line_filter.step(prepared, k, state, observed)
            states.append(state)
            self.slopes[i] += info.log_likelihood_increment.imag / STEP
        self.tangents = _derivatives(states, after.window)

    def _placed(self, prepared: Prepared, piece: Piece, coarse: Array, observed: np.ndarray) -> lw.Window:
        """Take the steps of a piece by the modes of coarse grids (K, 4), to grids of their own; return the last one."""
        states = [piece.before, *piece.states]
        for i, gained in enumerate(infos_of(prepared, [piece]).log_likelihood_increment):
            k, window, after = piece.first + i, states[i].window, piece.densities[i]
            centre, spacing, size, margin = coarse[i].tolist()
            wide = window._replace(centre=centre, spacing=spacing, size=int(size))
            predicted, self.tangents = self._varied(prepared, wide).through(
                states[i].values, self.tangents, prepared.lengths[k], window, wide, int(margin)
            )
            new = window._replace(centre=float(piece.centres[i]), spacing=float(piece.spacings[i]), size=len(after))
            self._regrid(predicted, wide, new)
            seen, logs = prepared.schedule.seen[k], np.zeros((len(self.shifted), len(after)), complex)
            if seen.any():
                logs = self._logs(partial(_logs_of, k=k, observed=observed[i], points=new.points), prepared)
            self._multiply(after, logs, gained)
        return states[-1].window

    def _by_modes(self, prepared: Prepared, piece: Piece, observed: np.ndarray) -> lw.Window:
        """Take the steps of a piece by the modes of its grid; return the grid."""
        window, own, density = piece.before.window, slice(piece.first, piece.first + piece.number), piece.before.values
        varied = self._varied(prepared, window)
        logs = self._logs(lambda one: log_likelihoods(one, own, observed, window.points[None]), prepared)
        for i, gained in enumerate(infos_of(prepared, [piece]).log_likelihood_increment):
            after = piece.densities[i]
            _, self.tangents = varied.through(density, self.tangents, prepared.lengths[piece.first + i])
            self._multiply(after, logs[:, i], gained)
            density = after
        return window

    def _by_splitting(self, prepared: Prepared, piece: Piece, observed: np.ndarray) -> lw.Window:
        """Take the steps of a piece by splittings, or singly; return the last grid."""
        window, own, states = piece.before.window, slice(piece.first, piece.first + piece.number), [piece.before, *piece.states]
        grids = [grid_of(one, window, own) for one in self.shifted]
        table = np.array([grid.table for grid in grids if grid is not None])
        cells = np.rint(np.append(window.centre, piece.centres) / window.spacing).astype(int)
        starts = cells + int(piece.reports[0, START]) - cells[1]  # in the table
        centres, gains = piece.centres, infos_of(prepared, [piece]).log_likelihood_increment
        points = window.origin + centres[:, None] + window.spacing * lw.index(window.size)
        logs = self._logs(lambda one: log_likelihoods(one, own, observed, points), prepared)
        for i in range(piece.number):
            shift = int(starts[i + 1] - starts[i])
            interval, coefficients = self._divided(prepared, piece, i, observed[i]), None
            if interval is not None and len(table) == len(self.shifted):
                own_table = table[:, i if table.shape[1] > 1 else 0, :, :, starts[i + 1] : starts[i + 1] + window.size]
                time = [np.array([getattr(one.coefficients, name)[piece.first + i] for one in self.shifted]) for name in IN_TIME]
                coefficients = TangentCoefficients(own_table, *time)
            if interval is None or coefficients is None:
                self._singly(piece.first + i, states[i], states[i + 1], observed[i])
                window = states[i + 1].window
            else:
                before, tangents = (lw.shifted(one, shift, window.size) for one in (states[i].values, self.tangents))
                _, self.tangents, log_factor = through(interval, coefficients, before, tangents)
                self._multiply(piece.densities[i], logs[:, i] + log_factor[:, None], gains[i])
                window = window._replace(centre=float(centres[i]))
        return window

    def _divided(self, prepared: Prepared, piece: Piece, i: int, observed: Array) -> Interval | None:
        """Return what the filter did in a step that was split, None for another one."""
        k, (pairs, substeps, needed) = piece.first + i, piece.reports[i, [PAIRS, SUBSTEPS, NEEDED]]
        if substeps == 0.0:
            return None
        length, inside, depth = float(prepared.lengths[k]), bool(prepared.kinds[k] == SPLIT), 8.0 - float(np.log(prepared.cut))
        narrow, (spacing, closed) = bool(needed > 0.0), (piece.before.spacing, piece.before.closed)
        return Interval(length, spacing, closed, observed, inside, int(pairs), int(substeps), narrow, depth)

    def _logs(self, function: Callable[[Prepared], Array], prepared: Prepared) -> Array:
        """Return the logarithms (p, ...) of likelihoods, with imaginary parts where a likelihood depends on the parameter."""
        result = {i: function(self.shifted[i]) for i in self.observing}
        real = next(iter(result.values())).real if result else function(prepared)
        return np.array([result.get(i, real) for i in range(len(self.shifted))], complex)

    def _varied(self, prepared: Prepared, window: lw.Window) -> Varied:
        """Return the decomposition on a grid with its derivatives."""
        if window not in self.known:
            modes, shifted = spectral(prepared, window), [spectral(one, window) for one in self.shifted]
            assert modes is not None
            self.known[window] = Varied.of(modes, [one for one in shifted if one is not None])
        return self.known[window]

    def _multiply(self, after: Array, logs: Array, gained: float) -> None:
        """Multiply the derivatives of a prediction by a likelihood.

        Args:
            after: the density after that (N,).
            logs: the logarithms (p, N) of the likelihood, with imaginary parts.
            gained: the log-likelihood of what was observed.
        """
        factor = np.where(after > 0, np.exp(np.where(after > 0, logs[0].real - gained, 0.0)), 0.0)
        product = self.tangents * factor + np.where(after > 0, after * logs.imag, 0.0) / STEP
        slopes = np.sum(product, axis=1)
        self.slopes += slopes
        self.tangents = product - after * slopes[:, None]

    def _regrid(self, values: Array, window: lw.Window, new: lw.Window) -> None:
        """Take the derivatives of a density to another grid."""
        self.tangents = resampled_tangents(values, self.tangents, window, new)


def _logs_of(prepared: Prepared, k: int, observed: Array, points: Array) -> Array:
    """Return the log-likelihood of an observation at points (N,)."""
    likelihood = factor_of(prepared, k, observed, None)
    result: Array = np.zeros(len(points)) if likelihood is None else likelihood.logs(points)
    return result


def _derivatives(states: Sequence[State], new: lw.Window) -> Array:
    """Return the derivatives (p, N) on a grid of states at parameters with infinitesimal imaginary parts."""
    result = [resampled_tangents(one.values.real, one.values.imag[None] / STEP, one.window, new)[0] for one in states]
    return np.array(result)
