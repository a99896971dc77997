"""Random systems, and the same systems in other coordinates."""

from __future__ import annotations

import random

import sympy as sp

from zakai import Model


def polynomial(rng: random.Random, x: list[sp.Symbol], degree: int, terms: int) -> sp.Expr:
    """A sum of random monomials with small whole coefficients."""
    monomials = [sp.prod([rng.choice(x) for _ in range(rng.randint(0, degree))]) for _ in range(terms)]
    return sp.Add(*[rng.randint(-3, 3) * monomial for monomial in monomials])


def polynomial_system(seed: int) -> Model:
    """Up to three states, drift and observations of degree three at most."""
    rng = random.Random(seed)
    x = [sp.Symbol(f"x{i + 1}", real=True) for i in range(rng.randint(1, 3))]
    degree = rng.randint(1, 3)
    return Model(
        state=[s.name for s in x],
        drift=[polynomial(rng, x, degree, rng.randint(0, 4)) for _ in x],
        observation=[polynomial(rng, x, rng.choice([1, 1, 1, 2, 3]), rng.randint(1, 2)) for _ in range(rng.randint(1, 2))],
    )


def conjugated(model: Model, seed: int) -> Model:
    """The model in the coordinates z = T x for a random regular T, its observations mixed, relabelled and scaled."""
    rng = random.Random(seed)
    T, M = regular(rng, model.n), regular(rng, model.m)
    z = sp.Matrix(model.x)
    old = dict(zip(model.x, T.inv() * z))
    order = rng.sample(range(model.m), model.m)
    scale = sp.Rational(rng.randint(1, 5), rng.randint(1, 5))
    h = M * model.observation.subs(old, simultaneous=True)
    S = M * model.observation_noise * M.T / scale**2
    return Model(
        state=model.state,
        drift=T * model.drift.subs(old, simultaneous=True),
        diffusion=T * model.diffusion,
        process_noise=model.process_noise,
        observation=[h[i] for i in order],
        observation_noise=[[S[i, j] for j in order] for i in order],
        functions=model.functions,
        parameters=model.parameters,
    )


def regular(rng: random.Random, size: int) -> sp.Matrix:
    """A random matrix of small whole numbers that has an inverse."""
    while True:
        matrix = sp.Matrix(size, size, lambda i, j: rng.randint(-2, 2))
        if matrix.det() != 0:
            return matrix
