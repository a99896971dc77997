"""The transition of a time-varying Yau system with one state: f = L x + l + G phi', q quadratic.

In the gauge u = e^phi v the equation of an interval is linear-quadratic, so that its kernel is Gaussian for any interval
(`numerics/line/channel.py`), positive, and exact:

    u(x) = e^phi(x, stop) int N(x; a y + b, V) exp(k0 + k1 y + k2 y^2) e^-phi(y, start) u(y) dy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zakai.methods._yau_system import YauSystem
from zakai.methods.series.kernel import PowerSeries
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.numerics.flow import FlowResult, Transition, integrate
from zakai.numerics.line import window as lw
from zakai.numerics.line.channel import Channel
from zakai.numerics.line.filters import applied

Array = Any

KEPT_SPACING = 160  # points up to which the spacing of a grid is kept where it is enlarged
NARROWEST = 1.4  # spacings that the standard deviation of a kernel must have
UNRESOLVED = 1e-10  # relative error of a transition from which the coefficients in time are not resolved


class YauLine(YauSystem):
    """The equation of v of one state, and its kernels."""

    def __init__(self, model: Model):
        super().__init__(model)
        matrix, _, _, quadratic, linear, *_ = self.blocks
        # Whether the kernel of an interval depends on x - y alone.
        self.flat = self.unobserved and matrix == quadratic == linear == 0 and not self.gauged
        self.m, self.steady_gauge = model.m, not self.gauge_varies

    def potential(self, points: Array, t: float, theta: Array) -> Array:
        """Return phi (N,)."""
        return super().potential(points[:, None], t, theta) if self.gauged else np.zeros(len(points))

    def serves(self, inside: np.ndarray, lie: bool) -> bool:
        """Return whether the equation of an interval is linear-quadratic with these coordinates acting inside."""
        if not inside.any():
            return self.unobserved
        if lie:
            return self.full and bool(inside.all())
        return self.affine and self.unobserved

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
        rows, at, none = np.flatnonzero(served & (lengths > 0)), np.array([origin]), np.zeros(self.m, bool)
        if not len(rows):
            return None

        def integrated(own: Array) -> FlowResult:
            """Return the transitions of intervals in which the same coordinates act."""
            begins, times, acting = starts[own], lengths[own], inside[own[0]]
            full = bool(lie and acting.all())
            if series is not None:
                return series.integrate(begins, times, theta, at, full)
            acting = none if lie else acting
            begins = begins if self.varies(acting) else np.zeros(len(own))
            found = integrate(
                lambda t, _: self.coefficients(t, theta, at, acting, full), begins, begins + times, not self.varies(acting)
            )
            return found._replace(error=np.where(found.error > UNRESOLVED, found.error, 0.0))

        which = np.unique(inside[rows], axis=0, return_inverse=True)[1].reshape(-1)
        groups = [rows[which == i] for i in range(which.max() + 1)]
        found = [integrated(own) for own in groups]
        place = np.full(len(starts), -1)
        place[np.concatenate(groups)] = np.arange(len(rows))
        fields = zip(*(_padded(one.transition, 1 + self.m) for one in found), strict=True)
        return Kernels(Transition(*map(np.concatenate, fields)), np.concatenate([one.error for one in found]), place, origin)


class Kernels(NamedTuple):
    """The kernels for x relative to `origin`, the errors of their coefficients, and where that of an interval is, or -1."""

    transitions: Transition
    errors: Array
    place: Array
    origin: float


def _padded(found: Transition, inputs: int) -> Transition:
    """Return transitions for more inputs, which have no effect."""
    more = (0, 0), (0, 0), (0, inputs - found.offset.shape[2])
    offset, vector = np.pad(found.offset, more), np.pad(found.vector, more)
    return found._replace(offset=offset, vector=vector, constant=np.pad(found.constant, (more[0], more[2], more[2])))


@once_for_a_model
def yau_line_of(model: Model) -> YauLine:
    """Return the equation of a model, made once."""
    return YauLine(model)


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
