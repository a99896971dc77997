"""The systems on which the filters of other libraries are tried."""

from __future__ import annotations

from typing import Any

import numpy as np

import zakai

LINEAR: dict[str, Any] = dict(
    state=["x", "v"],
    drift=["v", "-2*x - v/2 + sin(t)"],
    diffusion=[["1/2", "0"], ["0", "1 + t/10"]],
    observation=["x", "v - x/2"],
    observation_noise=[["1/4", "1/8"], ["1/8", "1/5"]],
    prior={"kind": "gaussian", "mean": [0.4, -0.2], "cov": [[0.6, 0.1], [0.1, 0.4]]},
)
SPIRAL: dict[str, Any] = dict(
    state=["x"],
    drift=["t*x/40"],
    observation=["x*sin(x)", "x*cos(x)"],
    observation_noise=[["1/2", "1/8"], ["1/8", "1/3"]],
    prior={"kind": "gaussian", "mean": [0.3], "cov": [[0.5]]},
)
# One number of particles and members, for which the loop of a system is compiled once.
FEW: dict[str, dict[str, int]] = {"particle": {"particles": 100}, "enkf": {"members": 100}}


def linear(kind: str) -> zakai.Model:
    return zakai.Model(observation_kind=kind, **LINEAR)


def spiral(kind: str) -> zakai.Model:
    return zakai.Model(observation_kind=kind, **SPIRAL)


def record_of(model: zakai.Model, times: np.ndarray, seed: int = 0, gaps: bool = False) -> zakai.Record:
    record = zakai.simulate(model, times, seed=seed)[1]
    values = record.values.copy()
    if gaps:
        values[2] = np.nan
        values[4, 0] = np.nan
        values[7, -1] = np.nan
    return zakai.Record(record.times, values, model.observation_kind)
