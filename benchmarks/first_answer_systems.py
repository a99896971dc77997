"""The systems of `first_answer.py`: those of the gallery with a prior, and fifteen others.

Each is a model and, written again, NumPy functions that share no code with zakai: `drift(x, t)` and `observation(x, t)` take the
columns of x (n, N) and give rows, `root` (n, r) is the diffusion with the root of the process noise, or a function of x and t
that returns it (n, r, N), `noise(t)` (m, m) is that of the observations, `prior(rng, N)` draws (N, n). `law(z, x)` is the log
density (N,) of a sample that is not Gaussian, up to a constant; `inputs(t)` are the inputs from t to the next time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import zakai


def gaussian(mean: list[float], cov: Any) -> Callable[..., np.ndarray]:
    """Return the sampler of a Gaussian; `cov` is a matrix or the variances."""
    cov = np.diag(cov) if np.ndim(cov) == 1 else np.asarray(cov)
    return lambda rng, count: rng.multivariate_normal(mean, cov, count, method="cholesky")


@dataclass(frozen=True)
class System:
    """A system; `model` are the keys of a model, or the name of one in the gallery."""

    model: dict[str, Any] | str
    drift: Callable[..., Any]
    observation: Callable[..., Any]
    root: Any
    prior: Callable[..., np.ndarray]
    noise: Callable[[float], Any] = lambda t: [[1.0]]
    law: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    inputs: Callable[[float], list[float]] | None = None
    angles: tuple[int, ...] = ()
    mean_step: float = 0.05
    irregular: bool = False
    missing: float = 0.0
    substep: float = 0.01
    count: int = 200

    def times(self, seed: int = 1) -> np.ndarray:
        """Return the times of the observations (K,); the seed is that of irregular ones."""
        if not self.irregular:
            return self.mean_step * np.arange(1, self.count + 1)
        gaps = np.random.default_rng(seed).exponential(self.mean_step, self.count)
        return np.cumsum(np.maximum(gaps, self.mean_step / 50))

    def loaded(self) -> zakai.Model:
        """Return the model."""
        return zakai.load_model(f"gallery:{self.model}") if isinstance(self.model, str) else zakai.Model(**self.model)

    def record(self, model: zakai.Model, times: np.ndarray, seed: int) -> zakai.Record:
        """Return a record of a model that is simulated, with missing values."""
        inputs = None
        if self.inputs is not None:
            starts = np.concatenate([[0.0], times[:-1]])
            inputs = zakai.Inputs(starts, [self.inputs(t) for t in starts])
        _, record = zakai.simulate(model, times, seed=seed, inputs=inputs)
        missing = np.random.default_rng(seed).random(record.values.shape) < self.missing
        return zakai.Record(record.times, np.where(missing, np.nan, record.values), record.kind, inputs=inputs)


def _normal(mean: list[float], cov: list[float]) -> dict[str, Any]:
    return {"kind": "gaussian", "mean": mean, "cov": cov}


def _heating(t: float) -> list[float]:
    """Return the power of the heater, by day, and the temperature outdoors."""
    return [3.0 * float(6.0 <= t % 24.0 < 22.0), 5.0 + 4.0 * np.sin(2 * np.pi * (t - 9.0) / 24.0)]


def _room(x: np.ndarray, t: float) -> list[np.ndarray]:
    heater, outdoor = _heating(t)
    return [(x[1] - x[0]) / 0.5 + (outdoor - x[0]) / 6 + 4 * heater, (x[0] - x[1]) / 8]


def _unit(m: int, size: float = 1.0) -> Callable[[float], Any]:
    return lambda t: size * np.eye(m)


GALLERY = {
    "benes": System("benes", lambda x, t: [np.tanh(x[0])], lambda x, t: [x[0]], [[1]], gaussian([0], [1])),
    "benes-2d": System(
        "benes-2d", lambda x, t: [np.tanh(x[0] + x[1])] * 2, lambda x, t: [x[0], x[1]], np.eye(2), gaussian([0, 0], [1, 1]),
        _unit(2),
    ),
    "counted-events": System(
        "counted-events", lambda x, t: [-0.2 * x[0]], lambda x, t: [3 * np.exp(x[0])], [[0.4]], gaussian([0], [0.4]),
        law=lambda z, x: z[0] * x[0] - 3 * np.exp(x[0]), mean_step=0.5, substep=0.05,
    ),
    "cox-ingersoll-ross": System(
        "cox-ingersoll-ross", lambda x, t: [2 - x[0]], lambda x, t: [x[0]], lambda x, t: [[np.sqrt(np.maximum(x[0], 0))]],
        lambda rng, count: rng.gamma(4, 0.5, (count, 1)), _unit(1, 0.04), mean_step=0.1,
    ),
    "cubic-sensor": System(
        "cubic-sensor", lambda x, t: [np.cos(x[0])], lambda x, t: [x[0] ** 3], [[1]], gaussian([0], [0.05]), mean_step=0.01
    ),
    "encoder": System(
        "encoder", lambda x, t: [x[1], -0.2 * x[1]], lambda x, t: [np.cos(x[0]), np.sin(x[0])], np.diag([0.05, 1]),
        gaussian([0, 0], [4, 4]), _unit(2, 0.01), angles=(0,),
    ),
    "falling-body": System(
        "falling-body", lambda x, t: [x[1], 9.81 + 0 * x[1]], lambda x, t: [x[0]], [[0], [1]], gaussian([0, 0], [1, 1]),
        mean_step=0.01, substep=0.001,
    ),
    "geometric-brownian-motion": System(
        "geometric-brownian-motion", lambda x, t: [0.05 * x[0]], lambda x, t: [x[0]], lambda x, t: [[0.3 * x[0]]],
        lambda rng, count: np.exp(0.1 * rng.standard_normal((count, 1))), _unit(1, 0.01), mean_step=0.1,
    ),
    "heated-room": System(
        "heated-room", _room, lambda x, t: [x[0]], np.diag([0.3, 0.09]), gaussian([18, 17], [[4, 3], [3, 4]]), _unit(1, 0.01),
        inputs=_heating, mean_step=0.25, substep=0.005,
    ),
    "kalman-bucy-1d": System("kalman-bucy-1d", lambda x, t: [-0.5 * x[0]], lambda x, t: [x[0]], [[1]], gaussian([0], [1])),
    "kalman-bucy-2d": System(
        "kalman-bucy-2d", lambda x, t: [x[1], -2.25 * x[0] - 0.3 * x[1]], lambda x, t: [x[0]],
        np.linalg.cholesky([[0.1, 0.05], [0.05, 0.5]]), gaussian([1, 0], [[0.5, 0.1], [0.1, 0.5]]), _unit(1, 0.2),
        substep=0.002,
    ),
    "logistic-growth": System(
        "logistic-growth", lambda x, t: [x[0] * (1 - x[0] / 2)], lambda x, t: [20 * x[0]], lambda x, t: [[0.3 * x[0]]],
        lambda rng, count: np.exp(0.5 * rng.standard_normal((count, 1)) - 1),
        law=lambda z, x: z[0] * np.log(np.maximum(x[0], 1e-300)) - 20 * x[0], mean_step=0.1,
    ),
    "lorenz": System(
        "lorenz", lambda x, t: [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]],
        lambda x, t: [x[0]], np.eye(3), gaussian([1, 1, 20], [1, 1, 1]), mean_step=0.02, substep=0.002, count=100,
    ),
    "passive-drift": System(
        "passive-drift",
        lambda x, t: [
            x[0] + x[1] + x[2],
            x[0] - (x[1] + x[2]) / 2 + 1.5 * np.sin(x[1] - x[2]) - 0.3 * (x[1] - x[2]) + 0.5 * np.sin(x[1]) * np.cos(x[2]) + 0.1,
            x[0] - (x[1] + x[2]) / 2 - 1.5 * np.sin(x[1] - x[2]) + 0.3 * (x[1] - x[2]) - 0.5 * np.sin(x[1]) * np.cos(x[2]),
        ],
        lambda x, t: [2 * x[0]], np.eye(3), gaussian([0, 0, 0], [0.1, 0.1, 0.1]), mean_step=0.02, count=100,
    ),
    "pendulum": System(
        "pendulum", lambda x, t: [x[1], -4 * np.sin(x[0]) - 0.2 * x[1]], lambda x, t: [np.sin(x[0])], [[0], [0.8]],
        lambda rng, count: np.stack([rng.vonmises(0, 4, count), 0.5 * rng.standard_normal(count)], axis=1), _unit(1, 0.04),
        angles=(0,), mean_step=0.1,
    ),
    "silent-double-well": System(
        "silent-double-well", lambda x, t: [x[0] - x[0] ** 3], lambda x, t: [0 * x[0]], [[1]], gaussian([0], [1])
    ),
    "spiral-sensor": System(
        "spiral-sensor", lambda x, t: [t / 40 * x[0]], lambda x, t: [x[0] * np.sin(x[0]), x[0] * np.cos(x[0])], [[1]],
        gaussian([0.1], [3]), _unit(2), mean_step=0.01,
    ),
    "stochastic-volatility": System(
        "stochastic-volatility", lambda x, t: [-0.05 * x[0]], lambda x, t: [0 * x[0]], [[0.2]], gaussian([0], [0.4]),
        law=lambda z, x: -0.5 * (z[0] ** 2 * np.exp(-x[0]) + x[0]), mean_step=1.0, substep=0.1,
    ),
    "unobserved-double-well": System(
        "unobserved-double-well", lambda x, t: [x[0] - x[0] ** 3], lambda x, t: [1 + 0 * x[0]], [[1]], gaussian([0], [1])
    ),
    "wind-vane": System(
        "wind-vane", lambda x, t: [0 * x[0]], lambda x, t: [np.cos(x[0]), np.sin(x[0])], [[0.411]],
        lambda rng, count: rng.uniform(-np.pi, np.pi, (count, 1)), _unit(2, 0.128**2), angles=(0,), mean_step=1.0, substep=1.0,
    ),
    "wind-vane-rate": System(
        "wind-vane-rate", lambda x, t: [x[1], -0.5 * x[1]], lambda x, t: [np.cos(x[0]), np.sin(x[0])], np.diag([0.3, 0.1]),
        gaussian([0, 0], [4, 0.05]), _unit(2, 0.04), angles=(0,), mean_step=0.5, substep=0.05,
    ),
    "wright-fisher": System(
        "wright-fisher", lambda x, t: [1 - 2.5 * x[0]], lambda x, t: [x[0]],
        lambda x, t: [[0.8 * np.sqrt(np.maximum(x[0] * (1 - x[0]), 0))]],
        lambda rng, count: rng.beta(3.125, 4.6875, (count, 1)), _unit(1, 0.01), mean_step=0.1,
    ),
}  # fmt: skip

ORDINARY = {
    "logarithm of a population, counted at irregular times": System(
        {
            "state": ["x"], "drift": ["1 - exp(x)"], "process_noise": [["1/10"]], "observation": ["exp(x)"],
            "observation_kind": "samples", "observation_noise": [["1/20"]], "prior": _normal([0.0], [0.3]),
        },
        lambda x, t: [1 - np.exp(x[0])], lambda x, t: [np.exp(x[0])], [[np.sqrt(0.1)]], gaussian([0], [0.3]), _unit(1, 0.05),
        mean_step=0.3, irregular=True, substep=0.02,
    ),
    "double well, irregular samples with gaps": System(
        {
            "state": ["x"], "drift": ["2*(x - x**3)"], "process_noise": [["1/2"]], "observation": ["x"],
            "observation_kind": "samples", "observation_noise": [["1/4"]], "prior": _normal([0.0], [1.0]),
        },
        lambda x, t: [2 * (x[0] - x[0] ** 3)], lambda x, t: [x[0]], [[np.sqrt(0.5)]], gaussian([0], [1]), _unit(1, 0.25),
        mean_step=0.25, irregular=True, missing=0.15, substep=0.01,
    ),
    "saturating sensor": System(
        {
            "state": ["x"], "drift": ["-x"], "observation": ["tanh(3*x)"], "observation_kind": "samples",
            "observation_noise": [["1/25"]], "prior": _normal([0.5], [1.0]),
        },
        lambda x, t: [-x[0]], lambda x, t: [np.tanh(3 * x[0])], [[1]], gaussian([0.5], [1]), _unit(1, 0.04), mean_step=0.2,
        irregular=True, substep=0.02,
    ),
    "sensor of the size (a kink in h)": System(
        {
            "state": ["x"], "drift": ["-x/2"], "observation": ["abs(x)"], "observation_kind": "samples",
            "observation_noise": [["1/25"]], "prior": _normal([0.5], [1.0]),
        },
        lambda x, t: [-x[0] / 2], lambda x, t: [np.abs(x[0])], [[1]], gaussian([0.5], [1]), _unit(1, 0.04), mean_step=0.1,
    ),
    "quadratic friction (a kink in f)": System(
        {
            "state": ["v"], "drift": ["1 - v*abs(v)"], "process_noise": [["1/4"]], "observation": ["v"],
            "observation_kind": "increments", "observation_noise": [["1/10"]], "prior": _normal([0.0], [0.5]),
        },
        lambda x, t: [1 - x[0] * np.abs(x[0])], lambda x, t: [x[0]], [[0.5]], gaussian([0], [0.5]), _unit(1, 0.1),
        mean_step=0.1, irregular=True, missing=0.1,
    ),
    "cubic sensor whose gain and noise vary in time": System(
        {
            "state": ["x"], "drift": ["-x/2 + sin(t)/2"], "observation": ["(1 + cos(3*t)/2)*(x + x**3/10)"],
            "observation_kind": "path", "observation_noise": [["1/5 + 3/20*cos(2*t)"]], "prior": _normal([0.0], [1.0]),
        },
        lambda x, t: [-x[0] / 2 + np.sin(t) / 2], lambda x, t: [(1 + np.cos(3 * t) / 2) * (x[0] + x[0] ** 3 / 10)], [[1]],
        gaussian([0], [1]), lambda t: [[0.2 + 0.15 * np.cos(2 * t)]], mean_step=0.05, irregular=True, missing=0.2,
    ),
    "phase of an oscillator, with gaps": System(
        {
            "state": ["p"], "drift": ["2 + sin(p - t)/2"], "process_noise": [["1/5"]], "observation": ["cos(p)", "sin(p)"],
            "observation_kind": "samples", "observation_noise": [["1/4", "0"], ["0", "1/4"]], "periodic": ["p"],
            "prior": _normal([0.0], [0.5]),
        },
        lambda x, t: [2 + np.sin(x[0] - t) / 2], lambda x, t: [np.cos(x[0]), np.sin(x[0])], [[np.sqrt(0.2)]],
        gaussian([0], [0.5]), _unit(2, 0.25), angles=(0,), mean_step=0.2, irregular=True, missing=0.12, substep=0.02,
    ),
    "tide: linear, with coefficients in time": System(
        {
            "state": ["x", "v"], "drift": ["v", "-(1 + cos(t)/2)*x - v/5 + sin(2*t)"], "diffusion": [["0"], ["1/2"]],
            "observation": ["x"], "observation_kind": "samples", "observation_noise": [["1/10"]],
            "prior": _normal([0.0, 0.0], [1.0, 1.0]),
        },
        lambda x, t: [x[1], -(1 + np.cos(t) / 2) * x[0] - x[1] / 5 + np.sin(2 * t)], lambda x, t: [x[0]], [[0], [0.5]],
        gaussian([0, 0], [1, 1]), _unit(1, 0.1), mean_step=0.2, irregular=True, substep=0.01,
    ),
    "pendulum, both coordinates of its bob, with gaps": System(
        {
            "state": ["a", "w"], "drift": ["w", "-2*sin(a) - w/5"], "diffusion": [["0"], ["1/2"]],
            "observation": ["sin(a)", "cos(a)"], "observation_kind": "samples",
            "observation_noise": [["1/25", "0"], ["0", "1/25"]], "periodic": ["a"], "prior": _normal([0.5, 0.0], [0.2, 0.2]),
        },
        lambda x, t: [x[1], -2 * np.sin(x[0]) - x[1] / 5], lambda x, t: [np.sin(x[0]), np.cos(x[0])], [[0], [0.5]],
        gaussian([0.5, 0], [0.2, 0.2]), _unit(2, 0.04), angles=(0,), mean_step=0.1, irregular=True, missing=0.1,
    ),
    "bearing of a target from a fixed sensor": System(
        {
            "state": ["x", "y"], "drift": ["(3 - x)/2", "(1 - y)/2"], "process_noise": [["1/4", "0"], ["0", "1/4"]],
            "observation": ["atan(y/x)", "sqrt(1 + x**2 + y**2)"], "observation_kind": "samples",
            "observation_noise": [["1/100", "0"], ["0", "1/4"]], "prior": _normal([3.0, 1.0], [0.05, 0.25]),
        },
        lambda x, t: [(3 - x[0]) / 2, (1 - x[1]) / 2],
        lambda x, t: [np.arctan(x[1] / x[0]), np.sqrt(1 + x[0] ** 2 + x[1] ** 2)], 0.5 * np.eye(2),
        gaussian([3, 1], [0.05, 0.25]), lambda t: np.diag([0.01, 0.25]), mean_step=0.1, missing=0.2, substep=0.02,
    ),
    "predator and prey, logarithms": System(
        {
            "state": ["u", "v"], "drift": ["1 - exp(v)", "exp(u) - 1"], "process_noise": [["1/20", "0"], ["0", "1/20"]],
            "observation": ["exp(u)"], "observation_kind": "samples", "observation_noise": [["1/25"]],
            "prior": _normal([0.3, 0.0], [0.1, 0.1]),
        },
        lambda x, t: [1 - np.exp(x[1]), np.exp(x[0]) - 1], lambda x, t: [np.exp(x[0])], np.sqrt(0.05) * np.eye(2),
        gaussian([0.3, 0], [0.1, 0.1]), _unit(1, 0.04), mean_step=0.2, irregular=True,
    ),
    "Van der Pol's oscillator": System(
        {
            "state": ["x", "v"], "drift": ["v", "3/2*(1 - x**2)*v - x"], "diffusion": [["0"], ["1/2"]], "observation": ["x"],
            "observation_kind": "samples", "observation_noise": [["1/10"]], "prior": _normal([0.0, 0.0], [1.0, 1.0]),
        },
        lambda x, t: [x[1], 1.5 * (1 - x[0] ** 2) * x[1] - x[0]], lambda x, t: [x[0]], [[0], [0.5]],
        gaussian([0, 0], [1, 1]), _unit(1, 0.1), mean_step=0.1,
    ),
    "two wells that drive each other": System(
        {
            "state": ["x", "y"], "drift": ["x - x**3 + y/4", "y - y**3 - x/4"], "process_noise": [["1/2", "0"], ["0", "1/2"]],
            "observation": ["x + y"], "observation_kind": "increments", "observation_noise": [["1/10"]],
            "prior": _normal([0.0, 0.0], [0.5, 0.5]),
        },
        lambda x, t: [x[0] - x[0] ** 3 + x[1] / 4, x[1] - x[1] ** 3 - x[0] / 4], lambda x, t: [x[0] + x[1]],
        np.sqrt(0.5) * np.eye(2), gaussian([0, 0], [0.5, 0.5]), _unit(1, 0.1), mean_step=0.05, irregular=True,
    ),
    "three linear states, each sensor with gaps": System(
        {
            "state": ["x", "y", "z"], "drift": ["-x + cos(t)*y/2", "-y + z/2", "-z/2 + sin(3*t)/2"],
            "process_noise": [["1/4", "0", "0"], ["0", "1/4", "0"], ["0", "0", "1"]], "observation": ["x", "y + z"],
            "observation_kind": "path", "observation_noise": [["1/10", "0"], ["0", "1/10"]],
            "prior": _normal([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
        },
        lambda x, t: [-x[0] + np.cos(t) * x[1] / 2, -x[1] + x[2] / 2, -x[2] / 2 + np.sin(3 * t) / 2],
        lambda x, t: [x[0], x[1] + x[2]], np.diag([0.5, 0.5, 1]), gaussian([0, 0, 0], [1, 1, 1]), _unit(2, 0.1),
        mean_step=0.1, irregular=True, missing=0.3,
    ),
    "unicycle with a known speed": System(
        {
            "state": ["x", "y", "a"], "drift": ["cos(a)", "sin(a)", "1/2"],
            "process_noise": [["1/100", "0", "0"], ["0", "1/100", "0"], ["0", "0", "1/10"]], "observation": ["x", "y"],
            "observation_kind": "samples", "observation_noise": [["1/25", "0"], ["0", "1/25"]], "periodic": ["a"],
            "prior": _normal([0.0, 0.0, 0.0], [0.1, 0.1, 0.5]),
        },
        lambda x, t: [np.cos(x[2]), np.sin(x[2]), 0.5 + 0 * x[2]], lambda x, t: [x[0], x[1]], np.diag([0.1, 0.1, np.sqrt(0.1)]),
        gaussian([0, 0, 0], [0.1, 0.1, 0.5]), _unit(2, 0.04), angles=(2,), mean_step=0.2, substep=0.02, count=100,
    ),
}  # fmt: skip
SYSTEMS = GALLERY | ORDINARY
