"""The transition of a time-varying Yau system with one state: f = L x + l + G phi', q quadratic.

In the gauge u = e^phi v the equation of an interval is linear-quadratic, so that its kernel is Gaussian for any interval
(`numerics/line/gaussian_kernels.py`), positive, and exact:

    u(x) = e^phi(x, stop) int N(x; a y + b, V) exp(k0 + k1 y + k2 y^2) e^-phi(y, start) u(y) dy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zakai.methods.yau.kernel import PowerSeries
from zakai.methods.yau.system import YauSystem
from zakai.models.kept import once_for_a_model
from zakai.models.model import Model
from zakai.numerics.arrays import Array
from zakai.numerics.flow import FlowResult, Transition, integrate

UNRESOLVED_IN_TIME = 1e-10  # relative error of a transition from which the coefficients in time are not resolved


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
        if not (self.unobserved or lie):
            return None
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
            result = integrate(
                lambda t, _: self.coefficients(t, theta, at, acting, full), begins, begins + times, not self.varies(acting)
            )
            return result._replace(error=np.where(result.error > UNRESOLVED_IN_TIME, result.error, 0.0))

        which = np.unique(inside[rows], axis=0, return_inverse=True)[1].reshape(-1)
        groups = [rows[which == i] for i in range(which.max() + 1)]
        result = [integrated(own) for own in groups]
        place = np.full(len(starts), -1)
        place[np.concatenate(groups)] = np.arange(len(rows))
        fields = zip(*(_padded(one.transition, 1 + self.m) for one in result), strict=True)
        return Kernels(Transition(*map(np.concatenate, fields)), np.concatenate([one.error for one in result]), place, origin)


class Kernels(NamedTuple):
    """The kernels for x relative to `origin`, the errors of their coefficients, and where that of an interval is, or -1."""

    transitions: Transition
    errors: Array
    place: Array
    origin: float


def _padded(result: Transition, inputs: int) -> Transition:
    """Return transitions for more inputs, which have no effect."""
    more = (0, 0), (0, 0), (0, inputs - result.offset.shape[2])
    offset, vector = np.pad(result.offset, more), np.pad(result.vector, more)
    return result._replace(offset=offset, vector=vector, constant=np.pad(result.constant, (more[0], more[2], more[2])))


@once_for_a_model
def yau_line_of(model: Model) -> YauLine:
    """Return the equation of a model, made once."""
    return YauLine(model)
