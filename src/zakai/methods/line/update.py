"""The factors of observations at the end of an interval, for one state."""

from __future__ import annotations

from typing import Any

import numpy as np

from zakai.methods.line.figures import figures
from zakai.methods.line.model import System
from zakai.methods.line.system import Prepared
from zakai.methods.line.tables import tables
from zakai.methods.system.observation import log_likelihood
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.line import window as lw
from zakai.numerics.line.panels import GAUSS_NODES, GAUSS_WEIGHTS, panels
from zakai.numerics.line.posterior import Gaussian, General, Likelihood, Product
from zakai.numerics.line.weak import WEAK_SHARE, at_nodes, nodes, weak_error, weaken

Array = Any


def acting_inside(prepared: Prepared, k: int) -> np.ndarray:
    """Return which increments (m,) act within interval k."""
    inside: np.ndarray = prepared.inside[k]
    return np.zeros_like(inside) if prepared.lie and not inside.all() else inside


def factor_of(prepared: Prepared, k: int, observed: np.ndarray, window: lw.Window | None) -> Likelihood | None:
    """Return the likelihood of what acts at the end of interval k, None where nothing does; `window` as of `factor_at_end`."""
    inside = acting_inside(prepared, k)
    at_end = prepared.schedule.seen[k] & ~inside
    if at_end.any():
        return factor_at_end(prepared, k, at_end, observed, window)
    return exponential_factor(prepared, k, observed) if prepared.lie and inside.any() else None


def factor_at_end(prepared: Prepared, k: int, at_end: np.ndarray, observed: np.ndarray, window: lw.Window | None) -> Likelihood:
    """Return the likelihood of the samples, or of the increments that were gathered over more than the interval.

    `window` is a grid at which h is known where it does not depend on t.
    """
    system, theta, stop = prepared.system, prepared.theta, float(prepared.schedule.stops[k])
    rows = np.flatnonzero(at_end)
    if system.general:
        inputs = system.inputs_at(stop)

        def log_density(points: Array) -> Array:
            return log_likelihood(system.model, observed, at_end, points[:, None], stop, theta, inputs)

        return General(log_density)
    if system.samples:
        spans = np.ones(len(rows))
        precision, constant = _sample_noise(prepared, stop, at_end)
    else:
        spans = prepared.schedule.elapsed[k, rows]
        precision = np.linalg.inv(shared_noise(system, theta, stop, spans, rows))
        constant = 0.5 * observed[rows] @ precision @ observed[rows]

    def evaluate(points: Array) -> Array:
        return system.observation(points[:, None], stop, theta)[:, rows].T * spans[:, None]

    known = None
    if system.steady_observation and window is not None:
        h = tables(prepared, window).observation
        known = window, (h if len(rows) == len(h) and system.samples else h[rows] * spans[:, None])
    return Gaussian(evaluate, observed[rows], precision, constant, known=known)


def sampled_weakly(
    prepared: Prepared, k: int, values: Array, window: lw.Window, observed: np.ndarray
) -> tuple[Product, lw.Figures]:
    """Return the product of a density and the likelihood of a sample of an h with kinks, on a grid that resolves it weakly.

    The figures of the product report the error in the weak sense in place of the spectrum at the highest frequencies.
    """
    system, start, theta = prepared.system, prepared.model.start, prepared.theta
    precision, constant = np.ascontiguousarray(prepared.coefficients.precisions[k, 0]), prepared.coefficients.constants[k]
    observed, source = np.ascontiguousarray(observed, float), (values, window)
    while True:
        at = int(np.argmax(values))
        centre = system.observation(window.points[at : at + 1, None], start, theta)[0]
        fine = at_nodes(system.observation(nodes(window.points, window.spacing)[:, None], start, theta).T)
        logs, change = np.full(window.size, -np.inf), np.ones(window.size)
        weaken(fine, 0, precision, observed, np.ascontiguousarray(centre), logs, change)
        known = np.where(values > 0, np.log(np.where(values > 0, values, 1.0)), -np.inf)
        best = float(np.max(known + logs))
        product = np.exp(known + logs - best)
        total = float(np.sum(product))
        product = product / total
        error = 0.5 * weak_error(product, change)
        new, covers = _finer(prepared, product, window)
        if error <= WEAK_SHARE * prepared.tolerance or new.size > prepared.largest or not covers:
            break
        # From the whole density: one that ends within a grid cannot be interpolated there.
        values, window = lw.resampled(*source, new), new
    rest = observed - centre
    gained = np.log(total) + best + constant - 0.5 * rest @ precision @ rest
    reference = float(np.log(values.max()))
    growth = float(np.sum(np.exp(np.minimum(logs + reference - best - np.log(total), 200.0))))
    depth = float(product @ np.where(product > 0, reference - known, 0.0))
    look = figures(prepared, product, window)._replace(aliasing=error)
    return Product(product, gained, depth, growth, window), look


def _finer(prepared: Prepared, values: Array, window: lw.Window) -> tuple[lw.Window, bool]:
    """Return a finer grid for a density, and whether that holds it with the margins that a grid is kept with."""
    look = figures(prepared, values, window)
    low, high = window.offsets[look.first], window.offsets[look.last]
    new = lw.quantized(window, low, high, window.spacing / 2**0.5 * 1.001, margin=0.16, most=lw.SIZES[-1])
    least = new.size // 16
    return new, bool(new.offsets[least] <= low and high < new.offsets[-least])


def _sample_noise(prepared: Prepared, stop: float, at_end: np.ndarray) -> tuple[Array, Any]:
    """Return the precision of the observed coordinates of a sample, and the logarithm of the density's constant."""
    system, rows = prepared.system, np.flatnonzero(at_end)

    def make() -> tuple[Array, Any]:
        noise = system.noise(np.zeros(1), stop, prepared.theta)[np.ix_(rows, rows)]
        return np.linalg.inv(noise), -0.5 * (log_determinant(noise) + np.log(2 * np.pi) * len(rows))

    found: tuple[Array, Any] = prepared.once(("noise", at_end.tobytes()), make) if system.steady_noise else make()
    return found


def exponential_factor(prepared: Prepared, k: int, observed: np.ndarray) -> Gaussian:
    """Return exp(h'S^-1 dy) of the order of factors of the papers, all of it at the end of the interval."""
    system, theta, stop = prepared.system, prepared.theta, float(prepared.schedule.stops[k])
    precision = np.linalg.inv(system.noise(np.zeros(1), stop, theta))

    def evaluate(points: Array) -> Array:
        return system.observation(points[:, None], stop, theta).T

    return Gaussian(evaluate, observed, precision, 0.0, linear=True)


def shared_noise(system: System, theta: np.ndarray, stop: float, spans: np.ndarray, rows: np.ndarray) -> Array:
    """Return the covariance of increments that end together: the integral of S over the time that two have in common."""
    common = np.minimum(spans[:, None], spans)
    if system.steady_noise:
        return system.noise(np.zeros(1), stop, theta)[np.ix_(rows, rows)] * common
    total = np.zeros((len(rows), len(rows)), complex if np.iscomplexobj(theta) else float)
    for span in np.unique(spans):
        pieces = panels(lambda t: system.noise(np.zeros((len(t), 1)), t, theta.real).reshape(len(t), -1), stop - span, stop)
        for first, last in pieces.bounds:
            times = first + (last - first) * GAUSS_NODES
            part = system.noise(np.zeros((len(times), 1)), times, theta)[:, rows[:, None], rows]
            total = np.where(common == span, total + np.tensordot(GAUSS_WEIGHTS * (last - first), part, axes=1), total)
    return total
