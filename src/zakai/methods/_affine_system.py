"""A linear-quadratic system with affine observations: its equation at any time, and its transitions over a schedule.

After the gauge u = e^phi v, with y linear between observations,

    v_t = 1/2 G:Hess v - (L x + l).grad v + (-q/2 - h'S^-1 h/2 + h'S^-1 dy/dt) v,     h = C x + c,

is linear-quadratic.  The rates dy/dt of the coordinates that are observed over just an interval are its inputs, and the
transition of every interval is prepared without data.  Coordinates are relative to a fixed `origin`, so that a state far from
zero costs no digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import sympy as sp

from zakai.algebra.gauges import affine_system
from zakai.algebra.systems import affine_observation
from zakai.errors import InputError
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.complex_step import cholesky
from zakai.numerics.flow import Coefficients, FlowResult, Transition, integrate
from zakai.numerics.transition import Array, at, transposed
from zakai.records.schedule import Schedule

RESOLVED = 1e-9  # relative error of a transition above which a result warns
_KEPT = 256  # transitions of a system without time that are kept


class Matrices:
    """Matrices of time and parameters as one function: few functions of t, times a table of numbers."""

    def __init__(self, blocks: Sequence[sp.MatrixBase], model: Model):
        self.shapes = [block.shape for block in blocks]
        entries = [entry for block in blocks for entry in block.flat()]
        found: dict[sp.Expr, int] = {}
        places, columns, numbers = [], [], []
        for place, entry in enumerate(entries):
            if entry == 0:
                continue
            for function, number in entry.as_coefficients_dict().items():
                if number != 0:
                    places.append(place)
                    columns.append(found.setdefault(function, len(found)))
                    numbers.append(float(number))
        self.table = np.zeros((max(len(found), 1), len(entries)))
        np.add.at(self.table, (columns, places), numbers)
        functions = list(found) or [sp.Integer(0)]
        self.varying = any(model.t in function.free_symbols for function in functions)
        self._function = numpy_function(functions, model)
        moving = [function for function in functions if model.t in function.free_symbols]
        self._moving = numpy_function(moving or [sp.Integer(0)], model)
        self._state = np.zeros(model.n)

    def __call__(self, times: Array, theta: Array) -> list[Array]:
        """Return the blocks (J, rows, columns) at times (J,)."""
        values = self._function(self._state, times, theta)
        # One row after the other, so that a row does not depend on how many there are.
        flat = (values[:, None, :] @ self.table)[:, 0]
        parts = np.split(flat, np.cumsum([rows * columns for rows, columns in self.shapes])[:-1], axis=1)
        return [part.reshape(len(flat), *shape) for part, shape in zip(parts, self.shapes, strict=True)]

    def features(self, times: Array, theta: Array) -> Array:
        """Return the functions (J, F) of time alone."""
        return self._moving(self._state, times, theta)


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
        self._observation = Matrices([slope, intercept, model.observation_noise], model)
        self._noise = Matrices([model.observation_noise], model)
        self.varying = self.matrices.varying
        self.source = model.source
        self.kept_quadratics: dict[Any, tuple[Array, Array]] = {}

    def letters(self, times: Array, theta: Array, origin: Array) -> list[Array]:
        """Return L, l, G, Q, p, r, C, c, S at times (J,), in coordinates relative to the origin."""
        L, l, G, Q, p, r, C, c, S = self.matrices(times, theta)
        if origin.any():
            pushed = Q @ origin[:, None]
            r = r + transposed(p + pushed) @ origin[:, None]
            l, p, c = l + L @ origin[:, None], p + 2.0 * pushed, c + C @ origin[:, None]
        return [L, l, G, Q, p, r, C, c, S]

    def coefficients(self, times: Array, theta: Array, origin: Array, inside: Array) -> Coefficients:
        """Return the coefficients at times (J,) with the potential of the coordinates `inside` (J, m)."""
        L, l, G, Q, p, r, C, c, S = self.letters(times, theta, origin)
        precision = precision_of(S, inside)
        gain = transposed(C) @ precision
        driven = precision @ c
        linear = np.concatenate([p - gain @ c, gain], axis=2)
        constant = np.concatenate([r[:, :, 0] - 0.5 * (transposed(c) @ driven)[:, :, 0], driven[:, :, 0]], axis=1)
        offset = np.concatenate([l, np.zeros((*l.shape[:2], inside.shape[1]))], axis=2)
        return Coefficients(L, offset, G, Q - 0.5 * gain @ C, linear, constant)

    def features(self, times: Array, theta: Array) -> Array:
        """Return the functions of time that the coefficients are made of, (J, F)."""
        own = self.matrices.features(times, theta)
        if not self._noise.varying:
            return own
        precision = np.linalg.inv(self._noise(times, theta)[0])
        return np.concatenate([own, precision.reshape(len(times), -1)], axis=1)

    def observation(self, times: Array, theta: Array, origin: Array) -> tuple[Array, Array, Array]:
        """Return C (J, m, n), c (J, m) and S (J, m, m) at times (J,)."""
        slope, intercept, noise = self._observation(times, theta)
        return slope, (intercept + slope @ origin[:, None])[:, :, 0], noise

    def quadratic(self, theta: Array, origin: Array) -> tuple[Array, Array] | None:
        """Return K (n, n) and k (n,) of S = -x'K x / 2 - k.x where the equation is that of e^S v; None: it is that of v."""
        return None


