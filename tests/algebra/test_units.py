"""Which methods hold does not depend on the unit of the state."""

import pytest

import zakai

DRIFTS = {
    "cubic": "x*(1 - (x/u)**2)",
    "logistic": "x*(1 - x/u)",
    "rational": "x/(1 + (x/u)**2)",
    "sine": "u*sin(x/u)",
    "tanh": "u*tanh(x/u)",  # of Benes' class
    "linear": "u - x",
}


def methods(drift, unit):
    analysis = zakai.analyze(
        zakai.Model(
            state=["x"],
            drift=[drift.replace("u", unit)],
            diffusion=[[unit]],
            observation=[f"x/{unit}"],
            observation_kind="samples",
            prior={"kind": "gaussian", "mean": [0.0], "cov": [[float(unit) ** 2]]},
        )
    )
    return analysis.recommended, {
        name: all(one.holds is True for one in conditions) for name, conditions in analysis.methods.items()
    }


@pytest.mark.parametrize("unit", ["1e-10", "1e10", "1e22"])
@pytest.mark.parametrize("drift", DRIFTS)
def test_the_same_methods_hold_in_every_unit(drift, unit):
    assert methods(DRIFTS[drift], unit) == methods(DRIFTS[drift], "1")


@pytest.mark.parametrize("unit", [f"1e-{k}" for k in range(9, 15)])
def test_a_steep_tanh_is_recognised(unit):
    assert methods("u*tanh(x/u)", unit)[0] == "benes"
