"""The example of a ship that is seen by its bearing alone."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

import zakai

FOLDER = Path(__file__).parents[2] / "examples" / "bearings"


def test_the_first_bearings_tell_the_direction_and_the_picture_is_drawn(tmp_path):
    spec = importlib.util.spec_from_file_location("bearings_picture", FOLDER / "picture.py")
    picture = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(picture)
    model, truth, record = picture.track()
    first = zakai.Record(record.times[:4], record.values[:4], record.kind)
    result = zakai.filter(model, first, method="tensor-train")
    mean, cov = result.mean[-1], result.cov[-1]
    boat = np.array([0.3 * first.times[-1], 2 * np.sin(0.25 * first.times[-1])])
    along = (mean[:2] - boat) / np.linalg.norm(mean[:2] - boat)
    across = np.array([-along[1], along[0]])
    assert along @ cov[:2, :2] @ along > 30 * across @ cov[:2, :2] @ across
    assert np.all(np.abs(mean - truth.values[4]) < 4 * np.sqrt(np.diag(cov)))
    picture.save_figure(picture.draw(result, truth, record, [2, 4]), tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 20_000
