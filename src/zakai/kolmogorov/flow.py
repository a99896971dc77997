"""The affine Hamiltonian flow: how a density moves between observations in a linear-quadratic system.

The equation, with every coefficient a function of time,

    v_t = 1/2 G:Hess v - (L x + l).grad v + (x'Q x + p.x + r) v                                            (1)

is solved by its characteristics.  They obey a linear system in x-coordinates (no square root of G, no inverse of G):

    d/dt [xi; eta] = [[L, -2 G], [Q, -L']] [xi; eta] + [l; p/2],

and its solution over one interval, Phi = [[P11, P12], [P21, P22]], turns (1) into three plain operations:

    v(t1, c1 + P11 xi) = exp(kappa + 2 e1'P11 xi + xi'P11'P21 xi) . (N(0, Sigma) * v(t0, c0 + .))(xi),
    Sigma = -P11^-1 P12 / 2,                                                                               (2)

*spread* by a Gaussian, *move* along the flow that starts in (c0, 0) and ends in (c1, e1), *weigh* by the potential.  No step
subtracts large numbers, singular G is allowed, and for Q <= 0 nothing can blow up.  (2) follows from the classical action
of the quadratic Hamiltonian; it is the kernel of Chen, Luo and Yau (2017), Theorem 2, without its restrictions, and for one
Gaussian it is the linear-fractional solution of the Riccati equation.

The forcing may depend linearly on inputs e = (1, e_1, ...): l and p are then matrices with a column for each input, and so is
r.  A rate of observation enters in this way after the flow has been prepared.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zakai import _float64  # noqa: F401
from zakai.errors import InputError
from zakai.kolmogorov.linear_solve import solve
from zakai.models.checks import irregular
from zakai.models.compile import jit_small

STAGES = 8
TOLERANCE = 1e-13
MOST_SUBSTEPS = 4096
PROBES = 4096  # times at which coefficients are looked at, before it is believed that they vary slowly
MANY = 32  # substeps from which a short block is worth a compilation of its own
KNOWN = 1e-9  # what a flow must be known to
MOST_IMPLICIT = 4  # states up to which the implicit method is the cheaper one
MOST_GROWTH = 4.0
MOST_BYTES = 2**28  # of the flows of the parts of one interval
MOST_TOGETHER = 32  # states up to which many intervals are integrated at once


# Prepared flows are held as NumPy arrays and traced as JAX arrays.
Array = Any


class Coefficients(NamedTuple):
    """The coefficients of equation (1) at one time, for n states and k inputs.

    `matrix` is L (n, n), `offset` l (n, k), `covariance` G (n, n), `quadratic` Q (n, n), `linear` p (n, k), `constant` r (k,).
    """

    matrix: Array
    offset: Array
    covariance: Array
    quadratic: Array
    linear: Array
    constant: Array


class Flow(NamedTuple):
    """Equation (2) for one interval, or for many with a leading axis.

    `map` is P11, `spread` Sigma, `bend` the symmetric P11'P21, `lift` P21, `shift` and `push` (n, k) the response of
    (xi, eta) to the inputs, `action` (k, n) and `action_inputs` (k, k) the linear functional J of the classical action,
    `growth` (k,) the integral of r, `trace` that of tr L / 2, and `log_volume` log |det P11|.
    """

    map: Array
    spread: Array
    bend: Array
    lift: Array
    shift: Array
    push: Array
    action: Array
    action_inputs: Array
    growth: Array
    trace: Array
    log_volume: Array


class Motion(NamedTuple):
    """Equation (2) for one interval and one centre: v(t1, `centre` + map xi) = exp(`log_mass` + `tilt`.xi + xi'bend xi) ..."""

    centre: Array
    tilt: Array
    log_mass: Array


def motion(flow: Flow, centre: jax.Array, inputs: jax.Array) -> Motion:
    """The numbers of equation (2) for a lattice or a Gaussian that is centred at `centre` (n,) with inputs e (k,)."""
    end = flow.map @ centre + flow.shift @ inputs
    costate = flow.lift @ centre + flow.push @ inputs
    log_mass = (
        costate @ end
        + inputs @ (flow.action @ centre + flow.action_inputs @ inputs)
        + flow.growth @ inputs
        + flow.trace
        - 0.5 * flow.log_volume
    )
    return Motion(end, 2.0 * flow.map.T @ costate, log_mass)


def move_gaussian(
    flow: Flow, mean: jax.Array, cov: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The mean, the covariance and the log-mass of N(mean, cov) after one interval; `cov` may be singular.

    This is the linear-fractional step P = (P11 P0 - P12/2)(P22 - 2 P21 P0)^-1 of the Riccati equation, written as equation (2).
    """
    moved = motion(flow, mean, inputs)
    spread = cov + flow.spread
    weigh = jnp.eye(mean.shape[0]) - 2.0 * spread @ flow.bend
    inner = jnp.linalg.solve(weigh, spread)
    inner = 0.5 * (inner + inner.T)
    offset = inner @ moved.tilt
    log_mass = moved.log_mass + 0.5 * moved.tilt @ offset - 0.5 * jnp.linalg.slogdet(weigh)[1] + flow.log_volume
    new_cov = flow.map @ inner @ flow.map.T
    return moved.centre + flow.map @ offset, 0.5 * (new_cov + new_cov.T), log_mass


def _gauss_collocation(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes c, the matrix a and the weights b of Gauss' collocation method of order 2 `stages` on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    nodes, weights = (nodes + 1.0) / 2.0, weights / 2.0
    matrix = np.empty((stages, stages))
    for j in range(stages):
        others = np.delete(nodes, j)
        basis = np.poly1d(np.poly(others) / np.prod(nodes[j] - others))
        integral = basis.integ()
        matrix[:, j] = integral(nodes) - integral(0.0)
    return nodes, matrix, weights


_NODES, _MATRIX, _WEIGHTS = _gauss_collocation(STAGES)


def _generator(c: Coefficients) -> jax.Array:
    """The linear system of (xi, eta, inputs, J): J' = (p/2)'xi - l'eta is the action's linear part, a row for each input."""
    n, k = c.offset.shape
    top = jnp.hstack([c.matrix, -2.0 * c.covariance, c.offset, jnp.zeros((n, k))])
    middle = jnp.hstack([c.quadratic, -c.matrix.T, 0.5 * c.linear, jnp.zeros((n, k))])
    inputs = jnp.zeros((k, 2 * n + 2 * k))
    action = jnp.hstack([0.5 * c.linear.T, -c.offset.T, jnp.zeros((k, 2 * k))])
    return jnp.vstack([top, middle, inputs, action])


def _one_step(coefficients: Callable[[jax.Array], Coefficients], start: jax.Array, length: jax.Array):
    """One collocation step from the identity: (Phi - 1, integral of r, integral of tr L / 2)."""
    at_nodes = jax.vmap(coefficients)(start + length * _NODES)
    generators = length * jax.vmap(_generator)(at_nodes)
    size = generators.shape[-1]
    system = jnp.eye(STAGES * size) - jnp.einsum("ij,iab->iajb", _MATRIX, generators).reshape(STAGES * size, -1)
    slopes = jnp.linalg.solve(system, generators.reshape(STAGES * size, size)).reshape(STAGES, size, size)
    deviation = jnp.einsum("i,iab->ab", _WEIGHTS, slopes)
    growth = length * jnp.einsum("i,ik->k", _WEIGHTS, at_nodes.constant)
    trace = 0.5 * length * jnp.einsum("i,iaa->", _WEIGHTS, at_nodes.matrix)
    return deviation, growth, trace


def integrate(
    coefficients: Callable[[jax.Array], Coefficients], start: jax.Array, stop: jax.Array, substeps: int
) -> Flow:
    """The flow over [start, stop] in `substeps` equal steps of Gauss' collocation method (order 16); pure."""
    length = (stop - start) / substeps
    n, k = jax.eval_shape(coefficients, start).offset.shape

    def add(index, carry):
        deviation, growth, trace = carry
        step, more_growth, more_trace = _one_step(coefficients, start + index * length, length)
        return deviation + step + step @ deviation, growth + more_growth, trace + more_trace

    # From nothing, that the step is traced once.
    nothing = jnp.zeros((2 * n + 2 * k, 2 * n + 2 * k)), jnp.zeros(k), jnp.zeros(())
    deviation, growth, trace = jax.lax.fori_loop(0, substeps, add, nothing)
    forced, action = slice(2 * n, 2 * n + k), slice(2 * n + k, None)
    responses = deviation[: 2 * n, forced], deviation[action, :n], deviation[action, forced]
    return _flow(deviation[: 2 * n, : 2 * n], *responses, growth, trace)


def _flow(deviation: jax.Array, response: jax.Array, action, action_inputs, growth, trace) -> Flow:
    """The pieces of equation (2) from Phi - 1 (2n, 2n) and the response of (xi, eta) to the inputs (2n, k)."""
    n = len(deviation) // 2
    p11, p12, p21 = jnp.eye(n) + deviation[:n, :n], deviation[:n, n:], deviation[n:, :n]
    solved, log_volume = solve(p11, p12)
    spread, bend = -0.5 * solved, p11.T @ p21
    return Flow(
        map=p11,
        spread=0.5 * (spread + spread.T),
        bend=0.5 * (bend + bend.T),
        lift=p21,
        shift=response[:n],
        push=response[n:],
        action=action,
        action_inputs=action_inputs,
        growth=growth,
        trace=trace,
        log_volume=log_volume,
    )


# The numbers of midpoint steps whose results are extrapolated, and the weights that cancel all errors but those of order 10.
_MIDPOINTS = (2, 4, 6, 8, 10)
_EXTRAPOLATION = tuple(
    float(np.prod([N**2 / (N**2 - M**2) for M in _MIDPOINTS if M != N])) for N in _MIDPOINTS
)


class _Stage(NamedTuple):
    """An evaluation of the midpoint rule: where, how long its steps are, and, after the last of them, the weight of its result
    and how long the next ones are; lengths in those of the whole step."""

    place: Array
    part: Array
    weight: Array
    next_part: Array


def _stages() -> _Stage:
    rows = []
    for count, weight, following in zip(_MIDPOINTS, _EXTRAPOLATION, (*_MIDPOINTS[1:], 1), strict=True):
        rows += [(i / count, 1.0 / count, weight * (i == count), 1.0 / following) for i in range(1, count + 1)]
    return _Stage(*np.array(rows).T)


_STAGES = _stages()


def integrate_explicitly(
    coefficients: Callable[[jax.Array], Coefficients], start: jax.Array, stop: jax.Array, substeps: int
) -> Flow:
    """The flow in `substeps` equal steps of Gragg's extrapolated midpoint rule (order 10): products of matrices only.

    For many states, where the implicit system of `integrate` would be too large.
    """
    length = (stop - start) / substeps
    n, k = jax.eval_shape(coefficients, start).offset.shape

    def slope(t, value):
        c = coefficients(t)
        phi, response, _, _, _, _ = value
        generator = jnp.block([[c.matrix, -2.0 * c.covariance], [c.quadratic, -c.matrix.T]])
        forcing = jnp.vstack([c.offset, 0.5 * c.linear])
        functional = jnp.hstack([0.5 * c.linear.T, -c.offset.T])
        moved = generator @ jnp.hstack([phi, response])
        return (
            generator + moved[:, : 2 * n],
            forcing + moved[:, 2 * n :],
            functional[:, :n] + functional @ phi[:, :n],
            functional @ response,
            c.constant,
            0.5 * jnp.trace(c.matrix),
        )

    def added(value, factor, rate):
        return jax.tree.map(lambda a, b: a + factor * b, value, rate)

    def step(index, value):
        """Gragg's smoothed midpoint rule for every number of steps, as changes of `value`, one evaluation after another."""
        begin = start + index * length
        first = slope(begin, value)
        still = jax.tree.map(jnp.zeros_like, value)

        def evaluation(carry, stage):
            total, before, now = carry
            rate = slope(begin + stage.place * length, added(value, 1.0, now))

            def on(_):
                return total, now, added(before, 2.0 * stage.part * length, rate)

            def last(_):
                end = jax.tree.map(lambda a, b, c: 0.5 * (a + b + stage.part * length * c), before, now, rate)
                return added(total, stage.weight, end), still, added(still, stage.next_part * length, first)

            return jax.lax.cond(stage.weight == 0.0, on, last, None), None

        begun = added(still, length / _MIDPOINTS[0], first)
        return jax.lax.scan(evaluation, (value, still, begun), _STAGES)[0][0]

    zero = (
        jnp.zeros((2 * n, 2 * n)),
        jnp.zeros((2 * n, k)),
        jnp.zeros((k, n)),
        jnp.zeros((k, k)),
        jnp.zeros(k),
        jnp.zeros(()),
    )
    return _flow(*jax.lax.fori_loop(0, substeps, step, zero))


def _integrate_one(coefficients, start, stop, argument, substeps):
    def at(t):
        return coefficients(t, argument)

    if jax.eval_shape(at, start).matrix.shape[0] > MOST_IMPLICIT:
        return integrate_explicitly(at, start, stop, substeps)
    return integrate(at, start, stop, substeps)


def _integrate_all(coefficients, starts, stops, arguments, substeps):
    def one(slices):
        return _integrate_one(coefficients, *slices, substeps)

    # Large matrices fill the processor by themselves; all intervals at once would only fill the memory.
    together = jax.vmap(one) if _states(coefficients, starts, arguments) <= MOST_TOGETHER else partial(jax.lax.map, one)
    return together((starts, stops, arguments))


# With a fixed number of substeps the loop over them can be differentiated; with a variable one it is compiled only once.
_fixed = partial(jax.jit, static_argnums=(0, 4))(_integrate_all)
_variable = partial(jax.jit, static_argnums=0)(_integrate_all)


@lru_cache(maxsize=1)
def _alone() -> Callable[..., Flow]:
    """The compiled flow of one interval by itself: a system with constant coefficients has no other, nor has a live filter."""
    return jit_small(_integrate_one, static_argnums=0)


@partial(jax.jit, static_argnums=0)
def coefficients_at(coefficients: Callable[[jax.Array, Any], Coefficients], times: Any, arguments: Any) -> Coefficients:
    """The coefficients at times (K,), each with its own argument; compiled once."""
    return jax.vmap(coefficients)(times, arguments)


@partial(jax.jit, static_argnums=0)
def _at_many(coefficients, times, arguments):
    return jax.vmap(jax.vmap(coefficients, (0, None)))(times, arguments)


def _in_blocks(coefficients, starts, stops, arguments, substeps):
    """`_integrate_all` in blocks of one size, whatever the number of intervals: one compilation, unless there is much to do."""
    slices = (np.asarray(starts, float), np.asarray(stops, float), jax.tree.map(np.asarray, arguments))
    if len(starts) == 1 and _states(coefficients, starts, arguments) <= MOST_TOGETHER:
        flow = _alone()(coefficients, *jax.tree.map(lambda a: a[0], slices), substeps)
        return jax.tree.map(lambda a: np.asarray(a)[None], flow)
    count, block = len(starts), _tried(coefficients, starts, arguments)
    if substeps > MANY:
        block = min(block, 2 ** int(np.ceil(np.log2(count))))
    parts = []
    for first in range(0, count, block):
        rows = np.minimum(np.arange(first, first + block), count - 1)
        flow = _variable(coefficients, *jax.tree.map(lambda a, rows=rows: a[rows], slices), substeps)
        parts.append(jax.tree.map(lambda a, first=first: np.asarray(a)[: count - first], flow))
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _tried(coefficients, starts, arguments) -> int:
    """How many intervals are tried, and how many are integrated together."""
    return 48 if _states(coefficients, starts, arguments) <= MOST_TOGETHER else 6


def _states(coefficients, starts, arguments) -> int:
    """How many states the coefficients are for."""
    leaves, structure = jax.tree.flatten(arguments)
    return _states_of(coefficients, structure, tuple(leaf.shape[1:] for leaf in leaves))


@lru_cache(maxsize=128)
def _states_of(coefficients, structure, shapes) -> int:
    """The same of an argument with arrays of these shapes; to trace the coefficients takes longer than a short flow."""
    argument = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(shape, float) for shape in shapes])
    return jax.eval_shape(coefficients, 0.0, argument).matrix.shape[0]


