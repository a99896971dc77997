"""A linear-quadratic system with affine observations: its equation at any time, and its flows over a schedule.

After the gauge u = e^phi v, with y running linearly between readings,

    v_t = 1/2 G:Hess v - (L x + l).grad v + (-q/2 - h'S^-1 h/2 + h'S^-1 dy/dt) v,     h = C x + c,

is linear-quadratic, the rates dy/dt of the coordinates that are read over just an interval are its inputs, and the flow of
every interval is prepared without data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import sympy as sp

from zakai import _float64  # noqa: F401
from zakai.algebra.gauges import affine_system
from zakai.algebra.systems import affine_observation
from zakai.errors import InputError
from zakai.filters._formulas import Formulas
from zakai.filters._protocol import Schedule
from zakai.kolmogorov.flow import MOST_IMPLICIT, Coefficients, Flow, flows, parts_for, substeps_for
from zakai.kolmogorov.linear_solve import inverse
from zakai.kolmogorov.numpy_or_jax import numpy_or_jax
from zakai.models.compile import jax_function
from zakai.models.model import Model
from zakai.models.numeric import numpy_function


class Matrices:
    """Matrices of time and parameters as one function: few functions of t, each times a table of numbers.

    A system of a hundred states has ten thousand entries, but seldom more than some functions of time.  It is NumPy for NumPy
    arguments, of which t may be an array (...), and JAX for JAX arguments, of which t is a scalar.
    """

    def __init__(self, blocks: Sequence[sp.MatrixBase], model: Model):
        self.shapes = [block.shape for block in blocks]
        entries = [entry for block in blocks for entry in block]
        found: dict[sp.Expr, int] = {}
        places, columns, numbers = [], [], []
        for place, entry in enumerate(entries):
            for function, number in entry.as_coefficients_dict().items():
                if number != 0:
                    places.append(place)
                    columns.append(found.setdefault(function, len(found)))
                    numbers.append(float(number))
        self.table = np.zeros((max(len(found), 1), len(entries)))
        np.add.at(self.table, (columns, places), numbers)
        self.varying = any(model.t in function.free_symbols for function in found)
        functions = list(found) or [sp.Integer(0)]
        self._functions: dict[Any, Callable[..., Any]] = {
            jnp: jax_function(functions, model),
            np: numpy_function(functions, model),
        }
        self._origin = np.zeros(model.n)

    def __call__(self, t: Any, theta: Any) -> list[Any]:
        xp = numpy_or_jax(t, theta)
        flat = self._functions[xp](self._origin, t, theta) @ self.table
        parts = xp.split(flat, np.cumsum([rows * columns for rows, columns in self.shapes])[:-1], axis=-1)
        return [part.reshape(*flat.shape[:-1], *shape) for part, shape in zip(parts, self.shapes, strict=True)]


class AffineSystem:
    """The coefficients of the equation above, and of the observation alone, as functions of time and the parameters."""

    def __init__(self, model: Model):
        found, observed = affine_system(model), affine_observation(model)
        assert found is not None and observed is not None
        (form, bare, _, _), (slope, intercept) = found, observed
        assert bare is not None
        constant = sp.Matrix([bare.constant])
        own = [form.matrix, form.offset, model.covariance, bare.matrix, bare.linear, constant]
        self.matrices = Matrices([*own, slope, intercept, model.observation_noise], model)
        self._observation = Matrices([slope, intercept], model)
        self.varying = self.matrices.varying
        self.outputs = model.m

    def coefficients(self, t: Any, argument: tuple[Any, Any]) -> Coefficients:
        """The coefficients of the flow at time t; `argument` is (theta, inside), `inside` (m,) what acts as a rate.

        They are NumPy for NumPy arguments.
        """
        theta, inside = argument
        L, l, G, Q, p, r, C, c, S = self.matrices(t, theta)
        # The precision of those coordinates alone, with zeros elsewhere.
        xp = numpy_or_jax(L)
        both = inside[:, None] * inside
        precision = both * inverse(both * S + xp.diag(1.0 - inside))
        gain = C.T @ precision
        linear = xp.hstack([p - gain @ c, gain])
        constant = xp.concatenate([r[:, 0] - 0.5 * (c.T @ precision @ c)[:, 0], (precision @ c)[:, 0]])
        offset = xp.hstack([l, np.zeros((len(l), len(inside)))])
        return Coefficients(L, offset, G, Q - 0.5 * gain @ C, linear, constant)

    def quadratic(self, t: Any, theta: Any) -> Any:
        """S, where the equation is that of e^S v; None, for it is that of v."""
        return None

    def observation(self, t: Any, theta: Any) -> tuple[Any, Any]:
        """C (m, n) and c (m,) at time t; NumPy for NumPy arguments, of which t may be an array."""
        slope, intercept = self._observation(t, theta)
        return slope, intercept[..., 0]


@lru_cache(maxsize=32)
def affine_system_of(of: Formulas) -> AffineSystem:
    """The system of a model, one for all values of its parameters."""
    return AffineSystem(of.model)


class Plan:
    """What is decided once for a schedule, at the model's own parameters: which intervals differ, their parts and substeps."""

    def __init__(self, system: AffineSystem, model: Model, schedule: Schedule):
        self.system = system
        starts, stops = schedule.starts, schedule.stops
        self.which, first = _distinct(schedule, system.varying)
        self.inside = schedule.inside[first].astype(float)
        self.parts = _parts(system, model, starts[first], stops[first], self.inside)
        # Where nothing depends on time all parts of an interval are alike.
        self.pieces = self.parts if system.varying else 1
        edges = starts[first, None] + (stops - starts)[first, None] * np.arange(self.pieces + 1) / self.parts
        self.starts, self.stops = edges[:, :-1].ravel(), edges[:, 1:].ravel()
        self.repeated = np.repeat(self.inside, self.pieces, axis=0)
        argument = self._argument(model.theta())
        self.substeps = substeps_for(system.coefficients, self.starts, self.stops, argument, varying=system.varying)

    def _argument(self, theta: Any) -> tuple[Any, Any]:
        tile = jnp.tile if isinstance(theta, jax.Array) else np.tile
        return tile(theta, (len(self.starts), 1)), self.repeated

    def flows(self, theta: Any) -> Flow:
        """The flow of every interval of the schedule, (K, parts, ...)."""
        flow = flows(
            self.system.coefficients, self.starts, self.stops, self._argument(theta), substeps=self.substeps.steps
        )
        # NumPy arrays where nothing is traced: a run takes many slices of them.
        xp = jnp if isinstance(theta, jax.core.Tracer) else np
        count = len(self.inside)

        def arranged(array: Any) -> Any:
            pieces = xp.reshape(xp.asarray(array), (count, self.pieces, *array.shape[1:]))
            return xp.broadcast_to(pieces, (count, self.parts, *array.shape[1:]))[self.which]

        return jax.tree.map(arranged, flow)

    def lasting(self, length: float, theta: np.ndarray) -> Flow:
        """The flow of one interval of another length, (parts, ...), of a system that does not depend on time.

        What was decided for a longer interval does for a shorter one.
        """
        piece, argument = np.array([length / self.parts]), (theta[None], self.inside)
        flow = flows(self.system.coefficients, np.zeros(1), piece, argument, substeps=self.substeps.steps)
        return jax.tree.map(lambda a: np.broadcast_to(a[0], (self.parts, *a.shape[1:])), flow)


