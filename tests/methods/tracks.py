"""A target that moves on a line, for the tests of tensor trains."""

from __future__ import annotations

import numpy as np

import zakai

NAMES = ["px", "py", "vx", "vy"]


def track(**more):
    """Return a target that moves on a line, seen by its position."""
    return zakai.Model(
        state=NAMES, drift=["vx", "vy", "0", "0"], diffusion=[[0, 0], [0, 0], ["sqrt(0.05)", 0], [0, "sqrt(0.05)"]],
        **{
            "observation": ["px", "py"], "observation_kind": "samples", "observation_noise": [[0.09, 0], [0, 0.04]],
            "prior": {"kind": "gaussian", "mean": [8, 4, -0.8, 0.3], "cov": np.diag([4, 4, 0.5, 0.5]).tolist()}, **more,
        },
    )  # fmt: skip
