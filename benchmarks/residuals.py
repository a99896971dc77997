"""Residuals of 20 records: uniform for the true model, and for the model with half the noise not.

    python benchmarks/residuals.py
"""

import numpy as np
from scipy.stats import kstest

import zakai

model = zakai.Model(
    state=["x"], drift=["-x"], observation=["x"], observation_noise=[["s"]], observation_kind="samples", parameters={"s": 1.0},
    prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
)  # fmt: skip
accepted = detected = 0
for seed in range(20):
    _, record = zakai.simulate(model, np.arange(1, 401) / 20, seed=seed)
    true, halved = (zakai.filter(model.with_parameters(s=s), record).residuals()[:, 0] for s in (1.0, 0.5))
    accepted += kstest(true, "uniform").pvalue > 0.05
    detected += kstest(halved, "uniform").pvalue < 0.05
print(f"true model accepted: {accepted} of 20; half the noise detected: {detected} of 20")
