"""A path of the state and a record of its observations, in substeps of each interval."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from zakai.errors import InputError
from zakai.models import checks
from zakai.models._definite import square_root
from zakai.models._entries import kind_of
from zakai.models.model import Model
from zakai.models.numeric import explain_nonfinite, numpy_function, program_of
from zakai.models.observed_path import observed_in_formulas, with_path_as_states
from zakai.models.prior import DensityPrior
from zakai.records import Inputs, Record, Truth
from zakai.records.inputs import check_inputs
from zakai.simulation.density_draw import draw_from_density
from zakai.simulation.stepper import Stepper, mean_drift, outside_domain
from zakai.simulation.substeps import finer_counts, usual_counts

CHUNK = 100_000  # substeps held in memory at once
ATTEMPTS = 4  # at a path whose steps are too long


def simulate(
    model: Model,
    times: Any,
    seed: int | np.random.Generator = 0,
    initial: Any = None,
    substeps: int | None = None,
    inputs: Inputs | None = None,
) -> tuple[Truth, Record]:
    """Simulate a path of the state and a record of its observations.

        x_{j+1} = F(x_j + w_j / 2) + w_j / 2,    w_j = g(t_j) Q(t_j)^{1/2} sqrt(d) e_j,    e_j ~ N(0, I)
        y_{j+1} = y_j + (h(x_j, t_j) + h(x_{j+1}, t_{j+1})) d / 2 + S(t_j)^{1/2} sqrt(d) e'_j

    where F follows x' = f(x, t) over a substep d by the method of Runge and Kutta: this is of second order in d. Where the
    diffusion depends on the state, or the state lives in a domain, x_{j+1} = F(x_j) + w_j, with Milstein's correction where the
    noises commute.
    Formulas that contain the observed values receive those of the path. Samples are drawn from the model's observation family. A
    step that would leave a domain with natural ends is halved, with the Brownian bridge between; at reflecting ends the state is
    mirrored.

    Args:
        model: the system.
        times: times (K,) of the record, in the model's unit, strictly increasing and after the model's start (samples: at or
            after it).
        seed: an integer (the same seed gives the same record) or a NumPy generator.
        initial: the state (n,) at the start; by default it is drawn from the prior.
        substeps: steps in each interval, which then are those of Euler and Maruyama, x_{j+1} = x_j + f(x_j, t_j) d + w_j and
            y_{j+1} = y_j + h(x_j, t_j) d + ... By default 10 of the above in an interval of at most the median length, and
            proportionally more in a longer one, at most 1,000; 50 where the diffusion depends on the state. Where the drift is
            too fast for them along the path, it is drawn again with more.
        inputs: the known inputs of the model; a step begins where they jump.

    Returns:
        The `Truth` at the start and at the K times, and the `Record`.

    Raises:
        InputError: wrong times, initial state or noise; or the state is no longer finite, with the formula that caused it.

    Example:
        >>> from zakai.models import load_model
        >>> truth, record = simulate(load_model("gallery:benes"), [0.1, 0.2, 0.3], seed=1)
        >>> truth.values.shape, record.values.shape
        ((4, 1), (3, 1))
    """
    if observed_in_formulas(model).any():
        return _with_path(model, times, seed, initial, substeps, inputs)
    grid = _checked_times(model, times)
    check_inputs(model, inputs, float(grid[1]), float(grid[-1]))
    counts = _counts(np.diff(grid), substeps, model)
    checks.check_noise_at(model, grid)
    try:
        rng = np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise InputError(f"seed: expected a whole number of at least 0, got {kind_of(seed)}") from None
    state = _initial_state(model, initial, rng)
    path = _Path(model, rng, inputs, of_euler=substeps is not None)
    states, rows = path.whole(state, grid, counts)
    values = np.array(states)
    for column, name in enumerate(model.state):
        if name in model.periodic:
            values[:, column] = np.pi - np.mod(np.pi - values[:, column], 2 * np.pi)
    observed = _reading(model, grid, np.concatenate(rows))
    return Truth(grid, values, model.state), Record(grid[1:], observed, model.observation_kind, inputs)


def _with_path(
    model: Model, times: Any, seed: Any, initial: Any, substeps: int | None, inputs: Inputs | None
) -> tuple[Truth, Record]:
    """Simulate the state and the path together, where formulas contain what is observed."""
    grid, both = _checked_times(model, times), with_path_as_states(model)
    rng = np.random.default_rng(seed)
    start = np.append(_initial_state(model, initial, rng), np.zeros(model.m))
    truth, _ = simulate(both, grid[1:], rng, start, substeps, inputs)
    path = np.diff(truth.values[:, model.n :], axis=0)
    values = _reading(model, grid, path)
    return Truth(grid, truth.values[:, : model.n], model.state), Record(grid[1:], values, model.observation_kind, inputs)


class _Path:
    """The equations of one model with fixed parameters, advanced over many intervals at a time."""

    def __init__(self, model: Model, rng: np.random.Generator, inputs: Inputs | None, of_euler: bool):
        self.model, self.inputs = model, inputs
        # Streams of their own, so that the path does not depend on what is observed, nor either on the chunks.
        self._generators = rng.spawn(3)
        self._state_rng, self._observation_rng, bridge_rng = self._generators
        self._of_euler = of_euler
        self._theta = model.theta()
        self._drift = program_of(list(model.drift), model, stable=True).scalar(self._theta.tolist())
        self._stepper = None
        if model.domain or checks.depends_on_state(model.diffusion, model):
            self._stepper = Stepper(model, self._theta, bridge_rng, of_euler)
        self._observation = numpy_function(model.observation, model)
        matrices = {key: getattr(model, key) for key in checks.COEFFICIENTS}
        self._coefficients = {key: numpy_function(matrix, model, matrix.shape) for key, matrix in matrices.items()}

    def _coefficient(self, key: str, times: np.ndarray) -> np.ndarray:
        """The matrix at all times, (N, ., .), or at one, (., .), if it does not depend on time."""
        t = times if getattr(self.model, key).has(self.model.t) else times[0]
        return self._coefficients[key](np.zeros(self.model.n), t, self._theta)

    def whole(self, state: np.ndarray, grid: np.ndarray, counts: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The states (K + 1) and the observations, in parts; with more steps where they are too long, but for Euler's."""
        generators = [own.bit_generator.state for own in self._generators]
        for attempt in range(ATTEMPTS):
            states, rows, fault = [state], list[np.ndarray](), None
            try:
                for first, last in _chunks(counts):
                    inner, observed = self.advance(states[-1], grid[first : last + 1], counts[first:last])
                    states.extend(inner)
                    rows.append(observed)
            except InputError as wrong:
                fault = wrong
            finer = None
            if not self._of_euler and attempt + 1 < ATTEMPTS:
                finer = finer_counts(self.model, grid, np.array(states), counts, self.inputs)
            if finer is None or (finer == counts).all():
                break
            counts = finer
            for own, known in zip(self._generators, generators, strict=True):
                own.bit_generator.state = known
        if fault is not None:
            raise fault
        return states, rows

    def advance(self, state: np.ndarray, grid: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The states at the ends of the intervals, (K, n), and the increments or samples there, (K, m)."""
        model, rng = self.model, self._observation_rng
        times, steps, first = self._fine_times(grid, counts)
        # Those of the middle of a step, in which they do not jump.
        u = None if self.inputs is None else self.inputs.at(times if self._of_euler else times + 0.5 * steps, model.input_hold)
        root = square_root(self._coefficient("process_noise", times))
        noise = self._state_rng.standard_normal((len(times), root.shape[-1]))
        if self._stepper is None:
            shocks = _times(self._coefficient("diffusion", times) @ root, noise) * np.sqrt(steps)[:, None]
            fine = self._integrate(state, times, steps, shocks, u)
        else:
            fine = self._stepper.path(state, times, steps, np.broadcast_to(root, (len(times), *root.shape[-2:])), noise, u)
        ends = fine[first[1:]]
        if model.observation_kind == "samples":
            u = None if self.inputs is None else self.inputs.at(grid[1:], model.input_hold)
            if not model.observation_law.is_gaussian or checks.depends_on_state(model.observation_noise, model):
                self._observe(ends, grid[1:], u)
                return ends, model.observation_law.sample(rng, ends, grid[1:], self._theta, u)
            root = square_root(self._coefficient("observation_noise", grid[1:]))
            noise = rng.standard_normal((len(ends), model.m))
            return ends, self._observe(ends, grid[1:], u) + _times(root, noise)
        S, shared = self._coefficient("observation_noise", times), np.zeros(())
        if not model.cross_noise.is_zero_matrix:
            # dw = C' Q^-1 dv + what is independent of dv
            cross = np.swapaxes(self._coefficient("cross_noise", times), -1, -2)
            gain = cross @ np.linalg.pinv(self._coefficient("process_noise", times), hermitian=True)
            S = S - gain @ np.swapaxes(cross, -1, -2)
            shared = _times(gain @ root, noise)
        own = _times(square_root(S), rng.standard_normal((len(times), model.m)))
        noise = (shared + own) * np.sqrt(steps)[:, None]
        seen = self._observe(fine[:-1], times, u)
        if not self._of_euler:
            seen = 0.5 * (seen + self._observe(fine[1:], times + steps, u))
        return ends, np.add.reduceat(seen * steps[:, None] + noise, first[:-1])

    def _fine_times(self, grid: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The times and lengths of all substeps, and the place of the first of each interval, with the end."""
        steps = np.repeat(np.diff(grid) / counts, counts)
        first = np.concatenate([[0], np.cumsum(counts)])
        times = np.repeat(grid[:-1], counts) + (np.arange(first[-1]) - np.repeat(first[:-1], counts)) * steps
        jumps = () if self.inputs is None else self.inputs.within(grid[0], grid[-1])
        if len(jumps):
            times = np.union1d(np.union1d(times, grid[:-1]), jumps)
            steps = np.diff(times, append=grid[-1])
            first = np.append(np.searchsorted(times, grid[:-1]), len(times))
        return times, steps, first

    def _integrate(
        self, state: np.ndarray, times: np.ndarray, steps: np.ndarray, noise: np.ndarray, u: np.ndarray | None
    ) -> np.ndarray:
        """The states at every substep, (N+1, n); plain floats are faster than arrays of a few numbers."""
        drift, x = self._drift, state.tolist()
        fine = [x]
        try:
            inputs = [()] * len(times) if u is None else u.tolist()
            for t, step, shock, own in zip(times.tolist(), steps.tolist(), noise.tolist(), inputs):
                if self._of_euler:
                    x = [xi + fi * step + wi for xi, fi, wi in zip(x, drift(x, t, own), shock)]
                else:
                    x = [xi + 0.5 * wi for xi, wi in zip(x, shock)]
                    x = [xi + fi * step + 0.5 * wi for xi, fi, wi in zip(x, mean_drift(drift, x, t, own, step), shock)]
                fine.append(x)
        except (ValueError, ArithmeticError):  # no such number, or too large a one; said below
            fine.append([float("nan")] * len(x))
        result = np.array(fine)
        finite = np.isfinite(result).all(axis=1)
        if not finite.all():
            last = max(int(np.argmin(finite)) - 1, 0)
            own = None if u is None else u[last]
            self._refuse("drift", result[last], times[last], "the state grows beyond double precision", own)
        return result

    def _observe(self, x: np.ndarray, t: np.ndarray, u: np.ndarray | None) -> np.ndarray:
        values = self._observation(x, t, self._theta, u)
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            first = int(np.argmin(finite))
            self._refuse("observation", x[first], t[first], "the observation is not finite", None if u is None else u[first])
        return values

    def _refuse(self, key: str, x: np.ndarray, t: float, otherwise: str, u: np.ndarray | None) -> None:
        reason = explain_nonfinite(self.model, key, getattr(self.model, key), x, t, u)
        reason = reason or f"{key}: {otherwise} after t = {t:.6g}; try more substeps"
        raise InputError(f"{self.model.source}: {reason}")


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    if matrices.ndim > 2:
        return (matrices @ vectors[..., None])[..., 0]
    diagonal = np.diagonal(matrices)
    if matrices.shape[0] == matrices.shape[1] and np.array_equal(matrices, np.diag(diagonal)):
        return vectors * diagonal
    return vectors @ matrices.T


def _checked_times(model: Model, times: Any) -> np.ndarray:
    """The start, then the times of the record."""
    try:
        grid = np.concatenate([[model.start], np.asarray(times, dtype=float)])
    except (TypeError, ValueError):
        raise InputError("times: expected a list of numbers") from None
    if len(grid) == 1 or not np.isfinite(grid).all():
        raise InputError("times: expected at least one time, all of them finite")
    steps = np.diff(grid)
    if model.observation_kind == "samples":
        steps[0] = 1.0 if steps[0] == 0 else steps[0]
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0))
        before = f"the start {model.start:.12g}" if row == 0 else f"{grid[row]:.12g}"
        time = f"{grid[row + 1]:.12g}"
        raise InputError(f"times: entry {row} ({time}) is not after {before}; times must increase")
    return grid


