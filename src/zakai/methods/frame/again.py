"""A step with the choices of another run: substeps, frames and grids are known, and no error is measured.

What it gives is a smooth function of the parameters, but for the errors of cross interpolations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from zakai.methods._protocol import Info
from zakai.methods.frame.chain import Chain, Prediction, corrections, extrapolated
from zakai.methods.frame.errors import Error
from zakai.methods.frame.placement import Mass
from zakai.methods.frame.state import Choice, Control, Half, Made, Prepared, State, Substeps
from zakai.methods.frame.unresolved import Unresolved
from zakai.methods.particles.programs import Array
from zakai.numerics.trains.cross import cross
from zakai.numerics.trains.train import Train

FINER = 0.05  # of the tolerance of a cross interpolation, whose error jumps from one parameter to the next


def begun(prepared: Prepared, function: Callable[[Array], Array], choice: Choice) -> State:
    """Return the prior by a known build."""
    v = _built(prepared, function, choice)
    n = prepared.model.n
    return State.of(v.scaled(1.0 / v.mass), Control(0, Substeps(1.0, 0.0), Error.zero(n)))


def step(chain: Chain, state: State, made: Made, figures: Sequence[str]) -> tuple[State, Info]:
    """Return the state after an interval, and its report without figures."""
    prepared, interval = chain.prepared, chain.interval
    u = prepared.train(state)
    predictions = [_predicted(chain, u, halves) for halves in made.motions]
    first, function = predictions[0], predictions[0].function
    if len(predictions) > 1:
        function = extrapolated(*predictions)
    if made.tails:
        function = function.with_tails(made.tails)
    law = prepared.motion.likelihood(interval, chain.values)
    function = function.times(law._replace(top=made.top)).about(made.choice.turn)
    v = _built(prepared, function, made.choice)
    log_evidence = math.log(v.mass) + made.top + first.log_mass + float(first.function.terms[0].scale[1])
    v = v.scaled(1.0 / v.mass)
    turn = made.choice.turn
    mean, cov = v.moments(np.arctan2(np.sin(turn), np.cos(turn)) if prepared.system.base.angles.any() else None)
    control = state.control._replace(interval=state.control.interval + 1)
    return State.of(v, control), Info(log_evidence, mean, cov, dict.fromkeys(figures, math.nan))


def _predicted(chain: Chain, u: Train, halves: tuple[Half, ...]) -> Prediction:
    """Return a prediction, as `Chain.predict` does."""
    prepared, interval, count = chain.prepared, chain.interval, len(halves) - 1
    at, log_mass = interval.start, 0.0
    length = (interval.stop - at) / max(count, 1)
    for j, half in enumerate(halves[:-1]):
        assert half.choice is not None and half.about is not None
        middle = interval.start + (j + 0.5) * length
        function = chain.carried(u, (at, middle), half.steps, half.top).about(half.choice.turn)
        v = _built(prepared, function, half.choice)
        total = v.mass
        if prepared.system.weighted:
            log_mass += math.log(total) + half.top
        Q, _ = prepared.motion.noise(interval, chain.values, middle, length, half.about)
        D = _in_frame(Q, v)
        v = v.convolve(np.maximum(np.diag(D), 0.0), FINER * FINER * half.choice.options.tolerance)
        u, at = v.in_basis(np.ascontiguousarray(v.grid.basis @ corrections(D))).scaled(1.0 / total), middle
    function = chain.carried(u, (at, interval.stop), halves[-1].steps, halves[-1].top)
    n = prepared.model.n
    return Prediction(function, Mass(np.zeros((n, 1)), np.ones(1)), log_mass, 0.0, np.eye(n))


def _in_frame(Q: Array, v: Train) -> Array:
    """Return noise (n, n) in the frame of a density; between closed axes and others it is left out."""
    D = np.linalg.solve(v.grid.basis, np.linalg.solve(v.grid.basis, Q).T)
    closed = v.grid.closed
    return np.asarray(np.where(closed[:, None] | closed, np.diag(np.diag(D)), D))


def _built(prepared: Prepared, function: Callable[[Array], Array], choice: Choice) -> Train:
    """Return a function as a train on a known grid."""
    options = choice.options._replace(tolerance=FINER * choice.options.tolerance)
    v = cross(choice.grid, function, choice.control, options, prepared.system.periods, choice.ranks).train
    if not v.mass > 0 or not math.isfinite(v.mass):
        raise Unresolved(f"a density has mass {v.mass:.1g} on a grid of another run")
    return v
