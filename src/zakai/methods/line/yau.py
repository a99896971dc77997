"""The transition of a time-varying Yau system with one state: f = L x + l + G phi', q quadratic.

In the gauge u = e^phi v the equation of an interval is linear-quadratic, so that its kernel is Gaussian for any interval
(`numerics/line/channel.py`), positive, and exact:

    u(x) = e^phi(x, stop) int N(x; a y + b, V) exp(k0 + k1 y + k2 y^2) e^-phi(y, start) u(y) dy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import sympy as sp

from zakai.algebra.systems import yau_system
from zakai.methods.series.kernel import PowerSeries
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.flow import Coefficients, Transition, integrate
from zakai.numerics.line import window as lw
from zakai.numerics.line.channel import Channel
from zakai.numerics.line.filters import applied

Array = Any

KEPT_SPACING = 160  # points up to which the spacing of a grid is kept where it is enlarged
NARROWEST = 1.4  # spacings that the standard deviation of a kernel must have
UNRESOLVED = 1e-10  # relative error of a transition from which the coefficients in time are not resolved


class YauLine:
    """The coefficients of the equation of v as functions of time."""

    def __init__(self, model: Model):
        yau = yau_system(model)
        assert yau is not None
        zero = sp.Integer(0)
        self.affine = yau.slope is not None and model.observation_kind != "samples"
        self.unobserved, self.full = yau.unobserved is not None, yau.full is not None
        m = model.m
        slope = yau.slope if self.affine and yau.slope is not None else sp.zeros(m, 1)
        intercept = yau.intercept if self.affine and yau.intercept is not None else sp.zeros(m, 1)

        def numbers(quadratic: Any) -> list[Any]:
            if quadratic is None:
                return [zero, zero, zero]
            return [quadratic.matrix[0, 0], quadratic.linear[0], quadratic.constant]

        own = [yau.form.matrix[0, 0], yau.form.offset[0], model.covariance[0, 0], *numbers(yau.unobserved)]
        if model.drift.has(model.t) or model.covariance.has(model.t):
            found = _unexpanded(model, yau)
            self.unobserved = self.unobserved and found is not None
            own = own if found is None else found
        noise = sp.eye(m) if model.observation_kind == "samples" else model.observation_noise
        entries = [*own, *numbers(yau.full), *slope, *intercept, *noise]
        self.m, self.blocks = m, entries[:9]
        self._numbers = numpy_function(entries, model)
        self.steady = not any(sp.sympify(entry, strict=True).has(model.t) for entry in entries)
        # Whether the kernel of an interval depends on x - y alone.
        self.flat = self.unobserved and all(entry == 0 for entry in (own[0], own[3], own[4], yau.form.potential))
        self.gauged = yau.form.potential != 0
        self.steady_gauge = not sp.sympify(yau.form.potential, strict=True).has(model.t)
        self._potential = numpy_function([yau.form.potential], model, (1,))

    def potential(self, points: Array, t: float, theta: Array) -> Array:
        """Return phi (N,)."""
        if not self.gauged:
            return np.zeros(len(points))
        return self._potential(points[:, None], t, theta)[:, 0]

    def serves(self, inside: np.ndarray, lie: bool) -> bool:
        """Return whether the equation of an interval is linear-quadratic with these coordinates acting inside."""
        if not inside.any():
            return self.unobserved
        if lie:
            return self.full and bool(inside.all())
        return self.affine and self.unobserved

    def coefficients(self, t: Array, theta: Array, inside: np.ndarray, lie: bool, origin: float) -> Coefficients:
        """Return the coefficients at times (J,) for x relative to `origin`; the inputs are 1 and the rates of the coordinates.

        `inside` (J, m) marks the coordinates that act inside of the interval of each time.
        """
        numbers = np.moveaxis(self._numbers(np.zeros((len(t), 1)), t, theta), -1, 0)
        m, whole = self.m, np.asarray(inside.all(axis=1) & lie)
        L, l, G = numbers[:3]
        Q, p, r = (np.where(whole, full, unobserved) for unobserved, full in zip(numbers[3:6], numbers[6:9], strict=True))
        l, p, r = l + L * origin, p + 2.0 * Q * origin, r + (p + Q * origin) * origin
        inputs = np.zeros((3, len(t), 1 + m), numbers.dtype)
        inputs[..., 0] = l, p, r
        if not lie and inside.any():
            C = np.moveaxis(numbers[9 : 9 + m], 0, -1)
            c = np.moveaxis(numbers[9 + m : 9 + 2 * m], 0, -1) + C * origin
            S = np.moveaxis(numbers[9 + 2 * m :], 0, -1).reshape(len(t), m, m)
            both = inside[:, :, None] & inside[:, None]
            alone = np.eye(m) * ~inside[:, None]
            precision = np.where(both, np.linalg.inv(np.where(both, S, 0.0) + alone), 0.0)
            gain, weighted = np.zeros_like(C), np.zeros_like(c)
            for i in range(m):
                gain, weighted = gain + precision[..., i] * C[:, i, None], weighted + precision[..., i] * c[:, i, None]
            for i in range(m):
                Q = Q - 0.5 * gain[:, i] * C[:, i]
                inputs[1, :, 0] -= gain[:, i] * c[:, i]
                inputs[2, :, 0] -= 0.5 * weighted[:, i] * c[:, i]
            inputs[1, :, 1:], inputs[2, :, 1:] = gain, weighted
        L, G, Q = (part[:, None, None] for part in (L, G, Q))
        return Coefficients(L, inputs[0, :, None], G, Q, inputs[1, :, None], inputs[2])

    def kernels(
        self,
        starts: Array,
        lengths: Array,
        inside: np.ndarray,
        theta: Array,
        lie: bool,
        origin: float,
        series: PowerSeries | None = None,
    ) -> Kernels | None:
        """Return the kernels of intervals whose equation is linear-quadratic, None if there are none.

        With `series` they are computed by power series, which have no inputs: rates of observation do not act inside.
        """
        served = np.array([self.serves(row, lie) and (series is None or lie or not row.any()) for row in inside], bool)
        rows = np.flatnonzero(served & (lengths > 0))
        if not len(rows):
            return None

        def at(times: Array, which: Array) -> Coefficients:
            return self.coefficients(times, theta, inside[rows[which]], lie, origin)

        if series is None:
            begins = np.zeros(len(rows)) if self.steady else starts[rows]
            found, errors = integrate(at, begins, begins + lengths[rows], self.steady)
            errors = np.where(errors > UNRESOLVED, errors, 0.0)
        else:
            full = np.asarray(inside[rows].all(axis=1) & lie)
            found, errors = series.channels(starts[rows], lengths[rows], theta, origin, full, 1 + self.m)
        place = np.full(len(starts), -1)
        place[rows] = np.arange(len(rows))
        return Kernels(found, errors, place, origin)


class Kernels(NamedTuple):
    """The kernels for x relative to `origin`, the errors of their coefficients, and where that of an interval is, or -1."""

    transitions: Transition
    errors: Array
    place: Array
    origin: float


def _unexpanded(model: Model, yau: Any) -> list[sp.Expr] | None:
    """L, l, G, Q, p, r from the formulas as they were written, or None where these do not show that they are all there is.

    An expanded pulse such as exp(-(t - 1/3)^2 / w^2) overflows, and its parts may be taken for zero.
    """
    x, t, G = model.x[0], model.t, model.covariance[0, 0]
    phi, slope = yau.form.potential, yau.form.gradient[0]
    rest = model.drift[0] - G * slope
    matrix = sp.diff(rest, x).subs(x, 0)
    offset = rest.subs(x, 0)
    q = -(sp.diff(phi, t) + G * (sp.diff(slope, x) + slope**2) / 2 + (matrix * x + offset) * slope + matrix)
    entries = [matrix, offset, G, sp.diff(q, x, 2).subs(x, 0) / 2, sp.diff(q, x).subs(x, 0), q.subs(x, 0)]
    if any(entry.has(sp.zoo, sp.nan, sp.oo) for entry in entries) or sp.expand(rest - matrix * x - offset) != 0:
        return None
    return entries


@once_for_a_model
def yau_line_of(model: Model) -> YauLine:
    """Return the equation of a model, made once."""
    return YauLine(model)


@once_for_a_model
def power_series_of(model: Model, order: int | None) -> PowerSeries:
    """Return the equation of a model as Taylor series in time, made once."""
    return PowerSeries(model, yau_line_of(model).blocks, order)


class Moved(NamedTuple):
    """The density after an interval times exp(-offset), its grid, and its figures."""

    values: Array
    window: lw.Window
    offset: Any
    look: lw.Figures


def moved(
    yau: YauLine,
    kernel: Channel,
    values: Array,
    window: lw.Window,
    start: float,
    stop: float,
    theta: Array,
    negligible: float,
    rough: float,
    cut: float,
) -> Moved | None:
    """Return the density after an interval, or None where its kernel is too narrow for the grid or no grid fits.

    Args:
        yau: the equation.
        kernel: that of the interval, for x relative to the origin of `window`.
        values, window: the density (N,) and its grid.
        start, stop: the ends of the interval.
        theta: parameters (p,).
        negligible, rough: the spectrum that need not be resolved, and that of a density with kinks that is accepted.
        cut: the density relative to its maximum that a grid must hold.
    """
    width = np.sqrt(np.abs(kernel.variance.real))
    if not width > NARROWEST * window.spacing * abs(kernel.scale.real):
        return None
    sources = window.offsets
    positive = values.real > 0
    with np.errstate(divide="ignore"):
        logs = np.where(positive, np.log(np.where(positive, values, 1.0)), -np.inf)
    logs = logs - yau.potential(window.points, start, theta)
    weights = logs + kernel.constant + sources * (kernel.slope + kernel.curvature * sources)
    top = float(np.max(np.where(np.isfinite(weights.real), weights.real, -np.inf)))
    weights = np.where(np.isfinite(weights.real), np.exp(weights - top), 0.0)

    def after(new: lw.Window) -> tuple[Array, float]:
        first = new.centre - new.spacing * (new.size // 2)
        found = applied(sources, first, new.spacing, new.size, weights, kernel.scale, kernel.shift, kernel.variance) * new.spacing
        if not yau.gauged:
            best = float(np.max(found.real))
            return found, (0.0 if best > 0 else -np.inf)
        gauge = yau.potential(new.points, stop, theta)
        with np.errstate(divide="ignore", invalid="ignore"):
            total = np.where(found.real > 0, np.log(np.where(found.real > 0, found, 1.0)) + gauge, -np.inf)
        best = float(np.max(total.real))
        return (np.exp(total - best), best) if np.isfinite(best) else (np.zeros_like(found), best)

    def good(found: Array) -> tuple[lw.Figures, bool, bool, bool]:
        look = lw.figures(found, False, negligible, cut)
        if not found.any():
            return look, True, True, False
        coarse = look.aliasing > 30.0 * negligible and (look.aliasing > rough or not look.rough)
        return look, look.left > 10 * cut, look.right > 10 * cut, coarse

    new = window
    found, best = after(new)
    look, *bad = good(found)
    if any(bad):
        own = lw.figures(values, False, negligible, cut)
        first, last = own.first, own.last
        ends = kernel.scale.real * sources[[first, last]] + kernel.shift.real
        spacing = float(np.sqrt((kernel.scale.real * window.spacing) ** 2 + kernel.variance.real / 6.0))
        reach = float(np.sqrt(-2.0 * np.log(cut)))
        low, high = float(ends.min() - reach * width), float(ends.max() + reach * width)
        if (high - low) / window.spacing < KEPT_SPACING:
            spacing = min(spacing, window.spacing)
        new = lw.quantized(window, low, high, max(spacing, (high - low) / 400), most=lw.SIZES[-1])
        for _ in range(12):
            found, best = after(new)
            look, left, right, coarse = good(found)
            if not (left or right or coarse):
                break
            larger = lw.enlarged(new, left, right) if left or right else new
            larger = lw.refined(larger) if coarse else larger
            if larger.size >= lw.SIZES[-1] and larger.size == new.size:
                return None
            new = larger
        else:
            return None
    return Moved(found, new, top + best, look)
