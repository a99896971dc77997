"""Random systems of three to five states: is the error of `tensor-train` within three times its estimate, particles as judge?

    python benchmarks/random_space.py [--states 3 4 5] [--count 20] [--first 0] [--particles 100000] [--tolerance 5e-3]

Each system has a random stable linear part, random couplings (polynomial, trigonometric, saturating), noise on some states (on
one of them it may depend on the state), and one or two random sensors at irregular times with a gap.  The judge is the mean of
three runs of a bootstrap filter, with its standard error by their differences.  Where the error seems larger, the judge is asked
again with eight times as many particles: three runs know their own error only roughly.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np
import several_states

import zakai


def system(n, seed):
    """Return a random model and its record."""
    rng = np.random.default_rng(1000 * n + seed)
    x = [f"x{i}" for i in range(n)]

    def u(low, high):
        return f"{rng.uniform(low, high):.3f}"

    def coupling(a, b):
        return str(rng.choice([
            f"{u(-1, 1)}*sin({u(0.5, 2)}*{a})", f"{u(-1, 1)}*tanh({a})", f"{u(-0.8, 0.8)}*{a}",
            f"{u(-1, 1)}*{a}*{b}/(1 + {a}**2)", f"{u(-1, 1)}*cos({b})", f"{u(-0.5, 0.5)}*{a}*exp(-{b}**2)",
        ]))  # fmt: skip

    drift = []
    for i in range(n):
        parts = [f"-{u(0.2, 1.2)}*x{i}" if rng.random() < 0.7 else f"{u(0.2, 1)}*x{i} - {u(0.2, 0.6)}*x{i}**3"]
        parts += [coupling(*rng.choice(x, 2)) for _ in range(rng.integers(1, 3))]
        drift.append(" + ".join(parts))
    noisy = [i for i in range(n) if rng.random() < 0.7] or [0]
    noise = {i: u(0.2, 0.8) for i in noisy}
    if rng.random() < 0.2:
        noise[noisy[0]] += f"*sqrt(1 + 0.5*x{noisy[0]}**2)"
    m = int(rng.integers(1, 3))
    a, b = rng.choice(x, 2, replace=False)
    sensors = [
        f"{a}", f"{a}**2/2", f"sqrt(({a} - 2)**2 + {b}**2)", f"atan2({b} + 2, {a} + 3)", f"{a}*{b}", f"tanh({a}) + {b}",
        f"{a} + {b}", f"sin({u(0.5, 1.5)}*{a})",
    ]  # fmt: skip
    chosen = [str(h) for h in rng.choice(sensors, m, replace=False)]
    errors = [float(f"{10 ** rng.uniform(-2, 0):.4f}") for _ in range(m)]
    mean, variances = [float(u(-0.7, 0.7)) for _ in range(n)], [float(u(0.1, 0.8)) for _ in range(n)]
    model = several_states.system(x, drift, noise, chosen, errors, mean, variances)
    times = np.cumsum(rng.uniform(0.1, 0.5, 8))
    times[5:] += 0.8
    _, record = zakai.simulate(model, times, seed=seed)
    return model, record


def main():
    """Print a line for each system and a sum."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--states", type=int, nargs="*", default=[3, 4, 5])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--tolerance", type=float, default=5e-3)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    silent = warned = 0
    for seed in range(args.first, args.first + args.count):
        n = args.states[seed % len(args.states)]
        model, record = system(n, seed)
        begin = time.process_time()
        result = zakai.filter(model, record, "tensor-train", tolerance=args.tolerance)
        took = 1e3 * (time.process_time() - begin) / len(record.times)
        for count in (args.particles, 8 * args.particles):
            runs = [several_states.bootstrap(model, record, count, 10 + i) for i in range(3)]
            mean, cov = np.mean([run[0] for run in runs], axis=0), np.mean([run[1] for run in runs], axis=0)
            sd = np.sqrt(np.einsum("kii->ki", cov))
            judge = (np.std([run[0] for run in runs], axis=0, ddof=1) / np.sqrt(3) / sd).max(axis=1)
            error = np.abs((result.mean[1:] - mean) / sd).max(axis=1)
            wrong = bool((~(error <= 3 * result.error_estimate[1:] + 4 * judge)).any())
            if not wrong or result.warnings:
                break
        silent += wrong and not result.warnings
        warned += bool(result.warnings)
        logs = np.array([run[2] for run in runs])
        print(f"{seed} n = {n}: {took:.0f} ms, error {np.max(error):.3f}, estimate {np.max(result.error_estimate[1:]):.4f}, "
              f"judge {judge.max():.3f}, log {result.log_likelihood - logs.mean():+.3f} +- {logs.std(ddof=1) / np.sqrt(3):.3f}, "
              f"rank {np.nanmax(np.asarray(result.health['rank'])):.0f}"
              f"{' WRONG' if wrong else ''} {[w[:90] for w in result.warnings]}", flush=True)  # fmt: skip
    print(f"{args.count} systems: {silent} with a silent error, {warned} with a warning")


if __name__ == "__main__":
    main()
