"""A linear-quadratic system with affine observations: its equation at any time, and its transitions over a schedule.

After the gauge u = e^phi v, with y linear between observations,

    v_t = 1/2 G:Hess v - (L x + l).grad v + (-q/2 - h'S^-1 h/2 + h'S^-1 dy/dt) v,     h = C x + c,

is linear-quadratic.  The rates dy/dt of the coordinates that are observed over just an interval drive it, and the
transition of every interval is prepared without data.  Coordinates are relative to a fixed `origin`, so that a state far from
zero costs no digits.

With correlated noise E dv dw' = N dt and D = g N, the state is driven by dy and by noise that is independent of dw,

    dx = (L x + l - D S^-1 h) dt + D S^-1 dy + dv~,     E dv~ dv~' = (G - D S^-1 D') dt,

and y that is linear between observations adds -tr(S^-1 C D)/2 to the potential (Stratonovich).

The transition of an interval is composed of those of its pieces, in which the known inputs u(t) are constant or linear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import sympy as sp

from zakai.algebra.gauges import affine_system
from zakai.algebra.systems import affine_observation
from zakai.errors import InputError
from zakai.methods.system.input_pieces import Pieces, pieces_of
from zakai.models.kept import kept
from zakai.models.model import Model
from zakai.models.numeric import numpy_function
from zakai.numerics.flow import Coefficients, FlowResult, Transition, composed, integrate
from zakai.numerics.transition import Array, at, transposed
from zakai.records.schedule import Schedule

RESOLVED = 1e-9  # relative error of a transition above which a result warns
_MOST_PIECES = 2**16  # that are prepared together, for memory


class Matrices:
    """Matrices of time, inputs and parameters as one function: few functions of (t, u), times a table of numbers."""

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
        moving = [function for function in functions if function.free_symbols & {model.t, *model.u}]
        self.timed = any(model.t in function.free_symbols for function in moving)
        self.driven = any(function.free_symbols & set(model.u) for function in moving)
        self.varying = self.timed or self.driven
        self._function = numpy_function(functions, model)
        self._moving = numpy_function(moving or [sp.Integer(0)], model)
        self._state = np.zeros(model.n)
        ends = np.cumsum([0, *(rows * columns for rows, columns in self.shapes)]).tolist()
        self._parts = [slice(first, last) for first, last in zip(ends[:-1], ends[1:], strict=True)]

    def __call__(self, times: Array, theta: Array, u: Array | None = None) -> list[Array]:
        """Return the blocks (J, rows, columns) at times (J,) and inputs (J, number of inputs)."""
        values = self._function(self._state, times, theta, u)
        # One row after the other, so that a row does not depend on how many there are.
        flat = (values[:, None, :] @ self.table)[:, 0]
        return [flat[:, part].reshape(len(flat), *shape) for part, shape in zip(self._parts, self.shapes, strict=True)]

    def features(self, times: Array, theta: Array, u: Array | None = None) -> Array:
        """Return the functions (J, F) of time and inputs alone."""
        return self._moving(self._state, times, theta, u)


class AffineSystem:
    """The coefficients of the equation above, and of the observation alone, as functions of time and the parameters."""

    def __init__(self, model: Model):
        found, observed = affine_system(model), affine_observation(model)
        assert found is not None and observed is not None
        (form, unobserved), (slope, intercept) = found, observed
        assert unobserved is not None
        constant = sp.Matrix([unobserved.constant])
        equation = [form.matrix, form.offset, model.covariance, unobserved.matrix, unobserved.linear, constant]
        observation = [slope, intercept, model.observation_noise]
        # Samples act at the ends of intervals only, increments and paths inside of them too.
        self.matrices = Matrices(equation if model.observation_kind == "samples" else [*equation, *observation], model)
        self._observation = Matrices(observation, model)
        self._noise = Matrices([model.observation_noise], model)
        self._cross = None if model.cross_noise.is_zero_matrix else Matrices([model.diffusion * model.cross_noise], model)
        parts = [self.matrices] if self._cross is None else [self.matrices, self._cross]
        self.observation_varies = self._observation.varying
        self.varying = self.observation_varies or any(part.varying for part in parts)
        # Whether a piece has one flow for each length: the inputs are constant in it.
        self.autonomous = not any(part.timed for part in parts) and (model.input_hold == "zero" or not self.matrices.driven)
        self.inputs = len(model.u)
        self.kind, self.hold, self.source = model.observation_kind, model.input_hold, model.source

    @property
    def correlated(self) -> bool:
        """Whether the noises of the state and of the observations are correlated."""
        return self._cross is not None

    def letters(self, times: Array, theta: Array, origin: Array, u: Array | None = None) -> list[Array]:
        """Return L, l, G, Q, p, r, C, c, S at times (J,), in coordinates relative to the origin."""
        equation, observed = self._equation(times, theta, origin, u)
        C, c, S = observed or self._observation(times, theta, u)
        return [*equation, C, c + C @ origin[:, None], S]

    def _equation(
        self, times: Array, theta: Array, origin: Array, u: Array | None = None
    ) -> tuple[list[Array], list[Array]]:
        """Return L, l, G, Q, p, r relative to the origin, and the other matrices."""
        L, l, G, Q, p, r, *others = self.matrices(times, theta, u)
        if origin.any():
            pushed = Q @ origin[:, None]
            r = r + transposed(p + pushed) @ origin[:, None]
            l, p = l + L @ origin[:, None], p + 2.0 * pushed
        return [L, l, G, Q, p, r], others

    def coefficients(
        self, times: Array, theta: Array, origin: Array, inside: Array, u: Array | None = None
    ) -> Coefficients:
        """Return the coefficients at times (J,) with the potential of the coordinates `inside` (J, m); samples have none."""
        if self.kind == "samples":
            (L, l, G, Q, p, r), _ = self._equation(times, theta, origin, u)
            return Coefficients(L, l, G, Q, p, r[:, :, 0])
        L, l, G, Q, p, r, C, c, S = self.letters(times, theta, origin, u)
        precision = precision_of(S, inside)
        gain = transposed(C) @ precision
        driven = precision @ c
        linear = np.concatenate([p - gain @ c, gain], axis=2)
        constant = np.concatenate([r[:, :, 0] - 0.5 * (transposed(c) @ driven)[:, :, 0], driven[:, :, 0]], axis=1)
        pushed = np.zeros((*l.shape[:2], inside.shape[1]))
        if self._cross is not None:
            (cross,) = self._cross(times, theta, u)
            pushed = cross @ precision
            L, l, G = L - pushed @ C, l - pushed @ c, G - pushed @ transposed(cross)
            # The transport of dx moves mass, tr(S^-1 C D), of which Stratonovich's term takes half.
            constant[:, 0] += 0.5 * (gain * cross).sum(axis=(1, 2))
        return Coefficients(L, np.concatenate([l, pushed], axis=2), G, Q - 0.5 * gain @ C, linear, constant)

    def features(self, times: Array, theta: Array, u: Array | None = None) -> Array:
        """Return the functions of time that the coefficients are made of, (J, F)."""
        found = [self.matrices.features(times, theta, u)]
        if self.kind != "samples" and self._noise.varying:
            found.append(np.linalg.inv(self._noise(times, theta, u)[0]).reshape(len(times), -1))
        if self._cross is not None:
            found.append(self._cross.features(times, theta, u))
        return np.concatenate(found, axis=1)

    def observation(self, times: Array, theta: Array, origin: Array, u: Array | None) -> tuple[Array, Array, Array]:
        """Return C (J, m, n), c (J, m) and S (J, m, m) at times (J,)."""
        slope, intercept, noise = self._observation(times, theta, u)
        return slope, (intercept + slope @ origin[:, None])[:, :, 0], noise

    def quadratic(self, theta: Array, origin: Array) -> tuple[Array, Array] | None:
        """Return `Setup.quadratic`."""
        return None


def precision_of(noise: Array, seen: Array) -> Array:
    """Return the inverses (J, m, m) of the blocks `seen` (J, m) of covariances, with zeros elsewhere."""
    both = seen[:, :, None] & seen[:, None, :]
    alone = np.eye(seen.shape[1]) * ~seen[:, None, :]
    return np.where(both, np.linalg.inv(np.where(both, noise, 0.0) + alone), 0.0)


def _padded(whole: Transition, m: int) -> Transition:
    """Return transitions of an equation without rates of y as ones with m of them, which have no effect."""
    wide = [np.zeros((*field.shape[:2], 1 + m), field.dtype) for field in (whole.offset, whole.vector)]
    for padded, own in zip(wide, (whole.offset, whole.vector), strict=True):
        padded[:, :, :1] = own
    constant = np.zeros((len(whole.constant), 1 + m, 1 + m), whole.constant.dtype)
    constant[:, :1, :1] = whole.constant
    return whole._replace(offset=wide[0], vector=wide[1], constant=constant)


@dataclass(frozen=True, eq=False)
class Setup:
    """What does not depend on the schedule: the system, the parameters and the origin."""

    system: AffineSystem
    theta: Array
    origin: Array

    @cached_property
    def quadratic(self) -> tuple[Array, Array] | None:
        """K (n, n) and k (n,) of S = -x'K x / 2 - k.x where the equation is that of e^S v; None: it is that of v."""
        return self.system.quadratic(self.theta, self.origin)

    @cached_property
    def constant_observation(self) -> tuple[Array, Array, Array]:
        """C, c and S, each with a leading axis of one, where they do not vary."""
        return self.system.observation(np.zeros(1), self.theta, self.origin, None)

    def integrated(self, pieces: Pieces, lengths: Array, inside: Array) -> FlowResult:
        """Return the transitions of pieces in which the coordinates `inside` (J, m) act."""
        system, theta, origin = self.system, self.theta, self.origin
        # Equal lengths of what does not depend on time have equal flows.
        starts, stops = (np.zeros(len(lengths)), lengths) if system.autonomous else (pieces.starts, pieces.stops)
        found = integrate(
            lambda times, rows: system.coefficients(times, theta, origin, inside[rows], pieces.inputs(times, rows)),
            starts,
            stops,
            system.autonomous,
            lambda times, rows: system.features(times, theta.real, pieces.inputs(times, rows)),
        )
        return found._replace(transition=_padded(found.transition, inside.shape[1])) if system.kind == "samples" else found

    def observation(self, schedule: Schedule) -> tuple[Array, Array, Array]:
        """Return C (K, m, n), c (K, m) and S (K, m, m) at the ends of intervals; increments end before an input jumps."""
        stops, inputs = schedule.stops, schedule.inputs
        if self.system.observation_varies:
            u = np.zeros((len(stops), self.system.inputs))
            if inputs is not None:
                u = inputs.at(stops, self.system.hold, before=self.system.kind != "samples")
            return self.system.observation(stops, self.theta, self.origin, u)
        slope, intercept, noise = (np.broadcast_to(array, (len(stops), *array.shape[1:])) for array in self.constant_observation)
        return slope, intercept, noise

    def transitions(self, schedule: Schedule, inside: Array) -> tuple[Transition, tuple[str, ...]]:
        """Return the transitions of all intervals, in which the coordinates `inside` (K, m) act, and notes.

        Raises:
            InputError: a coefficient is not finite.
        """
        pieces = pieces_of(schedule, self.system.hold, self.system.inputs)
        if len(pieces.row) > _MOST_PIECES and len(schedule) > 1:
            middle = len(schedule) // 2
            both = [self.transitions(schedule.part(rows), inside[rows]) for rows in (slice(None, middle), slice(middle, None))]
            parts = zip(*(found for found, _ in both), strict=True)
            return Transition(*map(np.concatenate, parts)), tuple(dict.fromkeys(note for _, notes in both for note in notes))
        inside = inside[pieces.row]
        if self.system.autonomous and len(schedule):
            return composed(self._repeated(pieces, inside), pieces.row, len(schedule)), ()
        found = self.integrated(pieces, pieces.lengths, inside)
        self._check_finite(found, pieces.starts, pieces.stops)
        worst = float(found.error.max(initial=0.0))
        whole = composed(found.transition, pieces.row, len(schedule))
        if worst <= RESOLVED:
            return whole, ()
        time = pieces.stops[np.argmax(found.error)]
        return whole, (
            f"the coefficients vary so fast within an interval that its transition is known to {worst:.1g} only (first at "
            f"t = {time:.12g}); give shorter intervals",
        )

    def _repeated(self, pieces: Pieces, inside: Array) -> Transition:
        """Return the transitions of pieces that do not depend on time: one for each length, inputs and coordinates."""
        lengths = pieces.lengths
        table = np.column_stack([lengths, inside, pieces.first])
        _, rows, places = np.unique(table, axis=0, return_index=True, return_inverse=True)
        found = self.integrated(pieces.part(rows), lengths[rows], inside[rows])
        self._check_finite(found, pieces.starts[rows], pieces.stops[rows])
        return at(found.transition, places.ravel())

    def _check_finite(self, found: FlowResult, starts: Array, stops: Array) -> None:
        wrong = np.isinf(found.error)
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(
                f"{self.system.source}: a coefficient is not finite between t = {starts[row]:.12g} and {stops[row]:.12g}"
            )


def affine_system_of(model: Model, kind: type[AffineSystem] = AffineSystem) -> AffineSystem:
    """Return the system of a model, one for all values of its parameters."""
    return kept(model, kind, lambda: kind(model))
