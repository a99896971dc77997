"""One state on a grid: the prior, the grid check of a density, regridding, and the factors of observations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zakai.errors import InputError
from zakai.methods.line.cache import Derived
from zakai.methods.line.coefficients import covariance_at, sensor_at_nodes, tables
from zakai.methods.line.domain import variable_of
from zakai.methods.line.model import System
from zakai.methods.line.prepared import Prepared, State
from zakai.methods.system.observation import log_likelihood
from zakai.models.numeric import numpy_function
from zakai.models.prior import DensityPrior, Prior
from zakai.numerics.arrays import Array, Number
from zakai.numerics.complex_step import log_determinant
from zakai.numerics.line import window as lw
from zakai.numerics.line.averages import GAUSS_NODES, GAUSS_WEIGHTS, panels
from zakai.numerics.line.density import support
from zakai.numerics.line.product import (
    WEAK_SHARE,
    Gaussian,
    General,
    Likelihood,
    Product,
    finer,
    middles,
    normalized,
    weak,
    weak_error,
    weaken,
)
from zakai.numerics.line.resolution import RESOLVED, TRIALS
from zakai.numerics.line.window import Window
from zakai.numerics.prior_grid import mixture_log_density, prior_grid

HIDING_WAVES = 1e-6  # spectrum at the highest frequencies from which waves hide where a density ends, and a prior is averaged


def resampled(prepared: Prepared, values: Array, window: lw.Window, new: lw.Window) -> Array:
    """Return probabilities on another grid, in the weak sense on a coarser one where densities have kinks."""
    if not prepared.weak or new.spacing <= window.spacing:
        return lw.resampled(values, window, new)
    density = lw.density_at(values, window, middles(new.offsets, new.spacing))
    result = weak(density, new.spacing)[0] * (new.spacing / window.spacing)
    return np.where(result > 0, result, 0.0)


def grid_check(prepared: Prepared, values: Array, window: lw.Window) -> lw.GridCheck:
    """Return the figures of a density.

    A spectrum that falls slowly, of kinks and of what the largest grid does not resolve, does not tell where a density ends.  Of
    kinks of likelihoods a coarser grid would fold it, and a finer one has no more of it.
    """
    check = lw.grid_check(values, window.closed, prepared.negligible, prepared.cut)
    if prepared.kinked or check.aliasing > HIDING_WAVES:
        noise = 0.0 if prepared.weak else 1e-2 * check.aliasing  # of waves that the transition leaves everywhere
        first, last = support(np.ascontiguousarray(values.real), max(prepared.cut, noise))
        check = check._replace(first=first, last=last)
    return check._replace(resolving=1.0) if prepared.weak else check


def refitted(
    prepared: Prepared, values: Array, window: lw.Window, check: lw.GridCheck, generous: int = 64, large: bool = True
) -> tuple[Array, lw.Window]:
    """Return a density on the grid for its next substep, and this grid.

    Args:
        values: probabilities (N,).
        check: figures of the density by its spectrum.
        generous: a grid of up to so many points is kept though fewer would do.
        large: whether it may have more points than a matrix of the operator.
    """
    large = large and prepared.largest_for(check, window.size) > prepared.largest
    check = check._replace(resolving=1.0) if prepared.smoothing else check
    new = lw.fitted(check, window, lw.SIZES[-1] if large else lw.LARGEST, generous)
    new_values = resampled(prepared, values, window, new)
    if prepared.smoothing:  # elsewhere an imaginary part need not have the sum zero
        new_values = new_values / np.sum(new_values)
    return new_values, new


def on_fitting_grid(
    prepared: Prepared, values: Array, window: lw.Window, check: lw.GridCheck, generous: int
) -> tuple[Array, lw.Window, float]:
    """Return a density on the grid for the next interval, this grid, and the spectrum that it does not resolve.

    The grid is large only where one on which matrices act does not resolve the density.  For the arguments see `fitted` of
    `numerics/line/window.py`.
    """
    most, large = prepared.largest, prepared.largest_for(check, window.size)
    while True:
        new = lw.fitted(check, window, most, generous)
        if new == window:
            return values, window, check.aliasing
        new_values = resampled(prepared, values, window, new)
        new_values = new_values / np.sum(new_values)
        coarse = 0.0 if prepared.weak else lw.grid_check(new_values, new.closed, prepared.negligible, prepared.cut).aliasing
        if coarse <= RESOLVED or most >= large:
            return new_values, new, coarse
        most = large


def outside_tables(prepared: Prepared, values: Array, window: lw.Points, t: float) -> float:
    """Return the share of the mass where a table is constant beyond its range."""
    return float(values.real @ prepared.system.outside(window.points, t, prepared.theta) / np.sum(values.real))


def state_moments(prepared: Prepared, values: Array, window: lw.Window, mean: Number, variance: Number) -> tuple[Number, Number]:
    """Return the mean and variance of the state from those of the variable of the grid, relative to its origin.

    The mean of an angle is in (-pi, pi].
    """
    variable = variable_of(prepared.model)
    if variable is None:
        mean = window.origin + mean
        return mean - (2 * np.pi * np.ceil((mean.real - np.pi) / (2 * np.pi)) if window.closed else 0.0), variance
    offsets = variable.offset(window.points)
    mean = np.dot(offsets, values)
    apart = offsets - mean
    return variable.end + mean, np.dot(apart * apart, values)


def edge_of_moments(prepared: Prepared, values: Array, window: lw.Window) -> float:
    """Return the share of the second moment of the state at the ends of the grid, where the state has a domain."""
    variable = variable_of(prepared.model)
    if variable is None:
        return 0.0
    offsets = variable.offset(window.points)
    parts = (offsets - offsets[int(np.argmax(values.real))]) ** 2 * values.real
    return float(max(parts[0], parts[-1]) / np.sum(parts))


def error_remainder(before: Number, predicted: Number, after: Number, spread: float) -> float:
    """Return the remainder of an old relative error after a step, from the variances: that of an error of the mean in deviations.

    `spread` is the integral of G over the interval, which counts where the observation acts inside.
    """
    ratio = np.sqrt(max(before.real * after.real, 0.0)) / max(predicted.real, 1e-300)
    return float(np.clip(ratio * np.exp(-min(0.5 * spread / max(before.real, 1e-300), 5.0)), 0.3, 1.0))


def spread(prepared: Prepared, k: int, length: float, mean: float) -> float:
    """Return about the integral of G over interval k where increments act inside."""
    if not prepared.inside[k].any():
        return 0.0
    middle = float(prepared.schedule.starts[k]) + 0.5 * length
    return length * float(np.max(covariance_at(prepared.system, np.array([mean]), middle, prepared.theta).real))


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


def factor_at_end(prepared: Prepared, k: int, at_end: np.ndarray, observed: np.ndarray, window: lw.Points | None) -> Likelihood:
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
) -> tuple[Product, lw.GridCheck]:
    """Return the product of a density and the likelihood of a sample of an h with kinks, on a grid that resolves it weakly.

    The figures of the product report the error in the weak sense in place of the spectrum at the highest frequencies.
    """
    system, start, theta = prepared.system, prepared.model.start, prepared.theta
    precision, constant = np.ascontiguousarray(prepared.coefficients.precisions[k, 0]), prepared.coefficients.constants[k]
    observed, source = np.ascontiguousarray(observed, float), (values, window)
    while True:
        at = int(np.argmax(values))
        centre = system.observation(window.points[at : at + 1, None], start, theta)[0]
        fine = sensor_at_nodes(prepared, window.points, window.spacing)
        logs, change = np.full(window.size, -np.inf), np.ones(window.size)
        weaken(fine, 0, precision, observed, np.ascontiguousarray(centre), logs, change)
        product, gained, depth, growth = normalized(values, logs, np.ones(window.size), float(values.max()))
        error = 0.5 * weak_error(product, change)
        check = grid_check(prepared, product, window)
        new = finer(product, window, check)
        if error <= WEAK_SHARE * prepared.tolerance or new == window or new.size > prepared.largest:
            break
        # From the whole density: one that ends within a grid cannot be interpolated there.
        values, window = lw.resampled(*source, new), new
    rest = observed - centre
    gained = gained + constant - 0.5 * rest @ precision @ rest
    return Product(product, gained, depth, growth, window), check._replace(aliasing=error)


def _sample_noise(prepared: Prepared, stop: float, at_end: np.ndarray) -> tuple[Array, Number]:
    """Return the precision of the observed coordinates of a sample, and the logarithm of the density's constant."""
    system, rows = prepared.system, np.flatnonzero(at_end)

    def make() -> tuple[Array, Number]:
        noise = system.noise(np.zeros(1), stop, prepared.theta)[np.ix_(rows, rows)]
        return np.linalg.inv(noise), -0.5 * (log_determinant(noise) + np.log(2 * np.pi) * len(rows))

    result: tuple[Array, Number] = prepared.once(Derived.SAMPLE_NOISE, at_end.tobytes(), make) if system.steady_noise else make()
    return result


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
        return np.asarray(system.noise(np.zeros(1), stop, theta)[np.ix_(rows, rows)] * common)
    total = np.zeros((len(rows), len(rows)), complex if np.iscomplexobj(theta) else float)
    for span in np.unique(spans):
        pieces = panels(lambda t: system.noise(np.zeros((len(t), 1)), t, theta.real).reshape(len(t), -1), stop - span, stop)
        for first, last in pieces.bounds:
            times = first + (last - first) * GAUSS_NODES
            part = system.noise(np.zeros((len(times), 1)), times, theta)[:, rows[:, None], rows]
            total = np.where(common == span, total + np.tensordot(GAUSS_WEIGHTS * (last - first), part, axes=1), total)
    return total


