"""How long the decisions about a system take, and whether any contradicts values in 60 digits.

    python benchmarks/decisions.py [--count 100] [--formulas 2000]

Random Yau systems with coefficients in time, systems that are none, and Yau systems broken in one term; then the gallery, full
moving covariances, linear systems and rings; then random formulas.  Times are CPU seconds of `zakai.analyze` in one process.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import sympy as sp

import zakai

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from algebra.random_formulas import formula, values, zero  # noqa: E402
from zakai.algebra.identities import is_zero  # noqa: E402

T = sp.Symbol("t", real=True)


def model(drift: list, G: list, h: list, kind: str) -> zakai.Model:
    n = len(drift)
    return zakai.Model(
        state=[f"x{i + 1}" for i in range(n)],
        drift=drift,
        process_noise=G,
        observation=h,
        observation_kind=kind,
        prior={"kind": "gaussian", "mean": [0] * n, "cov": np.eye(n).tolist()},
    )


def states(n: int) -> tuple[sp.Symbol, ...]:
    return sp.symbols(f"x1:{n + 1}", real=True)


def yau_systems(seed: int, count: int, broken: bool = False) -> Iterator[zakai.Model]:
    rng = random.Random(seed)
    for _ in range(count):
        x = states(rng.randint(1, 3))
        n = len(x)

        def number() -> sp.Expr:
            return sp.Rational(rng.randint(-9, 9), rng.choice([2, 3, 4, 5, 7]))

        def moving() -> sp.Expr:
            return number() * rng.choice([1, sp.sin(T / 2), sp.cos(T / 3), 1 + T / 10, sp.exp(-T / 5), 1 / (1 + T**2)])

        G = sp.Matrix(n, n, lambda i, j: 2 + sp.sin(T + i) / 4 if i == j else sp.Rational(1, 5))
        u = sum(moving() * s for s in x) + x[0] / 3
        phi = rng.choice(
            [sp.log(sp.cosh(u)), sp.sin(u), u**3 / 5, sp.log(1 + u**2), u * sp.atan(u) - sp.log(1 + u**2) / 2, sp.exp(u)]
        )
        drift = [
            sum(moving() * s for s in x) + moving() + sum(G[i, j] * sp.diff(phi, s) for j, s in enumerate(x)) for i in range(n)
        ]
        if broken:
            drift[0] += rng.choice([x[-1] ** 2 / 20, sp.sin(x[-1]) / 1000, x[-1] ** 3 * sp.sin(T) / 20])
        h = [rng.choice([x[0], x[-1] * (1 + T), x[0] ** 2, sp.sin(x[-1])])]
        yield model(drift, G.tolist(), h, rng.choice(["increments", "samples"]))


def other_systems(seed: int, count: int) -> Iterator[zakai.Model]:
    """Systems whose drift is a random formula of the grammar."""
    rng = random.Random(seed)
    x, y = states(2)
    old = sp.symbols("x y a", real=True)
    for _ in range(count):
        drift = [formula(rng, 2).xreplace(dict(zip(old, (x, y, sp.Rational(1, 3))))) for _ in range(2)]
        yield model([-x + drift[0], -y + drift[1]], [[1, 0], [0, 2 + sp.sin(T)]], [x], "increments")


def gallery() -> Iterator[zakai.Model]:
    return (zakai.load_model(f"gallery:{name}") for name in zakai.gallery.names())


def large_systems() -> Iterator[zakai.Model]:
    for n in (2, 4, 6):
        x = states(n)
        G = sp.Matrix(n, n, lambda i, j: 2 + sp.sin(T + i) if i == j else sp.cos(T / (min(i, j) + 2)) / (5 + i + j))
        p = [sp.cos(T / (i + 2)) + sp.Rational(i, 3) for i in range(n)]
        slope = sp.tanh(sum(a * s for a, s in zip(p, x)))
        yield model([-x[i] + sum(G[i, j] * p[j] for j in range(n)) * slope for i in range(n)], G.tolist(), [x[0]], "increments")
    for n in (10, 20):
        x, rng = states(n), random.Random(n)
        drift = [sum(sp.Rational(rng.randint(-9, 9), 7) * sp.cos(T / 3 + j) * x[j] for j in range(n)) for _ in range(n)]
        G = sp.Matrix(n, n, lambda i, j: 3 + sp.sin(T) if i == j else sp.cos(T) / 5 if abs(i - j) == 1 else 0)
        yield model(drift, G.tolist(), [x[0] * (1 + T)], "increments")
    x = states(40)
    drift = [sp.sin(x[(i + 1) % 40] - x[i]) + sp.sin(x[i - 1] - x[i]) for i in range(40)]
    yield model(drift, sp.eye(40).tolist(), [x[0]], "increments")


def print_times(name: str, systems: Iterator[zakai.Model]) -> None:
    spent, yau, recommended = [], 0, 0
    for one in systems:
        began = time.process_time()
        analysis = zakai.analyze(one)
        spent.append(time.process_time() - began)
        yau, recommended = yau + (analysis.yau_form is not None), recommended + (analysis.recommended is not None)
    print(
        f"{name:<36} {len(spent):4} systems, {yau:4} of Yau form, {recommended:4} with a method: "
        f"median {np.median(spent):.3f} s, largest {max(spent):.3f} s",
        flush=True,
    )


def print_formulas(count: int) -> None:
    answers, false, slowest = {True: 0, False: 0, None: 0}, 0, 0.0
    for seed in range(count // 2):
        rng = random.Random(10_000 + seed)
        for e, is_identity in ((zero(rng), True), (formula(rng), False)):
            began = time.process_time()
            answer = is_zero(e)
            slowest = max(slowest, time.process_time() - began)
            answers[answer] += 1
            found = values(e)
            proved_falsely = answer is True and any(value > 1e-40 for value in found)
            refuted_falsely = answer is False and (is_identity or (found and all(value < 1e-50 for value in found)))
            if proved_falsely or refuted_falsely:
                false += 1
                print(f"false answer {answer}: {e}")
    words = f"{answers[True]} zero, {answers[False]} not, {answers[None]} undecided"
    print(f"formulas: {words}; {false} false; largest {slowest:.3f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="random systems of each kind")
    parser.add_argument("--formulas", type=int, default=2000, help="random formulas")
    arguments = parser.parse_args()
    print_times("gallery", gallery())
    print_times("Yau systems", yau_systems(1, 2 * arguments.count))
    print_times("Yau systems broken in one term", yau_systems(2, arguments.count, broken=True))
    print_times("random drifts", other_systems(3, arguments.count))
    for index, one in enumerate(large_systems()):
        print_times(f"large {index}: n = {one.n}", iter([one]))
    print_formulas(arguments.formulas)
