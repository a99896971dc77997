"""Tables of two arguments, whose grid may be as long in one as in the other."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline, RegularGridInterpolator

import zakai

X = np.linspace(-3.0, 4.0, 12)


@pytest.mark.parametrize("Y", [X, np.linspace(-2.0, 5.0, 12), np.linspace(-2.0, 5.0, 9)], ids=["the same", "as long", "shorter"])
@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_values_have_the_first_argument_along_the_rows(kind, Y):
    values = np.sin(X)[:, None] + 0.3 * X[:, None] * Y + Y**2
    model = zakai.Model(
        state=["x", "y"],
        drift=["0", "0"],
        diffusion=[["0.1", "0"], ["0", "0.1"]],
        observation=["T(x, y)"],
        observation_kind="samples",
        observation_noise=[[1e-12]],
        tables={"T": {"x": X, "y": Y, "values": values, "kind": kind}},
        prior={"kind": "gaussian", "mean": [0.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]},
    )
    reference = RegularGridInterpolator((X, Y), values) if kind == "linear" else RectBivariateSpline(X, Y, values).ev
    for x, y in [(0.33, 1.21), (2.9, -1.7), (-2.2, 3.4)]:
        _, record = zakai.simulate(model, [0.0], seed=0, initial=[x, y])
        expected = float(reference([x, y])[0] if kind == "linear" else reference(x, y))
        assert record.values[0, 0] == pytest.approx(expected, abs=1e-5)
