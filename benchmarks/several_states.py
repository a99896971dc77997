"""Systems of three to six coupled states: `auto` and `tensor-train` against a bootstrap filter in NumPy, error and time.

    python benchmarks/several_states.py [NAME ...] [--particles 100000] [--reference 1000000] [--tolerance 5e-3]

The reference is two runs of the bootstrap filter with many particles; errors are in standard deviations, rms over times and
coordinates.  The bootstrap filter moves particles by half a Runge-Kutta step, noise, and half a step, at most 0.05 long.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np

import zakai
from zakai.models.numeric import numpy_function
from zakai.studies import tracking


def columns(n, entries):
    """Return a diffusion matrix with one column for each {row: value}."""
    return [[value if i == row else 0 for row, value in entries.items()] for i in range(n)]


def system(state, drift, noise, observation, errors, mean, variances, **more):
    """Return a model with samples."""
    return zakai.Model(
        state=state, drift=drift, diffusion=columns(len(state), noise), observation=observation, observation_kind="samples",
        observation_noise=np.diag(errors).tolist(),
        prior={"kind": "gaussian", "mean": mean, "cov": np.diag(variances).tolist()}, **more,
    )  # fmt: skip


def reentry():
    """Height (10 km), speed and the logarithm of the drag of a body that falls; the range from a mast."""
    return system(
        ["h", "v", "b"], ["-v", "0.1 - exp(b - h)*v**2", "0"], {1: 0.03, 2: 0.05}, ["sqrt(4 + h**2)"], [4e-4],
        [4.0, 1.2, 0.0], [0.02, 0.01, 0.15],
    ), times(30, 0.08, 0.25)  # fmt: skip


def robot():
    """A robot with its heading on the circle; range and bearing of a beacon."""
    return system(
        ["px", "py", "a"], ["0.8*cos(a)", "0.8*sin(a)", "0.25"], {0: 0.06, 1: 0.06, 2: 0.35},
        ["sqrt(px**2 + py**2)", "atan2(py, px)"], [0.03, 0.01], [2.5, 1.5, 0.8], [0.4, 0.4, 0.8], periodic=["a"],
    ), times(30, 0.1, 0.4)  # fmt: skip


def duffing():
    """Three coupled Duffing oscillators, of which two positions are seen."""
    x, v = ["x1", "x2", "x3"], ["v1", "v2", "v3"]
    pull = ["0.8*(x2 - x1)", "0.8*(x1 + x3 - 2*x2)", "0.8*(x2 - x3)"]
    forces = [f"x{i} - x{i}**3 - 0.4*v{i} + {p}" for i, p in enumerate(pull, 1)]
    return system([*x, *v], [*v, *forces], {3: 0.4, 4: 0.4, 5: 0.4}, ["x1", "x3"], [0.05, 0.05],
                  [0.5, 0.0, -0.5, 0.0, 0.0, 0.0], [0.2] * 6), times(25, 0.1, 0.35)  # fmt: skip


def squares(n=6):
    """Squares of independent states, filtered as a whole: 2^n modes."""
    return system(
        [f"x{i}" for i in range(n)], [f"-0.2*x{i}" for i in range(n)],
        {i: 0.6 for i in range(n)}, [f"x{i}**2/2" for i in range(n)], [0.25] * n, [0.0] * n, [1.0] * n,
    ), times(25, 0.1, 0.6)  # fmt: skip


def times(count, low, high):
    """Return irregular times."""
    return np.cumsum(np.random.default_rng(11).uniform(low, high, count))


SYSTEMS = {name: lambda model=model: (model(), times(25, 0.1, 0.6)) for name, model in tracking.SYSTEMS.items()}
SYSTEMS |= {f.__name__: f for f in (reentry, robot, duffing, squares)}


def bootstrap(model, record, count, seed, longest=0.05):
    """Return the means, covariances, and the log-likelihood of a bootstrap filter."""
    rng, theta = np.random.default_rng(seed), model.theta()
    f, h = numpy_function(model.drift, model), numpy_function(model.observation, model)
    S = np.diag(np.asarray(model.observation_noise.tolist(), float))
    shape, moving = model.diffusion.shape, bool(model.diffusion.free_symbols & set(model.x))
    g = numpy_function(model.diffusion, model, shape)
    wrapped = np.array(["atan2" in str(part) for part in model.observation])
    x = model.prior.sample(rng, count)
    means, covs, total, t = [], [], 0.0, 0.0
    angles = [i for i, name in enumerate(model.state) if name in model.periodic]

    def half(x, t, d):
        a = f(x, t, theta)
        b = f(x + d / 2 * a, t + d / 2, theta)
        c = f(x + d / 2 * b, t + d / 2, theta)
        return x + d / 6 * (a + 2 * b + 2 * c + f(x + d * c, t + d, theta))

    for stop, z in zip(record.times, record.values, strict=True):
        steps = max(1, math.ceil((stop - t) / longest))
        d = (stop - t) / steps
        for i in range(steps):
            x = half(x, t + i * d, d / 2)
            noise = math.sqrt(d) * rng.standard_normal((count, shape[1]))
            if moving:  # Ito, by Milstein's step for one field a state: g w + g g' (w^2 - d) / 2
                a = g(x, t, theta)
                up = x + 1e-4 * np.einsum("pij,pj->pi", a, np.ones_like(noise))
                slope = (g(up, t, theta) - a) / 1e-4
                x = x + np.einsum("pij,pj->pi", a, noise) + 0.5 * np.einsum("pij,pj->pi", slope, noise**2 - d)
            else:
                x = x + noise @ g(x[:1], t, theta)[0].T
            x = half(x, t + (i + 0.5) * d, d / 2)
        t = stop
        apart = z - h(x, t, theta)
        apart = np.where(wrapped, (apart + np.pi) % (2 * np.pi) - np.pi, apart)
        logs = -0.5 * (apart**2 / S).sum(axis=1)
        top = logs.max()
        w = np.exp(logs - top)
        total += math.log(w.mean()) + top - 0.5 * np.log(2 * np.pi * S).sum()
        w /= w.sum()
        mean = w @ x
        for i in angles:
            mean[i] = np.angle(w @ np.exp(1j * x[:, i]))
        e = x - mean
        e[:, angles] = (e[:, angles] + np.pi) % (2 * np.pi) - np.pi
        means.append(mean)
        covs.append((e * w[:, None]).T @ e)
        x = x[np.minimum(np.searchsorted(np.cumsum(w), (rng.random() + np.arange(count)) / count), count - 1)]
    return np.array(means), np.array(covs), total


def reference(name, model, record, count):
    """Return the mean of two runs with many particles, and half of their difference, kept in a file."""
    key = hashlib.sha256(record.values.tobytes()).hexdigest()[:8]
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"several-{name}-{count}-{key}.npz"
    if not path.exists():
        one, two = (bootstrap(model, record, count, seed) for seed in (101, 102))
        np.savez(path, mean=(one[0] + two[0]) / 2, cov=(one[1] + two[1]) / 2, log=(one[2] + two[2]) / 2,
                 apart=np.abs(one[0] - two[0]) / 2, logs=abs(one[2] - two[2]) / 2)  # fmt: skip
    return np.load(path)


def errors(mean, cov, known, model):
    """Return the rms and the largest error of means, and the largest of deviations."""
    sd = np.sqrt(np.einsum("kii->ki", known["cov"]))
    e = mean - known["mean"]
    for i, name in enumerate(model.state):
        if name in model.periodic:
            e[:, i] = (e[:, i] + np.pi) % (2 * np.pi) - np.pi
    e = np.abs(e) / sd
    s = np.abs(np.sqrt(np.einsum("kii->ki", cov)) / sd - 1)
    return f"mean rms {np.sqrt((e**2).mean()):.1e} max {e.max():.1e}, sd max {s.max():.1e}"


def main():
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=list(SYSTEMS))
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--reference", type=int, default=1_000_000)
    parser.add_argument("--tolerance", type=float, nargs="*", default=[None])
    args = parser.parse_args()
    for name in args.names:
        model, when = SYSTEMS[name]()
        _, record = zakai.simulate(model, when, seed=5)
        known = reference(name, model, record, args.reference)
        sd = np.sqrt(np.einsum("kii->ki", known["cov"]))
        spread = np.sqrt(((known["apart"] / sd) ** 2).mean())
        print(f"{name} ({model.n}): reference +- {spread:.1e} sd, {known['logs']:.2f} log", flush=True)
        for method, tolerance in [("auto", None), *(("tensor-train", tolerance) for tolerance in args.tolerance)]:
            took = []
            for _ in range(3):
                begin = time.process_time()
                result = zakai.filter(model, record, method, **({} if tolerance is None else {"tolerance": tolerance}))
                took.append(1e3 * (time.process_time() - begin) / len(when))
            words = errors(result.mean[1:], result.cov[1:], known, model)
            health = {key: float(np.nanmax(np.asarray(value))) for key, value in result.health.items()}
            figures = ", ".join(f"{key} {value:.2g}" for key, value in health.items())
            apart = result.log_likelihood - known["log"]
            print(f"  {result.method} {tolerance}: {took[0]:.1f} then {min(took[1:]):.1f} ms, {words}, log {apart:+.3f}")
            print(f"    {figures}\n    {result.warnings}", flush=True)
        if args.particles:
            begin = time.process_time()
            mean, cov, total = bootstrap(model, record, args.particles, 7)
            took = 1e3 * (time.process_time() - begin) / len(when)
            words = errors(mean, cov, known, model)
            print(f"  {args.particles} particles: {took:.1f} ms, {words}, log {total - known['log']:+.3f}", flush=True)


if __name__ == "__main__":
    main()
