"""The solution of a linear-quadratic equation over one interval, as an operator on Gaussians and on grids.

The equation, with every coefficient a function of time,

    v_t = 1/2 G:Hess v - (L x + l e).grad v + (x'Q x + (p e).x + r.e) v,                                   (1)

is driven by inputs e = (1, e_1, ...) (k,) that are constant in an interval.  Its solution over one interval is known without e:

    transition    weigh by exp(-x'Omega x / 2 + (eta e).x + e'C e), move x -> Psi x + b e, add N(0, Gamma)   (2)
    flow          v(t1, c1 + A xi) = exp(kappa + tilt.xi + xi'B xi) (N(0, Sigma) * v(t0, c0 + .))(xi)        (3)

Both are the same operator.  (2) is for Gaussians: it stays bounded over any length, for singular G and Q, and two of them make
one (`compose`).  (3) is for grids: `spread_first` makes a `Flow` of a `Transition`, `motion` its numbers for a centre and inputs.

The characteristics d/dt [xi; eta] = [[L, -2 G], [Q, -L']] [xi; eta] + [l; p/2] e are linear.  With their solution P over an
interval, Psi = P22^-T, Gamma = -P12 P22^-1 / 2, Omega = -2 P22^-1 P21, and A = P11, Sigma = -P11^-1 P12 / 2, B = P11'P21.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zakai.numerics.complex_step import log_determinant

Array = NDArray[Any]


class Coefficients(NamedTuple):
    """The coefficients of equation (1) at J times, for n states and k inputs.

    `matrix` L (J, n, n), `offset` l (J, n, k), `covariance` G (J, n, n), `quadratic` Q (J, n, n), `linear` p (J, n, k),
    `constant` r (J, k).
    """

    matrix: Array
    offset: Array
    covariance: Array
    quadratic: Array
    linear: Array
    constant: Array


class Transition(NamedTuple):
    """The arrays of equation (2).

    `map` Psi (..., n, n), `offset` b (..., n, k), `noise` Gamma (..., n, n), `information` Omega (..., n, n), `vector` eta
    (..., n, k), `constant` C (..., k, k).
    """

    map: Array
    offset: Array
    noise: Array
    information: Array
    vector: Array
    constant: Array


class Flow(NamedTuple):
    """The arrays of equation (3).

    `map` A, `spread` Sigma, `curvature` B, `lift` (..., n, n), `shift` and `push` (..., n, k), `log_volume` log |det A| (...);
    `transition` is the same operator as equation (2), and `log_scale` log |det Psi| (...).
    """

    map: Array
    spread: Array
    curvature: Array
    lift: Array
    shift: Array
    push: Array
    log_volume: Array
    log_scale: Array
    transition: Transition


class Motion(NamedTuple):
    """The numbers of equation (3) for one centre: c1 (n,) `centre`, `tilt` (n,) and kappa `log_mass`."""

    centre: Array
    tilt: Array
    log_mass: Any


Part = TypeVar("Part", Transition, Flow)


def at(whole: Part, index: Any) -> Part:
    """Return the transition or flow of an interval (or of those of a slice)."""
    fields: list[Any] = [at(field, index) if isinstance(field, Transition) else field[index] for field in whole]
    return type(whole)(*fields)


def transposed(matrices: Array) -> Array:
    """Return the transposes of matrices (..., n, m)."""
    return matrices.swapaxes(-1, -2)


def symmetric(matrices: Array) -> Array:
    """Return the symmetric parts of matrices (..., n, n)."""
    return 0.5 * (matrices + transposed(matrices))


def compose(first: Transition, second: Transition) -> Transition:
    """Return `second` after `first`; both may have leading axes.

    With W = (I + Gamma_1 Omega_2)^-1: Psi = Psi_2 W Psi_1, Gamma = Gamma_2 + Psi_2 W Gamma_1 Psi_2',
    Omega = Omega_1 + Psi_1' Omega_2 W Psi_1.
    """
    n = first.map.shape[-1]
    system = np.eye(n) + first.noise @ second.information
    meeting = first.offset + first.noise @ second.vector
    solved = np.linalg.solve(system, np.concatenate([first.map, first.noise, meeting, first.offset], axis=-1))
    inner_map, noise = solved[..., :n], symmetric(solved[..., n : 2 * n])
    k = first.offset.shape[-1]
    met, offset = solved[..., 2 * n : 2 * n + k], solved[..., 2 * n + k :]
    pull = second.vector - second.information @ first.offset
    backward = transposed(inner_map)
    constant = transposed(second.vector) @ offset - 0.5 * transposed(first.offset) @ second.information @ offset
    constant = first.constant + second.constant + symmetric(constant + 0.5 * transposed(second.vector) @ noise @ second.vector)
    constant[..., 0, 0] -= 0.5 * log_determinant(system)
    return Transition(
        second.map @ inner_map,
        second.map @ met + second.offset,
        symmetric(second.noise + second.map @ noise @ transposed(second.map)),
        symmetric(first.information + transposed(first.map) @ second.information @ inner_map),
        first.vector + backward @ pull,
        constant,
    )


def identity(n: int, k: int, count: int) -> Transition:
    """Return `count` transitions that change nothing."""
    square, forced = np.zeros((count, n, n)), np.zeros((count, n, k))
    return Transition(square + np.eye(n), forced, square, square, forced, np.zeros((count, k, k)))


def spread_first(transition: Transition) -> Flow:
    """Return transitions as equation (3); lossy where Psi is nearly singular, as over intervals that are long for the system."""
    n = transition.map.shape[-1]
    backward = transposed(transition.map)
    both = np.linalg.solve(backward, np.concatenate([transition.information, transition.vector], axis=-1))
    lift, push = -0.5 * both[..., :n], 0.5 * both[..., n:]
    matrix = transition.map - 2.0 * transition.noise @ lift
    # A^-1 Gamma Psi^-T is symmetric.
    spread = np.linalg.solve(matrix, transposed(np.linalg.solve(transition.map, transposed(transition.noise))))
    return Flow(
        matrix,
        symmetric(spread),
        symmetric(transposed(matrix) @ lift),
        lift,
        transition.offset - 2.0 * transition.noise @ push,
        push,
        log_determinant(matrix),
        log_determinant(transition.map),
        transition,
    )


def motion(flow: Flow, centre: Array, inputs: Array) -> Motion:
    """Return the numbers of equation (3) of one interval, for a grid centred at `centre` (n,) and inputs e (k,)."""
    own = flow.transition
    costate = flow.lift @ centre + flow.push @ inputs
    log_mass = (
        centre @ (own.vector @ inputs - 0.5 * (own.information @ centre))
        + inputs @ own.constant @ inputs
        - 2.0 * costate @ own.noise @ costate
        - 0.5 * (flow.log_volume + flow.log_scale)
    )
    return Motion(flow.map @ centre + flow.shift @ inputs, 2.0 * transposed(flow.map) @ costate, log_mass)
