"""One step of the particle filter: motion, weights, resampling, moves of the past, and standard errors.

    x_i <- F(x_i, noise_i);   w_i <- w_i p(z | x_i);   resample where 1 / sum w^2 is below half of the particles

A step whose plain weights leave few particles draws the noise again from the Gaussian posterior of the linearised interval, then
of the last intervals, and where that fails too, carries plain particles to the posterior by powers of the likelihood with moves
between them.  What is drawn depends on the seed, the number of the interval and the particle alone.

References:
    Gordon, Salmond and Smith 1993, Novel approach to nonlinear/non-Gaussian Bayesian state estimation.
    Del Moral, Doucet and Jasra 2006, Sequential Monte Carlo samplers (powers of the likelihood).
    Gilks and Berzuini 2001, Following a moving target (moves of the past).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from zakai.methods._protocol import Info
from zakai.methods.particles.block import FEW, TRIED, drawn_again
from zakai.methods.particles.events import Events, Interval, Observed, with_update
from zakai.methods.particles.islands import CAUTION, FEW_ISLANDS, Islands, regression
from zakai.methods.particles.moments import moments_of
from zakai.methods.particles.programs import Array
from zakai.methods.particles.state import Cloud, Control, Prepared, Rule, State
from zakai.methods.particles.substeps import allowed_error, substeps
from zakai.methods.particles.window import Target, Window, taken
from zakai.methods.system.escape_of_states import RARE, check_escape
from zakai.numerics.particles.even import Even, even_normals
from zakai.numerics.particles.population import effective, next_power, normalised

NOISE, RESAMPLING, GUIDE, MOVE, PRIOR, LEVELS = 0, 1, 3, 4, 5, 6  # uses of random numbers, beside that of `substeps`
RESAMPLE_BELOW = 0.5  # effective share of the particles
GUIDE_BELOW = 0.3  # effective share below which the noise of an interval, then of the last ones, is drawn again
DOUBTFUL = 16  # resamplings after an interval that left few particles, in which standard errors are lower bounds
# Least ratio of the effective sizes after and before that, and in how many intervals it rests at most where it is in vain, twice
# as many each time.
BLOCK_GAIN, MOST_RESTS = 1.5, 16
TEMPER_BELOW, TEMPER_FLOOR = 0.1, 400  # effective share and number below which powers of the likelihood are taken
HOPELESS = 0.01  # effective share of the particles below which their number is not raised
GUIDE_SHARE, FIRST_SHARE = 0.1, 0.2  # of plain noise in draws from the linearised posterior, of an interval and of the prior
FIRST_WIDER, FIRST_ROUNDS = 1.5, 6
INFORMED = 0.25  # log det of the linearised posterior of the noise, below which the observation says nothing about the noise
MOST_LEVELS = 60
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
MOVE_CONTROL = (1.0, 1.2, 4.0, 0.4, 1.0)  # power, change, most sweeps, rho, share
VARIANCE = 5.0  # that of a mean times N, in variances of the state, that the number of particles is chosen for
MOST_GROWTH = 4
REPEATED, NARROWEST = 2.0, 0.02  # excess of the time error at which an interval is repeated, and least narrowing that counts


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
    system, count, n = prepared.system, particles.shape[1], prepared.model.n
    width = system.law.width if system.law is not None else system.factor.width  # type: ignore[union-attr]
    window = Window.begin(particles, first, gaussian, (width, len(prepared.motion.law[3])))
    islands, control = Islands.begin(count, n), Control(variance=VARIANCE * count / prepared.rule.particles)
    logs, shift = np.full(count, -np.log(count)), np.zeros(n)
    return State(particles, logs, window, islands, control, shift, np.zeros(system.n), np.ones(system.n))


def reduced(state: State) -> State:
    """Return a state with its particles, without their past."""
    nothing = np.zeros((len(state.particles), 0))
    window = Window.begin(nothing, np.zeros((0, 0)), (np.zeros(0), np.zeros((0, 0))), (0, 0))
    return state._replace(window=window, islands=Islands.begin(0, len(state.islands.excess)))


class Advanced(NamedTuple):
    """Particles after an interval, with what was needed.

    `weights` (N,) are those of the particles, `gained` is the increment of the log-likelihood, `noise` (D, N) that of the
    interval, `predicted` (n',) the spread of the coordinates before the weights of the observation act, `deviations` (n,)
    those of the states before it, `acceptance` that of moves between powers of the likelihood, `lost` the share of the particles
    that left every bounded set; `unseen`: few particles are left by an observation that says nothing of the noise; `block` is 1
    where the noise of the last intervals was drawn again, -1 where that was tried in vain.
    """

    cloud: Cloud
    weights: Array
    gained: float
    noise: Array
    predicted: Array
    deviations: Array
    levels: int = 0
    guided: bool = False
    acceptance: float = np.nan
    lost: float = 0.0
    unseen: bool = False
    block: int = 0


def step(prepared: Prepared, k: int, state: State, values: Array) -> tuple[State, Info]:
    """Advance by interval k of the schedule, then use what is observed at its stop."""
    try:
        return _step(prepared, k, state, values)
    except np.linalg.LinAlgError:
        n = prepared.model.n
        none = np.full(n, np.nan)
        return state, Info(np.nan, none, np.full((n, n), np.nan), dict.fromkeys(FIGURES, np.nan), none, np.nan)


FIGURES = (
    "effective_sample_size", "particles", "founders", "largest_weight", "tempering_levels", "acceptance", "time_error",
    "monte_carlo_error", "log_likelihood_error", "lower_bound", "uncertain_error", "guided", "moved", "linear_states", "substeps",
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
    if size < HOPELESS * len(weights):  # more of them would be of no use
        wanted = min(wanted, len(weights))
    # A change of their number alone would resample weights that the next may undo.
    count = wanted if size < RESAMPLE_BELOW * len(weights) else None
    cloud, rank = cloud.ordered(before.particles, count, prepared.key(number, RESAMPLING))
    start, narrow = cloud, control.narrow
    for last_turn in (False, True):
        # Errors are measured in deviations after the observation, by how much the last one, or this one, has narrowed them.
        steps, control = substeps(prepared, interval, values, state, (before.mean, narrow * scale))
        events = with_update(motion.events(interval, steps.scheme, values, before.mean, scale), system, observed)
        done = _advanced(prepared, start, events, observed, number, rank, control.rest > 0)
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
    cloud = cloud._replace(islands=cloud.islands.carried(T), parents=None)
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
            islands, cov = cloud.islands.carried(regression(after.particles, end.particles, cloud.parents)), end.cov
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
    carried, fresh = T @ state.shift, steps.shift[:n]
    predicted = carried / np.maximum(contraction, NARROWEST**2) + fresh
    # A shifted prediction changes the log density of an observation by the shift times an innovation.
    shifts = (predicted / np.maximum(done.deviations, 1e-300)) ** 2 * (1.0 - contraction)
    shifted, shift = control.shifted + float(shifts.max()), carried + contraction * fresh
    islands, variance = cloud.islands, found.variance
    evidence, families = islands.settled + found.evidence + shifted, islands.families(end.particles)
    spread = end.deviations
    positive = np.where(spread > 0, spread, np.inf)
    share = variance / positive**2
    random_error = float(np.sqrt(share.max()))
    doubtful = doubtful or found.effective < FEW_ISLANDS
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
        "log_likelihood_error": float(np.sqrt(evidence)),
        "lower_bound": float(marked),
        "uncertain_error": CAUTION * random_error if marked else 0.0,
        "guided": float(done.guided),
        "moved": moved,
        "linear_states": float(system.linear),
        "substeps": float(steps.scheme.substeps),
    }
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


def _advanced(
    prepared: Prepared, cloud: Cloud, events: Events, observed: Observed, number: int, rank: Array, resting: bool
) -> Advanced:
    """Return the particles, with these numbers (N,) within their islands, after an interval and its observation.

    `resting`: the noise of the last intervals is drawn again only where very few particles are left.
    """
    system, count = prepared.system, len(cloud.logs)
    single = (np.array([observed.time]), observed.given[None], observed.counted[None])
    target = Target(prepared.motion, events, *single, None, cloud.particles)
    even = cloud.islands.even(prepared.key(number, NOISE), rank)
    (noise, particles, seen, logs), lost = target.propagate(even, system.update is not None)
    weights = np.exp(cloud.logs)
    moved = moments_of(system, particles, weights)
    before = moments_of(system, seen, weights) if len(seen) else moved
    spreads = moved.spread, before.deviations
    if system.sampled and not observed.counted.any() and not lost:
        return Advanced(cloud._replace(particles=particles), weights, 0.0, noise, *spreads)
    total = cloud.logs + logs
    weights, top = normalised(total)
    after = cloud._replace(particles=particles, logs=total - top)
    plain = Advanced(after, weights, top, noise, *spreads, lost=lost / count)
    if effective(weights) >= GUIDE_BELOW * count and np.isfinite(top):
        return plain
    moving = cloud.window.length == 0 and len(cloud.window.first) > 0
    target = replace(target, prior=(cloud.window.mean, cloud.window.root) if moving else None)
    first = np.concatenate([cloud.window.first, noise]) if moving else noise
    gaussian = _linearised(target, cloud, plain)
    unseen = gaussian is not None and not moving and not np.isinf(top) and _uninformed(gaussian, 1.0)
    even = cloud.islands.even(prepared.key(number, GUIDE), rank)
    best = (gaussian and _guided(target, cloud, plain, gaussian, even)) or Drawn(plain, first, logs, None)
    size = effective(best.after.weights) if np.isfinite(best.after.gained) else 0.0
    if size < (TEMPER_BELOW if resting else GUIDE_BELOW) * count and not moving:
        least = max(BLOCK_GAIN * size / count, TEMPER_BELOW)
        block = drawn_again(cloud.window, cloud.logs, target, GUIDE_SHARE, even, least)
        found, gained = normalised(cloud.logs + block.logs) if block is not None else (weights, -np.inf)
        if block is not None and np.isfinite(gained) and effective(found) > least * count:
            after = cloud._replace(particles=block.particles, logs=cloud.logs + block.logs - gained, window=block.window)
            return plain._replace(cloud=after, weights=found, gained=gained, noise=block.noise, guided=True, block=1)
        plain, best = plain._replace(block=-1), best._replace(after=best.after._replace(block=-1))
    if unseen:  # moves of noise of which the observation says nothing would be of no use
        return plain._replace(unseen=True)
    if size >= min(TEMPER_BELOW * count, TEMPER_FLOOR) or not np.isfinite(best.logs).any():
        return best.after
    return _tempered(prepared, target, cloud, best, number)


class Drawn(NamedTuple):
    """A draw of the noise of an interval, and the particles after it.

    `path` (D, N) is the noise, with that of the prior where that is moved, `logs` (N,) the log weights, and `gaussian` that of
    which it is drawn, none for plain noise.
    """

    after: Advanced
    path: Array
    logs: Array
    gaussian: Any


def _narrowing(cov: Array, before: Array) -> float:
    """Return the smallest ratio of the deviations of a state after and before the observation."""
    ratios = np.sqrt(np.maximum(np.diag(cov), 0.0)) / before
    return min(max(min((ratio for ratio in ratios.tolist() if ratio >= 0.0), default=1.0), NARROWEST), 1.0)


def _linearised(target: Target, cloud: Cloud, plain: Advanced) -> Any:
    """Return the linearised posterior of the noise, None where there is none."""
    moving = target.prior is not None
    begin = np.zeros(((len(cloud.window.first) if moving else 0) + len(plain.noise), 1))
    wider, rounds = (FIRST_WIDER, FIRST_ROUNDS) if moving else (1.0, 2)
    return target.gaussian(begin, np.exp(cloud.logs), rounds=rounds, wider=wider) if len(begin) else None


def _uninformed(gaussian: Any, wider: float) -> bool:
    return bool(np.log(gaussian[4] * np.sqrt(wider)).sum() < INFORMED)


def _guided(target: Target, cloud: Cloud, plain: Advanced, gaussian: Any, even: Even) -> Drawn | None:
    """Return the particles whose noise is drawn from the linearised posterior, None where that is no better."""
    moving = target.prior is not None
    d0 = len(cloud.window.first) if moving else 0
    if _uninformed(gaussian, FIRST_WIDER if moving else 1.0):
        return None
    share = FIRST_SHARE if moving else GUIDE_SHARE
    path, ratio = target.draw(gaussian, share, even)
    particles, logs = target.follow(path)
    logs = logs + ratio
    lost = ~np.isfinite(particles).all(axis=0)
    particles[:, lost] = plain.cloud.particles[:, lost]
    logs[lost | np.isnan(logs)] = -np.inf
    found, top = normalised(cloud.logs + logs)
    if not np.isfinite(top) or np.isfinite(plain.gained) and effective(found) <= effective(plain.weights):
        return None
    window = cloud.window._replace(first=np.ascontiguousarray(path[:d0])) if moving else cloud.window
    after = cloud._replace(particles=particles, logs=cloud.logs + logs - top, window=window)
    done = plain._replace(cloud=after, weights=found, gained=top, noise=np.ascontiguousarray(path[d0:]), guided=True)
    return Drawn(done, path, logs, gaussian)


def _tempered(prepared: Prepared, target: Target, cloud: Cloud, drawn: Drawn, number: int) -> Advanced:
    """Return particles carried from what they were drawn from to the posterior, by powers of their weights with moves between."""
    count, moving, fixed = len(cloud.logs), target.prior is not None, drawn.gaussian
    d0 = len(cloud.window.first) if moving else 0
    path, logs, particles = drawn.path, drawn.logs, drawn.after.cloud.particles
    gained, low, levels, rates = 0.0, 0.0, 0, list[float]()
    share = 1.0 if fixed is None else FIRST_SHARE if moving else GUIDE_SHARE
    control = (2.0, 20.0) if moving else (1.5, 12.0)
    while low < 1.0 and levels < MOST_LEVELS:
        high = next_power(cloud.logs, logs, 0.5 * count, low)
        weights, top = normalised(cloud.logs + (high - low) * np.maximum(logs, -1e300))
        gained, levels, low = gained + top, levels + 1, high
        cloud, ancestors = cloud.resampled(weights, count, prepared.key(number, RESAMPLING, levels))
        path = taken(path, ancestors)
        target = replace(target, start=cloud.particles)
        gaussian = target.gaussian(path, None, power=high) if fixed is None else fixed
        if gaussian is None:
            n, D = cloud.particles.shape[0], len(path)
            gaussian = (np.zeros(D), np.zeros((D, n)), np.zeros(n), np.zeros((0, D)), np.zeros(0))
        own = prepared.key(number, LEVELS, levels)
        path, particles, logs, rate, _ = target.sweep(gaussian, path, (high, *control, 0.4, share), own)
        rates.append(rate)
    window = cloud.window._replace(first=np.ascontiguousarray(path[:d0])) if moving else cloud.window
    after = cloud._replace(particles=particles, window=window)
    noise, guided = np.ascontiguousarray(path[d0:]), fixed is not None
    spreads, weights = (drawn.after.predicted, drawn.after.deviations), np.exp(cloud.logs)
    done = Advanced(after, weights, gained, noise, *spreads, levels, guided, float(np.mean(rates)), drawn.after.lost)
    return done._replace(block=drawn.after.block)


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
    cloud, _ = cloud.resampled(weights, count, prepared.key(number, RESAMPLING, MOST_LEVELS + 1))
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
