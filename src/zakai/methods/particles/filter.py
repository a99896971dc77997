"""One step of the particle filter: motion, weights, resampling, moves of the past, and standard errors.

    x_i <- F(x_i, noise_i);   w_i <- w_i p(z | x_i);   resample where 1 / sum w^2 is below half of the particles

What is drawn depends on the seed, the number of the interval and the particle alone.

References:
    Gordon, Salmond and Smith 1993, Novel approach to nonlinear/non-Gaussian Bayesian state estimation.
    Gilks and Berzuini 2001, Following a moving target (moves of the past).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from zakai.methods._protocol import Info
from zakai.methods.particles.block import FEW, TRIED
from zakai.methods.particles.events import Interval, Observed, with_update
from zakai.methods.particles.islands import CAUTION, FEW_FAR, FEW_ISLANDS, Islands, regression
from zakai.methods.particles.moments import moments_of
from zakai.methods.particles.programs import Array
from zakai.methods.particles.proposals import HOPELESS, MOST_RESTS, TEMPER_BELOW, advanced
from zakai.methods.particles.state import BEFORE_MOVES, MOVE, PRIOR, RESAMPLING, Cloud, Control, Prepared, Rule, State
from zakai.methods.particles.substeps import allowed_error, substeps
from zakai.methods.particles.window import Window
from zakai.methods.system.escape_of_states import RARE, check_escape
from zakai.numerics.particles.even import even_normals
from zakai.numerics.particles.population import effective

RESAMPLE_BELOW = 0.5  # effective share of the particles
DOUBTFUL = 16  # resamplings after an interval that left few particles, in which standard errors are lower bounds
# The past is moved where that pays: by error^2 x time, with N variance of a mean, in variances of the state, as error^2.  What
# ancestors add to that, beyond what the last move left, is taken away from later steps, and as the ancestors that are lost before
# a move cannot come back, `MOVE_WORTH` times as much as has added up since the last one counts (error^2 x time of the turn is a
# third more with 4, of bearings, a falling body and a robot the same), but no more than the present one adds up to until the
# state has forgotten it: the share that a step leaves is measured.  That is compared with its cost, both as shares of all so far.
# A move waits until it can divide the present loss by `MOVE_GAIN`, and longer where the last one had gained less; what that left
# is forgotten at a rate.  The cost is counted in normal numbers: those of the window, once and for each sweep by the acceptance
# of the last, and in a step its own and as many as the rest of it takes.  (Measured: 30 to 38 ns in a move, 0.3 us and 40 ns a
# number in a step.)
MOVE_GAIN, MOVE_WORTH, FORGOTTEN, STEP_WORK, LEAST_RATE = 1.5, 8.0, 0.98, 4.0, 0.3
MOVE_CONTROL = (1.0, 1.2, 4.0, 0.4, 1.0, 0.0)  # power, change, most sweeps, rho, share, of all observations
VARIANCE = 5.0  # that of a mean times N, in variances of the state, that the number of particles is chosen for
MOST_GROWTH = 4
REPEATED, NARROWEST = 2.0, 0.02  # excess of the time error at which an interval is repeated, and least narrowing that counts
SURELY = 2.0  # inverse of the error of a regression on a direction, below which that is not known


def init(prepared: Prepared, prior: Any) -> State:
    """Return draws of the prior with equal weights."""
    system, count = prepared.system, prepared.rule.start
    gaussian = system.gaussian_prior(prior)
    if gaussian is not None:
        return begun(prepared, gaussian, count)
    rng = np.random.Generator(np.random.Philox(key=prepared.key(0, PRIOR)))
    return begun_at(prepared, system.drawn(prior, prepared.theta, count, rng))


def begun(prepared: Prepared, gaussian: tuple[Array, Array], count: int) -> State:
    """Return draws of a Gaussian with a mean (n,) and a root (n, d) of its covariance."""
    first, islands = np.empty((gaussian[1].shape[1], count)), Islands.begin(count, prepared.model.n)
    even_normals(islands.even(prepared.key(0, PRIOR), islands.rank), 0, count, first)
    return _at_start(prepared, np.ascontiguousarray(gaussian[0][:, None] + gaussian[1] @ first), first, gaussian)


def begun_at(prepared: Prepared, particles: Array) -> State:
    """Return equally weighted particles (n, N), whose start is not moved."""
    n, count = particles.shape
    return _at_start(prepared, particles, np.zeros((0, count)), (np.zeros(n), np.zeros((n, 0))))


def _at_start(prepared: Prepared, particles: Array, first: Array, gaussian: tuple[Array, Array]) -> State:
    system, count = prepared.system, particles.shape[1]
    width = system.law.width if system.law is not None else system.factor.width  # type: ignore[union-attr]
    window = Window.begin(particles, first, gaussian, (width, len(prepared.motion.law[3])))
    logs, n = np.full(count, -np.log(count)), prepared.model.n
    islands, control = Islands.begin(count, n), Control(variance=VARIANCE * count / prepared.rule.particles)
    return State(particles, logs, window, islands, control, np.zeros(n), np.zeros(system.n), np.ones(system.n))


def reduced(state: State) -> State:
    """Return a state with its particles, without their past."""
    nothing = np.zeros((len(state.particles), 0))
    window = Window.begin(nothing, np.zeros((0, 0)), (np.zeros(0), np.zeros((0, 0))), (0, 0))
    return state._replace(window=window, islands=Islands.begin(0, len(state.islands.excess)))


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance by interval k of the schedule, then use what is observed at its stop."""
    try:
        return _step(prepared, k, state, values)
    except np.linalg.LinAlgError:
        n = prepared.model.n
        none, figures = np.full(n, np.nan), (*FIGURES, "outside_tables") if prepared.system.outside else FIGURES
        return state, Info(np.nan, none, np.full((n, n), np.nan), dict.fromkeys(figures, np.nan), none, np.nan)


