"""The derivatives of densities of one state with respect to parameters, for the gradient of the log-likelihood.

The filter's own steps are taken, to the bit.  With each the derivatives of the density are carried for all parameters at once,
where the transition is by the modes of the operator; elsewhere by the step at parameters with infinitesimal imaginary parts, for
one parameter after the other (`numerics/complex_step.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from zakai.methods import _line
from zakai.methods._line_adjoint import log_likelihoods
from zakai.methods._line_coarse import coarsened
from zakai.methods._line_loop import Piece, infos_of
from zakai.methods._line_moves import Passage
from zakai.methods._line_system import Prepared, State
from zakai.methods._line_tables import spectral
from zakai.methods._line_update import factor_at_end
from zakai.methods._protocol import Infos, Tangents
from zakai.numerics import line_window as lw
from zakai.numerics.complex_step import STEP
from zakai.numerics.line_tangents import Varied

Array = Any


def tangents(
    prepared: Prepared, shifted: Sequence[Prepared], rows: slice, state: State, shifted_states: Sequence[State], observed: Array
) -> Tangents[State] | None:
    """Return what `_line.segment` returns, with derivatives; None for kernels, splittings and weak likelihoods.

    Args:
        prepared: what is known without data.
        shifted: the same at parameters of which the i-th has an infinitesimal imaginary part, for i < p.
        rows: the intervals.
        state: the state before them.
        shifted_states: the same at the p parameters.
        observed: what is observed (K, m).
    """
    if prepared.weak or prepared.gaussian:
        return None
    walk = _Walk(shifted, np.array([_moved(one, state.window).imag / STEP for one in shifted_states]))
    states, infos = walk.over(prepared, rows, state, observed)
    last = states[-1]
    return Tangents(states, infos, walk.slopes, [last._replace(values=last.values + 1j * STEP * one) for one in walk.tangents])


class _Walk:
    """The derivatives (p, N) of a density on their way through the intervals, and those (p,) of what was gained."""

    def __init__(self, shifted: Sequence[Prepared], tangents: Array):
        self.shifted, self.tangents, self.slopes = shifted, tangents, np.zeros(len(shifted))

    def over(self, prepared: Prepared, rows: slice, state: State, observed: np.ndarray) -> tuple[Sequence[State], Infos]:
        """Take the intervals of a slice; return the states and the reports."""

        def noted(k: int, before: State, found: _line.Taken) -> None:
            values = observed[k - rows.start :]
            if isinstance(found, _line.Stepped):
                if found.passage is None:
                    self._singly(k, before, found.state, values[0])
                else:
                    self._passed(prepared, k, before, found, found.passage, values[0])
                return
            for piece in found:
                place = piece.first - k
                self._regrid(before.values, before.window, piece.before.window)
                self._by_modes(prepared, piece, values[place : place + piece.number])
                self._regrid(piece.segment.densities[-1], piece.before.window, piece.last.window)
                before = piece.last

        return _line.segment_of_whole(prepared, rows, state, observed, noted)

    def _singly(self, k: int, before: State, after: State, observed: np.ndarray) -> None:
        """Take one interval, for one parameter after the other."""
        found = []
        for i, prepared in enumerate(self.shifted):
            state = before._replace(values=before.values + 1j * STEP * self.tangents[i])
            state, info = _line.step(prepared, k, state, observed)
            found.append(_moved(state, after.window).imag / STEP)
            self.slopes[i] += info.log_likelihood_increment.imag / STEP
        self.tangents = np.array(found)

    def _by_modes(self, prepared: Prepared, piece: Piece, observed: np.ndarray) -> None:
        """Take the steps of a piece by the modes of its grid."""
        window, own, density = piece.before.window, slice(piece.first, piece.first + piece.number), piece.before.values
        varied = self._varied(prepared, window)
        logs = np.array([log_likelihoods(one, own, observed, window.points[None]) for one in self.shifted])
        for i, gained in enumerate(infos_of(prepared, [piece]).log_likelihood_increment):
            after = piece.segment.densities[i]
            _, self.tangents = varied.through(density, self.tangents, prepared.lengths[piece.first + i])
            self._multiply(after, logs[:, i], gained)
            density = after

    def _passed(
        self, prepared: Prepared, k: int, before: State, step: _line.Stepped, passage: Passage, observed: np.ndarray
    ) -> None:
        """Take a single step whose transition was by modes."""
        length, (values, window, of_modes) = float(prepared.lengths[k]), passage
        self._regrid(before.values, before.window, window)
        if of_modes == window:
            values, self.tangents = self._varied(prepared, window).through(values, self.tangents, length)
        else:
            pairs = zip(self.shifted, values + 1j * STEP * self.tangents, strict=True)
            carried = [coarsened(one, own, window, length) for one, own in pairs]
            found = np.array([one[0] for one in carried if one is not None])
            values, self.tangents = found[0].real, found.imag / STEP
        self._regrid(values, of_modes, step.window)
        at_end = prepared.schedule.seen[k] & ~prepared.inside[k]
        logs = np.zeros((len(self.shifted), step.window.size), complex)
        if at_end.any():
            logs[:] = [factor_at_end(one, k, at_end, observed, None).logs(step.window.points) for one in self.shifted]
        self._multiply(step.values, logs, step.info.log_likelihood_increment)
        self._regrid(step.values, step.window, step.state.window)

    def _varied(self, prepared: Prepared, window: lw.Window) -> Varied:
        modes, shifted = spectral(prepared, window), [spectral(one, window) for one in self.shifted]
        assert modes is not None
        return Varied.of(modes, [one for one in shifted if one is not None])

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
        if new != window:
            moved = [lw.resampled(one, window, new).imag for one in values + 1j * STEP * self.tangents]
            self.tangents = np.array(moved) / STEP


def _moved(state: State, window: lw.Window) -> Array:
    """Return the density of a state at parameters with imaginary parts, on a grid."""
    return lw.resampled(np.asarray(state.values, complex), state.window, window)
