"""Does a product of exponentials solve its equation?  By SymPy's derivatives, at random points.

    sigma_t = (1/2 G:Hess - f.grad - div f - 1/2 h'S^-1 h + h'S^-1 dy/dt) sigma,      sigma = exp(r_d E_d) ... exp(r_1 E_1) v

with v_t = L_0 v.  Each E is a.D + b(x) with constant a, or a function, so that sigma = exp(M(x)) v(x + A):

    exp(s (a.D + b)) phi(x) = exp( integral_0^s (b - a.g)(x + a tau) dtau ) phi(x + s a)
"""

from __future__ import annotations

import random

import sympy as sp
from mpmath import mp


def residuals(model, equations, robust: bool, values=None, points: int = 2) -> list:
    """The difference of the equation's two sides at random points, in 100 digits, with v and its derivatives random too.

    values: of the parameters; random otherwise.  Undetermined functions are taken to be sin(u) + u/3 of the sum u of their
    arguments.
    """
    rng, x = random.Random(1964), sp.Matrix(model.x)
    n, tau = len(x), sp.Dummy("tau", real=True)

    def concrete(matrix: sp.MatrixBase) -> sp.Matrix:
        for name in model.functions:
            gamma = sp.Function(name, real=True)
            matrix = matrix.replace(
                lambda e, gamma=gamma: getattr(e, "func", None) == gamma, lambda e: sp.sin(sum(e.args)) + sum(e.args) / 3
            )
        return sp.Matrix(matrix).doit()

    f, h = concrete(model.drift), concrete(model.observation)
    G, S = sp.Matrix(model.covariance), sp.Matrix(model.observation_noise)
    regular = sp.cancel(G.det()) != 0
    g = G.inv() * f if regular else sp.zeros(n, 1)

    M, A = sp.Integer(0), sp.zeros(n, 1)
    for s, element in zip(equations.statistics, equations.basis[1:], strict=True):
        D = [sp.Symbol(f"D{i + 1}", commutative=False) for i in range(n)]
        a = sp.Matrix([sp.expand(element).coeff(D_i) for D_i in D])
        b = sp.expand(element).subs(dict.fromkeys(D, 0))
        moved = dict(zip(x, x + tau * a))
        weight = (b - (a.T * g)[0]).subs(moved, simultaneous=True)
        M = M.subs(moved, simultaneous=True).subs(tau, s) + sp.integrate(sp.expand(weight), (tau, 0, s))
        A = A + s * a

    rates = dict(equations.robust if robust else equations.stratonovich)
    y, dy = sp.Matrix(equations.path), sp.Matrix(equations.rates)
    if robust:
        M = M + (h.T * S.inv() * y)[0]
        rates |= dict(zip(y, dy))
    v = sp.Symbol("v")
    dv = sp.Matrix(n, 1, lambda i, _: sp.Symbol(f"v_{i}"))
    ddv = sp.Matrix(n, n, lambda i, j: sp.Symbol(f"v_{min(i, j)}{max(i, j)}"))
    dM = sp.Matrix([sp.diff(M, x_i) for x_i in x])
    potential = sum(sp.diff(f_i, x_i) for f_i, x_i in zip(f, x)) + (h.T * S.inv() * h)[0] / 2

    there = dict(zip(x, x + A))
    left = (G * ddv).trace() / 2 - (f.subs(there, simultaneous=True).T * dv)[0] - potential.subs(there, simultaneous=True) * v
    left += sum(rate * (sp.diff(M, s) * v + (sp.diff(A, s).T * dv)[0]) for s, rate in rates.items())
    second = ddv + dM * dv.T + dv * dM.T + (sp.hessian(M, list(x)) + dM * dM.T) * v
    right = (G * second).trace() / 2 - (f.T * (dv + dM * v))[0] - potential * v + (h.T * S.inv() * dy)[0] * v
    difference = (left - right).subs(values or {})
    free = sorted(difference.free_symbols, key=str)
    evaluate = sp.lambdify(free, difference, "mpmath", dummify=True, cse=True)
    with mp.workdps(100):
        return [evaluate(*(mp.mpf(rng.randint(-60, 60)) / 53 for _ in free)) for _ in range(points)]