FIGURES = (
    "effective_sample_size", "particles", "founders", "largest_weight", "tempering_levels", "acceptance", "time_error",
    "monte_carlo_error", "deviation_error", "log_likelihood_error", "lower_bound", "uncertain_error", "guided", "moved",
    "linear_states", "substeps",
)  # fmt: skip


def _step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    system, n, weights = prepared.system, prepared.model.n, np.exp(state.log_weights)
    before = moments_of(system, state.particles, weights)

    def at_start() -> tuple[Array, Array]:
        return before.mean[:n], before.cov

    check_escape(prepared, k, at_start, infinity=False)
    motion, interval, control = prepared.motion, prepared.interval(k), state.control
    number, rule = control.interval + 1, prepared.rule
    cloud = Cloud(state.particles, state.log_weights, state.window, state.islands)
    scale = np.maximum(system.scales(before.cov), 1e-12)
    observed = _observed(prepared, interval, values)
    wanted, size = _wanted(rule, len(weights), control.variance), effective(weights)
    if size < HOPELESS * len(weights):  # more particles would be of no use
        wanted = min(wanted, len(weights))
    # A change of their number alone would resample weights that the next may undo.
    count = wanted if size < RESAMPLE_BELOW * len(weights) else None
    cloud, rank = cloud.ordered(before.particles, count, prepared.key(number, RESAMPLING))
    start, narrow = cloud, control.narrow
    for last_turn in (False, True):
        # Errors are measured in deviations after the observation, by how much the last one, or this one, has narrowed them.
        steps, control = substeps(prepared, interval, values, state, (before.mean, narrow * scale))
        events = with_update(motion.events(interval, steps.scheme, values, before.mean, scale), system, observed)
        done = advanced(prepared, start, (events, observed), number, rank, control.rest > 0)
        after = moments_of(system, done.cloud.particles, done.weights)
        found_narrow = _narrowing(after.cov, done.deviations)
        if last_turn or steps.error * narrow <= REPEATED * allowed_error(control, len(weights)) * found_narrow:
            break
        narrow = found_narrow
    last = (steps.shift, narrow * scale) if steps.measured else (state.last_shift, state.last_scale)
    if done.lost > 0.5 * RARE:
        check_escape(prepared, k, at_start)
    cloud = done.cloud
    # Of many coordinates the states at the end are not kept: an interval is run again when it leaves the window.
    ends = cloud.particles if system.n <= 2 * n else np.zeros((0, 0))
    cloud = cloud._replace(window=cloud.window.appended(motion, events, observed, done.noise, ends))
    weights, cov = done.weights, after.cov
    size, largest = effective(weights), float(weights.max())
    T, end = regression(before.particles, after.particles, cloud.parents), after
    cloud = cloud._replace(islands=cloud.islands.carried(T, before.particles, after.particles), parents=None)
    found = cloud.islands.spread(after.particles)
    doubtful = size < TEMPER_BELOW * len(weights) or done.levels > 3
    acceptance, moved = done.acceptance, 0.0
    own = found.independent
    if done.unseen:  # what is lost now does not come back by the noise of later intervals
        own = np.minimum(own, np.diag(cov) / len(weights))
    error, own_loss, loss = (_loss(part, cov, len(weights)) for part in (found.variance, own, np.maximum(found.variance, own)))
    present, floor = max(loss - own_loss - control.floor, 0.0), FORGOTTEN * control.floor
    excess, known = control.excess + present, FORGOTTEN * control.known + control.present
    remembered = FORGOTTEN * control.remembered + min(control.present, present)
    future = present * known / (known - remembered) if remembered < known else np.inf
    losses, work, rate = control.losses + error, control.work + STEP_WORK + len(done.noise), control.rate
    cost = cloud.window.width * (1.0 + MOVE_CONTROL[1] / max(rate, LEAST_RATE))
    worth = min(MOVE_WORTH * excess, future)
    if loss > MOVE_GAIN * (own_loss + floor) and worth * work > cost * losses and cloud.window.width:

        def gains(T: Array) -> bool:  # where T of the deviations is left
            return MOVE_GAIN * _loss(np.diag(T @ found.cov @ T.T) + own, cov, len(weights)) < loss

        cloud, accepted, change = _moved(prepared, cloud, weights, number, gains)
        remains, work, excess = loss, work + cost / TRIED, 0.0
        if change is not None:
            weights = np.exp(cloud.logs)
            end = moments_of(system, cloud.particles, weights)
            T_moved = regression(after.particles, end.particles, cloud.parents)
            islands, cov = cloud.islands.carried(T_moved, after.particles, end.particles), end.cov
            acceptance, doubtful_move = accepted, accepted < 0.1 or change < 0.5
            if len(cloud.window.first) and not doubtful_move:
                islands = islands.renewed()
            cloud, found = cloud._replace(islands=islands), islands.spread(end.particles)
            present, work, moved, rate = 0.0, work + cost, 1.0, acceptance
            own_loss = _loss(found.independent, cov, len(weights))
            remains = _loss(np.maximum(found.variance, found.independent), cov, len(weights))
            doubtful = doubtful or doubtful_move
        floor = (remains - own_loss) * max(1.0, MOVE_GAIN * remains / loss) ** 2
    # What the weights say of a coordinate makes a shift of the prediction smaller by the ratio of the variances.
    contraction = np.where(done.predicted > 0, np.minimum(1.0, end.spread / np.maximum(done.predicted, 1e-300)) ** 2, 1.0)[:n]
    carried, fresh = T @ _known_part(state.shift, before.particles.cov, np.diag(before.cov), size), steps.shift[:n]
    predicted = carried / np.maximum(contraction, NARROWEST**2) + fresh
    # A shifted prediction changes the log density of an observation by the shift times an innovation.
    shifts = (predicted / np.maximum(done.deviations, 1e-300)) ** 2 * (1.0 - contraction)
    shifted, shift = control.shifted + float(shifts.max()), carried + contraction * fresh
    islands, variance = cloud.islands, found.variance
    evidence, families = islands.settled + found.evidence + shifted, islands.families(end.particles)
    spread = end.deviations
    positive = np.where(spread > 0, spread, np.inf)
    share = variance / positive**2
    random_error, deviation_error = float(np.sqrt(share.max())), 0.5 * math.sqrt(found.wide)
    doubtful = doubtful or found.effective < FEW_ISLANDS or deviation_error > FEW_FAR
    until = islands.age + DOUBTFUL if doubtful else control.doubtful_until
    marked = islands.age < until or not families.forgotten
    health = {
        "effective_sample_size": size,
        "particles": float(len(weights)),
        "founders": float(families.number),
        "largest_weight": largest,
        "tempering_levels": float(done.levels),
        "acceptance": acceptance,
        "time_error": float((np.abs(shift) / positive).max()),
        "monte_carlo_error": random_error,
        "deviation_error": deviation_error,
        "log_likelihood_error": float(np.sqrt(evidence)),
        "lower_bound": float(marked),
        "uncertain_error": CAUTION * random_error if marked else 0.0,
        "guided": float(done.guided),
        "moved": moved,
        "linear_states": float(system.linear),
        "substeps": float(steps.scheme.substeps),
    }
    if system.outside:
        u = None if interval.inputs is None else interval.inputs.at(interval.stop, system.model.input_hold)
        beyond = system.outside(cloud.particles[:n].T, interval.stop, prepared.theta, u)
        health["outside_tables"] = float(weights[beyond].sum() / weights.sum())
    info = Info(done.gained, end.mean[:n], cov, health, np.sqrt(variance + shift**2), float(np.sqrt(evidence)))
    failed = 0 if done.block > 0 else min(max(2 * control.failed, 1), MOST_RESTS) if done.block else control.failed
    rest = failed if done.block else max(control.rest - 1, 0)
    control = control._replace(
        interval=number, failed=failed, rest=rest,
        narrow=found_narrow, losses=losses, work=work, excess=excess, floor=floor, rate=rate,
        doubtful_until=until, shifted=shifted, present=present, known=known, remembered=remembered,
        variance=0.8 * control.variance + 0.2 * len(weights) * float(share.mean()),
    )  # fmt: skip
    return State(cloud.particles, cloud.logs, cloud.window, islands, control, shift, *last), info