class Substeps(NamedTuple):
    """Into how many steps each interval is cut, and what the flows are then known to."""

    steps: int
    error: float

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence where the steps do not suffice."""
        if self.error <= KNOWN:
            return ()
        known = f"known to {self.error:.1g} only" if self.error < 1 else "not known"
        return (f"the coefficients vary so fast within an interval that its flow is {known}; give shorter intervals",)


def substeps_for(
    coefficients: Callable[[jax.Array, Any], Coefficients],
    starts: np.ndarray,
    stops: np.ndarray,
    arguments: Any,
    tolerance: float = TOLERANCE,
    varying: bool = True,
) -> Substeps:
    """Into how many steps each interval is cut for flows that are accurate to `tolerance`, decided outside of JAX.

    It is doubled until halving the step changes nothing on the intervals that are tried: the longest and a spread of others;
    where coefficients are `varying`, from a step in which they can change in some part only.
    """
    lengths = stops - starts
    few = min(len(starts), _tried(coefficients, starts, arguments))
    # The longest takes the place of the first, so that they are one block.
    tried = np.r_[np.argmax(lengths), np.linspace(0, len(starts) - 1, few).astype(int)[1:]]
    needed = 1.0
    if varying:
        fastest, needed = _fastest(coefficients, starts, stops, arguments)
        tried[-1] = fastest if len(tried) > 1 else tried[-1]
    tried = np.unique(tried)
    sample = jax.tree.map(lambda a: a[tried], arguments)
    substeps, previous, error = int(min(2 ** np.ceil(np.log2(max(needed, 1.0))), MOST_SUBSTEPS // 2)), None, np.inf
    while True:
        flow = _in_blocks(coefficients, starts[tried], stops[tried], sample, substeps)
        if previous is not None:
            last, error = error, max(_difference(a, b) for a, b in zip(previous, flow, strict=True))
            # Below 1e-11 rounding may stop the error from falling further.
            if error <= tolerance or (error <= 1e-11 and error >= 0.25 * last) or substeps >= MOST_SUBSTEPS:
                return Substeps(substeps // 2, max(error, np.inf if needed > STAGES * MOST_SUBSTEPS else 0.0))
        previous, substeps = flow, 2 * substeps


def _fastest(coefficients, starts, stops, arguments) -> tuple[int, float]:
    """The interval in which the coefficients vary fastest for its length, and the steps that this takes.

    A step is half of the time in which a coefficient could go through all its values at its greatest speed: that of a short
    pulse is about its width.  Seen are pulses that a few thousand times spread over all intervals do not miss.
    """
    n = _states(coefficients, starts, arguments)
    budget = min(PROBES, int(1e6 / (n * n)))
    chosen = np.unique(np.linspace(0, len(starts) - 1, max(1, budget // 4)).astype(int))
    shares = irregular(max(4, budget // len(chosen)))
    times = starts[chosen, None] + (stops - starts)[chosen, None] * shares
    given = jax.tree.map(lambda a: np.asarray(a)[chosen], arguments)
    values = _at_many(coefficients, times, given)
    needed = np.zeros(len(chosen))
    for array in values:
        entries = np.asarray(array).reshape(*times.shape, -1)
        bottom, top = entries.min(axis=(0, 1)), entries.max(axis=(0, 1))
        span = np.where(top - bottom > 1e-12 * np.maximum(abs(top), abs(bottom)), top - bottom, np.inf)
        with np.errstate(invalid="ignore"):
            speed = np.max(abs(np.diff(entries, axis=1)) / np.diff(times, axis=1)[..., None] / span, axis=(1, 2))
        needed = np.maximum(needed, 2 * speed * (stops - starts)[chosen])
    worst = int(np.argmax(needed))
    return int(chosen[worst]), float(needed[worst]) if np.isfinite(needed[worst]) else np.inf


def parts_for(growth: float, states: int, inputs: int, what: str) -> int:
    """Into how many equal parts an interval is cut whose flow grows by e^growth at most, lest it lose digits.

    Raises InputError where they are too many to be held; `what` is what the error calls the interval.
    """
    parts = np.ceil(growth / MOST_GROWTH)
    too_long = parts * 8 * (2 * (states + inputs)) ** 2 / MOST_BYTES
    if not too_long <= 1:
        rows = f"{np.ceil(too_long):.0f} rows" if np.isfinite(too_long) else "rows"
        raise InputError(
            f"{what} is {growth:.3g} times as long as the system's own time, too long for this filter; check the unit of the "
            f"times, or give {rows} in between in which nothing is observed"
        )
    return max(1, int(parts))


def flows(
    coefficients: Callable[[jax.Array, Any], Coefficients],
    starts: np.ndarray,
    stops: np.ndarray,
    arguments: Any,
    tolerance: float = TOLERANCE,
    substeps: int | None = None,
) -> Flow:
    """The flows over all intervals [starts_i, stops_i] at once, accurate to `tolerance`.

    `coefficients(t, argument)` gives the `Coefficients` at time t; `arguments` is a pytree with an entry for each interval.
    With `substeps`, the steps of `substeps_for`, this is a pure function of `arguments`, to be traced and differentiated.
    """
    if substeps is None:
        substeps = substeps_for(coefficients, starts, stops, arguments, tolerance).steps
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments))
    return (_fixed if traced else _in_blocks)(coefficients, starts, stops, arguments, substeps)


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    with np.errstate(all="ignore"):
        difference = np.max(np.abs(a - b), initial=0.0) / (1.0 + np.max(np.abs(b), initial=0.0))
    return float(difference) if np.isfinite(difference) else np.inf