def precision_of(noise: Array, seen: Array) -> Array:
    """Return the inverses (J, m, m) of the blocks `seen` (J, m) of covariances, with zeros elsewhere."""
    both = seen[:, :, None] & seen[:, None, :]
    alone = np.eye(seen.shape[1]) * ~seen[:, None, :]
    return np.where(both, np.linalg.inv(np.where(both, noise, 0.0) + alone), 0.0)


class Ends(NamedTuple):
    """What is observed at the ends of K intervals, with noise of variance one: `whiten` (K, m, m) values = H x + c + noise.

    `observed` (K, m) marks the rows that count, `slope` is H (K, m, n), `intercept` c (K, m) and `constant` (K,) what the
    logarithm of the factor exp(-|whiten values - H x - c|^2 / 2) lacks.  The evidence of increments is relative to noise alone.
    """

    observed: Array
    slope: Array
    intercept: Array
    whiten: Array
    constant: Array
    relative: bool


def ends_of(kind: str, schedule: Schedule, slope: Array, intercept: Array, noise: Array) -> Ends:
    """Return what is observed at the ends; `slope`, `intercept` and `noise` are C, c and S there.

    Increments that end together share the noise of the time that they have in common, S min(elapsed_i, elapsed_j).
    """
    sampled = kind == "samples"
    at_end = schedule.seen if sampled else schedule.seen & ~schedule.inside
    both = at_end[:, :, None] & at_end[:, None, :]
    spans = np.where(at_end, 1.0 if sampled else schedule.elapsed, 0.0)
    shared = 1.0 if sampled else np.minimum(spans[:, :, None], spans[:, None, :])
    try:
        factor = cholesky(np.where(both, noise * shared, 0.0) + np.eye(at_end.shape[1]) * ~at_end[:, None, :])
    except np.linalg.LinAlgError:
        first, last = schedule.stops[0], schedule.stops[-1]
        raise InputError(f"observation_noise: is not positive definite between t = {first:g} and {last:g}") from None
    whiten = np.linalg.inv(factor)
    logs = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1) + 0.5 * np.log(2 * np.pi) * at_end.sum(axis=1)
    constant = -logs if sampled else np.zeros(len(logs))
    return Ends(
        np.ascontiguousarray(at_end),
        whiten @ (spans[:, :, None] * slope),
        (whiten @ (spans * intercept)[:, :, None])[:, :, 0],
        whiten,
        constant,
        not sampled,
    )