def _observed(prepared: Prepared, interval: Interval, values: Array) -> Observed:
    """Return what the law of the observations at the end of an interval receives."""
    system, theta, t = prepared.system, prepared.theta, interval.stop
    u = None if interval.inputs is None else interval.inputs.at(t, system.model.input_hold)
    if system.law is not None:
        return Observed(t, *system.law.given(values, interval.seen, prepared.motion.law_parameters(t, u), u))
    m, late = system.m, np.flatnonzero(interval.seen & ~interval.inside)
    P = np.zeros((m, m))
    if len(late):
        S, spans = system.noise(np.zeros(system.model.n), t, theta, u), interval.elapsed
        P[np.ix_(late, late)] = np.linalg.inv((S * np.minimum(spans[:, None], spans))[np.ix_(late, late)])
    r = interval.elapsed * (P @ values)
    P = P * np.outer(interval.elapsed, interval.elapsed)
    row = np.concatenate([[] if u is None else u, r, [P[pair] for pair in system.numbers.pairs]])
    return Observed(t, row, np.array([float(len(late) > 0)]))


def _narrowing(cov: Array, before: Array) -> float:
    """Return the smallest ratio of the deviations of a state after and before the observation."""
    ratios = np.sqrt(np.maximum(np.diag(cov), 0.0)) / before
    return min(max(min((ratio for ratio in ratios.tolist() if ratio >= 0.0), default=1.0), NARROWEST), 1.0)