# The smallest value that counts of a prior with natural ends, relative to the largest: farther out, rounding in the transition
# exceeds the mass, since the coefficients of the variable w grow exponentially.
CUT_OF_DOMAIN = 1e-8
_PLACES = 256  # in a spacing, to which the place of a jump is known


def averaged(evaluate: Callable[[Array], Array], window: Window) -> Array:
    """Return a density with a kink or a jump as averages around the grid points, which keep its mass and its mean.

    The weights are those of linear interpolation, so that a jump between two points has its place.
    """
    place = (np.arange(2 * _PLACES) + 0.5) / _PLACES - 1.0
    points = window.points[:, None] + window.spacing * place
    logs = evaluate(points.reshape(-1, 1)).reshape(points.shape)
    logs = np.where(np.isnan(logs.real), -np.inf, logs)
    values = np.exp(logs - np.max(logs.real)) @ (1.0 - np.abs(place))
    return np.asarray(values / np.sum(values))


def init(prepared: Prepared, prior: Prior) -> State:
    """Return the prior on a grid that fits it."""
    model, closed, variable = prepared.model, bool(prepared.model.periodic), variable_of(prepared.model)
    if isinstance(prior, DensityPrior):
        function, log_density = numpy_function([prior.log_density], model, (1,)), None

        def evaluate(points: Array) -> Array:
            return function(points if variable is None else variable.x(points), model.start, prepared.theta)[..., 0]

    else:
        weights, means, covs = prior.components
        deviations = np.sqrt(covs[:, 0, 0])
        if np.any(deviations <= 1e-14 * np.abs(means[:, 0])):
            raise InputError("prior: a variance is zero; a grid needs a density, so give it a small variance")
        log_density = mixture_log_density(weights, means, covs, [closed])
        if variable is not None:
            mixture, log_density = log_density, None

            def evaluate(points: Array) -> Array:
                return mixture(np.array([variable.end]), variable.offset(points))

    if variable is not None:
        of_state = evaluate

        def evaluate(points: Array) -> Array:
            with np.errstate(all="ignore"):
                return np.asarray(of_state(points) + variable.log_slope(points)[..., 0])

    cut = lw.CUT if variable is None else CUT_OF_DOMAIN
    if log_density is None:
        tolerance = 1e-12 if variable is None else cut
        grid = prior_grid(lambda points: evaluate(points).real, 1, [closed], tolerance=tolerance)
        low, high = (float(grid.points[i, 0]) for i in (0, -1))
        # Rather too coarse than without a part of the mass.
        spacing = max(float(grid.basis[0, 0]), (high - low) / (lw.LARGE - 2 * lw.ALIGNMENT))
    else:
        depth = float(np.sqrt(-2.0 * np.log(cut))) + 0.1
        low, high = float(np.min(means[:, 0] - depth * deviations)), float(np.max(means[:, 0] + depth * deviations))
        spacing = float(deviations.min()) / 3.0
    if closed:
        size = lw.size_for(2 * np.pi / min(spacing * 0.95, 2 * np.pi / 64))
        window = Window(0.0, 0.0, 2 * np.pi / size, size, True, 1.0)
    else:
        origin = 0.5 * (low + high)
        window = Window(origin, 0.0, spacing, 0, False, spacing)
        window = lw.quantized(window, low - origin, high - origin, spacing, margin=0.0, most=lw.LARGE)
    for trial in range(TRIALS):
        if log_density is None:
            points = window.points[:, None]
            logs = evaluate(np.pi - np.mod(np.pi - points, 2 * np.pi) if closed else points)
            logs = np.where(np.isnan(logs.real), -np.inf, logs)
        else:
            logs = log_density(np.array([window.origin]), window.offsets[:, None])
        values = np.exp(logs - np.max(logs.real))
        values = values / np.sum(values)
        check = lw.grid_check(values, closed, cut=cut)
        new = lw.fitted(check, window, lw.LARGE)
        if new == window or trial == TRIALS - 1:  # the values belong to this window
            break
        window = new
    if log_density is None and not closed and check.aliasing > HIDING_WAVES:
        values = averaged(evaluate, window)
    return State.of(values, window, max(0.0, check.aliasing - 1e-12), -700.0)
