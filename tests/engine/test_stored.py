"""What a stored result answers."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import xarray

import zakai
from zakai.cli import main
from zakai.errors import InputError

WELLS = zakai.Model(
    state=["x"], drift=["x - x**3 + u"], observation=["x"], observation_kind="samples", observation_noise=[["0.2"]], inputs=["u"],
    prior={"kind": "gaussian", "mean": [0.5], "cov": [[0.5]]},
)  # fmt: skip
PAIR = zakai.Model(
    state=["x", "y"], drift=["-x", "sin(y)"], observation=["x", "y"], observation_kind="samples",
    prior={"kind": "gaussian", "mean": [0, 0], "cov": [[1, 0], [0, 1]]},
)  # fmt: skip


def record_of(model):
    inputs = zakai.Inputs([0.0, 0.6], np.ones((2, 1))) if model.inputs else None
    return zakai.simulate(model, np.arange(0.1, 0.85, 0.1), seed=1, inputs=inputs)[1]


@pytest.mark.parametrize("model", [WELLS, PAIR], ids=["one state with an input", "two blocks"])
@pytest.mark.parametrize("call", [zakai.filter, zakai.smooth])
def test_a_result_that_was_stored_with_densities_answers_as_before(model, call, tmp_path):
    result = call(model, record_of(model))
    result.save(tmp_path / "result.nc", densities=True)
    stored = zakai.load_result(tmp_path / "result.nc")
    points = np.zeros((3, model.n)) + np.array([[-0.5], [0.0], [0.9]])
    assert stored.has_densities and type(stored) is type(result)
    for k in (0, 7, -1):
        np.testing.assert_allclose(stored.density(k).log_density(points), result.density(k).log_density(points), rtol=1e-9)
    np.testing.assert_allclose(stored.quantile([0.1, 0.6]), result.quantile([0.1, 0.6]), rtol=1e-9)
    np.testing.assert_allclose(stored.residuals(), result.residuals(), rtol=1e-9)
    np.testing.assert_allclose(stored.forecast([3.0, 4.0]).mean, result.forecast([3.0, 4.0]).mean, rtol=1e-9)
    if call is zakai.smooth:
        np.testing.assert_array_equal(stored.sample_paths(3), result.sample_paths(3))
    stored.save(tmp_path / "again.nc", densities=True) if call is zakai.filter else None
    assert stored.plot().get_ylabel() == "x"


def test_quantiles_are_stored_without_the_densities(tmp_path):
    result = zakai.filter(WELLS, record_of(WELLS))
    result.save(tmp_path / "result.nc")
    stored = zakai.load_result(tmp_path / "result.nc")
    np.testing.assert_array_equal(stored.quantile([0.975, 0.05]), result.quantile([0.975, 0.05]))
    np.testing.assert_array_equal(stored.quantile(0.5), result.quantile(0.5))
    opened = xarray.open_dataset(tmp_path / "result.nc", engine="h5netcdf")
    np.testing.assert_array_equal(opened["quantile"].sel(level=0.25), result.quantile(0.25))
    for ask in (lambda: stored.quantile(0.3), lambda: stored.density(1), stored.residuals, lambda: stored.forecast([5.0])):
        with pytest.raises(InputError, match="densities=True"):
            ask()


def test_a_table_has_moments_and_quantiles(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = zakai.filter(PAIR, record_of(PAIR))
    (tmp_path / "model.toml").write_text(PAIR.to_toml())
    record_of(PAIR).to_csv("record.csv")
    assert main(["filter", "model.toml", "record.csv", "-o", "result.csv"]) == 0
    rows = list(csv.DictReader((tmp_path / "result.csv").read_text().splitlines()))
    assert [float(row["time"]) for row in rows] == result.times.tolist()
    np.testing.assert_allclose([float(row["y"]) for row in rows], result.mean[:, 1], rtol=1e-12)
    np.testing.assert_allclose([float(row["y_deviation"]) ** 2 for row in rows], result.variance[:, 1], rtol=1e-12)
    np.testing.assert_allclose([float(row["y_q0.95"]) for row in rows], result.quantile(0.95)[:, 1], rtol=1e-12)
    with pytest.raises(InputError, match=r"save: .* ends in \.nc"):
        result.save("result.csv", densities=True)


def test_what_cannot_be_computed_again_is_refused(tmp_path):
    result = zakai.filter(WELLS, record_of(WELLS))
    with pytest.raises(InputError, match="forecast"):
        result.forecast([5.0]).save(tmp_path / "ahead.nc", densities=True)
    result.save(tmp_path / "plain.nc")
    with pytest.raises(InputError, match="record"):
        zakai.load_result(tmp_path / "plain.nc").save(tmp_path / "again.nc", densities=True)
    result.mean[3] += 0.1  # as if another version had computed it
    result.save(tmp_path / "other.nc", densities=True)
    with pytest.raises(InputError, match=r"other.nc: was computed with another version"):
        zakai.load_result(tmp_path / "other.nc").density(3)