@dataclass(frozen=True, eq=False)
class Setup:
    """What does not depend on the schedule: the system, the parameters, the origin; transitions without time are kept."""

    system: AffineSystem
    theta: Array
    origin: Array
    kept: dict[bytes, Transition] = field(default_factory=dict)
    still: list[tuple[Array, Array, Array]] = field(default_factory=list)
    lock: Any = field(default_factory=Lock)

    def integrated(self, starts: Array, stops: Array, inside: Array) -> FlowResult:
        """Return the transitions of intervals in which the coordinates `inside` (K, m) act."""
        system, theta = self.system, self.theta
        return integrate(
            lambda times, rows: system.coefficients(times, theta, self.origin, inside[rows]),
            starts,
            stops,
            not system.varying,
            lambda times, rows: system.features(times, theta.real),
        )

    def observation(self, stops: Array) -> tuple[Array, Array, Array]:
        """Return C (K, m, n), c (K, m) and S (K, m, m) at the ends of intervals."""
        if self.system.varying:
            return self.system.observation(stops, self.theta, self.origin)
        if not self.still:
            self.still.append(self.system.observation(np.zeros(1), self.theta, self.origin))
        slope, intercept, noise = (np.broadcast_to(array, (len(stops), *array.shape[1:])) for array in self.still[0])
        return slope, intercept, noise

    def transitions(self, schedule: Schedule) -> tuple[Transition, tuple[str, ...]]:
        """Return the transitions of all intervals and what is to be said of them.

        Raises:
            InputError: a coefficient is not finite.
        """
        if self.system.varying or len(schedule) == 0:
            found = self.integrated(schedule.starts, schedule.stops, schedule.inside)
            self._check_finite(found, schedule.starts, schedule.stops)
            worst = float(found.error.max(initial=0.0))
            if worst <= RESOLVED:
                return found.transition, ()
            time = schedule.stops[np.argmax(found.error)]
            return found.transition, (
                f"the coefficients vary so fast within an interval that its transition is known to {worst:.1g} only (first at "
                f"t = {time:g}); give shorter intervals",
            )
        names = [row.tobytes() for row in np.concatenate([schedule.lengths[:, None], schedule.inside], axis=1)]
        first = {name: row for row, name in reversed(list(enumerate(names)))}
        with self.lock:
            known = {name: self.kept[name] for name in first if name in self.kept}
        missing = [name for name in first if name not in known]
        tables = [Transition(*(array[None] for array in one)) for one in known.values()]
        if missing:
            rows = np.array([first[name] for name in missing])
            found = self.integrated(np.zeros(len(rows)), schedule.lengths[rows], schedule.inside[rows])
            self._check_finite(found, schedule.starts[rows], schedule.stops[rows])
            tables.append(found.transition)
            with self.lock:
                if len(self.kept) > _KEPT:
                    self.kept.clear()
                self.kept.update({name: at(found.transition, i) for i, name in enumerate(missing[:_KEPT])})
        place = {name: i for i, name in enumerate([*known, *missing])}
        places = np.array([place[name] for name in names])
        return Transition(*(np.concatenate(fields)[places] for fields in zip(*tables, strict=True))), ()

    def _check_finite(self, found: FlowResult, starts: Array, stops: Array) -> None:
        wrong = np.isinf(found.error)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"{self.system.source}: a coefficient is not finite between t = {starts[row]:g} and {stops[row]:g}"
            )


_SYSTEMS: WeakKeyDictionary[Model, dict[type[AffineSystem], AffineSystem]] = WeakKeyDictionary()


def affine_system_of(model: Model, kind: type[AffineSystem] = AffineSystem) -> AffineSystem:
    """Return the system of a model, one for all values of its parameters."""
    kept = _SYSTEMS.setdefault(model, {})
    if kind not in kept:
        kept[kind] = kind(model)
    return kept[kind]
