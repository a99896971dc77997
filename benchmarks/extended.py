"""Cost of an observation in `extended-kalman-bucy` against a plain EKF loop in NumPy with one Euler step a row.

    python benchmarks/extended.py [rows]

Both run in turns in one process, after a first run that compiles; a figure is the least CPU time of five.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

import zakai

Array = np.ndarray


def spiral(x: Array, t: float) -> tuple[Array, Array, Array, Array]:
    """Return f, df/dx, h and dh/dx of the gallery's spiral sensor."""
    c, s = np.cos(x[0]), np.sin(x[0])
    h, slope = np.array([x[0] * s, x[0] * c]), np.array([[s + x[0] * c], [c - x[0] * s]])
    return t / 40 * x, np.array([[t / 40]]), h, slope


def turning(x: Array, t: float) -> tuple[Array, Array, Array, Array]:
    """Return f, df/dx, h and dh/dx of a coordinated turn with range and bearing."""
    px, py, v, p, w = x
    c, s, r = np.cos(p), np.sin(p), np.hypot(px, py)
    F, H = np.zeros((5, 5)), np.zeros((2, 5))
    F[0, 2], F[0, 3], F[1, 2], F[1, 3], F[3, 4] = c, -v * s, s, v * c, 1.0
    H[0, :2], H[1, :2] = [px / r, py / r], [-py / r**2, px / r**2]
    return np.array([v * c, v * s, 0.0, w, 0.0]), F, np.array([r, np.arctan2(py, px)]), H


def ring(x: Array, t: float) -> tuple[Array, Array, Array, Array]:
    """Return f, df/dx, h and dh/dx of Lorenz' system of 1996 with six states, of which every second is observed."""
    n = len(x)
    after, before, second = np.roll(x, -1), np.roll(x, 1), np.roll(x, 2)
    rows, F = np.arange(n), -np.eye(n)
    F[rows, (rows + 1) % n] += before
    F[rows, (rows - 1) % n] += after - second
    F[rows, (rows - 2) % n] -= before
    H = np.zeros((3, n))
    H[[0, 1, 2], [0, 2, 4]] = 1.0
    return (after - second) * before - x + 8.0, F, x[::2], H


def plain(
    functions: Callable[[Array, float], tuple[Array, Array, Array, Array]],
    model: zakai.Model, record: zakai.Record, G: Array, S: Array, angles: Array,
) -> Array:  # fmt: skip
    """Return the means of an extended Kalman filter with one Euler step a row."""
    x, P, t = np.array(model.prior.mean), np.array(model.prior.cov), model.start
    identity, means = np.eye(len(x)), []
    samples = record.kind == "samples"
    for stop, z in zip(record.times, record.values):
        d = stop - t
        f, F, _, _ = functions(x, t)
        A = identity + d * F
        x, P, t = x + d * f, A @ P @ A.T + d * G, stop
        _, _, h, H = functions(x, t)
        span = 1.0 if samples else d
        r, H = z - span * h, span * H
        r[angles] = np.pi - np.mod(np.pi - r[angles], 2 * np.pi)
        V = H @ P @ H.T + span * S
        K = np.linalg.solve(V, H @ P).T
        x, P = x + K @ r, P - K @ V @ K.T
        means.append(x)
    return np.array(means)


def cases(rows: int, irregular: bool) -> dict[str, tuple]:
    """Return the models, their times, and the matrices of the plain filter."""
    rng = np.random.default_rng(1)
    steps = rng.uniform(0.5, 1.5, rows) if irregular else np.ones(rows)
    turn = zakai.Model(
        state=["x", "y", "v", "p", "w"], drift=["v*cos(p)", "v*sin(p)", "0", "w", "0"],
        diffusion=[[0, 0], [0, 0], [0.05, 0], [0, 0], [0, 0.02]],
        observation=["sqrt(x**2 + y**2)", "atan2(y, x)"], observation_kind="samples", observation_noise=[[0.01, 0], [0, 0.0004]],
        prior={"kind": "gaussian", "mean": [-5, 3, 1, -1.5, 0.4], "cov": [0.1, 0.1, 0.04, 0.04, 0.01]},
    )  # fmt: skip
    names = [f"x{i}" for i in range(6)]
    lorenz = zakai.Model(
        state=names, drift=[f"({names[(i + 1) % 6]} - {names[i - 2]})*{names[i - 1]} - {names[i]} + 8" for i in range(6)],
        observation=names[::2], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [8.0, 8.1, 7.9, 8, 8, 8], "cov": [0.1] * 6},
    )  # fmt: skip
    none = np.array([False, False])
    return {
        "spiral sensor, 1 state, increments": (
            zakai.load_model("gallery:spiral-sensor"), 0.005 * steps, spiral, np.eye(1), np.eye(2), none,
        ),
        "coordinated turn, 5 states, samples": (
            turn, 0.05 * steps, turning, np.diag([0, 0, 0.05**2, 0, 0.02**2]), np.diag([0.01, 0.0004]), np.array([False, True]),
        ),
        "Lorenz 1996, 6 states, samples": (lorenz, 0.01 * steps, ring, np.eye(6), np.eye(3), np.zeros(3, bool)),
    }  # fmt: skip


def cost(run: Callable[[], object]) -> float:
    """Return the CPU seconds of a run."""
    start = time.process_time()
    run()
    return time.process_time() - start


def main() -> None:
    """Print a line for each model and kind of times."""
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    print(f"{rows} rows; us an observation: extended-kalman-bucy, a loop in NumPy, their ratio; largest distance in deviations")
    for irregular in (False, True):
        for name, (model, steps, *others) in cases(rows, irregular).items():
            _, record = zakai.simulate(model, np.cumsum(steps), seed=3, substeps=4)
            functions, *matrices = others
            own, other = [], []
            for _ in range(6):
                own.append(cost(partial(zakai.filter, model, record, "extended-kalman-bucy")))
                other.append(cost(partial(plain, functions, model, record, *matrices)))
            found = zakai.filter(model, record, "extended-kalman-bucy")
            apart = np.abs(found.mean[1:] - plain(functions, model, record, *matrices)) / np.sqrt(found.variance[1:])
            a, b = (1e6 * min(times[1:]) / rows for times in (own, other))
            kind = "irregular" if irregular else "regular"
            print(f"{name}, {kind:9s} {a:8.1f} {b:8.1f} {a / b:6.2f} {np.median(apart.max(axis=1)):8.3f}")


if __name__ == "__main__":
    main()