def _distinct(schedule: Schedule, varying: bool) -> tuple[np.ndarray, np.ndarray]:
    """Which distinct interval each interval is, and the first of each."""
    count = len(schedule.starts)
    lengths = schedule.stops - schedule.starts
    if varying or count == 0:
        return np.arange(count), np.arange(count)
    # A uniform clock is uniform to rounding of the times only.
    unit = 1e-9 * np.min(lengths) + 4 * np.spacing(np.abs(schedule.stops).max())
    keys = np.column_stack([np.rint(lengths / unit), schedule.inside])
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return which.ravel(), first


def _parts(system: AffineSystem, model: Model, starts: np.ndarray, stops: np.ndarray, inside: np.ndarray) -> int:
    """Into how many equal parts the intervals are cut."""
    few = 64 if model.n <= MOST_IMPLICIT else 4
    tried = np.unique(np.r_[np.argmax(stops - starts), np.linspace(0, len(starts) - 1, few).astype(int)])
    rate = 0.0
    for times in (starts[tried], stops[tried]):
        each = [system.coefficients(t, (model.theta(), inside[k])) for t, k in zip(times, tried, strict=True)]
        c = jax.tree.map(lambda *arrays: np.stack(arrays), *each)
        if not all(np.all(np.isfinite(array)) for array in c):
            raise InputError(f"{model.source}: a coefficient is not finite between t = {starts[0]:g} and {stops[-1]:g}")
        waves = np.linalg.norm(c.covariance @ c.quadratic, ord=2, axis=(1, 2))
        rate = max(rate, float(np.max(np.linalg.norm(c.matrix, ord=2, axis=(1, 2)) + np.sqrt(2 * waves))))
    longest = float(np.max(stops - starts))
    return parts_for(rate * longest, model.n, 1 + model.m, f"{model.source}: an interval of about {longest:.2g}")
