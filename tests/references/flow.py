"""The kernel from the affine Hamiltonian flow, by DOP853: plain, slow, for positive definite G.

d/dt [xi; eta] = [[L, -2 G], [-Q/2, -L']] [xi; eta] + [l; -p/4],
    Phi = [[P11, P12], [P21, P22]] and the forced part (f1, f2):
A = P22 P12^-1,  B = -2 P12^-T,  C = P12^-1 P11,  D = 2 (f2 - A f1),  E = 2 P12^-1 f1,
s = -n/2 log pi - 1/2 log |det P12| + int (1/2 tr L + 1/2 D' G D - l . D - r/2) dt.
"""

from __future__ import annotations

import numpy as np
import sympy
from scipy.integrate import solve_ivp


def flow_kernel(system, start: float, stop: float, nodes: int = 24):
    """A, B, C, D, E, s of the kernel of v over [start, stop], from the system's texts G, L, l, Q, p, r."""
    n, t = system.n, sympy.Symbol("t")
    G, L, l, Q, p = (
        sympy.lambdify(t, sympy.Matrix(sympy.sympify(system.yau[key])), "numpy")
        for key in ("G", "L", "l", "Q", "p")
    )
    r = sympy.lambdify(t, sympy.sympify(system.yau["r"]), "numpy")

    def rate(time: float, flat: np.ndarray) -> np.ndarray:
        generator = np.block([[L(time), -2.0 * G(time)], [-0.5 * Q(time), -L(time).T]])
        result = generator @ flat.reshape(2 * n, 2 * n + 1)
        result[:, -1] += np.concatenate([l(time)[:, 0], -0.25 * p(time)[:, 0]])
        return result.ravel()

    identity = np.hstack([np.eye(2 * n), np.zeros((2 * n, 1))]).ravel()
    points, weights = np.polynomial.legendre.leggauss(nodes)
    points, weights = start + (stop - start) * (points + 1.0) / 2.0, weights * (stop - start) / 2.0
    solution = solve_ivp(
        rate,
        (start, stop),
        identity,
        method="DOP853",
        rtol=1e-13,
        atol=1e-16,
        t_eval=[*points, stop],
        max_step=(stop - start) / nodes,
    )
    if not solution.success:
        raise RuntimeError(solution.message)

    def ends(flat: np.ndarray) -> tuple[np.ndarray, ...]:
        flow = flat.reshape(2 * n, 2 * n + 1)
        inverse = np.linalg.inv(flow[:n, n : 2 * n])
        A = flow[n:, n : 2 * n] @ inverse
        return flow, inverse, A, 2.0 * (flow[n:, -1] - A @ flow[:n, -1])

    flow, inverse, A, D = ends(solution.y[:, -1])
    s = -0.5 * n * np.log(np.pi) - 0.5 * np.linalg.slogdet(flow[:n, n : 2 * n])[1]
    for time, weight, flat in zip(points, weights, solution.y.T):
        d = ends(flat)[3]
        s += weight * (0.5 * np.trace(L(time)) + 0.5 * d @ G(time) @ d - l(time)[:, 0] @ d - 0.5 * r(time))
    return A, -2.0 * inverse.T, inverse @ flow[:n, :n], D, 2.0 * inverse @ flow[:n, -1], s
