"""Priors of one state with a jump or a kink, against exact transition densities on a dense line."""

from __future__ import annotations

import numpy as np
import pytest

import zakai

LINE = 0.004 * (np.arange(-3000, 3000) + 0.5)  # jumps at 0 and 1 lie between two points
COARSE = np.linspace(-8.0, 8.0, 801)
TIMES, VALUES = [0.1, 0.2, 0.7], [0.2, -0.1, 0.35]
PRIORS = {
    "half a Gaussian": ("-x**2/2 + log(heaviside(x))", np.exp(-(LINE**2) / 2) * (LINE > 0)),
    "exponential": ("-x + log(heaviside(x))", np.exp(-np.abs(LINE)) * (LINE > 0)),
    "uniform": ("log(heaviside(1 - x**2))", 1.0 * (np.abs(LINE) < 1)),
    "Laplace": ("-abs(x)", np.exp(-np.abs(LINE))),
}


def dense(density):
    """Means, deviations and log-likelihood for dx = -x dt + dv, samples of atan(3 x) with variance 0.1."""
    x, rows, total, before = LINE, [], 0.0, 0.0
    for time, value in zip(TIMES, VALUES, strict=True):
        mass = density > 0
        decay = np.exp(before - time)
        variance = (1 - decay**2) / 2
        source, weight = decay * x[mass], density[mass] / density.sum()
        density = np.exp(-0.5 * (COARSE[:, None] - source) ** 2 / variance) @ weight
        x = COARSE
        density = density * np.exp(-0.5 * (value - np.arctan(3 * x)) ** 2 / 0.1) / (2 * np.pi * np.sqrt(0.1 * variance))
        total += np.log(density.sum() * (x[1] - x[0]))
        density /= density.sum()
        mean = density @ x
        rows.append((mean, np.sqrt(density @ (x - mean) ** 2)))
        before = time
    return *np.array(rows).T, total


@pytest.mark.parametrize(("name", "method"), [*((name, "limited-direct") for name in PRIORS), ("uniform", "yau-yau")])
def test_a_jump_of_the_prior_costs_little_and_is_in_the_estimate(name, method):
    formula, density = PRIORS[name]
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["atan(3*x)"], observation_kind="samples", observation_noise=[["0.1"]],
        prior={"kind": "density", "log_density": formula},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record(TIMES, np.array(VALUES)[:, None], "samples"), method)
    mean, deviation, total = dense(density)
    worst = max(
        np.max(np.abs(result.mean[1:, 0] - mean) / deviation),
        np.max(np.abs(np.sqrt(result.variance[1:, 0]) / deviation - 1)),
        abs(result.log_likelihood - total),
    )
    assert worst < 2e-4
    assert worst < 10 * np.nanmax(result.health["error_estimate"])


@pytest.mark.parametrize("jump", ["log(heaviside(x))", "3*heaviside(x)"])
def test_auto_leaves_the_sums_of_gaussians_at_a_jump_and_a_named_one_names_another(jump):
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples", observation_noise=[["0.1"]],
        prior={"kind": "density", "log_density": f"-x**2/2 + {jump}"},
    )  # fmt: skip
    record = zakai.Record(TIMES, np.array(VALUES)[:, None], "samples")
    result, other = zakai.filter(model, record), zakai.filter(model, record, "yau-yau")
    assert result.method == "limited-direct" and not result.warnings
    assert np.allclose(result.mean, other.mean, rtol=0, atol=1e-4)
    with pytest.raises(zakai.InputError, match='jump; give method="yau-yau"'):
        zakai.filter(model, record, "kalman-bucy")


def test_a_function_that_does_not_decay_is_still_no_density():
    model = zakai.Model(
        state=["x"], drift=["-x**3"], observation=["x"], observation_kind="increments",
        prior={"kind": "density", "log_density": "log(heaviside(x)) - atan(x)"},
    )  # fmt: skip
    with pytest.raises(zakai.InputError, match="does not decay"):
        zakai.online(model)
