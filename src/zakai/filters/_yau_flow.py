"""What the direct methods share: the linear-quadratic equation of a time-varying Yau system, and its flows, offline.

After the gauge u = e^phi v the density between observations obeys

    v_t = 1/2 G:Hess v - (L x + l).grad v + (x'Q x + p.x + r) v,

and everything that a method needs of it is the affine Hamiltonian flow of each interval (`zakai.kolmogorov.flow`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import sympy as sp

from zakai import _float64  # noqa: F401
from zakai.algebra.theorems import yau_system
from zakai.errors import InputError
from zakai.filters._formulas import Formulas
from zakai.filters._protocol import Schedule
from zakai.kolmogorov.flow import Coefficients, Flow, Substeps, coefficients_at, flows, parts_for, substeps_for
from zakai.models.compile import jax_field, jax_function
from zakai.models.model import Model


class System:
    """The formulas of a model compiled for this method: JAX functions of (x, t, theta) and the coefficients of its flow."""

    def __init__(self, model: Model, rates: bool, splitting: str):
        yau = yau_system(model)
        assert yau is not None
        self.n = model.n
        self.affine = yau.slope is not None and model.observation_kind != "samples"
        self.rates = rates and self.affine
        self.inputs = 1 + (model.m if self.rates else 0)
        self.bare = yau.bare is not None
        # An h without time is the same at every reading.
        self.steady = not model.observation.has(model.t)
        # Where neither noise depends on time both halves of a factor are the same.
        self.even = not (model.observation_noise.has(model.t) or model.covariance.has(model.t))
        # Without a gauge nothing need be evaluated.
        self.gauged = yau.form.potential != 0
        # Whether a half of the observation's factor stands at the start of an interval.
        self.halves = splitting == "strang" and not self.rates and model.observation_kind != "samples"
        # Whether a lattice can stand still.
        self.still = self.halves and self.steady and not self.gauged and self.n == 1
        self.potential = jax_field([yau.form.potential], model)
        self.observe = jax_field(model.observation, model)
        bare, full = yau.bare or yau.full, yau.full or yau.bare
        assert bare is not None and full is not None
        n, m = model.n, model.m
        slope = yau.slope if self.affine else sp.zeros(m, n)
        intercept = yau.intercept if self.affine else sp.zeros(m, 1)
        blocks = [
            yau.form.matrix,
            yau.form.offset,
            model.covariance,
            bare.matrix,
            bare.linear,
            sp.Matrix([bare.constant]),
            full.matrix,
            full.linear,
            sp.Matrix([full.constant]),
            slope,
            intercept,
            model.observation_noise,
        ]
        self._shapes = [block.shape for block in blocks]
        flat = [entry for block in blocks for entry in block]
        used = flat if self.rates else flat[: -m * m]
        self.varying = any(model.t in entry.free_symbols for entry in used)
        self._numbers = jax_function(flat, model)

    def observe_sloped(self, x: Any, t: Any, theta: Any) -> list[jax.Array]:
        """h at points (..., n), an array for each coordinate; with one state the slopes of h behind them."""
        if self.n > 1:
            return list(self.observe(x, t, theta))
        h, slopes = jax.jvp(lambda x: list(self.observe(x, t, theta)), (x,), (jnp.ones_like(x),))
        return [*h, *slopes]

    def observe_bent(self, x: Any, t: Any, theta: Any) -> jax.Array:
        """h of one state and its first four derivatives at points (M, 1): (m, 5, M)."""

        def h(x: Any) -> Any:
            return jnp.stack(self.observe(x, t, theta))

        functions: list[Callable[[Any], Any]] = [h]
        for _ in range(4):
            functions.append(_slope(functions[-1]))
        return jnp.stack([function(x) for function in functions], axis=1)

    def coefficients(self, t: jax.Array, argument: tuple[jax.Array, jax.Array]) -> Coefficients:
        """The coefficients of the flow at time t; `argument` is (theta, inside), the coordinates that act inside."""
        theta, inside = argument
        numbers = self._numbers(jnp.zeros(self.n), t, theta)
        ends = np.cumsum([rows * columns for rows, columns in self._shapes])[:-1]
        parts = jnp.split(numbers, ends)
        L, l, G, Qb, pb, rb, Qf, pf, rf, C, c, S = (
            part.reshape(shape) for part, shape in zip(parts, self._shapes, strict=True)
        )
        if not self.rates:
            whole = jnp.min(inside)
            Q, p, r = (jnp.where(whole > 0, full, bare) for full, bare in ((Qf, Qb), (pf, pb), (rf, rb)))
            return Coefficients(L, l, G, Q, p, r[:, 0])
        # The precision of the observed coordinates alone, with zeros elsewhere.
        mask = jnp.diag(inside)
        precision = mask @ jnp.linalg.inv(mask @ S @ mask + jnp.eye(len(inside)) - mask) @ mask
        gain = C.T @ precision
        linear = jnp.hstack([pb - gain @ c, gain])
        constant = jnp.concatenate([rb[:, 0] - 0.5 * (c.T @ precision @ c)[:, 0], (precision @ c)[:, 0]])
        offset = jnp.hstack([l, jnp.zeros((len(l), self.inputs - 1))])
        return Coefficients(L, offset, G, Qb - 0.5 * gain @ C, linear, constant)


def _slope(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


@lru_cache(maxsize=32)
def system_of(of: Formulas, rates: bool, splitting: str) -> System:
    return System(of.model, rates, splitting)


def distinct(system: System, schedule: Schedule) -> tuple[np.ndarray, np.ndarray]:
    """The intervals that differ: (which of them each interval is, the first interval of each kind)."""
    count = len(schedule.starts)
    if system.varying or count == 0:
        return np.arange(count), np.arange(count)
    # A uniform clock is uniform to rounding of the times only.
    unit = 1e-9 * np.min(schedule.stops - schedule.starts) + 4 * np.spacing(np.abs(schedule.stops).max())
    length = np.rint((schedule.stops - schedule.starts) / unit)
    kinds = np.column_stack([length, schedule.inside])
    _, first, which = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
    return which.ravel(), first


def parts_of(system: System, model: Model, starts: np.ndarray, stops: np.ndarray, inside: np.ndarray) -> int:
    """Into how many equal parts the intervals are cut so that no flow grows by more than about e^4."""
    if not len(starts):
        return 1
    arguments = (np.tile(model.theta(), (len(starts), 1)), inside)
    rate = 0.0
    for times in (starts, stops):
        c = coefficients_at(system.coefficients, times, arguments)
        waves = np.linalg.norm(np.asarray(c.covariance @ c.quadratic), ord=2, axis=(1, 2))
        speed = np.linalg.norm(np.asarray(c.matrix), ord=2, axis=(1, 2)) + np.sqrt(2 * waves)
        rate = max(rate, float(np.max(speed * (stops - starts))))
    if not np.isfinite(rate):
        raise InputError(f"{model.source}: a coefficient is not finite between t = {starts[0]:g} and {stops[-1]:g}")
    longest = float(np.max(stops - starts))
    return parts_for(rate, model.n, 1 + model.m, f"{model.source}: an interval of about {longest:.2g}")


class FlowPlan(NamedTuple):
    """How the flows of a schedule are computed, decided once: the distinct intervals, in equal `parts`, in `substeps`.

    `starts`, `stops` and `inside` have a row for each part of each distinct interval, `which` (K,) says whose each interval is.
    """

    starts: np.ndarray
    stops: np.ndarray
    inside: np.ndarray
    which: np.ndarray
    parts: int
    substeps: Substeps


def plan_flows(system: System, model: Model, schedule: Schedule) -> FlowPlan:
    """The plan for the model's own parameters."""
    which, first = distinct(system, schedule)
    starts, stops, inside = schedule.starts[first], schedule.stops[first], schedule.inside[first].astype(float)
    parts = parts_of(system, model, starts, stops, inside)
    edges = starts[:, None] + (stops - starts)[:, None] * np.arange(parts + 1) / parts
    plan = FlowPlan(edges[:, :-1].ravel(), edges[:, 1:].ravel(), np.repeat(inside, parts, axis=0), which, parts, Substeps(1, 0.0))
    if not len(starts):
        return plan
    argument = (np.tile(model.theta(), (len(plan.starts), 1)), plan.inside)
    substeps = substeps_for(system.coefficients, plan.starts, plan.stops, argument, varying=system.varying)
    return plan._replace(substeps=substeps)


def planned_flows(system: System, plan: FlowPlan, theta: Any) -> Flow:
    """The flows of all intervals, (K, parts, ...), a pure function of theta: NumPy arrays where theta is one."""
    argument = (jnp.broadcast_to(theta, (len(plan.starts), len(theta))), plan.inside)
    flow = flows(system.coefficients, plan.starts, plan.stops, argument, substeps=plan.substeps.steps)
    xp = np if isinstance(theta, np.ndarray) else jnp

    def shaped(array):
        array = xp.asarray(array)
        return array.reshape(len(plan.starts) // plan.parts, plan.parts, *array.shape[1:])[plan.which]

    return jax.tree.map(shaped, flow)
