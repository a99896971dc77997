"""Density grids where they cannot keep the tolerance: the filter ends, warns, and goes on."""

from __future__ import annotations

import numpy as np

import zakai

CUBIC = {
    "state": ["x", "y"], "drift": ["-x + y/2", "-y**3"], "observation": ["x", "y"], "observation_kind": "samples",
    "observation_noise": [["1/10", "0"], ["0", "1/10"]], "prior": {"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]},
}  # fmt: skip


def test_a_fill_value_in_two_states_warns_with_its_time_and_does_not_end_the_filter():
    model, times = zakai.Model(**CUBIC), 0.1 * np.arange(1, 13)
    _, record = zakai.simulate(model, times, seed=1)
    values = np.asarray(record.values).copy()
    values[3] = 1e8
    result = zakai.filter(model, zakai.Record(times, values, "samples"), "yau-yau")
    assert any("most at t = 0.4" in text for text in result.warnings)
    without = values.copy()
    without[3] = np.nan
    expected = zakai.filter(model, zakai.Record(times, without, "samples"), "yau-yau")
    assert not expected.warnings
    assert np.abs(result.mean[-1] - expected.mean[-1]).max() < 1e-2 * np.sqrt(expected.variance[-1]).min()


def test_a_density_that_no_grid_of_three_states_holds_ends_with_a_warning():
    # The density of Lorenz' attractor is a sheet that is far thinner than the spacing of the largest grid.
    model = zakai.Model(
        state=["x", "y", "z"], drift=["10*(y - x)", "x*(28 - z) - y", "x*y - 8/3*z"], observation=["x"],
        observation_kind="samples", observation_noise=[["4"]], process_noise=np.eye(3).tolist(),
        prior={"kind": "gaussian", "mean": [0, 0, 25], "cov": [60, 80, 70]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.2], [[6.0]], "samples"), "yau-yau")
    assert any("tolerance_ratio exceeds 1" in text for text in result.warnings)
    assert result.density(1).log_values.size < 500_000 and np.isfinite(result.mean).all()
