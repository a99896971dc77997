"""zakai smooth"""

from __future__ import annotations

import numpy as np

import zakai as library


def test_the_command_writes_what_the_function_returns(zakai, tmp_path):
    answer = zakai("smooth", "model.toml", "record.csv", "-o", "smoothed.nc", "--report", "smoothed.html")
    assert answer.code == 0 and "x at the start" in answer.out and (tmp_path / "smoothed.html").stat().st_size > 1000
    model = library.load_model(tmp_path / "model.toml")
    result = library.smooth(model, library.read_record(tmp_path / "record.csv", model))
    np.testing.assert_array_equal(library.load_result(tmp_path / "smoothed.nc").mean, result.mean)


def test_a_method_without_a_smoother_is_refused_before_anything_is_written(zakai, tmp_path):
    choice = ("--method", "gaussian-sum", "--option", "reduction=algorithm-1")
    answer = zakai("smooth", "model.toml", "record.csv", "-o", "smoothed.nc", *choice)
    assert answer.code != 0 and answer.err.count("\n") == 1 and "no backward pass" in answer.err
    assert not (tmp_path / "smoothed.nc").exists()
