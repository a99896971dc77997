"""What is said where steps missed the tolerance: by how much the means may be off, and from when on."""

import numpy as np
import pytest

import zakai
from zakai.notes.health import warnings_of_run


@pytest.mark.parametrize(
    ("errors", "words"),
    [
        ([0, 5e-4, 9e-4, 2e-4], None),
        ([0, 5e-4, 0.03, 0.2], "off by about 0.2 deviations, from t = 0.2 on"),
        ([0, 4e3, 2.0, np.nan], "off by an unknown amount, from t = 0.1 on"),
    ],
)
def test_an_estimate_says_how_far_and_since_when(errors, words):
    model = zakai.Model(
        state=["x"], drift=["-x"], observation=["x"], observation_kind="samples",
        prior={"kind": "gaussian", "mean": [0], "cov": [[1]]},
    )  # fmt: skip
    result = zakai.filter(model, zakai.Record([0.1, 0.2, 0.3], [0.1, 0.3, 0.2], "samples"), "yau-yau")
    assert result.warnings == []
    result.health["error_estimate"] = np.array(errors)
    result.health["tolerance_ratio"] = np.array([np.nan, 7.0, 3.0, 2.0])
    found = warnings_of_run(result)
    assert found == [] if words is None else len(found) == 1 and words in found[0] and "up to 7" in found[0]