def _known_part(shift: Array, cov: Array, spread: Array, size: float) -> Array:
    """Return the part of a shift (n,) in directions in which so many particles say what becomes of it.

    The regression on a direction in which particles have a share e of the variance has an error of 1 / (e sqrt(size)).

    Args:
        shift: of the mean.
        cov: the covariance (n, n) of the particles.
        spread: the variances (n,) of the states, of which linear ones have more than particles show.
        size: effective number of the particles.
    """
    scale = np.sqrt(np.where(spread > 0, spread, 1.0))
    shares, directions = np.linalg.eigh(cov / np.outer(scale, scale))
    known = directions[:, shares * np.sqrt(size) > SURELY]
    return np.asarray(scale * (known @ (known.T @ (shift / scale))))


def _loss(variance: Array, cov: Array, count: int) -> float:
    """Return the variances of the means over those of independent draws, in the mean of the states."""
    spread = np.diag(cov)
    wide = spread > 0
    return float((variance[wide] / spread[wide]).mean()) * count if wide.any() else 0.0


def _moved(
    prepared: Prepared, cloud: Cloud, weights: Array, number: int, gains: Callable[[Array], bool]
) -> tuple[Cloud, float, float | None]:
    """Return equally weighted particles whose past has been moved, the acceptance, and the change of the noise.

    A few particles are moved first.  The cloud and no change are returned where what they keep of their states, T (n, n), says
    that a move gains too little: moves do not cross between modes.
    """
    before, count = cloud, len(weights)
    cloud, _ = cloud.resampled(weights, count, prepared.key(number, RESAMPLING, BEFORE_MOVES))
    path, start = cloud.window.path()
    target = cloud.window.target(prepared.motion, start)
    gaussian = target.gaussian(path, None)
    if gaussian is None:
        return before, np.nan, None
    if count >= TRIED * FEW:
        few = slice(None, None, TRIED)
        trial, states = replace(target, start=np.ascontiguousarray(start[:, few])), [cloud.particles[:, few]]
        states.append(trial.sweep(gaussian, np.ascontiguousarray(path[:, few]), MOVE_CONTROL, prepared.key(number, MOVE, 1))[1])
        equal = np.full(states[0].shape[1], 1.0 / states[0].shape[1])
        if not gains(regression(*(moments_of(prepared.system, x, equal).particles for x in states))):
            return before, np.nan, None
    path, particles, _, rate, change = target.sweep(gaussian, path, MOVE_CONTROL, prepared.key(number, MOVE))
    return cloud._replace(particles=particles, window=cloud.window.moved(path, start, particles)), rate, change


def _wanted(rule: Rule, count: int, variance: float) -> int:
    """Return the number of particles from here on, changed slowly: copies do not lower the error at once."""
    if rule.tolerance is None:
        return count
    need = variance / rule.tolerance**2
    if count / 1.3 < need < 1.2 * count:
        return count
    return int(np.clip(min(need, 1.5 * count), rule.particles, rule.most))