def _counts(intervals: np.ndarray, substeps: Any, model: Model) -> np.ndarray:
    if substeps is None:
        return usual_counts(intervals, model)
    if isinstance(substeps, bool) or not isinstance(substeps, int | np.integer) or substeps < 1:
        raise InputError(f"substeps: expected a whole number of at least 1, got {kind_of(substeps)}")
    return np.full(len(intervals), int(substeps))


def _initial_state(model: Model, initial: Any, rng: np.random.Generator) -> np.ndarray:
    if initial is None:
        if model.prior is None:
            raise InputError(f"{model.source}: prior: missing; give the model a prior, or initial=...")
        if isinstance(model.prior, DensityPrior):
            return draw_from_density(model, rng)
        for _ in range(100):  # a prior has 1e-6 of its mass outside of the domain at most
            state = model.prior.sample(rng, 1)[0]
            if outside_domain(model, state) is None:
                break
        return state
    try:
        state = np.atleast_1d(np.asarray(initial, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"initial: expected {model.n} numbers (one a state)") from None
    if state.shape != (model.n,) or not np.isfinite(state).all():
        raise InputError(f"initial: expected {model.n} finite numbers (one a state), got shape {state.shape}")
    if (name := outside_domain(model, state)) is not None:
        raise InputError(f"initial: {name} = {state[model.state.index(name)]:g} is outside of its domain, {model.domain[name]}")
    return state


def _chunks(counts: np.ndarray) -> Iterator[tuple[int, int]]:
    """Ranges of intervals with about CHUNK substeps each."""
    block = (np.cumsum(counts) - 1) // CHUNK
    edges = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(counts)]
    yield from zip(edges, edges[1:])


def _reading(model: Model, grid: np.ndarray, observed: np.ndarray) -> np.ndarray:
    if model.observation_kind == "path":
        return np.cumsum(observed, axis=0)
    if model.observation_kind == "rates":
        return observed / np.diff(grid)[:, None]
    return observed
