"""Results of filtering runs that need no filter: random walks whose posterior is known in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import sympy

from zakai.algebra.conditions import Condition
from zakai.densities import GaussianMixture
from zakai.models.prior import GaussianPrior


def fake_model(state=("x",), periodic=(), kind="increments", name="A random walk"):
    x = tuple(sympy.Symbol(s, real=True) for s in state)
    t, a = sympy.Symbol("t", real=True), sympy.Symbol("a", real=True)
    n = len(x)
    drift = [t * x[0] / 40 - a * sympy.tanh(x[0]), *[x[0] - x[i] / 3 for i in range(1, n)]]
    observation = [sympy.cos(x[0]), sympy.sin(x[0])] if periodic else [x[0] * sympy.sin(x[0] ** 2 / 2)]
    m = len(observation)
    prior = GaussianPrior(np.full(n, 0.1), 3.0 * np.eye(n))
    return SimpleNamespace(
        name=name, state=tuple(state), x=x, t=t, n=n, m=m, parameters={"a": sympy.Rational(1, 2)},
        parameter_symbols=(a,), drift=sympy.ImmutableMatrix(drift),
        diffusion=sympy.ImmutableMatrix(sympy.eye(n)),
        process_noise=sympy.ImmutableMatrix(sympy.eye(n)) * (1 + t**2 / 9),
        observation=sympy.ImmutableMatrix(observation),
        observation_noise=sympy.ImmutableMatrix(sympy.eye(m)) * sympy.Rational(1, 10),
        observation_kind=kind, start=0.0, observation_family=("gaussian",) * m, log_density=None, domain={},
        cross_noise=sympy.zeros(n, m),
        periodic=tuple(periodic), functions=(), prior=prior,
        text='name = "A random walk"\nstate = ["x"]\n', source="fake",
    )  # fmt: skip


def fake_result(
    observations=300,
    state=("x",),
    periodic=(),
    densities=True,
    seed=0,
    peaks=False,
    step=0.15,
    warnings=(),
    **model,
):
    """(result, truth): a random walk, its posterior spread swelling and shrinking, and figures of health."""
    random = np.random.default_rng(seed)
    n, count = len(state), observations + 1
    times = np.linspace(0.0, 0.1 * observations, count)
    deviation = 0.25 + 0.2 * np.sin(np.linspace(0, 12, count)) ** 2
    deviation = np.concatenate([[1.7], deviation[1:]])[:, None] * np.ones(n)
    truth = np.cumsum(step * random.standard_normal((count, n)), axis=0)
    mean = truth + deviation * random.standard_normal((count, n)) * np.where(np.arange(count) > 0, 0.8, 0.1)[:, None]
    angles = tuple(i for i, s in enumerate(state) if s in periodic)
    for i in angles:
        truth[:, i], mean[:, i] = np.angle(np.exp(1j * truth[:, i])), np.angle(np.exp(1j * mean[:, i]))
    variance = deviation**2
    increments = np.concatenate([[0.0], 0.4 - random.gamma(1.0, 0.7, observations)])

    def density(k):
        if not densities:
            raise AssertionError("the densities were not kept")
        away = 0.9 * deviation[k] if peaks else np.zeros(n)
        spread = np.diag((0.19 if peaks else 1.0) * variance[k])
        means, covs = np.stack([mean[k] - away, mean[k] + away]), np.stack([spread, spread])
        return GaussianMixture(np.full(2, 0.5), means, covs, tuple(state), tuple(s in periodic for s in state))

    def condition(holds, text):
        return Condition(text, holds, "q = x**2 + 1", "CLY (12)")

    result = SimpleNamespace(
        times=times, mean=mean, variance=variance, log_likelihood=float(increments.sum()),
        log_likelihood_increments=increments, method="limited-direct", attributes={"exactness": "exact in its class"},
        state=tuple(state), bounds={},
        warnings=list(warnings),
        health={
            "edge_mass": np.concatenate([[0.0], 10.0 ** random.uniform(-17, -12, observations)]),
            "std_in_spacings": 2.6 + 0.5 * random.standard_normal(count) ** 2,
            "discarded_mass": np.zeros(count),
        },
        why="f = L x + l + G grad phi with q quadratic: Theorem 3 holds; the cheapest exact method.",
        conditions={
            "limited-direct": (
                condition(True, "The drift has the Yau form"),
                condition(True, "q is quadratic"),
            ),
            "kalman-bucy": (condition(False, "h is affine in x"), condition(True, "f is affine in x")),
            "yau-yau": (condition(None, "h grows slower than x**2"),),
        },
        model=fake_model(state, periodic, **model), record=None, density=density, has_densities=densities,
    )  # fmt: skip
    return result, truth
